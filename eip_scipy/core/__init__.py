"""Invariants, projection options, problems, solvers and results: the code that all ways of running a method share."""
