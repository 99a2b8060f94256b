"""The options `variations`, `jvp` and `symplectic`: values that they take and refuse, and messages, on a pendulum."""

from functools import partial

import numpy as np
import pytest
from numba import njit
from systems import refuse

from eip_scipy import EIPDOP853, Invariant, hamiltonian, integrate, solve_ivp
from eip_scipy.checkpoint import CheckpointError

SPAN, START = (0.0, 3.0), [1.0, 0.3]
J = np.array([[0.0, 1.0], [-1.0, 0.0]])


def pendulum(t, y, params=(1.0,)):
    return np.array([y[1], -params[0] * np.sin(y[0])])


def energy(t, y, params=(1.0,)):
    return 0.5 * y[1] ** 2 - params[0] * np.cos(y[0])


def product(t, y, dy):
    return np.array([dy[1], -np.cos(y[0]) * dy[0]])


def run_of(**options):
    options = {"method": EIPDOP853, "h": 0.1, "invariants": [Invariant(energy, name="H")], **options}
    return integrate(**{"fun": pendulum, "t_span": SPAN, "y0": START, **options})


def test_refuses():
    energy_alone = [Invariant(lambda t, y: y[0] - y[1])]
    odd = {"variations": "state", "symplectic": True, "invariants": energy_alone, "fun": lambda t, y: -y}
    no_matrix = "symplectic=True: .*are not a state-transition matrix"
    rows = [
        ({"variations": ["state", "state"]}, ValueError, "twice"),
        ({"variations": []}, ValueError, "names or indices of"),
        ({"variations": [True]}, ValueError, "names or indices of"),
        ({"variations": np.eye(3)}, ValueError, r"an array \(2, k\)"),
        ({"variations": [[np.nan], [0.0]]}, ValueError, "finite"),
        ({"variations": 7}, ValueError, "there is no parameter 7"),
        ({"variations": "length"}, ValueError, "no parameter 'length'"),
        ({"variations": [[1.0], [0.0]], "symplectic": True}, ValueError, no_matrix),
        ({"variations": 0, "symplectic": True}, ValueError, no_matrix),
        ({"variations": ["state", 0], "symplectic": True}, ValueError, no_matrix),
        ({"variations": "state", "symplectic": True, "invariants": ()}, ValueError, "without invariants"),
        (odd | {"y0": np.ones(3), "params": None}, ValueError, r"3 components is not \(q, p\)"),
    ]
    refuse(run_of, [({"params": [1.3]} | options, *rest) for options, *rest in rows])
    assert not run_of(variations="state").columns["symplectic"]


def test_refuses_a_wrong_jvp():
    wrong = [
        (lambda t, y, dy: np.array([dy[1], np.cos(y[0]) * dy[0]]), ValueError, "jvp is not the Jacobian"),
        (lambda t, y, dy: dy[:1], ValueError, "jvp returned shape"),
        (lambda y, dy: dy, TypeError, r"jvp is called with \(t, y, dy\).*always the time"),
        (3, TypeError, "jvp must be a function"),
    ]
    rows = [({"variations": "state", "jvp": jvp}, *rest) for jvp, *rest in wrong]
    refuse(run_of, rows)
    refuse(partial(solve_ivp, pendulum, SPAN, START, method=EIPDOP853, h=0.1), rows)


def test_a_place_stands_for_a_list_of_one():
    one, several = (run_of(variations=asked, params=[1.3]).sensitivities for asked in (0, [0]))
    assert one.shape == (2, 2, 1)
    np.testing.assert_array_equal(one, several)


def reusing(fun):
    """Return `fun` with values in an array that each call fills again, one for each type of numbers."""
    arrays = {}

    def filled(*args):
        found = np.asarray(fun(*args))
        array = arrays.setdefault(found.dtype, np.empty_like(found))
        array[:] = found
        return array

    return filled


@pytest.mark.parametrize("jvp", [None, product])
def test_functions_may_return_the_same_array_in_each_call(jvp):
    options = {"variations": "state", "jvp": jvp and reusing(jvp)}
    expected = run_of(variations="state", jvp=jvp).variations
    found = integrate(reusing(pendulum), SPAN, START, method=EIPDOP853, h=0.1, invariants=Invariant(energy), **options)
    np.testing.assert_array_equal(found.variations, expected)


def test_complex_steps_that_are_wrong_are_refused():
    """The imaginary part is lost in an array that is used again, or in a drag; also where that is at rest."""
    norm = np.linalg.norm
    wrong = [
        {"fun": reusing(lambda t, y: pendulum(t, y.real))},
        {"fun": lambda t, y: np.array([y[1], -y[0] - abs(y[1]) * y[1]])},
        {"fun": lambda t, y: np.array([y[1], -y[0] - 1e-3 * norm(y[1]) * y[1]]), "y0": [1.0, 0.0]},
    ]
    given = {"variations": "state", "invariants": ()}
    refuse(run_of, [(given | options, ValueError, "does not support complex steps") for options in wrong])


def test_complex_steps_are_kept_where_forces_cancel():
    # The rounding of the differences of positions is larger than the comparison with differences of fun allows, and
    # these differences, whose lengths follow from the positions, are wrong.
    def two_bodies(t, y):
        d = y[2:4] - y[:2]
        a = d / (d @ d) ** 1.5
        return np.concatenate([y[4:], a / 2, -a / 2])

    near, far = (
        integrate(
            two_bodies, (0, 3), [x - 0.5, x, x + 0.5, x, 0, -0.5, 0, 0.5], method=EIPDOP853, h=0.1, variations="state"
        ).stm[-1]
        for x in (0.0, 1e6)
    )
    np.testing.assert_allclose(far, near, rtol=0, atol=1e-6)


def test_says_where_the_products_come_from():
    assert run_of(variations="state").columns["source"] == "complex steps"
    assert run_of(variations="state", jvp=product).columns["source"] == "jvp"
    problem = hamiltonian("p**2/2 - cos(q)")
    run = integrate(problem, SPAN, START, method=EIPDOP853, h=0.1, variations="state")
    assert run.columns == {"state": True, "parameters": 0, "names": [], "symplectic": True, "source": "problem"}


def test_symplectic_keeps_what_it_says():
    plain, kept = (run_of(h=0.4, variations="state", symplectic=symplectic).stm[-1] for symplectic in (False, True))
    residual = [np.abs(M.T @ J @ M - J).max() for M in (plain, kept)]
    assert residual[1] < 1e-13 < 1e-11 < residual[0]


def test_results_without_derivatives_say_what_to_ask_for():
    run = run_of()
    for name, message in (("stm", 'variations="state"'), ("sensitivities", "name parameters"), ("variations", "=...")):
        with pytest.raises(AttributeError, match=message):
            getattr(run, name)
    with pytest.raises(AttributeError, match="name parameters"):
        _ = run_of(variations="state").sensitivities
    with pytest.raises(AttributeError, match='variations="state"'):
        _ = run_of(variations=0, params=[1.0]).stm


def broken_off(tmp_path, **options):
    """Return a checkpoint of a run that ended in its middle."""

    def stop(t, y, values):
        if t > 1:
            raise RuntimeError

    with pytest.raises(RuntimeError):
        run_of(checkpoint=tmp_path / "file", checkpoint_every=1e-9, callback=stop, **options)
    return tmp_path / "file"


def test_a_checkpoint_belongs_to_its_derivatives(tmp_path):
    options = {"variations": "state", "symplectic": False}
    file = broken_off(tmp_path, **options)
    with pytest.raises(CheckpointError, match="symplectic"):
        run_of(checkpoint=file, resume=True, variations="state", symplectic=True)
    run = run_of(checkpoint=file, resume=True, **options)
    np.testing.assert_array_equal(run.stm, run_of(**options).stm)
    (tmp_path / "other").mkdir()
    file = broken_off(tmp_path / "other", variations=0, params=[1.0, 1.0])
    with pytest.raises(CheckpointError, match="derivatives by"):
        run_of(checkpoint=file, resume=True, variations=1, params=[1.0, 1.0])


@pytest.mark.parametrize("every", [1, 4])
def test_dense_output_is_that_of_the_states(every):
    t = np.linspace(*SPAN, 41)
    run = run_of(variations="state", dense_output=True, every=every)
    plain = run_of(dense_output=True, every=every)
    assert run.sol(t).shape == (2, 41)
    np.testing.assert_allclose(run.sol(t), plain.sol(t), rtol=0, atol=1e-15)
    if every == 1:
        np.testing.assert_allclose(energy(0, run.sol(t)), energy(0, np.array(START)), rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("rows", [{"every": 4, "save_every": 1}, {"t_eval": [0.13, 1.42, 2.9]}])
@pytest.mark.parametrize("jit", [pytest.param(True, marks=pytest.mark.needs_jit), False])
def test_rows_without_a_projection_of_their_own_are_projected(rows, jit):
    fun, kept = (njit(pendulum), njit(energy)) if jit else (pendulum, energy)
    options = {"params": [1.0], "method": EIPDOP853, "h": 0.4, "invariants": [kept], **rows}
    run = integrate(fun, SPAN, START, variations="state", **options)
    assert run.compiled == jit
    q, p = run.y
    gradients = np.column_stack([np.sin(q), p])[:, None] @ run.stm
    np.testing.assert_allclose(gradients, np.tile([np.sin(START[0]), START[1]], (q.size, 1, 1)), rtol=0, atol=2e-15)
