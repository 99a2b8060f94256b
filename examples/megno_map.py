"""A map of MEGNO of two planets, over the semi-major axis and the eccentricity of the second one.

Both planets have 0.001 solar masses. MEGNO after 300 revolutions of the first one is 2 for regular orbits and grows for
chaotic ones. Where REBOUND is installed, a second map shows its variational particles, with the same tangent vectors.
The script prints how many points agree, and draws megno-map.png; ``python examples/megno_map.py 5`` has 5 x 5 points.
"""

import sys
import warnings

import matplotlib.pyplot as plt
import numpy as np

from eip_scipy import EIPDOP853, ProjectionWarning
from eip_scipy.chaos import megno
from eip_scipy.plotting.chaos import draw_stability
from eip_scipy.problems import nbody

try:
    from eip_scipy.integrations import rebound
except ImportError:
    rebound = None

POINTS = int(sys.argv[1]) if len(sys.argv) > 1 else 20
PERIOD = 2 * np.pi
END = 300 * PERIOD
MASSES = np.array([1.0, 1e-3, 1e-3])


def planets(axis, e):
    """Return a star and two planets at their pericentres on opposite sides, as a problem."""
    q, v = np.zeros((3, 3)), np.zeros((3, 3))
    for k, (a, own, side) in enumerate(((1.0, 0.02, 1), (axis, e, -1)), 1):
        q[k, 0] = side * a * (1 - own)
        v[k, 1] = side * np.sqrt((1 + MASSES[k]) * (1 + own) / (a * (1 - own)))
    q, v = (values - MASSES @ values / MASSES.sum() for values in (q, v))
    return nbody(MASSES, q, v, t_span=(0, END))


axes, eccentricities = np.linspace(1.25, 1.75, POINTS), np.linspace(0.0, 0.2, POINTS)
maps = {name: np.full((POINTS, POINTS), np.nan) for name in (("EIPDOP853", "REBOUND") if rebound else ("EIPDOP853",))}
warnings.simplefilter("ignore", ProjectionWarning)  # close encounters, which these steps do not resolve
for i, j in np.ndindex(POINTS, POINTS):
    problem, deviation = planets(axes[j], eccentricities[i]), None
    if rebound:
        maps["REBOUND"][i, j], _, deviation = rebound.megno(MASSES, problem.y0, t_end=END, dt=PERIOD / 60)
    run = megno(problem, (0, END), deviation=deviation, method=EIPDOP853, h=PERIOD / 40, every=END / 2)
    maps["EIPDOP853"][i, j] = run.megno if run.trusted else np.inf  # counts as chaos

print({name: f"{(values < 2.2).sum()} regular, {(values > 4).sum()} chaotic" for name, values in maps.items()})
if rebound:
    ours, theirs = maps.values()
    both = [((ours < 2.2) & (theirs < 2.2)).sum(), ((ours > 4) & (theirs > 4)).sum()]
    opposite = ((ours < 2.2) & (theirs > 4) | (ours > 4) & (theirs < 2.2)).sum()
    print(f"of {ours.size} points {both[0]} regular by both, {both[1]} chaotic by both, {opposite} opposite")
width = 3.4 * len(maps) + 1
figure, panels = plt.subplots(1, len(maps), sharey=True, squeeze=False, figsize=(width, 3.7), layout="constrained")
for panel, (name, values) in zip(panels[0], maps.items(), strict=True):
    image = draw_stability(panel, axes, eccentricities, values, 8.0)
    panel.set(title=name, xlabel="semi-major axis of the second planet")
    for p, q in ((3, 2), (5, 3), (2, 1), (7, 5), (8, 5)):
        panel.axvline((p / q) ** (2 / 3), color="w", lw=0.8, ls=":")
        panel.text((p / q) ** (2 / 3), 0.198, f"{p}:{q}", color="w", va="top", fontsize=8)
    panel.set_xlim(axes[0], axes[-1])
panels[0, 0].set_ylabel("its eccentricity")
figure.colorbar(image, ax=panels, extend="max", label="mean MEGNO (2: regular)")
figure.savefig("megno-map.png", dpi=150)
