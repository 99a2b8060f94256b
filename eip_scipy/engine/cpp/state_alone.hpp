// The state alone of a run whose states have columns of derivatives behind them: what follows the stages of a step looks at
// nothing else, and costs what it costs without columns.
#pragma once

#include "columns.hpp"

namespace eip {

// Return whether the state is at the front and its functions are called by pointer. Batches of members have none.
template <class AnyRun>
inline bool has_state_alone(const AnyRun &) {
    return false;
}
template <class W>
inline bool has_state_alone(const RunOf<W, System> &run) {
    return run.system.columns && run.options.columns.half == 0;
}

// Call with a run of the state alone, on the front of the buffers; by code of its own for short states, as in engine.cpp. HAVE_F
// is OF_STATE where f is that of the state alone too.
template <class Call>
inline auto of_state_alone(const Run &run, const Call &call) {
    Work front(run.work);
    front.n = front.m = run.options.columns.size;
    front.behind = run.work.m - front.m;
    const auto by = [&]<class W>(const W &work) {
        return call(RunOf<W, System>{run.method, run.options, work, run.system, run.hooks});
    };
    if (front.m == 4 && front.l == 2) return by(SizedWith<4, 2>(front));
    return front.m == 6 ? by(Sized<6>(front)) : by(front);
}

// The columns behind a state that has been projected, step.y_new.
inline void project_columns_behind(const Run &run, const Step &step) {
    if (!has_state_alone(run)) return project_columns(run, step);
    of_state_alone(run, [&](const auto &alone) { project_columns(alone, step); });
}

// The projection of the state, and that of its columns.
[[gnu::noinline]] inline Code project_with_columns(const Run &run, const Step &step) {
    const int64_t size = run.options.columns.size;
    Code status;
    if (has_state_alone(run)) {
        status = of_state_alone(run, [&](const auto &alone) { return project_any(alone, step); });
        copy(run.work.y_hat + size, step.y_new + size, run.work.m - size);
    } else {
        status = project_any(run, step);
    }
    if (status == OK) project_columns_behind(run, step);
    return status;
}

template <class AnyRun>
inline Code project_whole(const AnyRun &run, const Step &step) {
    return project_any(run, step);
}
template <class W>
inline Code project_whole(const RunOf<W, System> &run, const Step &step) {
    if (run.options.columns.count > 0) [[unlikely]]
        return project_with_columns(of_any_length(run), step);
    return project_any(run, step);
}

}  // namespace eip
