"""A map of MEGNO of two planets, over the semi-major axis and the eccentricity of the second one.

Both planets have 0.0001 solar masses. MEGNO is 2 for regular orbits and grows for chaotic ones; planets may also escape
or collide. ``python examples/megno_map.py 20 3000`` draws 20 x 20 points after 3000 revolutions of the first planet
to megno-map.png. Where REBOUND is installed, a second map shows its variational particles, and the script prints how
many points agree, also of REBOUND with itself from another tangent vector, and the processor time of both.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context
from time import process_time

import matplotlib.pyplot as plt
import numpy as np
from numba import njit

from eip_scipy import EIPDOP853, plotting
from eip_scipy.chaos import ChaosResult, megno
from eip_scipy.problems import nbody

try:
    import rebound
except ImportError:
    rebound = None

MASSES = np.array([1.0, 1e-4, 1e-4])
PERIOD, FAR, NEAR = 2 * np.pi, 10.0, 0.001


def start(axis, e):
    """Return the state of a star and two planets at their pericentres on opposite sides."""
    q, v = np.zeros((3, 3)), np.zeros((3, 3))
    for k, (a, own, side) in enumerate(((1.0, 0.02, 1), (axis, e, -1)), 1):
        q[k, 0] = side * a * (1 - own)
        v[k, 1] = side * np.sqrt((1 + MASSES[k]) * (1 + own) / (a * (1 - own)))
    return np.concatenate([(values - MASSES @ values / MASSES.sum()).ravel() for values in (q, v)])


@njit
def square(y, i, j):
    """Return the square of the distance of two bodies whose positions begin at i and j."""
    return (y[i] - y[j]) ** 2 + (y[i + 1] - y[j + 1]) ** 2 + (y[i + 2] - y[j + 2]) ** 2


@njit
def escaped(t, y, params):
    """Become 0 where a planet is too far from the star."""
    return FAR**2 - max(square(y, 0, 3), square(y, 0, 6))


@njit
def collided(t, y, params):
    """Become 0 where two bodies are too close."""
    return min(square(y, 0, 3), square(y, 0, 6), square(y, 3, 6)) - NEAR**2


escaped.terminal = collided.terminal = True


def by_rebound(y, end, seed):
    """Return the mean MEGNO by WHFast, the status at the end, and the processor time in seconds."""
    begin, sim = process_time(), rebound.Simulation()
    for m, q, v in zip(MASSES, *y.reshape(2, 3, 3), strict=True):
        sim.add(m=m, x=q[0], y=q[1], z=q[2], vx=v[0], vy=v[1], vz=v[2])
    sim.integrator, sim.dt = "whfast", PERIOD / 60
    sim.exit_max_distance, sim.exit_min_distance = FAR, NEAR
    sim.init_megno(seed=seed)
    status = "ok"
    try:
        sim.integrate(end)
    except (rebound.Escape, rebound.Encounter) as error:
        status = "escaped" if isinstance(error, rebound.Escape) else "collided"
    return sim.megno(), status, process_time() - begin


def agreement(one, two):
    """Return the number of points in the same class of both maps, and that of points with a clear class in both."""
    both = [np.select([m.status != "ok", m.megno < 2.1, m.megno > 2.5], [3, 1, 2]) for m in (one, two)]
    clear = (both[0] > 0) & (both[1] > 0)
    return f"{(clear & (both[0] == both[1])).sum()} of {clear.sum()}"


def main(points=20, revolutions=300):
    """Compute the maps, print how they agree, and draw them."""
    axes, eccentricities, end = np.linspace(1.2, 1.65, points), np.linspace(0.0, 0.15, points), revolutions * PERIOD
    y0s = np.array([[start(a, e) for a in axes] for e in eccentricities])
    problem = nbody(MASSES, *y0s[0, 0].reshape(2, 3, 3), t_span=(0, end))
    begin = process_time()
    # These steps keep the energy to 1e-8 in 10000 revolutions, and need no projections.
    ours = megno(problem, end, y0s, method=EIPDOP853, h=PERIOD / 40, events=[escaped, collided], invariants=())
    maps, seconds = {"EIPDOP853": ours}, [process_time() - begin]
    if rebound:
        with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
            for name, seed in (("REBOUND", 1), ("again", 2)):
                rows = list(pool.map(by_rebound, y0s.reshape(-1, 18), repeat(end), repeat(seed), chunksize=8))
                found, status, times = (np.array(column) for column in zip(*rows, strict=True))
                maps[name] = ChaosResult(megno=found.reshape(points, points), status=status.reshape(points, points))
                seconds.append(times.sum())
    for name, found in maps.items():
        regular, chaotic = ((found.status == "ok") & clear for clear in (found.megno < 2.1, found.megno > 2.5))
        print(f"{name}: {regular.sum()} regular, {chaotic.sum()} chaotic, {(found.status != 'ok').sum()} ended early")
    if rebound:
        again = maps.pop("again")
        print(
            f"in the same class: {agreement(ours, maps['REBOUND'])}, REBOUND twice {agreement(again, maps['REBOUND'])}"
        )
        print(f"processor time: {seconds[0]:.1f} s, REBOUND {seconds[1]:.1f} s")
    figure, panels = plt.subplots(1, len(maps), squeeze=False, figsize=(4.5 * len(maps), 3.7), layout="constrained")
    for panel, (name, found) in zip(panels[0], maps.items(), strict=True):
        labels = {"xlabel": "semi-major axis of the second planet", "ylabel": "its eccentricity", "title": name}
        plotting.map(axes, eccentricities, found, ax=panel, **labels)
        for p, q in ((4, 3), (3, 2), (5, 3), (2, 1), (7, 5), (8, 5)):
            panel.axvline((p / q) ** (2 / 3), color="w", lw=0.8, ls=":")
    figure.savefig("megno-map.png", dpi=150)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
