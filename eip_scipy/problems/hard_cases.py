"""The former place of `eip_scipy_studies.hard_cases`."""

from ..core.moved import moved_names

__getattr__ = moved_names("eip_scipy.problems.hard_cases")
