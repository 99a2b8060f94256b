"""Adapters to other packages, each behind an extra: `rebound` (judge and source of problems), `jpl` (ephemerides)."""
