"""Functions jitted by Numba for batches of eight members; loaded only if a function is jitted."""
