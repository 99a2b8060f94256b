"""A halo orbit about the point L2 behind the Moon, closed by Newton's method on the monodromy matrix.

The orbit is listed in JPL's catalogue (https://ssd.jpl.nasa.gov/tools/periodic_orbits.html). The axes turn with Earth
and Moon; their distance, the sum of their masses and their angular velocity are 1.
"""

import numpy as np
from numba import njit

from eip_scipy import EIPDOP853, Invariant, integrate

MU = 1.215058560962404e-2  # mass of the Moon
PUBLISHED = np.array([1.1398248385779477, 0, 0.16364154884722404, 0, -0.22349331292348754, 0])
PUBLISHED_PERIOD = 3.1065871267784422
FREE = [0, 3, 4, 5]  # x and the velocity; y = 0 and z name one point of one orbit of the family


@njit
def spacecraft(t, s):
    """Return the velocity and the acceleration."""
    x, y, z, vx, vy, vz = s
    earth = (1 - MU) * ((x + MU) ** 2 + y * y + z * z) ** -1.5
    moon = MU * ((x + MU - 1) ** 2 + y * y + z * z) ** -1.5
    ax = x + 2 * vy - earth * (x + MU) - moon * (x + MU - 1)
    return np.array([vx, vy, vz, ax, y - 2 * vx - (earth + moon) * y, -(earth + moon) * z])


@njit
def jacobi(t, s):
    """Return Jacobi's integral."""
    x, y, z, vx, vy, vz = s
    r1, r2 = np.sqrt((x + MU) ** 2 + y * y + z * z), np.sqrt((x + MU - 1) ** 2 + y * y + z * z)
    return x * x + y * y + 2 * (1 - MU) / r1 + 2 * MU / r2 - vx * vx - vy * vy - vz * vz


def revolution(start, period):
    """Return the end of one revolution and the monodromy matrix."""
    run = integrate(spacecraft, (0, period), start, method=EIPDOP853, h=period / 64, variations="state",
                    invariants=Invariant(jacobi, name="C"))  # fmt: skip
    return run.y[:, -1], run.stm[-1]


start, period = np.array([1.14, 0, PUBLISHED[2], 0, -0.22, 0]), 3.1
for _ in range(10):
    end, monodromy = revolution(start, period)
    gap = end - start
    print(f"period {period:.12f}, the orbit is open by {np.linalg.norm(gap):.1e}")
    if np.linalg.norm(gap) < 1e-11:
        break
    # The change of the gap with the start and with the period; the flow and the family leave directions open.
    slopes = np.column_stack([(monodromy - np.eye(6))[:, FREE], spacecraft(0.0, end)])
    step = np.linalg.lstsq(slopes, -gap, rcond=1e-8)[0]
    start[FREE] += step[:-1]
    period += step[-1]

print(f"published: period off by {abs(period - PUBLISHED_PERIOD):.0e}, start by {abs(start - PUBLISHED).max():.0e}")
multipliers = np.linalg.eigvals(monodromy)
print("Floquet multipliers:", ", ".join(f"{m:.4g}" for m in multipliers[np.argsort(-abs(multipliers))]))
