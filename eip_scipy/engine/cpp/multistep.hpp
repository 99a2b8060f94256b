// Multistep steps for q'' = a(t, q): what the rest of the engine knows of them (nodes.hpp has the steps).
#pragma once

#include "floats.hpp"
#include "system.hpp"

namespace eip {

// Places in Multistep::place: whether there is a history, the newest node and its row, nodes since the last projection,
// and estimates collected.
enum Node : int { HAVE_NODES, NEWEST, NEWEST_ROW, SINCE, SEEN, N_NODE_PLACES };
inline double *newest(const Multistep &ms) { return ms.nodes + ms.place[NEWEST_ROW] * ms.pitch; }

// The derivative of a state so many nodes before the newest: its velocity, and its acceleration as the history has it.
inline void slope_of(const Multistep &ms, int64_t back, const double *y, double *f) {
    copy(y + ms.half, f, ms.half);
    copy(newest(ms) - back * ms.pitch, f + ms.half, ms.half);
}

// From the state y at step k to that at step `stop`, whose derivative is left in w.last(). OK, NOT_FINITE,
// FAILED_PROJECTION or UNSTABLE.
Code next_states(const Run &run, const Span &span, double *clock, int64_t k, int64_t stop, const double *y,
                 double *y_new);

}  // namespace eip
