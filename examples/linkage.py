"""A four-bar linkage from a model of SymPy: open without projection, closed with constraints and energy kept.

    python examples/linkage.py [figure.png]

RK45 at tolerances of 1e-4, 30 s. Prints how far the last link ends from its pivot, and draws the links and the gap.
"""

import sys
import warnings

import matplotlib.pyplot as plt
import numpy as np
import sympy
from sympy.physics import mechanics as me

from eip_scipy import EIPRK45, integrate
from eip_scipy.problems import mechanics

LENGTHS, GROUND = (0.8, 2.0, 1.0), 2.0  # m


def linkage():
    """Return the problem: particles of 1 kg at the ends of three massless links, and gravity along -y."""
    q, u = me.dynamicsymbols("q1:4"), me.dynamicsymbols("u1:4")
    N = me.ReferenceFrame("N")
    points, frame = [me.Point("P1")], N
    points[0].set_vel(N, 0)
    for k, length in enumerate(LENGTHS):
        before, frame = frame, me.ReferenceFrame("ABC"[k])
        frame.orient_axis(before, q[k], N.z)
        frame.set_ang_vel(before, u[k] * N.z)
        points.append(points[-1].locatenew(f"P{k + 2}", length * frame.x))
        points[-1].v2pt_theory(points[-2], N, frame)
    gap = points[3].pos_from(points[0]) - GROUND * N.x
    closed = [gap.dot(N.x), gap.dot(N.y)]
    speeds = {a.diff(): b for a, b in zip(q, u, strict=True)}
    model = me.KanesMethod(
        N, q[:1], u[:1], kd_eqs=[a - b for a, b in speeds.items()], q_dependent=q[1:], u_dependent=u[1:],
        configuration_constraints=closed,
        velocity_constraints=[item.diff(me.dynamicsymbols._t).xreplace(speeds) for item in closed],
    )  # fmt: skip
    m, g = sympy.symbols("m g")
    bodies = [me.Particle(f"p{k}", point, m) for k, point in enumerate(points[1:])]
    model.kanes_equations(bodies, [(point, -m * g * N.y) for point in points[1:]])
    start = {"q1": np.radians(10), "q2": 0.1, "q3": -2.6}  # q2 and q3 are guesses
    return mechanics(model, {m: 1.0, g: 9.81}, start, [0, 0, 0], t_span=(0, 30))


def joints(y):
    """Return the ends of the links (k, 4, 2) at the states (6, k)."""
    angles = np.cumsum(y[:3], axis=0).T
    links = np.array(LENGTHS)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.concatenate([np.zeros((len(angles), 1, 2)), np.cumsum(links, axis=1)], axis=1)


if __name__ == "__main__":
    problem = linkage()
    figure, (picture, gaps) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    cases = {"without projection": ((), "#a33"), "constraints and energy kept": (problem.invariants, "#27c")}
    for name, (invariants, color) in cases.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # without projection the run is not reliable
            options = {"rtol": 1e-4, "atol": 1e-4, "t_eval": np.linspace(0, 30, 601)}
            run = integrate(problem, invariants=invariants, method=EIPRK45, **options)
        places = joints(run.y)
        gap = np.linalg.norm(places[:, -1] - [GROUND, 0], axis=1)
        print(f"{name}: the last link ends {gap[-1]:.1e} m from its pivot")
        picture.plot(*places[-1].T, "o-", color=color, label=name)
        picture.plot(*np.array([places[-1, -1], [GROUND, 0]]).T, ":", color=color)
        gaps.semilogy(run.t, np.maximum(gap, 1e-16), color=color)
    picture.plot([0, GROUND], [0, 0], "^", color="black", markersize=9, label="pivots")
    picture.set(title="the links after 30 s", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    gaps.set(title="how far the loop is open", xlabel="t [s]", ylabel="gap [m]", xlim=(0, 30))
    gaps.grid(alpha=0.3)
    figure.suptitle("RK45, rtol = atol = 1e-4")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "linkage.png", dpi=120)
