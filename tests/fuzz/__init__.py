"""Random systems with random options, and runs that are killed, for any length of time."""
