"""Places of the numbers that the step counts and leaves for the next one."""

NFEV, NJEV, NLU, PROJECTIONS, SKIPPED, RANK_REDUCED, REJECTED, LAST_RANK, HAVE_F, SOFTENED = range(10)
# Whether an estimate of the step's error is at hand, projections begun without one, steps since the last projection,
# and what stood out in them.
HAVE_ERROR, BEGUN, WAITED, FOUND = range(10, 14)
N_COUNTERS = 14
