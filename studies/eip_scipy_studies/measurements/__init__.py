"""Measurements behind the numbers of the documentation, a module for each."""
