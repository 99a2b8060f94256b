"""Runs that `test_mpi.py` makes serially, and under mpirun as ``python -m mpi4py mpi_runs.py FILE``."""

import sys

import numpy as np

from eip_scipy import EIPRK4, Diagnostics, Invariant
from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap

# Neither x nor y is a multiple of the number of ranks. In two dimensions the grid resolves the field: only then does it
# keep the angular momentum.
GRIDS = {"2D": Grid((62, 58), -7, 7.5), "3D": Grid((22, 21, 10), -5, 5.5)}
BETA = {"2D": 5.0, "3D": 20.0}
OPTIONS = {"plain": {}, "twice": {"iterations": 2}, "seldom": {"every": 3, "reuse_f": False}}


def step(method, fun, y0, h, n, **options):
    """Return the solver after n steps, its last message, and the numbers of the projection."""
    diagnostics = Diagnostics()
    solver = method(fun, 0.0, y0, n * h, h=h, metric="euclidean", diagnostics=diagnostics, **options)
    message = None
    while solver.status == "running":
        message = solver.step()
    work = [solver.nfev, solver.njev, diagnostics.n_projections, diagnostics.n_rank_reduced]
    return solver.y, message, np.array(work), diagnostics.max_defect


def vortex(gpe):
    x, y, *z = gpe.grid.mesh()
    return ((x - 0.3 + 1j * (y + 0.2)) * np.exp(-(x**2 + y**2 + sum(a * a for a in z)) / 2)).ravel()


def fields(make, method, whole):
    """Return the equation's parts and its steps, with and without rotation."""
    for name, grid in GRIDS.items():
        for Omega in (0.0, 0.6):
            gpe = make(grid, harmonic_trap(*(1, 1, 0.9)[: grid.dim]), Omega=Omega, beta=BETA[name])
            psi, key = vortex(gpe), f"{name}, Omega {Omega}"
            values = (gpe.mass, gpe.energy, gpe.angular_momentum, gpe.chemical_potential)
            yield f"{key}: f", whole(gpe, gpe.fun(0.0, psi))
            yield f"{key}: values", np.array([value(psi) for value in values])
            yield f"{key}: bounds", np.array([gpe.largest_frequency(), gpe.largest_step(psi)])
            kept = gpe.invariants(("mass", "energy", "angular_momentum")[: 3 if key == "2D, Omega 0.0" else 2])
            for option, options in OPTIONS.items():
                h = 0.5 * gpe.largest_step(psi)
                y, _, work, defects = step(method, gpe.fun, psi, h, 20, invariants=kept, **options)
                yield f"{key}: y, {option}", whole(gpe, y)
                # Between projections a serial run evaluates the derivative for copies on the manifold, ranks do not.
                yield f"{key}: work, {option}", work[1:] if option == "seldom" else work
                yield f"{key}: defects, {option}", defects


def stationary(make, method, whole):
    """Run a plane wave, whose gradients of mass and energy are parallel."""
    gpe = make(Grid((16, 16), -np.pi, np.pi), beta=1.0)
    x, y = gpe.grid.mesh()
    wave = np.exp(1j * (x + 2 * y)).ravel()
    y, _, work, defects = step(method, gpe.fun, wave, 0.02, 10, invariants=gpe.invariants())
    yield "stationary: y", whole(gpe, y)
    yield "stationary: rank reduced", np.array(work[-1] > 0)
    yield "stationary: defects", defects


def overflow(make, method, whole):
    """Run a field whose last stage of the first step overflows at the peak, which is on one rank."""
    gpe = make(Grid((16, 16), -np.pi, np.pi), beta=1e4)
    x, y = gpe.grid.mesh()
    peak = np.where((x > 2.5) & (y > 2.5), 1e3 + 0j, np.cos(x + y))
    with np.errstate(all="ignore"):
        _, message, work, _ = step(method, gpe.fun, peak.ravel(), 0.05, 10, invariants=gpe.invariants("mass"))
    yield "overflow: work", work
    yield "overflow: message", np.array(message is not None)


def attraction(q):
    return -q / np.hypot(*q) ** 3


ORBIT = {
    "energy": (lambda y: y[2:] @ y[2:] / 2 - 1 / np.hypot(*y[:2]), lambda y: np.append(-attraction(y[:2]), y[2:])),
    "momentum": (lambda y: y[0] * y[3] - y[1] * y[2], lambda y: np.array([y[3], -y[2], -y[1], y[0]])),
}


def orbit(method, rank=0, ranks=1, join=lambda part: part):
    """Run Kepler's problem with its four components on the ranks: one on each of four, with two invariants."""
    part = slice(4 * rank // ranks, 4 * (rank + 1) // ranks)

    def fun(t, y):
        y = join(y)
        return np.append(y[2:], attraction(y[:2]))[part]

    def invariant(name, value, gradient):
        return Invariant(lambda t, y: value(join(y)), lambda t, y: gradient(join(y))[part], name=name)

    invariants = [invariant(name, *functions) for name, functions in ORBIT.items()]
    y, _, work, defects = step(method, fun, np.array([0.5, 0.0, 0.0, 3**0.5])[part], 0.02, 200, invariants=invariants)
    yield "orbit: y", join(y)
    yield "orbit: work", work
    yield "orbit: defects", defects


def everything(make, method, whole, **ranks):
    """Return results by name, complete ones on rank 0."""
    runs = (fields(make, method, whole), stationary(make, method, whole), overflow(make, method, whole))
    return dict(item for run in (*runs, orbit(method, **ranks)) for item in run)


def serially():
    return everything(GrossPitaevskii, EIPRK4, lambda gpe, y: gpe.grid.field(y))


def main() -> None:
    from eip_scipy.integrations.mpi import MPI, over_ranks
    from eip_scipy.integrations.mpi_fields import SlabGrossPitaevskii

    comm = MPI.COMM_WORLD
    results = everything(
        SlabGrossPitaevskii, over_ranks(EIPRK4), SlabGrossPitaevskii.gather, rank=comm.rank, ranks=comm.size,
        join=lambda part: np.concatenate(comm.allgather(part)),
    )  # fmt: skip
    if comm.rank == 0:
        np.savez(sys.argv[1], ranks=comm.size, **results)


if __name__ == "__main__":
    main()
