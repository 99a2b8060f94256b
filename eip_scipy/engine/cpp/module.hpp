// Parts of the module, by subject.
#pragma once

#include "arrays.hpp"

namespace eip {

void add_library(nb::module_ &module);
void add_examination(nb::module_ &module);
void add_condensates(nb::module_ module);
void add_fields(nb::module_ module);
void add_comparators(nb::module_ module);
void add_gradients(nb::module_ module);
void add_gravity(nb::module_ module);
void add_multibody(nb::module_ module);

}  // namespace eip
