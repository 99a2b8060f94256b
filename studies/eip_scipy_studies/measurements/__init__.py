"""Measurements of the numbers in the documentation; most modules are one command ``eip-scipy study NAME``."""
