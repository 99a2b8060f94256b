"""Runs of `trust`: systems, faulty runs, correct runs."""
