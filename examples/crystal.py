"""A crystal of 108 atoms in a periodic box, by RK4, and by EIPRK4 with its energy and its momentum kept.

Lennard-Jones' potential, cut off at 2.4 diameters and shifted so that it and the force are 0 there. The script prints
what both runs lose, how far their atoms are from those of a run with steps ten times shorter, and draws crystal.png.
"""

import matplotlib.pyplot as plt
import numba
import numpy as np

from eip_scipy import EIPRK4, Invariant, integrate

side, cut = 5.0, 2.4  # of the box, and of the forces
shift, pull = 4 * (cut**-12 - cut**-6), 24 * (2 * cut**-13 - cut**-7)  # so that V and V' are 0 at the cut


@numba.njit
def pair(y, i, j):
    """Return the vector to the nearest image of an atom, and its square."""
    d = y[i : i + 3] - y[j : j + 3]
    d -= side * np.round(d / side)
    return d, (d * d).sum()


@numba.njit
def atoms(t, y):
    """Return the velocities and the accelerations."""
    m = y.size // 2
    out = np.zeros(y.size)
    out[:m] = y[m:]
    for i in range(0, m, 3):
        for j in range(0, i, 3):
            d, r2 = pair(y, i, j)
            if r2 < cut * cut:
                force = (24 * (2 * r2**-7 - r2**-4) - pull * r2**-0.5) * d
                out[m + i : m + i + 3] += force
                out[m + j : m + j + 3] -= force
    return out


@numba.njit
def energy(t, y):
    """Return the kinetic and the potential energy."""
    m = y.size // 2
    total = (y[m:] * y[m:]).sum() / 2
    for i in range(0, m, 3):
        for j in range(0, i, 3):
            _, r2 = pair(y, i, j)
            if r2 < cut * cut:
                total += 4 * (r2**-6 - r2**-3) - shift + pull * (r2**0.5 - cut)
    return total


corners = np.array([[0, 0, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]])
cells = np.stack(np.meshgrid(*[np.arange(3)] * 3), axis=-1).reshape(-1, 1, 3)
places = ((cells + corners) * side / 3).reshape(-1)
speeds = np.random.default_rng(1).normal(0, 0.9, (108, 3))
y0 = np.append(places, speeds - speeds.mean(axis=0))
# Corrections leave the momentum unchanged: C y, and how a change of it is shared out, S. Up to 300 numbers of a state
# the package finds it by itself.
momentum = np.hstack([np.zeros((3, 324)), np.tile(np.eye(3), 108)])
kept = {"invariants": Invariant(energy, name="E"), "linear_invariants": (momentum, momentum.T / 108)}

times = np.linspace(0, 2, 41)
fine = integrate(atoms, (0, 2), y0, method=EIPRK4, h=0.0005, t_eval=times).y
figure, (energies, errors) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for name, options, colour in (("RK4", {}, "#a33"), ("EIPRK4, energy and momentum kept", kept, "#27c")):
    run = integrate(atoms, (0, 2), y0, method=EIPRK4, h=0.005, t_eval=times, **options)
    lost = np.array([abs(energy(0, y) - energy(0, y0)) for y in run.y.T])
    off = np.sqrt(((run.y - fine)[:324] ** 2).mean(axis=0))
    print(f"{name}: energy off by {lost[-1]:.0e} of {energy(0, y0):.0f}, places by {off[-1]:.0e}")
    energies.semilogy(times[1:], np.maximum(lost[1:], 1e-12), color=colour, label=name)
    errors.semilogy(times[1:], off[1:], color=colour)
energies.set(xlabel="t", ylabel="error of the energy")
errors.set(xlabel="t", ylabel="rms error of the places [diameters]")
for axis in (energies, errors):
    axis.grid(alpha=0.3)
figure.legend(loc="outside upper center", ncols=2, frameon=False)
figure.savefig("crystal.png", dpi=120)
