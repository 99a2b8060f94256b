"""Invariants, options, methods and results: what one step needs, whoever takes it."""
