"""Close encounters, chaos and choreography with reference states.

The starts are here; the reference states are data (``data/scene_references.json``), made in 160-bit arithmetic by
``tools/references.py``.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ...core.inputs import is_number
from ...core.problem import Problem
from ...data import stored
from . import solar_data
from .nbody import nbody

__all__ = ["comet", "figure_eight", "pythagorean"]

FIGURE_EIGHT_PERIOD = 6.32591398
# 1e13 kg, a nucleus of about 3 km, in solar masses.
COMET_MASS = 5e-18
# From the Sun, at the epoch of the DE440 data; AU and AU per year.
COMET_POSITION = np.array([1.002501036766, 3.897477161147, 2.176397333067])
COMET_VELOCITY = np.array([-2.100710600073, -0.613156552068, 0.134394494981])


def pythagorean() -> Problem:
    """Return Burrau's problem: masses 3, 4 and 5 at rest in the corners of the triangle with these sides.

    Returns
    -------
    Problem
        A problem from t = 0 to 70, with G = 1. Near t = 15.83 the bodies of masses 4 and 5 pass within 4e-4 of each
        other; from about t = 60 on they are a binary, and the body of mass 3 leaves. The invariants are those of
        `nbody`; the angular momentum is zero. There are `reference` states at t = 10, 20, ..., 70.

    See Also
    --------
    nbody, figure_eight, time_transformed

    References
    ----------
    C. Burrau, Astronomische Nachrichten 195 (1913) 113-118, doi:10.1002/asna.19131950602. V. Szebehely, C. F. Peters,
    Astronomical Journal 72 (1967) 876-883, doi:10.1086/110355.

    Examples
    --------
    >>> from eip_scipy.problems import pythagorean
    >>> pythagorean().params
    array([3., 4., 5.])
    """
    return nbody(
        [3.0, 4.0, 5.0],
        [[1.0, 3.0, 0.0], [-2.0, -1.0, 0.0], [1.0, -1.0, 0.0]],
        np.zeros((3, 3)),
        t_span=(0.0, 70.0),
        name="pythagorean",
        units="G = 1",
        source="Burrau (1913); Szebehely & Peters, AJ 72 (1967) 876",
        reference=partial(_reference, "pythagorean"),
    )


def figure_eight(periods: float = 100.0) -> Problem:
    """Return the problem of three equal masses that follow each other along a figure of eight.

    Parameters
    ----------
    periods : float, optional
        Length of the interval in periods, T = 6.32591398; positive, otherwise a ValueError is raised.

    Returns
    -------
    Problem
        The start has the eight digits that were published, so that the bodies return to it within 1e-7 after one
        period. The invariants are those of `nbody`; the angular momentum is zero. There are `reference` states after 1,
        10 and 100 periods.

    See Also
    --------
    nbody, pythagorean

    References
    ----------
    A. Chenciner, R. Montgomery, Annals of Mathematics 152 (2000) 881-901, doi:10.2307/2661357; initial data by C. Simó,
    there.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPRKN12, integrate
    >>> from eip_scipy.problems import figure_eight
    >>> problem = figure_eight(periods=1)
    >>> bool(np.allclose(integrate(problem, method=EIPRKN12, h=0.02).y[:, -1], problem.y0, atol=1e-6))
    True
    """
    if not (is_number(periods, "periods") and periods > 0 and np.isfinite(periods)):
        raise ValueError(f"figure_eight: periods must be positive and finite, got {periods!r}.")
    q = np.array([0.97000436, -0.24308753, 0.0])
    v = np.array([-0.93240737, -0.86473146, 0.0])
    return nbody(
        np.ones(3),
        [q, -q, np.zeros(3)],
        [-v / 2, -v / 2, v],
        t_span=(0.0, periods * FIGURE_EIGHT_PERIOD),
        h=FIGURE_EIGHT_PERIOD / 100,
        name="figure-eight",
        units="G = 1",
        source="Chenciner & Montgomery, Ann. Math. 152 (2000) 881 (data by Simó)",
        reference=partial(_reference, "figure-eight"),
    )


def comet() -> Problem:
    """Return the problem of a comet, Sun, Jupiter and Saturn, in which a passage of Jupiter ejects the comet.

    Returns
    -------
    Problem
        A problem over twenty years, in AU and years, with the centre of mass at rest. Sun, Jupiter and Saturn start
        from the DE440 data of `SolarSystemData` (2014-02-02). The comet is synthetic: a body of 1e13 kg, placed so that
        after 10 years it passes Jupiter's centre at 3.0 radii (0.0014 AU), about as near as Lexell's comet did in 1779.
        Before the passage its semi-major axis is 3.2 AU, with perihelia at 1.3 AU; afterwards it is 500 AU. An error
        before the passage has grown 700-fold at the end. The invariants are those of `nbody`. The comet's share in them
        is 1e-17, so that they do not show errors of its orbit. There is a `reference` state at 20 years.

    See Also
    --------
    nbody, solar_system, pythagorean

    Examples
    --------
    >>> from eip_scipy.problems import comet
    >>> comet().t_span
    (0.0, 20.0)
    """
    data = solar_data.load("de440")
    rows = [data.bodies.index(name) for name in ("Sun", "Jupiter", "Saturn")]
    gm = data.gm[rows] * solar_data.YEAR_D**2
    q, v = data.position[rows], data.velocity[rows] * solar_data.YEAR_D
    q = np.vstack([q, q[0] + COMET_POSITION])
    v = np.vstack([v, v[0] + COMET_VELOCITY])
    gm = np.append(gm, COMET_MASS * gm[0])
    q, v = solar_data.to_barycentre(gm, q, v)
    return nbody(
        gm,
        q,
        v,
        t_span=(0.0, 20.0),
        name="comet",
        units="AU, Julian year",
        source="DE440; the comet is synthetic",
        reference=partial(_reference, "comet"),
    )


def _reference(name: str, t: float) -> np.ndarray | None:
    """Return the stored reference state (6 N,) of the problem `name` at the time `t`; None if there is none."""
    row = stored("scene_references.json", name, t)
    return None if row is None else np.array(row["state"])
