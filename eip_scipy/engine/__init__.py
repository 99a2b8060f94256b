"""The step and all it is made of: compiled by Numba, or plain Python."""
