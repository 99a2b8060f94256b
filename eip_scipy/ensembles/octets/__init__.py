"""Functions jitted by Numba for eight members of an ensemble at once; loaded only where a function is jitted."""
