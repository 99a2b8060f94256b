// Parts of the module, by subject.
#pragma once

#include "arrays.hpp"

#include <utility>

#include "calls.hpp"

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

// A module or class whose functions compute with subnormal numbers, whatever mode another library left behind.
template <class Base>
struct Guarded : Base {
    using Base::Base;
    Guarded(Base base) : Base(std::move(base)) {}

    template <class... Given>
    Guarded &def(Given &&...given) {
        Base::def(std::forward<Given>(given)..., nb::call_guard<FloatingPoint>());
        return *this;
    }
};

using Module = Guarded<nb::module_>;
template <class T>
using Class = Guarded<nb::class_<T>>;

void add_library(nb::module_ &module);
void add_examination(Module module);
void add_states(Module module);
void add_condensates(Module module);
void add_gradients(Module module);
void add_multibody(Module module);

}  // namespace eip
