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

// The lengths of states for which there is code of its own; none in the build for the oldest processors.
#if defined(__x86_64__) && !defined(__AVX2__)
using Lengths = std::integer_sequence<int64_t>;
#else
using Lengths = std::integer_sequence<int64_t, 2, 3, 4, 6, 8>;
#endif

template <typename Call, int64_t... M>
Code by_length_of(const Run &run, Call call, std::integer_sequence<int64_t, M...>) {
    Code code = OK;
    const bool found = ((run.work.m == M && (code = with_work<Sized<M>>(run, call), true)) || ...);
    return found ? code : call(run);
}

// Many steps by `call`, which takes a RunOf: by code of its own for short states where no function is Python's.
template <typename Call>
Code by_length(const Run &run, Call call) {
    if (run.system.python || run.hooks || run.work.n != run.work.m) return call(run);
    if constexpr (Lengths::size() > 0)
        if (run.work.m == 4 && run.work.l == 2 && is_plain(run.method, run.options))
            return with_work<Plain<4, 2>>(run, call);
    return by_length_of(run, call, Lengths());
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
