"""Adapters to other packages, each behind an extra.

`rebound` (problems and runs in and out; reference integrators), `astropy` (units and dates), `gala` (orbits in
galaxies), `jpl` (ephemerides), `dask` (clusters).
"""
