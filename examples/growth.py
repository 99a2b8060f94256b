"""Growth of the error of position over 10 000 years, compared with Brouwer's law.

Ten bodies from DE440 under Newton's gravity, by EIPGJ14 and EIPRKN12, against states computed in 80 bits that the
package carries, and by WHFast and IAS15 where REBOUND is installed (a minute). An error of longitude that comes from
round-off alone grows as t^(3/2) (Brouwer 1937), one from a drift of the energy as t^2, one of a method that keeps the
energy's error bounded as t. The script prints the errors at the end and the exponents from 10 years on,
and draws growth.png. ``python examples/growth.py 1000`` ends after 1000 years.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12, integrate
from eip_scipy.problems import solar_system
from eip_scipy.problems.gravity.solar_data import reference_states

try:
    from eip_scipy.integrations import rebound
except ImportError:
    rebound = None

YEARS = float(sys.argv[1]) if len(sys.argv) > 1 else 10_000.0
BODIES = {"Mercury": 1, "Earth-Moon": 3, "Jupiter": 5}
NYSTROM = {"method": EIPRKN12, "h": 1 / 64, "compensated": True}
# A power of two, so that all times are exact: the rounding of 1/600 alone moves the Earth by 4e-12 AU by the end.
RUNS = {
    "EIPGJ14, balances": ("kepler", {"method": EIPGJ14, "h": 1 / 512}),
    "EIPGJ14": (None, {"method": EIPGJ14, "h": 1 / 600}),
    "EIPRKN12, every 10, compensated": (None, {**NYSTROM, "every": 10}),
    "RKN12, compensated": (None, {**NYSTROM, "invariants": ()}),
}

known = {t: y for t, y in reference_states().items() if t <= YEARS}
times, truth = np.array(list(known)), np.array(list(known.values())).T
states, seconds = {}, {}
for name, (balances, options) in RUNS.items():
    problem = solar_system(years=YEARS, balances=balances) if balances else solar_system(years=YEARS)
    run = integrate(problem, (0, times[-1]), t_eval=times, **options)
    states[name], seconds[name] = run.y, run.wall_time
if rebound:  # one run for each time, because a saved time would cut a step
    for name, integrator, per_year in (("WHFast, 1 d", "whfast-c17", 365.25), ("IAS15", "ias15", 0)):
        counts = [max(1, round(t * per_year)) for t in times]
        runs = [
            rebound.run(problem.params, problem.y0, integrator, h=t / n, n_steps=n)
            for t, n in zip(times, counts, strict=True)
        ]
        states[name], seconds[name] = np.transpose([run.y[:, -1] for run in runs]), runs[-1].wall_time

figure, axes = plt.subplots(1, len(BODIES), sharex=True, sharey=True, figsize=(8.4, 3.8), layout="constrained")
late = times >= 10
for name, y in states.items():
    apart = np.linalg.norm((y - truth)[:30].reshape(10, 3, -1), axis=1)  # AU
    text = []
    for axis, (body, k) in zip(axes, BODIES.items(), strict=True):
        fitted = late & (apart[k] > 0)
        slope = np.polyfit(np.log(times[fitted]), np.log(apart[k, fitted]), 1)[0] if fitted.sum() > 1 else np.nan
        text.append(f"{body} {apart[k, -1]:.1e} AU, t^{slope:.1f}")
        axis.loglog(times, np.where(apart[k] > 0, apart[k], np.nan), "o-", ms=4, label=name)
        axis.set(title=body, xlabel="time [yr]")
        axis.grid(alpha=0.3)
    print(f"{name}, {seconds[name]:.1f} s: {'; '.join(text)}")
for axis in axes:
    axis.loglog(times, 1e-15 * times**1.5, color="0.5", ls=":", label="slope 3/2 (Brouwer)")
axes[0].set_ylabel("error of position [AU]")
figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
figure.savefig("growth.png", dpi=150)
