"""The step and all it is made of: in C++, and for ensembles compiled by Numba."""
