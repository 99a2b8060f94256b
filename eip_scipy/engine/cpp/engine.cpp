#include "engine.hpp"

#include "batch_loop.hpp"

namespace eip {
namespace {

template <class W, typename Call>
Code with_work(const Run &run, Call call) {
    const W work(run.work);
    const typename W::Method method(run.method);
    const typename W::Options options(run.options);
    return call(RunOf<W>{method, options, work, run.system, nullptr});
}

// Many steps by `call`, which takes a RunOf: where no function is Python's by code of its own for the short states of
// bodies in two and three dimensions.
template <typename Call>
Code by_length(const Run &run, Call call) {
    const bool able = !run.system.python && !run.hooks && run.work.n == run.work.m;
    if (able && run.work.m == 4 && run.work.l == 2 && is_plain(run.method, run.options))
        return with_work<Plain<4, 2>>(run, call);
    if (able && run.work.m == 4) return with_work<Sized<4>>(run, call);
    return able && run.work.m == 6 ? with_work<Sized<6>>(run, call) : call(run);
}

}  // namespace

Code advance_run(const Run &run, Samples *samples, const Schedule &s, int64_t k_end, double *y, double *y_new,
                 const Saved &saved) {
    return by_length(run, [&](const auto &sized) { return advance(sized, samples, s, k_end, y, y_new, saved); });
}

Code sweep_members(const Run &run, Samples *samples, const Schedule &s, const Members &members, int64_t steps,
                   double *y, double *y_new) {
    return by_length(run, [&](const auto &sized) { return sweep(sized, samples, s, members, steps, y, y_new); });
}

Code step_once(const Run &run, const Schedule &s, int64_t k, const double *y, double *y_new) {
    return next_step(run, s.span, s.clock, k, y, y_new);
}

Code project_once(const Run &run, const Step &step) { return project_any(run, step); }

void describe_step(const Run &run, const Dense &d, double t_old, const double *y_old, double t, const double *y,
                   double *piece) {
    const DenseRun dense(d, run.system);
    describe(run, dense, t_old, y_old, t, y, piece);
    count_calls(dense, run.work);
}

void show_state(const Run &run, const Samples &samples, int64_t end, double t, const double *y, double *out) {
    give(run, &samples, end, t, y, out);
}

void interpolate_step(const Run &run, const Dense &d, double *piece, const double *t, int64_t rows, double *out) {
    const DenseRun dense(d, run.system);
    for (int64_t k = 0; k < rows; ++k) interpolate(dense, piece, t[k], out + k * d.work.m);
    count_calls(dense, run.work);
}

}  // namespace eip
