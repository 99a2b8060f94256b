"""States of one run on the ranks of an MPI communicator: each rank holds a part, and the step runs on all of them.

``over_ranks(EIPRK4)`` is a class for `scipy.integrate.solve_ivp`, as `EIPRK4` is. The user's right-hand side returns
the part of the derivative that belongs to its rank. An invariant returns the same number on every rank, and its
gradient returns the rank's part. The step and its projection are those of `EIPSolver`.

Needs ``pip install "eip_scipy[mpi]"`` and an MPI library.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from eip_scipy.core.invariants import Invariant, InvariantSet, as_invariants
from eip_scipy.core.names import nearest
from eip_scipy.core.parts import SolverOfParts
from eip_scipy.core.solvers import EIPSolver

try:
    from mpi4py import MPI
except ModuleNotFoundError as error:
    raise ImportError(
        'eip_scipy.integrations.mpi needs mpi4py and an MPI library: pip install "eip_scipy[mpi]" mpich', name="mpi4py"
    ) from error
except RuntimeError as error:
    raise ImportError(
        "mpi4py finds no MPI library: load or install the machine's, or pip install mpich", name="mpi4py"
    ) from error

__all__ = ["MPI", "RankError", "gathered", "over_ranks", "together", "total"]

# Number of floats of each rank that travel in one message with the flag that says whether it has failed.
ROOM = 15

OPTIONS = ("h", "vectorized", "invariants", "metric", "iterations", "every", "reuse_f", "check", "diagnostics")


class RankError(RuntimeError):
    """Error that another rank raised; the message has the number of that rank and its error message."""


def gathered(comm: MPI.Comm, a: Any) -> np.ndarray:
    """Return the arrays `a` of all ranks, in the order of the ranks, on every rank.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm
    a : array_like
        Real numbers, in the same shape on all ranks.

    Returns
    -------
    ndarray, shape (ranks, ...)

    Raises
    ------
    RankError
        If another rank has raised an error in a block of `together`.
    """
    part = np.array(a, dtype=float, order="C")  # "ascontiguousarray" would give a number an axis
    size, shape = part.size, (comm.size, *part.shape)
    # The message always has the same size: a rank that has failed does not know for which sum the others wait.
    message, messages = np.zeros(1 + ROOM), np.empty((comm.size, 1 + ROOM))
    if size <= ROOM:
        message[1 : 1 + size] = part.reshape(-1)
    comm.Allgather(message, messages)
    if any(messages[:, 0].tolist()):
        rank, text = next((rank, text) for rank, text in enumerate(comm.allgather(None)) if text is not None)
        raise RankError(f"rank {rank} raised {text}")
    if size <= ROOM:
        return messages[:, 1 : 1 + size].copy().reshape(shape)
    parts = np.empty(shape)
    comm.Allgather(part, parts)
    return parts


@contextmanager
def together(comm: MPI.Comm) -> Iterator[None]:
    """Run a block on all ranks: an error that one rank raises ends it on all, instead of letting the others wait.

    Each call of `total` and `gathered` also tells the other ranks whether this one has failed, and the end of the block
    makes one more such call. Steps of the classes of `over_ranks` are such blocks already.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm
        The communicator that `total` and `gathered` use in the block.

    Raises
    ------
    RankError
        On the ranks that have no error themselves, at their next call of `total` or `gathered` or the end of the block.

    Examples
    --------
    >>> from eip_scipy.integrations.mpi import MPI, together, total
    >>> with together(MPI.COMM_WORLD):
    ...     ranks = total(MPI.COMM_WORLD, 1)
    >>> ranks == MPI.COMM_WORLD.size
    True
    """
    try:
        yield
        gathered(comm, ())
    except (RankError, MPI.Exception):
        raise
    except BaseException as error:
        if not getattr(error, "_is_known_to_ranks", False):
            comm.Allgather(np.ones(1 + ROOM), np.empty((comm.size, 1 + ROOM)))
            comm.allgather(f"{type(error).__name__}: {error}")
            error._is_known_to_ranks = True  # type: ignore[attr-defined]
        raise


def total(comm: MPI.Comm, a: Any) -> Any:
    """Return the sum of `a` over all ranks, in their order.

    All ranks get the same bits, which a reduction by MPI does not promise.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm
    a : array_like
        Real numbers, in the same shape on all ranks.

    Returns
    -------
    float or ndarray
        The sum, in the shape of `a`.

    Raises
    ------
    RankError
        If another rank has raised an error in a block of `together`.
    """
    sums = gathered(comm, a).sum(axis=0)
    return sums if sums.ndim else float(sums)


def over_ranks(method: type[EIPSolver], comm: MPI.Comm | None = None) -> type[EIPSolver]:
    """Derive from an EIP method the class for states that are distributed over several ranks.

    Every rank calls `solve_ivp`, or the class itself and its ``step()``, with its part of the state.

    Parameters
    ----------
    method : type
        `EIPRK4` or another explicit Runge-Kutta method of the package.
    comm : mpi4py.MPI.Comm, optional
        Default: ``MPI.COMM_WORLD``.

    Returns
    -------
    type
        A subclass of `method`. It steps with a fixed `h`, in the Euclidean metric, and takes the options `h`,
        `invariants`, `iterations`, `every` (a number), `reuse_f`, `check` and `diagnostics`. The check at the start
        compares the invariants of all ranks with each other, and with their gradients; it does not check that they are
        conserved.

    Raises
    ------
    TypeError
        If `method` is not the class of an explicit Runge-Kutta method, or is a class that `over_ranks` has returned.

    Notes
    -----
    A correction is a combination of the gradients. On each rank the parts of the gradients are written in an
    orthonormal basis of the space that they span there, with l numbers each for l invariants. The array of all ranks,
    (l, ranks * l), holds every product of the gradients to round-off, and the engine projects on it, identically on all
    ranks. This is the first half of a QR factorisation of tall matrices (Demmel, Grigori, Hoemmen & Langou, SIAM J.
    Sci. Comput. 34 (2012) A206-A239).

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.integrate import solve_ivp
    >>> from eip_scipy import EIPRK4, Invariant
    >>> from eip_scipy.integrations.mpi import MPI, over_ranks, total
    >>> def fun(t, y):  # oscillators, one on each rank
    ...     return np.array([y[1], -y[0]])
    >>> energy = Invariant(lambda t, y: total(MPI.COMM_WORLD, y @ y), lambda t, y: 2 * y)
    >>> sol = solve_ivp(fun, (0, 1), [1.0, 0.0], method=over_ranks(EIPRK4), h=0.1, invariants=energy)
    >>> bool(np.allclose(sol.y[:, -1], [np.cos(1), -np.sin(1)], atol=1e-5))
    True
    """
    if not (isinstance(method, type) and issubclass(method, EIPSolver) and hasattr(method, "TABLEAU")):
        raise TypeError(f"over_ranks: method must be an EIP class such as EIPRK4, got {method!r}.")
    if method.TABLEAU.in_python:
        raise TypeError(
            f"over_ranks: {method.__name__} is not a Runge-Kutta method; its step would see one rank only. Use "
            "EIPRK4, for example."
        )
    if issubclass(method, SolverOfParts):
        raise TypeError(f"over_ranks: {method.__name__} is a class for ranks already. Use it as it is.")
    members = {"COMM": MPI.COMM_WORLD if comm is None else comm, "__doc__": f"`{method.__name__}` over ranks."}
    return type(f"{method.__name__}OverRanks", (_OverRanks, method), members)


class _OverRanks(SolverOfParts):
    """Base class that `over_ranks` combines with the class of a method; `COMM` is the communicator."""

    COMM: MPI.Comm

    def __init__(self, fun: Callable[..., Any], t0: float, y0: Any, t_bound: float, **options: Any) -> None:
        with together(self.COMM):
            _refuse(type(self).__name__, options)
            super().__init__(fun, t0, y0, t_bound, **options | {"metric": "euclidean", "check": False})
            if options.get("check", True) and self.known.size:
                _check(self.COMM, self.known, t0, self.y, self.f, options["h"])

    def _step_impl(self) -> tuple[bool, str | None]:
        with together(self.COMM):
            return super()._step_impl()

    @property
    def place(self) -> tuple[int, int]:
        """See `SolverOfParts`."""
        return self.COMM.rank, self.COMM.size

    def gathered(self, a: Any) -> np.ndarray:
        """See `SolverOfParts`."""
        return gathered(self.COMM, a)

    def _dense_output_impl(self) -> Any:
        raise NotImplementedError(
            f"{type(self).__name__} has no dense output, which t_eval, events and dense_output=True need; choose h so "
            "that steps end at the times that you need."
        )


def _refuse(name: str, options: dict[str, Any]) -> None:
    """Raise an error for an option that is not in `OPTIONS` or a value that a run on several ranks does not support."""
    for option in options:
        if option not in OPTIONS:
            raise TypeError(f"{name} has no option {option!r}, only {', '.join(OPTIONS)}{nearest(option, OPTIONS)}")
    if options.get("h") is None:
        raise ValueError(f"{name} takes fixed steps only: give h.")
    if not isinstance(metric := options.get("metric"), str | None) or metric not in ("euclidean", None):
        raise ValueError(f"{name} has the Euclidean metric only, got metric = {metric!r}.")
    if options.get("every", 1) == "auto":
        raise ValueError(f"{name}: every='auto' needs an error estimate, which fixed steps do not take; give a number.")
    for item in as_invariants(options.get("invariants", ())):
        if item.target is not None or item.grad is None:
            raise ValueError(f"{name}: {item!r} must have a gradient and no target; its value at the start is kept.")


def _check(comm: MPI.Comm, known: InvariantSet, t: float, y: np.ndarray, f: np.ndarray, h: float) -> None:
    """Raise ValueError on all ranks if an invariant differs between them or disagrees with its gradient.

    The gradients are checked as in a run on one rank, but only on the plane through y along two random directions.
    """
    for name, values in zip(known.names, gathered(comm, known.start_values).T, strict=True):
        if np.any(values != values[0]):
            raise ValueError(
                f"invariant {name!r} is {values.min():.17g} on one rank and {values.max():.17g} on another; let it "
                "return the sum over ranks, total(comm, ...)."
            )
    rng = np.random.default_rng([20220, comm.rank])
    parts = rng.standard_normal((2, y.size)) + (1j * rng.standard_normal((2, y.size)) if y.dtype.kind == "c" else 0.0)
    directions = parts * (np.abs(y) + h * np.abs(f))
    slopes = total(comm, np.real(np.conj(known.gradients(t, y, f)) @ directions.T))
    plane = [
        Invariant(
            lambda t, z, k=k: known.values(t, y + (z - 1) @ directions)[k], lambda t, z, k=k: slopes[k], name=name
        )
        for k, name in enumerate(known.names)
    ]
    here, nowhere = np.ones(2), np.zeros(2)
    InvariantSet(plane, t, here, nowhere, 0.0).check(t, here, nowhere, 0.0)
