"""A four-bar linkage from a model of SymPy: open without projection, closed with constraints and energy kept.

    python examples/linkage.py [figure.png]

RK45 at tolerances of 1e-4, 30 s. Prints how far the last link ends from its pivot, and draws the last two seconds.
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
    figure, axes = plt.subplots(1, 2, figsize=(9, 3), sharey=True, layout="constrained")
    colors = plt.get_cmap("viridis")(np.linspace(0, 1, 5))
    cases = {"without projection": (), "constraints and energy kept": problem.invariants}
    for axis, (name, invariants) in zip(axes, cases.items(), strict=True):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # without projection the run is not reliable
            options = {"rtol": 1e-4, "atol": 1e-4, "t_eval": np.linspace(28, 30, 5)}
            run = integrate(problem, invariants=invariants, method=EIPRK45, **options)
        places = joints(run.y)
        gap = np.linalg.norm(places[-1, -1] - [GROUND, 0])
        print(f"{name}: the last link ends {gap:.1e} m from its pivot")
        for t, color, place in zip(run.t, colors, places, strict=True):
            axis.plot(*place.T, "o-", color=color, label=f"{t:g} s")
        axis.plot(*np.array([places[-1, -1], [GROUND, 0]]).T, ":", color="crimson")
        axis.plot([0, GROUND], [0, 0], "^", color="black", markersize=10)
        axis.set(title=f"RK45, {name}", xlabel="x [m]", xlim=(-1.1, 2.9), aspect="equal")
    axes[0].set_ylabel("y [m]")
    axes[1].legend(loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "linkage.png", dpi=150)
