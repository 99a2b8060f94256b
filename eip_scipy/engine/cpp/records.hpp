// Conversion of the records that Python makes (`fields` in data.hpp, loop.hpp and members.hpp) and of the addresses of
// functions to the structures that the steps use. Everything that comes from Python is checked here, once. The arrays
// of a run keep their memory, so that Python reads what the engine writes.
#pragma once

#include "arrays.hpp"

#include "engine.hpp"

namespace eip {

// The buffers of a run: a record of arrays, which Python reads during the run. A complex state has two floats per number.
struct Buffers {
    nb::handle record;
    Work work{};
    int64_t blocks = 0;
    int type = NPY_DOUBLE;

    Buffers(nb::handle record, nb::list &kept);
    Array array(const char *name) const { return nb::borrow<Array>(nb::object(record.attr(name))); }
};

// Objects to which the steps of a run refer.
struct Data {
    Method method;
    Multistep multistep;
    Options options;
    Work work;
    System system;
};

// Reading adds to `kept` what has to live as long as the engine.
Method method_of(nb::handle method, bool has_tableau, nb::list &kept);
// Data of a multistep method in addition to the buffers of the run; its history, which Python may fill.
Multistep multistep_of(nb::handle record, const Work &w, nb::list &kept);
void check_history(const Multistep &multistep);
// Reads the options, and also sets what the buffers contain of them: the targets, and scratch memory of the frame.
Options options_of(nb::handle options, Work &w, int64_t blocks, nb::list &kept);
Schedule schedule_of(nb::handle schedule, nb::list &kept);
Samples samples_of(nb::handle dense, const Data &run, int64_t events, int type, nb::list &kept);
Members members_of(nb::handle members, const Data &run, const Schedule &schedule, int type, nb::list &kept);
// Functions of eight members of the run.
BatchFunctions batch_functions_of(nb::handle functions, const Data &run);
// The balances among the invariants; their rates by pointer are read with the other functions.
void read_balances(nb::handle functions, const Work &w, System &system);
// Functions by pointer; `columns` must live as long as the system.
void read_pointers(nb::handle functions, const Work &w, const Columns &columns, int64_t events, nb::list &kept,
                   System &system);

// Refuses functions whose values are another number of floats.
void require_floats(const char *name, int64_t total, int64_t expected);
// Attributes of a record.
double number(const nb::object &object);
bool truth(const nb::object &object);
// The records' types, and the function that makes the buffers of a run, in the module.
void add_records(nb::module_ &module);

}  // namespace eip
