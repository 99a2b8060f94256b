"""Runs of the study `trust`: systems, faulty runs, correct runs."""
