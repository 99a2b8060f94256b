"""Problems written as expressions: `hamiltonian` from H, `equations` from y' = f(t, y), `mechanics` from SymPy models.

SymPy is imported when one of these functions is called, and nowhere else in the package.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from ..multibody.callables import RANK_TOLERANCE

if TYPE_CHECKING:
    from ..multibody.problem import MechanicsProblem
    from .system import SymbolicProblem

__all__ = ["equations", "hamiltonian", "mechanics"]


def hamiltonian(
    H: Any,
    q: Any = None,
    p: Any = None,
    *,
    params: Mapping[Any, float] | None = None,
    invariants: Mapping[str, Any] | None = None,
    name: str | None = None,
    poisson: Any = None,
    extended: bool = False,
    perturbation: Any = None,
    dissipation: Mapping[str, Any] | None = None,
    balances: Mapping[str, Any] | None = None,
) -> SymbolicProblem:
    """Return the problem of a Hamiltonian: equations of motion, energy and gradients from one expression.

    Parameters
    ----------
    H : str or sympy.Expr
        The Hamiltonian. Text is read as Python's arithmetic of numbers, names, pi and functions such as sqrt and cos,
        by a parser that does not execute it. You can use every name except t, the time; a declared coordinate, momentum
        or parameter pi is not the number.
    q, p : str or sequence, optional
        Names of coordinates and momenta, as text such as ``"q1 q2"`` or a list, or SymPy symbols. The state is (q, p).
        Default: the names in `H` that are not parameters, paired as x with px, q1 with p1, theta with p_theta; the repr
        of the result shows the pairs.
    params : mapping, optional
        Values of the constants by name. ``problem.params`` and the rows of ``params`` for `ensemble` have its order.
    invariants : mapping, optional
        Expressions of further invariants by name; each is checked by its Poisson bracket with H.
    name : str, optional
    poisson : sequence of sequences or sympy.Matrix, optional
        Antisymmetric matrix B of a non-canonical system ``y' = B(y) grad H(y)``, whose entries are expressions. `q`
        then names the whole state y, and `p` is omitted. Give Casimirs as `invariants`.
    extended : bool, optional
        Whether to add a component p_t to the state, for an H that depends on t. With p_t' = -dH/dt and the start
        p_t = 0, H + p_t is an invariant.
    perturbation : str or sympy.Expr, optional
        A second Hamiltonian, which may depend on t: the equations are those of the sum of both.
    dissipation : mapping, optional
        Expressions that are added to the derivatives of components, by name: ``{"p": "-c*p"}`` for friction.
    balances : mapping, optional
        Expressions, by name, of integrals of `H` alone, by default H itself. With a perturbation or dissipation they
        become balances, with the rates that are due to these.

    Returns
    -------
    SymbolicProblem
        A `Problem` whose first invariant is "H". It has no start and no interval; pass these to the run:
        ``integrate(problem, t_span, y0, method=EIPDOP853, rtol=1e-10)``.

    Warns
    -----
    UserWarning
        If H depends on t, so that it is not an invariant.

    Raises
    ------
    ValueError, TypeError
        If an expression cannot be read or computed, names cannot be paired, or a given invariant is not conserved.
    ImportError
        If SymPy is not installed.

    See Also
    --------
    equations, eip_scipy.problems.mechanics, integrate

    Examples
    --------
    >>> from eip_scipy import EIPDOP853, hamiltonian, integrate
    >>> problem = hamiltonian("(px**2 + py**2 + x**2 + y**2)/2 + x**2*y - y**3/3")
    >>> run = integrate(problem, (0, 100), [0.0, 0.1, 0.5, 0.0], method=EIPDOP853, rtol=1e-10, atol=1e-10)
    >>> bool(run.max_residual[0] < 1e-14)
    True
    """
    with _sympy("hamiltonian"):
        from .system import hamiltonian_problem

        added = perturbation, dissipation, balances
        return hamiltonian_problem(
            H, q, p, poisson=poisson, extended=extended, added=added, params=params, invariants=invariants, name=name
        )


def equations(
    f: Any,
    y: Any = None,
    *,
    params: Mapping[Any, float] | None = None,
    invariants: Mapping[str, Any] | None = None,
    constraints: Mapping[str, Any] | None = None,
    name: str | None = None,
) -> SymbolicProblem:
    """Return the problem y' = f(t, y), written as expressions, with its invariants.

    Parameters
    ----------
    f : sequence or mapping
        The derivatives as text or SymPy expressions, in the order of `y`, or a mapping of components to derivatives.
    y : str or sequence, optional
        Names of the components, as text such as ``"x v"`` or a list, or SymPy symbols. Default: the keys of `f`.
        Components may be functions of time, `dynamicsymbols` of sympy.physics.mechanics. The keys may then be their
        derivatives, and a derivative in an expression is replaced by the right-hand side. If both x and x' are
        components, the latter is called ``v_x``.
    params, invariants, name
        As for `hamiltonian`. An invariant may depend on t; it is checked by its rate along the equations.
    constraints : mapping, optional
        Expressions by name that are 0 at the start and are kept at 0, such as ``{"length": "x**2 + y**2 - 1"}`` and the
        velocity constraint that belongs to it. The equations need to conserve the constraints and the invariants only
        at states where all constraints are 0.

    Returns
    -------
    SymbolicProblem

    Raises
    ------
    ValueError, TypeError, ImportError
        As for `hamiltonian`.

    See Also
    --------
    hamiltonian, eip_scipy.problems.mechanics, find_invariants

    Examples
    --------
    A pendulum in Cartesian coordinates, whose constraints are kept only where both of them hold:

    >>> from eip_scipy import equations
    >>> motion = {"x": "u", "y": "v", "u": "-s*x", "v": "-s*y - 9.81"}
    >>> motion = {k: f.replace("s", "(u**2 + v**2 - 9.81*y)") for k, f in motion.items()}
    >>> pendulum = equations(motion, constraints={"length": "x**2 + y**2 - 1", "rate": "x*u + y*v"},
    ...                      invariants={"energy": "(u**2 + v**2)/2 + 9.81*y"})
    >>> pendulum.checks["energy"]
    'numerically, at 8 points that meet the constraints'
    """
    with _sympy("equations"):
        from .system import equations_problem

        return equations_problem(f, y, params, invariants, constraints, name)


def mechanics(
    model: Any,
    params: Mapping[Any, float] | None = None,
    q0: Any = None,
    u0: Any = None,
    *,
    t_span: tuple[float, float] | None = None,
    inputs: Mapping[Any, Any] | None = None,
    energy: Any = None,
    potential_energy: Any = None,
    outputs: Mapping[str, Any] | None = None,
    independent: Iterable[Any] | None = None,
    rank_tolerance: float = RANK_TOLERANCE,
    name: str = "mechanics",
    **others: Any,
) -> MechanicsProblem:
    """Return the problem of a model of sympy.physics.mechanics.

    Its state is (q, u). A run keeps the constraints on positions and velocities, the norms of quaternions, the momenta
    of cyclic coordinates, and the energy if it is constant or changes slowly; see the problem's repr.

    Parameters
    ----------
    model : KanesMethod, LagrangesMethod or System
        The model, or any object with the attribute ``eom_method``, which is one of the first two.
    params : mapping, optional
        Values of the constants, by SymPy's symbols or by name. Values that are omitted are taken from
        ``model.constants``, which a System of PyDy has.
    q0, u0 : mapping or array_like, optional
        Coordinates and speeds at the start: mappings by dynamicsymbols or names, or arrays in the order of ``model.q``
        and ``model.u``, which has dependent speeds last. The speeds of a LagrangesMethod are the derivatives of the
        coordinates, called ``v_x`` for a coordinate ``x``. Default: ``model.initial_conditions``.
    t_span : tuple of float, optional
        Start and end of the interval. If it is omitted, the start is at t = 0.
    inputs : mapping, optional
        Values of the functions of time in the model that are neither coordinates nor speeds, by these functions, their
        names, or tuples of them: numbers, expressions of t and the state, or functions ``f(t, y)`` of y = (q, u), which
        return one number for each function in the key. A function may occur in forces only; the problem is compiled if
        the function is jitted by Numba. Default: ``model.specifieds`` of PyDy, whose functions have the arguments
        (y, t).
    energy : sympy.Expr, optional
        The total energy. Default: the energy of the bodies, or that of the Lagrangian, plus the potential of constant
        loads if the sum is constant.
    potential_energy : sympy.Expr, optional
        The potential of loads that are not constant, such as springs, which is added to the default of `energy`.
    outputs : mapping, optional
        Expressions, by name, of quantities that are computed at saved states; see ``run.outputs``. They may contain
        derivatives of coordinates and speeds.
    independent : iterable, optional
        Coordinates and speeds whose given values are kept; all others are guesses, from which the start is computed.
        Default: those that a KanesMethod does not call dependent; for a LagrangesMethod all of them.
    rank_tolerance, name, **others
        As for `mechanism`.

    Returns
    -------
    MechanicsProblem

    Raises
    ------
    ValueError
        If a parameter or an input is missing, two different quantities have the same name, the start does not meet the
        constraints, the equations divide by zero there, the mass matrix is singular for motions that the constraints
        allow, or the model has auxiliary speeds.
    ImportError
        If SymPy is not installed.

    See Also
    --------
    mechanism, eip_scipy.hamiltonian, MechanicsProblem

    Notes
    -----
    The equations of a KanesMethod are formed again with all speeds independent, and the constraints get Lagrange
    multipliers, see ``problem.multipliers``: the model's own equations have poles where its choice of dependent speeds
    is singular. KanesMethod ignores a configuration constraint without its velocity constraint; the latter is then
    added, and the repr has a note about it.

    Examples
    --------
    >>> from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols
    >>> from eip_scipy import EIPDOP853, integrate
    >>> from eip_scipy.problems import mechanics
    >>> x, y = dynamicsymbols("x y")
    >>> L = (x.diff() ** 2 + y.diff() ** 2) / 2 - 9.81 * y
    >>> rod = mechanics(LagrangesMethod(L, [x, y], hol_coneqs=[x**2 + y**2 - 1]), {}, [1, 0], [0, 0])
    >>> run = integrate(rod, (0, 10), method=EIPDOP853, rtol=1e-8, atol=1e-8)
    >>> bool(run.max_residual.max() < 1e-13)
    True
    """
    with _sympy("mechanics"):
        from .models import mechanics_of_model

        others |= {"t_span": t_span, "independent": independent, "tolerance": rank_tolerance, "name": name}
        return mechanics_of_model(model, params, (q0, u0), inputs, (energy, potential_energy), outputs, **others)


@contextmanager
def _sympy(what: str) -> Iterator[None]:
    """Raise ImportError without SymPy, and replace its RecursionError by a ValueError with the reason."""
    if find_spec("sympy") is None:
        raise ImportError(f'{what} needs SymPy: python -m pip install "eip_scipy[sympy]".')
    try:
        yield
    except RecursionError:
        raise ValueError(
            f"{what}: the expressions or their derivatives nest too deep for SymPy; pass Python functions to "
            "integrate instead."
        ) from None
