"""States on several ranks of MPI: the same as on one processor, to round-off."""

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import mpi_runs
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from test_docs import BLOCK, assert_output

pytest.importorskip("eip_scipy.integrations.mpi", exc_type=ImportError)

from eip_scipy import EIPRK4, EIPRK45, Diagnostics, Invariant, eip_method
from eip_scipy.integrations.mpi import MPI, gathered, over_ranks, total
from eip_scipy.integrations.mpi_fields import Slab, SlabGrossPitaevskii, Transposition
from eip_scipy.problems import Grid, GrossPitaevskii, Splitting, harmonic_trap
from eip_scipy.solvers import EIPSolver

TESTS = Path(__file__).parents[1]
# An MPI that pip installed for this Python has precedence.
MPIRUN = shutil.which("mpirun", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
ALONE = over_ranks(EIPRK4, MPI.COMM_SELF)
# Open MPI refuses to run as root and more ranks than cores; other libraries do not look at these.
OPEN_MPI = {
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
}


@pytest.fixture(scope="module")
def serial():
    return mpi_runs.serially()


def on_ranks(ranks, script, *arguments, cwd):
    """Return the output of a script; a rank that waits for another forever runs into the timeout."""
    command = [MPIRUN, "-n", str(ranks), sys.executable, "-m", "mpi4py", str(script), *arguments]
    done = subprocess.run(
        command, cwd=cwd, env=os.environ | OPEN_MPI, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


needs_mpirun = pytest.mark.skipif(MPIRUN is None, reason="there is no mpirun")


@needs_mpirun
@pytest.mark.parametrize(
    "ranks", [2, *(pytest.param(n, marks=[pytest.mark.nightly, pytest.mark.slow]) for n in (1, 4))]
)
def test_results_are_the_serial_ones(ranks, serial, tmp_path):
    on_ranks(ranks, TESTS / "mpi_runs.py", "results.npz", cwd=tmp_path)
    with np.load(tmp_path / "results.npz") as results:
        assert results["ranks"] == ranks, "mpirun and mpi4py belong to different MPI libraries"
        assert set(results) == {"ranks", *serial}
        for name, expected in serial.items():
            what = name.split(": ")[1].split(",")[0]
            found = results[name]
            if what in ("f", "y"):
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14 * np.abs(expected).max(), err_msg=name)
            elif what == "values":
                np.testing.assert_allclose(found, expected, rtol=1e-13, err_msg=name)
            elif what == "defects":
                np.testing.assert_allclose(found, expected, rtol=1e-2, atol=2e-13, err_msg=name)
            else:
                np.testing.assert_array_equal(found, expected, err_msg=name)


@pytest.mark.nightly
@pytest.mark.slow
@needs_mpirun
def test_the_page(tmp_path):
    """The script of the documentation's page runs on two ranks."""
    code, printed = (
        text for _, text in BLOCK.findall((TESTS.parent / "docs/developers/mpi.md").read_text(encoding="utf-8"))
    )
    (tmp_path / "condensate.py").write_text(code, encoding="utf-8")
    assert_output(on_ranks(2, "condensate.py", cwd=tmp_path), printed)
    assert np.load(tmp_path / "condensate.npy").shape == (32, 32, 24)


@pytest.mark.slow
@needs_mpirun
def test_a_sum_that_is_missing(tmp_path):
    """Ranks with different values would decide differently, and wait for each other."""
    code = """
        import numpy as np
        from eip_scipy import EIPRK4, Invariant
        from eip_scipy.integrations.mpi import MPI, over_ranks
        mass = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y, name="mass")
        start = np.array([1.0 + MPI.COMM_WORLD.rank, 0.0])
        try:
            over_ranks(EIPRK4)(lambda t, y: np.array([y[1], -y[0]]), 0.0, start, 1.0, h=0.1, invariants=mass)
        except ValueError as error:
            print(error)
    """
    (tmp_path / "run.py").write_text(textwrap.dedent(code), encoding="utf-8")
    message = "invariant 'mass' is 1 on one rank and 4 on another; let it return the sum over ranks, total(comm, ...)."
    # Lines of two ranks may run into one another.
    assert on_ranks(2, "run.py", cwd=tmp_path).count(message) == 2


FAILING = """
    import numpy as np
    from scipy.integrate import solve_ivp
    from eip_scipy import EIPRK4, Invariant
    from eip_scipy.integrations.mpi import MPI, RankError, over_ranks, together, total
    from eip_scipy.integrations.mpi_fields import SlabGrossPitaevskii
    from eip_scipy.problems import Grid

    comm = MPI.COMM_WORLD
    calls = {}

    def at(where, value):
        # Rank 1 raises in one function, at the call whose number is failing[1].
        if where != failing[0] or comm.rank != 1:
            return value
        calls[where] = calls.get(where, 0) + 1
        if calls[where] == failing[1]:
            raise failing[2]("beyond the data")
        return value

    def fun(t, y):
        return at("fun", np.array([y[1], -y[0]]))

    def mass(t, y):
        own = at("before the sum", y @ y)
        return at("after the sum", total(comm, own))

    def gradient(t, y):
        return at("gradient", 2 * y)

    gpe = SlabGrossPitaevskii(Grid((8, 6), -3, 3), beta=1.0)

    def field(t, y):
        return at("field", gpe.fun(t, y))

    def run():
        if failing[0] == "field":
            psi = np.exp(-sum(x * x for x in gpe.grid.mesh())).astype(complex).ravel()
            kept = gpe.invariants("mass")
            return solve_ivp(field, (0, 0.05), psi, method=over_ranks(EIPRK4), h=0.01, invariants=kept)
        kept = Invariant(mass, gradient, name="mass")
        with together(comm):
            sol = solve_ivp(fun, (0, 0.5), [1.0, 0.0], method=over_ranks(EIPRK4), h=0.1, invariants=kept)
            at("the loop", None)
        return sol

    def outcome():
        try:
            return run().message
        except BaseException as error:
            return f"{type(error).__name__}: {error}"

    failing = ("nowhere", 1, ValueError)
    run()
    # In the first call, in the middle, in the last one.
    for where, last in (("fun", 21), ("before the sum", 12), ("after the sum", 12), ("gradient", 6), ("field", 21),
                        ("the loop", 1)):
        for call in sorted({1, 2, 3, last // 2, last - 1, last} - {0}):
            for kind in (ValueError, KeyboardInterrupt) if call == last else (ValueError,):
                calls.clear()
                failing = where, call, kind
                texts = comm.gather(outcome())
                if comm.rank == 0:
                    print(where, call, kind.__name__, *texts, sep="|")
    failing = ("nowhere", 1, ValueError)
    texts = comm.gather(outcome())
    if comm.rank == 0:
        print(*texts, sep="|")
"""


@pytest.mark.slow
@needs_mpirun
@pytest.mark.parametrize("ranks", [2, pytest.param(3, marks=[pytest.mark.nightly, pytest.mark.slow])])
def test_a_rank_that_raises(ranks, tmp_path):
    """An error anywhere ends the other ranks with its message; nobody waits, and the communicator remains usable."""
    (tmp_path / "run.py").write_text(textwrap.dedent(FAILING), encoding="utf-8")
    *lines, last = on_ranks(ranks, "run.py", cwd=tmp_path).strip().split("\n")
    assert len(lines) > 20
    for line in lines:
        _, call, kind, *texts = line.split("|")
        own = f"{kind}: beyond the data"
        if texts[1] != own:  # fewer calls than that
            assert len(set(texts)) == 1, line
            assert int(call) > 1, line
            continue
        assert texts[0] == f"RankError: rank 1 raised {own}", line
        assert set(texts[2:]) <= {texts[0]}, line
    assert set(last.split("|")) == {"The solver successfully reached the end of the integration interval."}


# On one rank.


def small(make=GrossPitaevskii, shape=(10, 8), **options):
    gpe = make(Grid(shape, -3, 3.5), harmonic_trap(1, 1), Omega=0.5, beta=3.0, **options)
    return gpe, mpi_runs.vortex(gpe)


def test_values_are_those_of_the_equation():
    gpe, psi = small()
    slabs, _ = small(SlabGrossPitaevskii, comm=MPI.COMM_SELF)
    for name in ("mass", "energy", "angular_momentum", "chemical_potential", "largest_step"):
        assert getattr(slabs, name)(psi) == pytest.approx(getattr(gpe, name)(psi), rel=1e-14)
    at_rest = slabs.changed(Omega=0.0).fun(0, psi)
    np.testing.assert_allclose(at_rest, gpe.changed(Omega=0.0).fun(0, psi), rtol=0, atol=1e-13)


@pytest.mark.parametrize("iterations", [1, 2])
def test_a_run_through_solve_ivp(iterations):
    """Gradients are computed by numbers and vectors, in place and not."""

    def both(t, y):
        return np.array([total(MPI.COMM_SELF, np.vdot(y, y).real), 2 * total(MPI.COMM_SELF, np.vdot(y, y).real)])

    gpe, psi = small()
    slabs, _ = small(SlabGrossPitaevskii, comm=MPI.COMM_SELF)
    invariants = [*gpe.invariants("energy"), Invariant(both, lambda t, y: np.array([2 * y, 4 * y]), name="mass")]
    seen = Diagnostics(), Diagnostics()
    options = {"h": 0.02, "metric": "euclidean", "invariants": invariants, "iterations": iterations}
    expected = solve_ivp(gpe.fun, (0, 0.2), psi, method=EIPRK4, diagnostics=seen[0], **options)
    sol = solve_ivp(slabs.fun, (0, 0.2), psi, method=ALONE, diagnostics=seen[1], **options)
    np.testing.assert_allclose(sol.y, expected.y, rtol=0, atol=1e-14)
    assert (sol.nfev, sol.njev) == (expected.nfev, expected.njev)
    assert seen[1].n_rank_reduced == seen[0].n_rank_reduced == 10
    assert np.all(seen[1].max_defect < 1e-9)


def test_a_wrong_gradient_is_seen():
    gpe, psi = small(SlabGrossPitaevskii, comm=MPI.COMM_SELF)
    wrong = Invariant(lambda t, y: gpe.mass(y), lambda t, y: 2.001 * gpe.grid.cell * y, name="mass")
    with pytest.raises(ValueError, match="gradient of invariant 'mass' is wrong"):
        ALONE(gpe.fun, 0.0, psi, 1.0, h=0.1, invariants=wrong)
    ALONE(gpe.fun, 0.0, psi, 1.0, h=0.1, invariants=wrong, check=False)


def test_a_gradient_that_is_not_finite_fails_the_projection():
    mass = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y if t < 0.15 else y * np.nan, name="mass")
    sol = solve_ivp(lambda t, y: [y[1], -y[0]], (0, 1), [1.0, 0.0], method=ALONE, h=0.1, invariants=mass)
    assert sol.status == -1
    assert "projection failed at t=0.2: invariant 'mass'" in sol.message


def test_a_quench_stays_on_the_ranks():
    gpe, psi = small(SlabGrossPitaevskii, comm=MPI.COMM_SELF)
    other = gpe.changed(Omega=0.2)
    assert isinstance(other, SlabGrossPitaevskii)
    assert other.comm is gpe.comm
    expected = small()[0].changed(Omega=0.2).fun(0, psi)
    np.testing.assert_allclose(other.fun(0, psi), expected, rtol=0, atol=1e-13)
    values = SlabGrossPitaevskii(gpe.grid.whole, gpe.V, Omega=0.2, beta=3.0, comm=MPI.COMM_SELF)
    np.testing.assert_array_equal(values.fun(0, psi), other.fun(0, psi))


def test_parts_cover_the_grid():
    """Every point is on one rank, along x and along y, with the coordinates of the whole grid."""
    whole = Grid((11, 7, 5), -1, (1, 2, 3))
    ways = [Transposition(whole, SimpleNamespace(rank=rank, size=3)) for rank in range(3)]
    np.testing.assert_array_equal(np.concatenate([way.slab.points(0) for way in ways]), whole.points(0))
    np.testing.assert_array_equal(np.concatenate([way.turned.points(1) for way in ways]), whole.points(1))
    for way in ways:
        assert way.slab.cell == whole.cell
        np.testing.assert_array_equal(way.slab.wavenumbers(0, odd=True), whole.wavenumbers(0, odd=True))
        assert way.slab.mesh()[2].shape == (1, 1, 5)
    assert "Slab(Grid((11, 7, 5)" in repr(ways[0].slab)
    gpe, psi = small(SlabGrossPitaevskii, comm=MPI.COMM_SELF)
    assert isinstance(gpe.grid, Slab)
    np.testing.assert_array_equal(gpe.part(psi), gpe.gather(psi))


@pytest.mark.parametrize("shape", [(), (0,), (1, 2), (15,), (16,), (3, 7)])
def test_sums_are_in_the_order_of_the_ranks(shape):
    """The arrays have the sizes that travel with the flag, and larger ones."""
    a = np.random.default_rng(0).standard_normal(shape)
    found = gathered(MPI.COMM_SELF, a)
    assert found.shape == (1, *shape)
    np.testing.assert_array_equal(found[0], a)
    assert total(MPI.COMM_SELF, 0.1) == 0.1


def test_an_error_on_a_single_rank():
    def fun(t, y):
        if t > 0.5:
            raise ValueError("beyond the data")
        return -y

    with pytest.raises(ValueError, match="beyond the data"):
        solve_ivp(fun, (0, 1), [1.0], method=ALONE, h=0.1)


@pytest.mark.parametrize(("grid", "ranks"), [(Grid(8, 0, 1), 1), (Grid((8, 3), 0, 1), 4)])
def test_grids_that_cannot_be_cut(grid, ranks):
    with pytest.raises(ValueError, match=f"{ranks} ranks need at least {ranks} points along x and along y"):
        SlabGrossPitaevskii(grid, comm=SimpleNamespace(rank=0, size=ranks))


@pytest.mark.parametrize(
    ("method", "match"),
    [
        ("EIPRK4", "must be an EIP class"),
        (EIPSolver, "must be an EIP class"),
        (eip_method(Splitting(small()[0])), "not a Runge-Kutta method"),
        (ALONE, "is a class for ranks already"),
    ],
)
def test_methods_that_do_not_fit(method, match):
    with pytest.raises(TypeError, match=match):
        over_ranks(method)


MASS = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y, name="mass", target=1.0)


@pytest.mark.parametrize(
    ("error", "match", "options"),
    [
        (ValueError, "fixed steps only: give h", {}),
        (TypeError, "no option 'rtol'", {"rtol": 1e-6, "h": 0.1}),
        (TypeError, "did you mean 'iterations'", {"iteration": 2, "h": 0.1}),
        (ValueError, "Euclidean metric only", {"metric": "error", "h": 0.1}),
        (ValueError, "Euclidean metric only", {"metric": np.ones(2), "h": 0.1}),
        (ValueError, "every='auto'", {"every": "auto", "h": 0.1}),
        (ValueError, r"Invariant\(mass\) must have a gradient and no target", {"invariants": MASS, "h": 0.1}),
    ],
)
def test_options_that_do_not_fit(error, match, options):
    with pytest.raises(error, match=match):
        over_ranks(EIPRK45, MPI.COMM_SELF)(lambda t, y: y, 0.0, np.ones(2), 1.0, **options)


def test_no_dense_output():
    with pytest.raises(NotImplementedError, match="t_eval"):
        solve_ivp(lambda t, y: -y, (0, 1), [1.0], method=ALONE, h=0.1, t_eval=[0.05])
