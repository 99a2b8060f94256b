"""The former place of `eip_scipy_studies.comparators`."""

from .core.moved import moved_names

__getattr__ = moved_names("eip_scipy.comparators")
