"""Adapters to other packages, each behind an extra.

`rebound` (problems and runs in and out; reference integrators), `astropy` (units and dates), `heyoka` (reference
integrator), `jpl` (ephemerides), `dask` (clusters), `mpi` and `mpi_fields` (states on several ranks).
"""
