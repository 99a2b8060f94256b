"""The step and all it is made of, in C++."""
