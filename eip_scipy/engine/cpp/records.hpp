// From the records of data.py to what the steps take. What comes from Python is looked at here, once; all arrays of a run
// keep their memory, so that Python reads what the engine writes.
#pragma once

#include "python.hpp"

#include "engine.hpp"

namespace eip {

// What the steps of a run refer to.
struct Data {
    Method method;
    Multistep multistep;
    Options options;
    Work work;
    System system;
};

Method method_of(PyObject *method, Arrays &arrays);
// Coefficients, which a one-step method of a user's own has none of.
void read_tableau(PyObject *method, Arrays &arrays, Method &m);
// What a multistep method holds besides the run's buffers; its history, which Python may fill.
Multistep multistep_of(PyObject *record, const Work &w, Arrays &arrays);
void check_history(const Multistep &multistep);
Work work_of(PyObject *work, int64_t stages, int64_t blocks, Arrays &arrays, int type);
// Sets what the buffers hold of them too: targets, scratch of the frame.
Options options_of(PyObject *options, Work &w, Arrays &arrays);
Schedule schedule_of(PyObject *schedule, Arrays &arrays);
Samples samples_of(PyObject *dense, const Data &run, int64_t events, Arrays &arrays, int type);
// `rows` are saved of each member.
Members members_of(PyObject *members, const Data &run, const Schedule &schedule, int64_t rows, Arrays &arrays,
                   int type);
// Functions of eight members of the run.
OctetSystem octet_system_of(PyObject *functions, const Data &run);
// Functions by pointer.
void read_pointers(PyObject *functions, const Work &w, int64_t events, Arrays &arrays, System &system);

}  // namespace eip
