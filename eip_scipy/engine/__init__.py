"""The integration step and its parts, written in C++, and their interface to Python."""
