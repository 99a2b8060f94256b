"""Splitting methods for the Gross-Pitaevskii equation as one-step methods: explicit, unitary, stable for any step."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...core.names import nearest
from .flows import LinearFlow
from .pointwise import local_flow

if TYPE_CHECKING:
    from .equation import GrossPitaevskii

__all__ = ["RKN6", "S6", "STRANG", "Scheme", "Splitting"]


class Scheme(NamedTuple):
    """Coefficients of a symmetric splitting: flows of the local part and of the linear part in turn.

    Attributes
    ----------
    name : str
    order : int
    local : tuple of float, length s + 1
        Fractions of the step for the flows of ``V + beta |psi|^2``, which multiply the field by a phase at each point.
    linear : tuple of float, length s
        Fractions of the step for the flows of -Laplace / 2 - Omega Lz, each between two local flows.
    reference : str
        Citation of the scheme.
    """

    name: str
    order: int
    local: tuple[float, ...]
    linear: tuple[float, ...]
    reference: str


def _palindrome(half: tuple[float, ...], *, odd: bool, total: float = 1.0) -> tuple[float, ...]:
    """Return symmetric coefficients with the sum `total` from the first ones; those in the middle follow from it."""
    rest = total - 2 * sum(half)
    return (*half, rest, *half[::-1]) if odd else (*half, rest / 2, rest / 2, *half[::-1])


STRANG = Scheme("strang", 2, (0.5, 0.5), (1.0,), "Strang, SIAM J. Numer. Anal. 5 (1968) 506")
S6 = Scheme(
    "s6",
    4,
    _palindrome((0.0792036964311957, 0.353172906049774, -0.0420650803577195), odd=True),
    _palindrome((0.209515106613362, -0.143851773179818), odd=False),
    "Blanes & Moan, J. Comput. Appl. Math. 142 (2002) 313, table 2, S6 of order 4",
)
RKN6 = Scheme(
    "rkn6",
    4,
    _palindrome((0.0829844064174052, 0.396309801498368, -0.0390563049223486), odd=True),
    _palindrome((0.245298957184271, 0.604872665711080), odd=False),
    "Blanes & Moan, J. Comput. Appl. Math. 142 (2002) 313, table 3, SRKN6b of order 4",
)
SCHEMES = {scheme.name: scheme for scheme in (STRANG, S6, RKN6)}


class Splitting:
    """One-step method that solves the linear part, with the rotation, and the local part alternately, both exactly.

    Parameters
    ----------
    gpe : GrossPitaevskii
        The equation; its buffers and transforms are used.
    scheme : {"rkn6", "s6", "strang"} or Scheme, optional
        "rkn6" and "s6": of order 4, by Blanes and Moan; the former is made for Hamiltonians whose one part is quadratic
        in the momenta, as here. "strang": of order 2.

    Attributes
    ----------
    gpe, scheme
    order : int
    evaluations : int
        Number of linear flows in a step. Each takes about as many transforms as an evaluation of the right-hand side.
    name : str

    Raises
    ------
    ValueError
        If the scheme is unknown.

    Notes
    -----
    ``|psi|^2`` is constant in the local flow, which therefore only changes the phase. Every flow is unitary and
    reversible, and so are the steps: the mass is conserved to round-off, and a step back undoes a step. The energy is
    not conserved without a projection.

    Examples
    --------
    >>> from eip_scipy import eip_method, integrate
    >>> from eip_scipy.problems import Splitting, soliton
    >>> scene = soliton(t_end=1.0, h=0.02)
    >>> run = integrate(scene, method=eip_method(Splitting(scene.equation, "s6")))
    >>> bool((run.max_defect < 4e-13).all()), bool(abs(run.y[:, -1] - scene.reference(1.0)).max() < 1e-6)
    (True, True)
    """

    def __init__(self, gpe: GrossPitaevskii, scheme: str | Scheme = "rkn6") -> None:
        if not isinstance(scheme, Scheme):
            if scheme not in SCHEMES:
                names = ", ".join(map(repr, SCHEMES))
                raise ValueError(f"unknown scheme {scheme!r}, expected {names} or a Scheme{nearest(scheme, SCHEMES)}")
            scheme = SCHEMES[scheme]
        self.gpe, self.scheme = gpe, scheme
        self.order, self.name = scheme.order, f"splitting-{scheme.name}"
        self.evaluations = len(scheme.linear)
        self._h: float | None = None
        self._flows: list[LinearFlow] = []

    def __repr__(self) -> str:
        return f"Splitting({self.gpe!r}, {self.scheme.name!r})"

    def one_step(self, t: float, y: np.ndarray, h: float) -> np.ndarray:
        """Make one step of length h; `y` is overwritten and returned."""
        if h != self._h:
            self._flows, self._h = self._linear_flows(h), h
        gpe, scheme = self.gpe, self.scheme
        psi = y.reshape(gpe.grid.shape)
        field, work = psi, np.empty_like(psi)
        for part, flow in zip(scheme.local, self._flows, strict=False):
            local_flow(field, gpe.V, gpe.beta, part * h)
            field, work = flow.apply(field, work)
        local_flow(field, gpe.V, gpe.beta, scheme.local[-1] * h)
        if field is not psi:
            psi[...] = field
        return y

    def _linear_flows(self, h: float) -> list[LinearFlow]:
        made = {part: LinearFlow(self.gpe, part * h) for part in set(self.scheme.linear)}
        return [made[part] for part in self.scheme.linear]
