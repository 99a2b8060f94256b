"""Random systems with random options, and runs that are killed: looked at for as long as one likes."""
