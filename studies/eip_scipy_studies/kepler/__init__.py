"""The commands ``eip-scipy work-precision`` and ``reproduce fig-kepler``: Kepler's problem."""
