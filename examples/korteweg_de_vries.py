"""Two solitons of the Korteweg-de Vries equation, u_t + 6 u u_x + u_xxx = 0, the fast one overtaking the slow one.

Fourier modes in space, dealiased, so that the equations on the grid keep momentum and energy to rounding. The run is
compared with Hirota's closed form, and with SciPy's DOP853 without projection. The grid limits the steps of both and
sets the error of u, which the projection does not change; the momentum drifts only without it.
"""

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, Invariant, check_gradient

n, length, t_end = 112, 64.0, 30.0
dx, fine = length / n, 3 * n // 2
x = dx * np.arange(n) - length / 2
k = 2 * np.pi / length * np.arange(n // 2)  # the highest mode of an even number of points has no sign: it is left out
speeds, places = np.array([1.6, 0.6]), np.array([-8.0, 2.0])


def modes(u):
    """Return the modes of a real field on any grid, as means over its points."""
    return np.fft.rfft(u, norm="forward")[: k.size]


def field(modes, points=n):
    """Return the field with these modes; on `fine` points no mode of a product is mistaken for another one."""
    return np.fft.irfft(modes, points, norm="forward")


def fun(t, u):
    """Return u_t = -3 (u^2)_x - u_xxx."""
    m = modes(u)
    return field(-3j * k * modes(field(m, fine) ** 2) + 1j * k**3 * m)


def momentum(t, u):
    """Return the integral of u^2."""
    return dx * (u @ u)


def energy(t, u):
    """Return the integral of u_x^2 / 2 - u^3."""
    m = modes(u)
    slope = field(1j * k * m)
    return dx * (slope @ slope) / 2 - length * np.mean(field(m, fine) ** 3)


def energy_gradient(t, u):
    """Return the derivatives of the energy, a sum over the grid, by the values u_j; the spacing is part of them."""
    m = modes(u)
    return dx * field(k**2 * m - 3 * modes(field(m, fine) ** 2))


def exact(t):
    """Return Hirota's solution 2 (log F)_xx, twice the variance of the wavenumbers weighted with the terms of F."""
    middle = places.mean() + speeds.mean() * t
    place = np.remainder(x - middle + length / 2, length) - length / 2 + middle  # on the ring
    a = np.sqrt(speeds)
    sets = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    exponent = sets @ (a[:, None] * (place - places[:, None] - (speeds * t)[:, None]))
    exponent[3] += 2 * np.log((a[0] - a[1]) / (a[0] + a[1]))
    weights = np.exp(exponent - exponent.max(axis=0))
    weights /= weights.sum(axis=0)
    return 2 * ((sets @ a) ** 2 @ weights - (sets @ a @ weights) ** 2)


u0 = field(modes(exact(0.0)))
invariants = [
    Invariant(momentum, lambda t, u: 2 * dx * u, name="momentum"),
    Invariant(energy, energy_gradient, name="energy"),
]
assert all(check_gradient(item, 0.0, u0) < 1e-8 for item in invariants)
options = {"rtol": 1e-6, "atol": 1e-8}
projected = solve_ivp(fun, (0, t_end), u0, method=EIPDOP853, invariants=invariants, metric="euclidean", **options)
plain = solve_ivp(fun, (0, t_end), u0, method="DOP853", **options)
for name, run in (("projected", projected), ("plain", plain)):
    u = run.y[:, -1]
    kept = [f"{item.name} off by {abs(item.fun(t_end, u) / item.fun(0.0, u0) - 1):.0e}" for item in invariants]
    print(f"{name:9}: {', '.join(kept)}, u off by {np.abs(u - exact(t_end)).max():.1e}")

try:
    import matplotlib.pyplot as plt
except ImportError:
    raise SystemExit(0) from None
times = np.linspace(0, t_end, 61)
shown = np.array([projected.y[:, np.abs(projected.t - t).argmin()] for t in times])
plt.pcolormesh(x, times, shown, shading="nearest")
plt.xlabel("x")
plt.ylabel("t")
plt.savefig("korteweg_de_vries.png")
