// Parts of the module, by subject.
#pragma once

#include "arrays.hpp"

namespace eip {

// Slots of a class whose objects refer to Python objects: the garbage collector visits `kept()`, and `clear()` releases them.
template <class T>
struct Collected {
    static int traverse(PyObject *self, visitproc visit, void *arg) {
        Py_VISIT(Py_TYPE(self));
        if (nb::inst_ready(self)) Py_VISIT(nb::inst_ptr<T>(self)->kept().ptr());
        return 0;
    }
    static int clear(PyObject *self) {
        nb::inst_ptr<T>(self)->clear();
        return 0;
    }
    static inline PyType_Slot slots[] = {{Py_tp_traverse, reinterpret_cast<void *>(traverse)},
                                         {Py_tp_clear, reinterpret_cast<void *>(clear)},
                                         {0, nullptr}};
};

void add_library(nb::module_ &module);
void add_examination(nb::module_ &module);
void add_condensates(nb::module_ module);
void add_gradients(nb::module_ module);
void add_multibody(nb::module_ module);

}  // namespace eip
