"""``work-precision``, and Kepler's problem among the paper's figures."""
