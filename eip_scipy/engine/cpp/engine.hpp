// Functions of the engine that the binding calls. Their templates are compiled once, in engine.cpp.
#pragma once

#include "batch.hpp"
#include "members.hpp"

namespace eip {

// The first two call `advance` (loop.hpp) and `sweep` (members.hpp), the third one is in batch_loop.hpp; comments there
// explain the codes that are returned.
Code advance_run(const Run &run, Samples *samples, const Schedule &s, int64_t k_end, double *y, double *y_new,
                 const Saved &saved);
Code sweep_members(const Run &run, Samples *samples, const Schedule &s, const Members &members, int64_t steps,
                   double *y, double *y_new);

Code sweep_batches(const Run &run, Batch &batch, Samples *samples, const Schedule &s, const Members &members,
                   int64_t steps, double *y, double *y_new);

// Step k of a run, and parts of a step: its projection, and what follows it.
Code step_once(const Run &run, const Schedule &s, int64_t k, const double *y, double *y_new);
Code project_once(const Run &run, const Step &step);

// The interpolant over a step of a run from y_old at t_old to y at t, and states at some times by it.
void describe_step(const Run &run, const Dense &dense, double t_old, const double *y_old, double t, const double *y,
                   double *piece);
// The state y at t, an end (0 or 1) of the current step, as a run returns it.
void show_state(const Run &run, const Samples &samples, int64_t end, double t, const double *y, double *out);
void interpolate_step(const Run &run, const Dense &dense, double *piece, const double *t, int64_t rows, double *out);

}  // namespace eip
