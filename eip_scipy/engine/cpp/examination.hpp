// First checks of the invariants of a run, at one of its states. If a check finds something, core/invariant_checks.py
// examines it in Python, and writes the messages.
#pragma once

namespace eip {

// Gradients are compared with central differences over steps of this length in units of the components' motion, and may
// differ by this fraction of the terms and by this number of roundings of the values.
constexpr double CHECK_STEP = 6e-6, CHECK_TOLERANCE = 1e-4, CHECK_NOISE = 6.0;
// The share of its terms by which an invariant may change along the flow.
constexpr double INVARIANCE_TOLERANCE = 1e-8;
// Derivatives in time are taken over this share of a step, and to both sides where as many of these shares have room.
constexpr double TIME_SHARE = 0.01, TIME_ROOM = 5.0;
// Short differences along the flow: their step, in the time in which the state moves by its size, and the share of the
// rate's terms from which on those to both sides differ. What curvature makes them differ by is half as large at half
// the step; what a kink does is not. Next to a kink of the slope, where terms may vanish, the differences to both
// sides differ by more than the rate that is found.
constexpr double SHORT = 1e-6, KINK = 1e-4, KEPT_AT_HALF = 0.6;
// The rounding of a value, in units of its terms.
constexpr double VALUE_ROUNDINGS = 4.0;

}  // namespace eip
