"""Splitting methods for the Gross-Pitaevskii equation as one-step methods: explicit, unitary, stable for any step.

The flow of the linear part is exact, by factors of Fourier modes along axes in turn. Such flows also turn fields
between the rotating frame and the frame at rest, for potentials that are symmetric about the z axis.
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil, cos, pi, remainder, sin, tan
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...core.names import nearest
from .pointwise import local_flow
from .transforms import Axes

if TYPE_CHECKING:
    from .equation import FieldProblem, GrossPitaevskii

__all__ = ["RKN6", "S6", "STRANG", "LinearFlow", "Scheme", "Splitting", "at_rest", "rotated"]

LARGEST_TURN = pi / 4


class LinearFlow:
    """The flow exp(-i (time T - angle Lz)) with T = -Laplace / 2: a rotation by `angle` and free motion for `time`.

    Parameters
    ----------
    gpe : GrossPitaevskii
    time : float
        Time of the free motion.
    angle : float, optional
        Angle of the rotation. Default: ``gpe.Omega * time``, which gives the flow of the equation's linear part.

    Raises
    ------
    ValueError
        If the absolute value of the angle is above pi / 4, or the equation has one dimension and the angle is not 0.

    Notes
    -----
    The flow is exact in time. Without rotation it is one factor of all modes. With rotation there are three factors, of
    the modes along x, y and x again: ``exp(-i (a k^2 / 2 + c y k))``, ``exp(-i (b q^2 / 2 - d x q))`` and the first
    once more, with c = tan(angle / 2), d = sin(angle), a = time / (1 + cos(angle)), b = time cos(angle). For time = 0
    this is the rotation of images by three shears (Unser, Thevenaz & Yaroslavsky 1995); for splittings with the free
    motion see Bernier, Crouseilles & Li, J. Comput. Phys. 443 (2021) 110518. The values given here follow from the
    classical motion, which determines the flow of a quadratic Hamiltonian. On the grid the flow is unitary to
    round-off, and exact as far as the field and its spectrum vanish at the ends.
    """

    def __init__(self, gpe: GrossPitaevskii, time: float, angle: float | None = None) -> None:
        angle = gpe.Omega * time if angle is None else angle
        if abs(angle) > LARGEST_TURN * (1 + 1e-9):
            raise ValueError(
                f"the absolute value of the angle, by default Omega times time, must be at most pi / 4, got "
                f"{angle:.3g}; use shorter steps."
            )
        self._fft = gpe.transforms
        kinetic = [gpe.kinetic_factor(axis) for axis in range(gpe.grid.dim)]
        if angle == 0:
            axes = tuple(range(gpe.grid.dim))
            self._factors = [self._factor(gpe, axes, [time * sum(kinetic)])]
            return
        along_x, along_y = gpe.rotation_factors()
        others = tuple(range(1, gpe.grid.dim))
        x = self._factor(gpe, (0,), [time / (1 + cos(angle)) * kinetic[0] - tan(angle / 2) * along_x])
        y = [time * cos(angle) * kinetic[1] - sin(angle) * along_y, *(time * k for k in kinetic[2:])]
        self._factors = [x, self._factor(gpe, others, y), x]

    @staticmethod
    def _factor(gpe: GrossPitaevskii, axes: Axes, phases: list[Any]) -> tuple[Axes, list[np.ndarray]]:
        """Return `axes`, and the factors exp(-i phase) of the modes along them, the first with the normalisation."""
        points = int(np.prod([gpe.grid.shape[axis] for axis in axes]))
        first, *rest = (np.exp(-1j * phase) for phase in phases)
        return axes, [first / points, *rest]

    def apply(self, psi: np.ndarray, work: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the array that contains the field after the flow from `psi`, and the other one of the two arguments.

        Both arrays are overwritten; the content of `work` is not used.
        """
        for axes, factors in self._factors:
            self._fft.forward(psi, axes, work)
            for factor in factors:
                work *= factor
            self._fft.backward(work, axes)
            psi, work = work, psi
        return psi, work


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
        self._kept: tuple[float, list[LinearFlow]] | None = None

    def __repr__(self) -> str:
        return f"Splitting({self.gpe!r}, {self.scheme.name!r})"

    def one_step(self, t: float, y: np.ndarray, h: float) -> np.ndarray:
        """Make one step of length h; `y` is overwritten and returned."""
        gpe, scheme, kept = self.gpe, self.scheme, self._kept
        if kept is None or kept[0] != h:
            made = {part: LinearFlow(gpe, part * h) for part in set(scheme.linear)}
            # Replaced as a whole: another thread may be in a step of another length.
            kept = self._kept = h, [made[part] for part in scheme.linear]
        psi = y.reshape(gpe.grid.shape)
        field, work = psi, np.empty_like(psi)
        for part, flow in zip(scheme.local, kept[1], strict=False):
            local_flow(field, gpe.V, gpe.beta, part * h)
            field, work = flow.apply(field, work)
        local_flow(field, gpe.V, gpe.beta, scheme.local[-1] * h)
        if field is not psi:
            psi[...] = field
        return y


# Shears stretch what they turn, by a fortieth of its radius at this angle: the field must stay inside the box.
SMALL_TURN = pi / 32
ALIKE = 1e-9  # radii and values of a potential that count as equal


def at_rest(problem: FieldProblem) -> FieldProblem:
    """Return the problem in the frame at rest, in which the equation has no rotation and needs fewer transforms.

    The potential must be symmetric about the z axis. If y is the solution at time t in the frame at rest,
    ``rotated(gpe, y, gpe.Omega * t)`` is the solution in the rotating frame. The invariants are the mass and the energy
    in the frame at rest. The energy in the rotating frame is this energy minus Omega times the angular momentum, which
    is conserved as far as the grid resolves the field.

    Parameters
    ----------
    problem : FieldProblem
        A problem made by `GrossPitaevskii.problem`.

    Returns
    -------
    FieldProblem
        A problem with Omega = 0 and the same start, interval, step and names of invariants, without `reference`.

    Raises
    ------
    TypeError
        If `problem` is anything else.
    ValueError
        If the potential is not symmetric about the z axis, or the problem has one dimension.
    """
    gpe = getattr(problem, "equation", None)
    if gpe is None:
        raise TypeError(f"at_rest: expected a problem made by GrossPitaevskii.problem, got {problem!r}.")
    check_radial(gpe)
    names = [item.name for item in problem.invariants if item.name is not None]
    rest = gpe.changed(Omega=0.0).problem(
        problem.y0,
        problem.t_span[1],
        problem.h,
        name=f"{problem.name}-at-rest",
        invariants=names,
        source=problem.source,
    )
    return replace(rest, metric=problem.metric)


def rotated(gpe: GrossPitaevskii, psi: Any, angle: float) -> np.ndarray:
    """Return exp(i angle Lz) psi, the field at points turned anticlockwise by `angle` about the z axis.

    For a potential that is symmetric about z, this function converts a solution from the frame at rest (Omega = 0) to
    the frame that rotates with Omega, if the angle is ``Omega t``.

    Parameters
    ----------
    gpe : GrossPitaevskii
        An equation in two or three dimensions.
    psi : array_like
        A field or flat state that vanishes towards the ends of the box.
    angle : float
        Any angle. The rotation is made in parts of at most pi / 32, because the shears of larger parts could stretch
        the field beyond the box.

    Returns
    -------
    ndarray
        The rotated field.

    Raises
    ------
    ValueError
        If the grid has one dimension, or `psi` has the wrong shape.
    """
    psi = gpe.as_field(psi).copy()
    angle = remainder(angle, 2 * pi)
    parts = max(1, ceil(abs(angle) / SMALL_TURN - 1e-9))
    flow, work = LinearFlow(gpe, 0.0, angle / parts), np.empty_like(psi)
    for _ in range(parts):
        psi, work = flow.apply(psi, work)
    return psi


def check_radial(gpe: GrossPitaevskii) -> None:
    """Raise ValueError unless the potential is equal at all grid points with the same distance from the z axis."""
    if gpe.grid.dim == 1:
        raise ValueError("at_rest: the problem has one dimension, without a z axis; expected two or three dimensions.")
    x, y, *_ = gpe.grid.mesh()
    square = (x * x + y * y).ravel()
    order = np.argsort(square)
    values = gpe.V.reshape(square.size, -1)[order]
    alike = np.diff(square[order]) <= ALIKE * square.max()
    if np.any(np.abs(np.diff(values, axis=0))[alike] > ALIKE * np.abs(gpe.V).max()):
        raise ValueError(
            "at_rest: the potential differs between points at the same distance from the z axis, so that it would "
            "rotate in the frame at rest. Use the problem in the rotating frame."
        )
