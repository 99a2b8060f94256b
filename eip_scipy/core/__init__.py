"""Invariants, options, methods and results: everything that one step needs."""
