"""Adapters to other packages, each behind an extra.

`rebound` (problems and runs in and out; reference integrators), `astropy` (units and dates), `heyoka` (its Taylor
integrator with projections, and as a reference), `gala` and `galpy` (orbits in galaxies), `qutip` (Schrödinger's
equation), `jpl` (ephemerides), `dask` (clusters), `mpi` and `mpi_fields` (states on several ranks).
"""
