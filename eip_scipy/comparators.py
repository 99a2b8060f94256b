"""Old name of the module `eip_scipy_studies.comparators`: its names are still available here, with a warning."""

from .core.moved import moved_names

__getattr__ = moved_names("eip_scipy.comparators")
