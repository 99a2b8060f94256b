// Functions of the module beside the engine, by subject.
#pragma once

#include "python.hpp"

namespace eip {

extern PyMethodDef condensate_functions[], field_functions[], comparator_functions[], gradient_functions[];

}  // namespace eip
