"""Adapters to other packages, each behind an extra.

`rebound` (problems and runs in and out; a judge), `astropy` (units and dates), `heyoka` (peer), `jpl` (ephemerides),
`dask` (clusters), `mpi` and `mpi_fields` (states on several ranks).
"""
