"""Fourier transforms of complex fields; only this module chooses the library and the number of threads."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec

import numpy as np
import scipy.fft

__all__ = ["LIBRARIES", "Transforms", "make_transforms"]

Axes = tuple[int, ...]


class Transforms:
    """Transforms of contiguous complex fields along some of their axes, without normalisation in both directions.

    Parameters
    ----------
    threads : int
    """

    name = ""
    # True if transforms along x are faster for some copied columns at a time than for a whole field.
    gains_by_strips = False

    def __init__(self, threads: int) -> None:
        self.threads = threads

    def forward(self, field: np.ndarray, axes: Axes, out: np.ndarray) -> None:
        """Fill `out` with the transform of `field`, sum_j field_j exp(-i k x_j), along `axes`."""
        raise NotImplementedError

    def backward(self, field: np.ndarray, axes: Axes) -> None:
        """Replace `field` by its inverse transform along `axes`, times the number of points along them."""
        raise NotImplementedError


class _SciPy(Transforms):
    name = "scipy"
    gains_by_strips = True

    def forward(self, field: np.ndarray, axes: Axes, out: np.ndarray) -> None:
        np.copyto(out, field)
        self._in_place(scipy.fft.fftn, out, axes, "backward")

    def backward(self, field: np.ndarray, axes: Axes) -> None:
        self._in_place(scipy.fft.ifftn, field, axes, "forward")

    def _in_place(self, transform: Callable[..., np.ndarray], field: np.ndarray, axes: Axes, norm: str) -> None:
        # SciPy may, but need not, overwrite what it is given.
        result = transform(field, axes=axes, norm=norm, overwrite_x=True, workers=self.threads)
        if result is not field:
            np.copyto(field, result)


class _Ducc(Transforms):
    name = "ducc0"

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        self._c2c = import_module("ducc0").fft.c2c

    def forward(self, field: np.ndarray, axes: Axes, out: np.ndarray) -> None:
        self._c2c(field, axes=axes, forward=True, out=out, nthreads=self.threads)

    def backward(self, field: np.ndarray, axes: Axes) -> None:
        self._c2c(field, axes=axes, forward=False, out=field, nthreads=self.threads)


LIBRARIES: dict[str, type[Transforms]] = {kind.name: kind for kind in (_Ducc, _SciPy)}  # the first one wins


def make_transforms(fft: str = "auto", threads: int = 1) -> Transforms:
    """Choose a library and return its transforms.

    Parameters
    ----------
    fft : {"auto", "ducc0", "scipy"}, optional
        "auto" chooses ducc0 if it is installed, which is about twice as fast, otherwise scipy. ducc0, which has the GPL
        licence, is installed by ``pip install "eip_scipy[fft]"``.
    threads : int, optional
        Threads of each transform. No other part of the right-hand side has threads, so that no two pools compete.

    Returns
    -------
    Transforms

    Raises
    ------
    ValueError
        If the name is unknown, or the number of threads is below 1.
    ImportError
        If the requested library is not installed.
    """
    if isinstance(threads, bool) or not isinstance(threads, (int, np.integer)) or threads < 1:
        raise ValueError(f"threads must be an integer >= 1, got {threads!r}.")
    if fft == "auto":
        fft = next(name for name in LIBRARIES if find_spec(name) is not None)
    if fft not in LIBRARIES:
        raise ValueError(f"fft must be 'auto' or one of {', '.join(map(repr, LIBRARIES))}, got {fft!r}.")
    if find_spec(fft) is None:
        raise ImportError(f"fft={fft!r} needs {fft}: pip install \"eip_scipy[fft]\", or use fft='scipy'.", name=fft)
    return LIBRARIES[fft](int(threads))
