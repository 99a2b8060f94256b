"""The right-hand side on arrays of any library that follows the array API standard: NumPy, JAX and others."""

from __future__ import annotations

from typing import Any

from .equation import GrossPitaevskii
from .transforms import Axes

__all__ = ["ArrayGrossPitaevskii", "multiply_modes"]


def multiply_modes(field: Any, axes: Axes, factor: Any, fft: Any) -> Any:
    """Transform a field along some axes, multiply by a real factor, transform back.

    Parameters
    ----------
    field, factor : array
        Of one library; the factor broadcasts to the field.
    axes : tuple of int
    fft : module
        The library's ``fft``; not every array knows its library.

    Returns
    -------
    array
    """
    return fft.ifftn(factor * fft.fftn(field, axes=axes), axes=axes)


class ArrayGrossPitaevskii:
    """The right-hand side of a `GrossPitaevskii` as a function of arrays without side effects.

    Parameters
    ----------
    gpe : GrossPitaevskii
    xp : module
        A library of the array API standard (2022.12 or later, with its extension `fft`): ``numpy``, ``jax.numpy``.

    Raises
    ------
    ValueError
        When its arrays are not of double precision, as JAX's are unless ``jax_enable_x64`` is set.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap
    >>> from eip_scipy.problems.gross_pitaevskii import ArrayGrossPitaevskii
    >>> gpe = GrossPitaevskii(Grid((16, 16), -5, 5), harmonic_trap(1, 1), Omega=0.5, beta=10)
    >>> y = np.exp(-sum(a**2 for a in gpe.grid.mesh()) + 0j).ravel()
    >>> bool(np.allclose(ArrayGrossPitaevskii(gpe, np).fun(0, y), gpe.fun(0, y)))
    True
    """

    def __init__(self, gpe: GrossPitaevskii, xp: Any) -> None:
        self._xp, self._shape, self._beta = xp, gpe.grid.shape, gpe.beta
        self._V = self._real(gpe.V)
        self._terms = [(axes, self._real(factor)) for axes, factor in gpe.linear_terms()]

    def _real(self, values: Any) -> Any:
        array = self._xp.asarray(values)
        if array.dtype != self._xp.float64:
            raise ValueError(
                f"{self._xp.__name__} made {array.dtype} of float64; invariants need double precision. With JAX call "
                'jax.config.update("jax_enable_x64", True) first.'
            )
        return array

    def fun(self, t: float, y: Any) -> Any:
        """-i H(psi) psi, flat, of a flat array; for `solve_ivp` and for the library's own compiler."""
        xp = self._xp
        psi = xp.reshape(xp.asarray(y), self._shape)
        image = (self._V + self._beta * (xp.real(psi) ** 2 + xp.imag(psi) ** 2)) * psi
        for axes, factor in self._terms:
            image = image + multiply_modes(psi, axes, factor, xp.fft)
        return xp.reshape(-1j * image, (-1,))
