"""Places of the numbers that the step counts and leaves for the next one."""

NFEV, NJEV, NLU, PROJECTIONS, SKIPPED, RANK_REDUCED, REJECTED, LAST_RANK, HAVE_F, SOFTENED = range(10)
# Whether an estimate of the step's error is at hand, projections begun without one, steps since the last projection,
# what stood out in them, and whether the last row of K holds f at the raw result.
HAVE_ERROR, BEGUN, WAITED, FOUND, F_AT_RAW = range(10, 15)
N_COUNTERS = 15
