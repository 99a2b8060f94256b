// Functions of the module beside the engine: of arrays, by subject.
#pragma once

#include "python.hpp"

namespace eip {

extern PyMethodDef condensate_functions[], field_functions[];

}  // namespace eip
