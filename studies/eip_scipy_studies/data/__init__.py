"""Data files of the studies."""
