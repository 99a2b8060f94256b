"""``eip-scipy study gpe-mpi``: cost of the Gross-Pitaevskii equation on ranks of MPI, compared with one processor.

    mpirun -n 2 python -m mpi4py -m eip_scipy study gpe-mpi

The table has the least of several wall-clock times, measured in turn for each number of ranks. Each rank has one
thread, and ranks that do not take part in a measurement sleep.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy import EIPRK4
from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap

from ..report import needed, table
from ..study import Measurement, Session, option

SHAPES = ((256, 256), (64, 64, 64), (128, 128, 128))
QUICK_SHAPES = ((32, 32), (16, 16, 16))
SECONDS = 30.0  # for each shape
IN_A_ROW = 8
STEPS = 20  # whose results are compared


def mpi() -> Any:
    return needed("eip_scipy.integrations.mpi")


def slabs() -> Any:
    return needed("eip_scipy.integrations.mpi_fields")


def world() -> Any:
    return mpi().MPI.COMM_WORLD


def wait():
    """Wait until all ranks have called this function, sleeping meanwhile."""
    request = world().Ibarrier()
    while not request.Test():
        time.sleep(1e-4)


def timed(function, comm):
    """Call `function` on all ranks of `comm` at once, and return the wall time of the slowest rank in seconds."""
    comm.Barrier()
    begin = time.perf_counter()
    function()
    return comm.allreduce(time.perf_counter() - begin, mpi().MPI.MAX)


def start(gpe):
    x, y, *z = gpe.grid.mesh()
    # Not divided by the mass, whose last digits depend on the order of its sum: the results are compared.
    return (0.5 * (x - 0.5 + 1j * (y + 0.2)) * np.exp(-(x**2 + y**2 + sum(a * a for a in z)) / 2)).ravel()


class Case:
    """The Gross-Pitaevskii equation on the first `ranks` ranks, or, if `ranks` is 0, on a single one without MPI.

    On the other ranks the attribute `here` is False, and the object has no equation and no solvers.
    """

    def __init__(self, shape, ranks):
        self.here = world().rank < max(ranks, 1)
        self.comm = world().Split(0 if self.here else mpi().MPI.UNDEFINED)
        if not self.here:
            return
        grid, trap = Grid(shape, -10, 10), harmonic_trap(*[1.0] * len(shape))
        options: dict[str, Any] = {"Omega": 0.7, "beta": 400}
        if ranks:
            self.gpe: Any = slabs().SlabGrossPitaevskii(grid, trap, comm=self.comm, **options)
        else:
            self.gpe = GrossPitaevskii(grid, trap, **options)
        self.psi = start(self.gpe)
        self.out = np.empty_like(self.psi)
        self.solvers = [self.solver(ranks, names) for names in ((), ("mass", "energy"))]

    def solver(self, ranks, names):
        method = mpi().over_ranks(EIPRK4, self.comm) if ranks else EIPRK4
        h = 0.2 * self.gpe.largest_step(self.psi)
        invariants = self.gpe.invariants(names)
        return method(self.gpe.fun, 0.0, self.psi, 1e3, h=h, invariants=invariants, metric="euclidean")

    def measure(self):
        """Return the least seconds (3,) of a right-hand side, a step without invariants, and a projected step.

        The projected step keeps mass and energy.
        """
        functions = [lambda: self.gpe.rhs(0.0, self.psi, self.out), *(solver.step for solver in self.solvers)]
        return np.array([min(timed(function, self.comm) for _ in range(IN_A_ROW)) for function in functions])

    def results(self):
        """Return two fields, whole on rank 0: the right-hand side at the start, and the state after `STEPS` steps.

        The steps keep mass and energy.
        """
        solver = self.solvers[1]
        for _ in range(STEPS):
            solver.step()
        self.gpe.rhs(0.0, self.psi, self.out)
        whole = getattr(self.gpe, "gather", np.array)
        return [np.ravel(whole(a)) for a in (self.out, solver.y)]


def counts():
    """Return the numbers of ranks to measure: 0 (without MPI), 1, 2, 4, ... and all of them."""
    return sorted({0, *(2**k for k in range(world().size.bit_length()) if 2**k <= world().size), world().size})


def compare(shape, seconds):
    """Return, on rank 0, {ranks: [times of f, of RK4 and of EIP-ME in ms, relative errors of f and of the state]}.

    The times are those of one call or one step; f is the right-hand side, and EIP-ME keeps mass and energy. Errors are
    differences from the run without MPI. Other ranks return an empty dict. `seconds` is the time that is spent on
    measuring.
    """
    cases = {ranks: Case(shape, ranks) for ranks in counts()}
    results = {}
    for ranks, case in cases.items():
        if case.here:
            results[ranks] = case.results()
        wait()
    best: dict[int, Any] = dict.fromkeys(cases, np.inf)
    end = time.perf_counter() + seconds
    while world().bcast(time.perf_counter() < end):
        for ranks, case in cases.items():
            if case.here:
                best[ranks] = np.minimum(best[ranks], case.measure())
            wait()
    if world().rank:
        return {}
    errors = {
        ranks: [float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(result, results[0], strict=True)]
        for ranks, result in results.items()
    }
    return {ranks: [*(1e3 * best[ranks]).tolist(), *errors[ranks]] for ranks in cases}


@dataclass(frozen=True, kw_only=True)
class RanksCost(Measurement[dict[str, dict[int, list[float]]]]):
    """Command ``eip-scipy study gpe-mpi``."""

    quick: bool = option(False, "measure small grids, a second each")

    def measure(self, session: Session) -> dict[str, dict[int, list[float]]]:
        shapes, seconds = (QUICK_SHAPES, 1.0) if self.quick else (SHAPES, SECONDS)
        found = {" x ".join(map(str, shape)): compare(shape, seconds) for shape in shapes}
        if world().rank:  # the first rank shows the results of all
            session.json, session.quiet = None, True
        return found

    def table(self, found: dict[str, dict[int, list[float]]]) -> str:
        parts = [mpi().MPI.Get_library_version().splitlines()[0]]
        heads = [["f"], ["speed-up"], ["RK4", "step"], ["EIP-ME", "step"], ["speed-up"], ["error", "of f"],
                 ["error after", f"{STEPS} steps"]]  # fmt: skip
        for name, rows in found.items():
            body = [
                (
                    f"{ranks} rank{'s' * (ranks > 1)}" if ranks else "without MPI",
                    [f"{row[0]:.2f}", f"{rows[0][0] / row[0]:.2f}", f"{row[1]:.2f}", f"{row[2]:.2f}",
                     f"{rows[0][2] / row[2]:.2f}", f"{row[3]:.0e}", f"{row[4]:.0e}"],
                )
                for ranks, row in rows.items()
            ]  # fmt: skip
            if body:
                parts.append(f"{name} [ms]\n\n{table(heads, body)}")
        return "\n\n".join(parts)
