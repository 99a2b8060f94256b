"""Adapters to other packages, each behind an extra.

`rebound` (judge and source of problems), `heyoka` (peer), `jpl` (ephemerides), `dask` (clusters), `mpi` and
`mpi_fields` (states on several ranks).
"""
