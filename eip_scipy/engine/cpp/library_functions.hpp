// The library's functions among Python's objects.
#pragma once

#include "python.hpp"

#include "library.hpp"

namespace eip {

// Their type, and a dictionary of them by name; false with an error set.
bool add_library(PyObject *module);
// What an object is, null for all others.
const LibraryFunction *library_function_of(PyObject *object);
// Refuses sizes that a function does not take.
void require_sizes(const LibraryFunction &function, int64_t n, int64_t p);

}  // namespace eip
