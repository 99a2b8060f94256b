"""Stiff systems by SciPy's implicit methods, with and without projection."""
