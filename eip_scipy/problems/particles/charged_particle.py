"""Charged particles in electromagnetic fields, and the two of Experiment III of Cai, Gong & Wang."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import pi
from typing import Any

import numpy as np

from ...core.balances import Balance
from ...core.inputs import real_array
from ...core.invariants import Invariant
from ...core.names import nearest
from ...core.problem import Problem, bind
from ...data import stored
from .fields import TOKAMAK, UNIFORM, ParticleField
from .motion import CHARGE, MASS, Motion, motion

__all__ = ["ORBITS", "ParticleProblem", "charged_particle", "tokamak", "uniform_field"]

FORMS = ("canonical", "velocity")
BALANCES = ("energy", "kinetic")
STEP = pi / 10  # a twentieth of the gyro-period
UNIFORM_STEPS, TOKAMAK_STEPS = 270_000, 500_000
ORBITS = {"banana": 1.0, "transit": 2.0}
"""Names of the orbits of `tokamak`, with the factor of the initial v_y."""


@dataclass(frozen=True, eq=False, repr=False)
class ParticleProblem(Problem):
    """A `Problem` of one charged particle, with its field.

    Attributes
    ----------
    field : ParticleField
    form : {"canonical", "velocity"}
        "canonical" if the state is (x, p), "velocity" if it is (x, v).
    mass, charge : float

    See Also
    --------
    charged_particle, tokamak, uniform_field, Problem

    Examples
    --------
    >>> from eip_scipy.problems import tokamak
    >>> tokamak().form
    'canonical'
    """

    field: ParticleField = UNIFORM
    form: str = "canonical"

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the parameters by name."""
        return dict(zip(("mass", "charge"), np.asarray(self.params).tolist(), strict=True))

    @property
    def mass(self) -> float:
        """The particle's mass."""
        return self.parameters["mass"]

    @property
    def charge(self) -> float:
        """The particle's charge."""
        return self.parameters["charge"]

    def velocity(self, y: Any) -> np.ndarray:
        """Return the velocities (3, m) of states (6, m): (p - q A(x)) / m in the canonical form."""
        y = np.asarray(y, dtype=float)
        if self.form == "velocity":
            return y[3:]
        return (y[3:] - self.charge * self.field.along("A", y[:3])) / self.mass


def charged_particle(
    field: ParticleField,
    position: Any,
    velocity: Any,
    *,
    t_span: tuple[float, float],
    h: float | None = None,
    mass: float = 1.0,
    charge: float = 1.0,
    form: str = "canonical",
    balances: str | None = None,
    **options: Any,
) -> ParticleProblem:
    """Return the problem of one charged particle in a field, m x'' = q (E(t, x) + x' x B(t, x)).

    Parameters
    ----------
    field : ParticleField
        `UNIFORM`, `TOKAMAK`, or one of your own.
    position, velocity : array_like, shape (3,)
        x and x' at the start. The velocity x' must also be given if the state is (x, p).
    t_span : (float, float)
    h : float, optional
        Step, for example a twentieth of the gyro-period 2 pi m / (q B).
    mass, charge : float, optional
    form : {"canonical", "velocity"}, optional
        The state: (x, p) with p = m x' + q A(x), or (x, x'). A field that varies in time needs "velocity".
    balances : {"energy", "kinetic"}, optional
        Keep an energy as a `Balance` instead of the invariant "H"; this needs the form "velocity". "kinetic" keeps the
        kinetic energy "T", which changes at the rate q v . E. "energy" keeps the total energy "H", which changes at the
        rate q (dphi/dt - v . dA/dt), if the field varies and has a potential; otherwise it keeps "T".
    **options
        Further fields of `Problem`, such as `name` and `reference`.

    Returns
    -------
    ParticleProblem
        The invariants are the energy "H", if the field is static and has a potential or no electric field, and the
        angular momentum "L", x p_y - y p_x, if the field has ``axisymmetric=True`` and A is known. The blocks have 3
        components, so that the error metric does not depend on the orientation of the axes.

    Raises
    ------
    TypeError
        If `field` is not a ParticleField.
    ValueError
        If an argument is wrong, the canonical form has a field without A, or functions of the field are not finite or
        contradict each other at the start.

    See Also
    --------
    ParticleField, tokamak, uniform_field

    Examples
    --------
    A magnetic mirror with B_z = 1 + z^2 on the axis, defined by its vector potential alone:

    >>> import numpy as np
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import ParticleField, charged_particle
    >>> mirror = ParticleField(lambda x, y, z: (-y / 2 * (1 + z * z), x / 2 * (1 + z * z), 0.0), axisymmetric=True)
    >>> problem = charged_particle(mirror, [0.1, 0, 0], [0, 0.1, 0.05], t_span=(0, 20), h=0.1)
    >>> run = integrate(problem, method=EIPRK4)
    >>> [item.name for item in problem.invariants], bool(run.max_residual.max() < 1e-12)
    (['H', 'L'], True)
    """
    if not isinstance(field, ParticleField):
        raise TypeError(f"charged_particle: field must be a ParticleField, got {field!r}.")
    if form not in FORMS:
        hint = nearest(form, FORMS)
        raise ValueError(f"charged_particle: form must be one of {', '.join(FORMS)}, got {form!r}{hint}")
    if form == "canonical" and field.vector_potential is None:
        raise ValueError(
            "charged_particle: the canonical form needs the field's vector_potential; give it, or use form='velocity'."
        )
    if form == "canonical" and (field.varies or balances is not None):
        what = "balances need" if balances is not None else "a field that varies needs"
        raise ValueError(f"charged_particle: {what} form='velocity', got form='canonical'.")
    if balances is not None and balances not in BALANCES:
        hint = nearest(str(balances), BALANCES)
        raise ValueError(f"charged_particle: balances must be 'energy', 'kinetic' or None, got {balances!r}{hint}")
    x, v = _vector("position", position), _vector("velocity", velocity)
    params = np.array([mass, charge], dtype=float)
    if not (params[MASS] > 0 and params[CHARGE] != 0 and np.isfinite(params).all()):
        raise ValueError(
            f"charged_particle: mass must be positive and charge not 0, both finite; got {mass!r} and {charge!r}."
        )
    t0, t_end = map(float, t_span)
    field.check(x, t0)
    of_field = motion(field.functions, form)
    momentum = v if form == "velocity" else params[MASS] * v + params[CHARGE] * field.along("A", x[:, None])[:, 0]
    return ParticleProblem(
        fun=bind(of_field.rhs, params),
        rhs=of_field.rhs,
        y0=np.concatenate([x, momentum]),
        t_span=(t0, t_end),
        h=h,
        params=params,
        invariants=_invariants(of_field, field, form, params, balances),
        blocks=3,
        component_names=("x", "y", "z", *(("vx", "vy", "vz") if form == "velocity" else ("px", "py", "pz"))),
        field=field,
        form=form,
        **{"name": "charged-particle", **options},
    )


def _vector(name: str, value: Any) -> np.ndarray:
    vector = real_array(name, value)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"charged_particle: {name} must be three finite numbers, got {value!r}.")
    return vector


def _invariants(
    of_field: Motion, field: ParticleField, form: str, params: np.ndarray, balances: str | None
) -> tuple[Invariant, ...]:
    energy, momentum = of_field.energy, of_field.momentum
    given: dict[str, Any] = {"args": (params,), "in_place": True}
    found: list[Invariant] = []
    if balances == "energy" and field.varies and energy:
        found.append(Balance(energy[0], args=(params,), name="H"))
    elif balances is not None and of_field.kinetic:
        found.append(Balance(*of_field.kinetic, **given, name="T"))
    elif energy and not field.varies:
        found.append(Invariant(*energy, **given, uses_f=form == "canonical", name="H"))
    if field.axisymmetric and momentum:
        found.append(Invariant(*momentum, **given, name="L"))
    return tuple(found)


def uniform_field(*, form: str = "canonical", t_end: float = UNIFORM_STEPS * STEP, h: float = STEP) -> ParticleProblem:
    """Return the problem of a particle that gyrates and drifts around the z axis, in a uniform B.

    The fields are B = e_z and the electric potential 1e-2 / R, where R is the distance from the z axis.

    Parameters
    ----------
    form : {"canonical", "velocity"}, optional
        The state: (x, p), as in the paper, or (x, v).
    t_end, h : float, optional
        End of the interval that starts at 0, and a step; the defaults are the paper's, 270 000 steps of pi / 10.

    Returns
    -------
    ParticleProblem
        With invariants "H" and "L", and `reference` states at each hundredth of the paper's interval.

    See Also
    --------
    charged_particle, tokamak

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import uniform_field
    >>> integrate(uniform_field(t_end=300), method=EIPRK4).trusted
    True
    """
    return _of_paper("uniform", UNIFORM, ([0.0, -1.0, 0.0], [0.1, 0.01, 0.0]), form, t_end, h)


def tokamak(
    orbit: str = "banana", *, form: str = "canonical", t_end: float = TOKAMAK_STEPS * STEP, h: float = STEP
) -> ParticleProblem:
    """Return the problem of a charged particle in an axisymmetric tokamak, on a trapped or a passing orbit.

    Parameters
    ----------
    orbit : {"banana", "transit"}, optional
        The trapped ("banana") or the passing ("transit") orbit.
    form, t_end, h : optional
        See `uniform_field`; the paper's interval has 500 000 steps of pi / 10.

    Returns
    -------
    ParticleProblem
        With invariants "H" and "L", and `reference` states at each hundredth of the paper's interval.

    See Also
    --------
    charged_particle, uniform_field

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import tokamak
    >>> integrate(tokamak("transit", t_end=300), method=EIPRK4).trusted
    True
    """
    if orbit not in ORBITS:
        raise ValueError(f"tokamak: orbit must be one of {', '.join(ORBITS)}, got {orbit!r}{nearest(orbit, ORBITS)}")
    start = [1.05, 0.0, 0.0], [0.0, ORBITS[orbit] * 4.816e-4, -2.059e-3]
    return _of_paper(f"tokamak-{orbit}", TOKAMAK, start, form, t_end, h)


def _of_paper(
    name: str, field: ParticleField, start: tuple[list[float], list[float]], form: str, t_end: float, h: float
) -> ParticleProblem:
    return charged_particle(
        field,
        *start,
        t_span=(0.0, t_end),
        h=h,
        form=form,
        name=name,
        units="system size 1, charge and mass 1, B_0 = 1: gyro-period 2 pi / B",
        source="Cai, Gong & Wang, section 3.3",
        reference=partial(_reference, name, form),
    )


def _reference(name: str, form: str, t: float) -> np.ndarray | None:
    """Return the stored state of the problem `name` at the time `t`, in the given form; None if there is none."""
    row = stored("particle_references.json", name, t)
    return None if row is None else np.array(row["position"] + row["momentum" if form == "canonical" else "velocity"])
