"""``eip-scipy study tangent-maps``: effect of projection on derivatives with respect to the start.

The state-transition matrix of Kepler's problem against its closed form; periodic orbits of the restricted three-body
problem; Lyapunov exponents compared with heyoka's variational equations, from one start and as means over a chaotic
sea; MEGNO compared with REBOUND's variational particles; the cost of columns of the state-transition matrix, for each
way to compute products with the Jacobian. The figure is a map of MEGNO over the semi-major axis and the eccentricity of
the second of two planets, by this package and by REBOUND.

The study needs Numba and SymPy; heyoka and REBOUND are optional:
``pip install "eip_scipy[heyoka,numba,rebound,sympy]"``.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, ProjectionWarning, hamiltonian, integrate
from eip_scipy.problems import kepler, solar_system
from eip_scipy.tangent_maps import megno, periodic_orbit

from ..report import needed, table
from ..study import Figures, Measurement, Rows, Session, option
from ..timing import least

PERIOD = 2 * math.pi
E = 0.6
PERICENTRE = np.array([1 - E, 0.0, 0.0, math.sqrt((1 + E) / (1 - E))])
KEPLER = "(px**2 + py**2)/2 - 1/sqrt(x**2 + y**2)"
WAYS: dict[str, dict[str, Any]] = {
    "plain": {"invariants": (), "symplectic": False},
    "projected": {"symplectic": False},
    "projected, symplectic": {},
}
MU = 0.01215058560962404  # Earth and Moon
TO_EARTH, TO_MOON = "sqrt((x + mu)**2 + y**2 + z**2)", "sqrt((x - 1 + mu)**2 + y**2 + z**2)"
THREE_BODIES = f"(px**2 + py**2 + pz**2)/2 + px*y - py*x - (1 - mu)/{TO_EARTH} - mu/{TO_MOON}"
ORBITS = {
    "halo orbit": ([0.8234, 0.0, 0.0224, 0.0, 0.9577, 0.0], 2.743, "z"),
    "Lyapunov orbit": ([0.8189, 0.0, 0.0, 0.0, 0.9938, 0.0], 2.78, "x"),
}
MIRROR = [1, -1, 1, -1, 1, -1]
HENON_HEILES = "(px**2 + py**2 + x**2 + y**2)/2 + x**2*y - y**3/3"
DOUBLE_PENDULUM = "(p**2 + 2*r**2 - 2*p*r*cos(a - b))/(2*(1 + sin(a - b)**2)) - 2*cos(a) - cos(b)"
MASS = 1e-3
REGULAR, CHAOTIC = (1.8, 0.02), (1.38, 0.1)
STEP = PERIOD / 40
CALM, WILD = 2.2, 4.0  # MEGNO below and above which an orbit counts as regular and as chaotic


def henon_heiles(heyoka: Any, x: Any, y: Any, u: Any, v: Any) -> Any:
    """Return the Hamiltonian of Hénon and Heiles, with momenta u and v, as an expression of heyoka."""
    return (u * u + v * v + x * x + y * y) / 2.0 + x * x * y - y * y * y / 3.0


def double_pendulum(heyoka: Any, a: Any, b: Any, p: Any, r: Any) -> Any:
    """Return the Hamiltonian of a double pendulum, with angles a, b and momenta p, r, as an expression of heyoka."""
    kinetic = (p * p + 2.0 * r * r - 2.0 * p * r * heyoka.cos(a - b)) / (2.0 * (1.0 + heyoka.sin(a - b) ** 2.0))
    return kinetic - 2.0 * heyoka.cos(a) - heyoka.cos(b)


class Chaotic(NamedTuple):
    """A Hamiltonian system in the forms of this package and of heyoka, with start, step and length of the run.

    `text` is the Hamiltonian as text for `hamiltonian`, and ``energy(heyoka, *variables)`` returns it as an expression
    of heyoka. `share` is the length of the run divided by the setting `time` of the study.
    """

    text: str
    energy: Callable[..., Any]
    y0: list[float]
    h: float
    share: float

    def problem(self) -> Any:
        """Return the system as a problem of this package, made by `hamiltonian`."""
        pair = (None, None) if "px" in self.text else ("a b", "p r")
        return hamiltonian(self.text, *pair)


SYSTEMS = {
    "Hénon-Heiles, E = 1/6": Chaotic(
        HENON_HEILES,
        henon_heiles,
        [0.0, -0.15, math.sqrt(2 * (1 / 6 - 0.15**2 / 2 - 0.15**3 / 3) - 0.1**2), 0.1],
        0.1,
        1.0,
    ),
    "double pendulum": Chaotic(DOUBLE_PENDULUM, double_pendulum, [2.0, 2.0, 0.0, 0.0], 0.05, 0.2),
}


def after_revolutions(n: int) -> np.ndarray:
    """Return the state-transition matrix (4, 4) of Kepler's orbit from `PERICENTRE` after n periods, in closed form.

    It is I - 3 n T f (dH/dy), where T is the period, f the right-hand side and H the Hamiltonian.
    """
    x, _, _, vy = PERICENTRE
    f, by_energy = np.array([0.0, vy, -1 / x**2, 0.0]), np.array([1 / x**2, 0.0, 0.0, vy])
    return np.eye(4) - 3 * PERIOD * n * np.outer(f, by_energy)


def planets(numba: Any) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return two jitted functions of gravitating bodies in space: the right-hand side and the energy."""

    @numba.njit
    def rates(t, y, out, m):
        n = m.size
        for i in range(3 * n):
            out[i], out[3 * n + i] = y[3 * n + i], 0.0
        for i in range(n):
            for j in range(i):
                dx, dy, dz = y[3 * j] - y[3 * i], y[3 * j + 1] - y[3 * i + 1], y[3 * j + 2] - y[3 * i + 2]
                r2 = dx * dx + dy * dy + dz * dz
                s = 1.0 / (r2 * np.sqrt(r2))
                for k, d in enumerate((dx, dy, dz)):
                    out[3 * (n + i) + k] += m[j] * s * d
                    out[3 * (n + j) + k] -= m[i] * s * d

    @numba.njit
    def energy(t, y, m):
        n, found = m.size, 0.0
        for i in range(n):
            v = 3 * (n + i)
            found += 0.5 * m[i] * (y[v] ** 2 + y[v + 1] ** 2 + y[v + 2] ** 2)
            for j in range(i):
                dx, dy, dz = y[3 * j] - y[3 * i], y[3 * j + 1] - y[3 * i + 1], y[3 * j + 2] - y[3 * i + 2]
                found -= m[i] * m[j] / np.sqrt(dx * dx + dy * dy + dz * dz)
        return found

    return rates, energy


def two_planets(axis: float, e: float) -> tuple[np.ndarray, np.ndarray]:
    """Return masses (3,) and the state (q, v) (18,) of a star and two planets at their pericentres on opposite sides.

    `axis` and `e` are semi-major axis and eccentricity of the second planet; the first has 1 and 0.02. All bodies move
    in one plane.
    """
    m = np.array([1.0, MASS, MASS])
    q, v = np.zeros((3, 3)), np.zeros((3, 3))
    for k, (a, ecc, side) in enumerate(((1.0, 0.02, 1), (axis, e, -1)), 1):
        q[k, 0] = side * a * (1 - ecc)
        v[k, 1] = side * math.sqrt((1 + MASS) * (1 + ecc) / (a * (1 - ecc)))
    q, v = q - m @ q / m.sum(), v - m @ v / m.sum()
    return m, np.concatenate([q.ravel(), v.ravel()])


class Found(NamedTuple):
    """The results of `_kepler`, `_orbits` and so on by their names, and the map of MEGNO.

    `map` and `rates` are MEGNO and the exponents of this package at `eccentricities` (rows) and `axes` (columns);
    `rebound` has the same of REBOUND, and is empty without it.
    """

    kepler: list[tuple[str, dict[str, float]]]
    orbits: dict[str, list[float]]
    exponents: dict[str, list[float | None]]
    planets: dict[str, list[float | None]]
    costs: dict[str, float]
    axes: np.ndarray
    eccentricities: np.ndarray
    map: np.ndarray
    followed: dict[str, list[float | None]]
    sea: dict[str, Any]
    rebound: dict[str, np.ndarray]
    rates: dict[str, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class TangentMaps(Measurement[Found]):
    """Command ``eip-scipy study tangent-maps``."""

    writes_files = True
    revolutions: int = option(
        50, "revolutions of Kepler's problem; a second run has ten times as many (default: %(default)s)", type=int
    )
    time: float = option(4e5, "length of the runs for Lyapunov exponents (default: %(default)g)", type=float)
    periods: int = option(2000, "length of the runs of two planets in periods (default: %(default)s)", type=int)
    grid: int = option(20, "points of the map along each axis; 0: no map (default: %(default)s)", type=int)
    starts: int = option(24, "number of starts in the chaotic sea for the mean (default: %(default)s)", type=int)
    map_periods: int = option(300, "length of the runs of the map in periods (default: %(default)s)", type=int)

    def measure(self, session: Session) -> Found:
        numba, _ = needed("numba", '"eip_scipy[numba]"'), needed("sympy", '"eip_scipy[sympy]"')
        with session.bar(7, "tangent maps", "part") as bar:
            parts: dict[str, Any] = {}
            for part in (_kepler, _orbits, _exponents, _followed, _sea, _planets, _costs):
                parts[part.__name__[1:]] = part(self, session, numba)
                bar.update()
            axes, eccentricities = np.linspace(1.25, 1.75, self.grid), np.linspace(0.0, 0.2, self.grid)
            maps = self._maps(axes, eccentricities, numba, session)
            return Found(**parts, axes=axes, eccentricities=eccentricities, **maps)

    def _maps(self, axes: np.ndarray, eccentricities: np.ndarray, numba: Any, session: Session) -> dict[str, Any]:
        """Return the fields `map`, `rates` and `rebound` of `Found`: MEGNO and Lyapunov exponents at each point.

        REBOUND, if it is installed, computes both as well, from the same tangent vectors.
        """
        peer = session.peer("rebound", "REBOUND's map of MEGNO")
        rates, energy = planets(numba)
        shape, end = (eccentricities.size, axes.size), self.map_periods * PERIOD
        ours, slopes = np.full(shape, np.nan), np.full(shape, np.nan)
        theirs = {"megno": np.full(shape, np.nan), "exponent": np.full(shape, np.nan)} if peer is not None else {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ProjectionWarning)
            for i, j in np.ndindex(shape):
                m, y0 = two_planets(float(axes[j]), float(eccentricities[i]))
                deviation = None
                if peer is not None:
                    theirs["megno"][i, j], slope, deviation = peer.megno(m, y0, t_end=end, dt=PERIOD / 60)
                    theirs["exponent"][i, j] = 2 * slope
                run = megno(rates, (0, end), y0, deviation=deviation, params=m, in_place=True, method=EIPDOP853, h=STEP,
                            every=end / 2, invariants=energy)  # fmt: skip
                # Close encounters, which these steps do not resolve, count as chaos.
                ours[i, j], slopes[i, j] = (run.megno, run.lyapunov) if run.trusted else (np.inf, np.nan)
        return {"map": ours, "rebound": theirs, "rates": {"exponent": slopes}}

    def table(self, found: Found) -> str:
        heads = [["error of the", "matrix"]] + [[name, ""] for name in WAYS]
        blocks = ["Kepler's problem, e = 0.6: relative error of the state-transition matrix"]
        blocks.append(table(heads[1:], [(name, [f"{row[way]:.1e}" for way in WAYS]) for name, row in found.kepler]))
        blocks.append("Periodic orbits of the restricted three-body problem (Earth and Moon)")
        heads = [["period", ""], ["closure", ""], ["M f = f", ""], ["dJ M = dJ", ""], ["largest", "multiplier"],
                 ["pairs:", "|product - 1|"]]  # fmt: skip
        rows = [
            (name, [f"{row[0]:.6f}", *(f"{x:.1e}" for x in row[1:4]), f"{row[4]:.2f}", f"{row[5]:.1e}"])
            for name, row in found.orbits.items()
        ]
        blocks.append(table(heads, rows))
        blocks.append("Largest Lyapunov exponent, from the same start and tangent vector")
        heads = [["EIPDOP853", ""], ["heyoka", ""], ["difference", "[%]"]]
        blocks.append(table(heads, [(name, [_number(x, 5) for x in row]) for name, row in found.exponents.items()]))
        blocks.append("The same along one orbit: heyoka starts anew from our state before rounding parts the two")
        blocks.append(table(heads, [(name, [_number(x, 8) for x in row]) for name, row in found.followed.items()]))
        sea = found.sea
        text = f"{sea['mean']:.5f} +- {sea['error']:.5f}"
        if "their mean" in sea:
            apart, sigma = 100 * (sea["mean"] / sea["their mean"] - 1), 100 * math.hypot(
                sea["error"], sea["their error"]
            ) / sea["their mean"]  # fmt: skip
            text += (
                f", heyoka {sea['their mean']:.5f} +- {sea['their error']:.5f}: {apart:+.2f} % apart, with a standard "
                f"error of {sigma:.2f} %"
            )
        blocks.append(
            f"Mean exponent over the chaotic sea of Hénon-Heiles, {self.starts} starts on one orbit, t = "
            f"{self.time / 4:g} each: {text}."
        )
        blocks.append(f"Two planets, {self.periods} periods: mean MEGNO, and twice its slope")
        heads = [["EIPDOP853", "MEGNO"], ["REBOUND", "MEGNO"], ["EIPDOP853", "exponent"], ["REBOUND", "exponent"]]
        blocks.append(table(heads, [(name, [_number(x, 4) for x in row]) for name, row in found.planets.items()]))
        if found.rebound:
            blocks.append(self._compared(found))
        blocks.append(
            "Time of a run with k columns, by default all, as a multiple of (k + 1) plain runs, by where J v comes from"
        )
        blocks.append(table([["multiple", ""]], [(name, [f"{x:.2f}"]) for name, x in found.costs.items()]))
        return "\n\n".join(blocks)

    def _compared(self, found: Found) -> str:
        """Return a text that compares the maps of this package and of REBOUND.

        It has the numbers of regular and chaotic points, MEGNO at the regular ones, and exponents of the chaotic ones.
        """
        ours, theirs = found.map, found.rebound["megno"]
        regular, chaotic = (ours < CALM) & (theirs < CALM), (ours > WILD) & (theirs > WILD)
        opposite = (ours < CALM) & (theirs > WILD) | (ours > WILD) & (theirs < CALM)
        text = (
            f"Map of MEGNO, {ours.size} points: {regular.sum()} regular by both (below {CALM:g}), {chaotic.sum()} "
            f"chaotic by both (above {WILD:g}), {opposite.sum()} regular by one and chaotic by the other."
        )
        if regular.any():
            apart = np.abs(ours - theirs)[regular]
            text += (
                f" On the regular ones median {np.median(ours[regular]):.4f}, REBOUND "
                f"{np.median(theirs[regular]):.4f}; apart by {np.median(apart):.1e} (median), {apart.max():.1e} "
                "(largest)."
            )
        both = chaotic & np.isfinite(found.rates["exponent"])
        if both.any():
            # Medians: in close encounters single rates are as large as those of all others together.
            rate, other = np.median(found.rates["exponent"][both]), np.median(found.rebound["exponent"][both])
            text += f" Median exponent of {both.sum()} chaotic ones {rate:.4f}, REBOUND {other:.4f}."
        return text

    def tables(self, found: Found) -> dict[str, Rows]:
        values = {"megno": found.map, **found.rates}
        values |= {f"REBOUND's {key}": item for key, item in found.rebound.items()}
        rows = [
            {"axis": a, "eccentricity": e, **{key: item[i, j] for key, item in values.items()}}
            for i, e in enumerate(found.eccentricities)
            for j, a in enumerate(found.axes)
        ]
        return {"megno-map.csv": rows} if rows else {}

    def figures(self, found: Found) -> Figures:
        if not found.map.size:
            return
        from eip_scipy.plotting.chaos import draw_stability

        from ..plotting import blank_figure

        maps = {"EIPDOP853": found.map} | ({"REBOUND": found.rebound["megno"]} if found.rebound else {})
        title = f"Two planets of 0.001 solar masses: MEGNO after {self.map_periods} periods"
        figure = blank_figure(4.2 * len(maps) + 1.2, 4.4, title)
        axes = figure.subplots(1, len(maps), sharey=True, squeeze=False)[0]
        for axis, (name, values) in zip(axes, maps.items(), strict=True):
            image = draw_stability(axis, found.axes, found.eccentricities, values, 8.0)
            axis.set_title(name, fontsize="medium")
            axis.set_xlabel("semi-major axis of the second planet [axis of the first]")
            for p, q in ((3, 2), (5, 3), (2, 1), (7, 5), (8, 5)):
                place = (p / q) ** (2 / 3)
                if found.axes[0] < place < found.axes[-1]:
                    axis.axvline(place, color="w", lw=0.8, ls=":")
                    axis.annotate(f"{p}:{q}", (place, found.eccentricities[-1]), (2, -2), textcoords="offset points",
                                  color="w", va="top", fontsize=8,
                                  bbox={"fc": "k", "alpha": 0.6, "lw": 0, "pad": 1.0})  # fmt: skip
        axes[0].set_ylabel("its eccentricity")
        figure.colorbar(image, ax=axes, extend="max", label="mean MEGNO (2: regular)")
        yield "megno-map.png", figure


def _number(x: float | None, digits: int) -> str:
    return "-" if x is None else f"{x:.{digits}g}"


def _kepler(study: TangentMaps, session: Session, numba: Any) -> list[tuple[str, dict[str, float]]]:
    problem = hamiltonian(KEPLER, invariants={"L": "x*py - y*px"})
    found = []
    for method, steps in ((EIPRK4, 388), (EIPDOP853, 60)):
        for n in (study.revolutions, 10 * study.revolutions):
            exact = after_revolutions(n)
            row = {}
            for way, options in WAYS.items():
                run = integrate(problem, (0, n * PERIOD), PERICENTRE, method=method, h=PERIOD / steps,
                                variations="state", **options)  # fmt: skip
                row[way] = float(np.linalg.norm(run.stm[-1] - exact) / np.linalg.norm(exact))
            found.append((f"{method.__name__}, {steps} steps, {n} revolutions", row))
    return found


def _orbits(study: TangentMaps, session: Session, numba: Any) -> dict[str, list[float]]:
    problem = hamiltonian(THREE_BODIES, q="x y z", p="px py pz", params={"mu": MU})
    found = {}
    for name, (guess, period, fixed) in ORBITS.items():
        orbit = periodic_orbit(problem, guess, period, fixed=[fixed], symmetry=MIRROR, method=EIPDOP853, h=0.01)
        pairs = orbit.multipliers.reshape(3, 2)
        off = float(np.abs(pairs.prod(axis=1) - 1).max())
        largest = float(np.abs(pairs[0, 0]))
        found[name] = [orbit.period, orbit.closure, orbit.flow_residual, orbit.invariant_residual, largest, off]
    return found


def _exponents(study: TangentMaps, session: Session, numba: Any) -> dict[str, list[float | None]]:
    heyoka = session.peer("heyoka", "heyoka's variational equations")
    found: dict[str, list[float | None]] = {}
    for name, system in SYSTEMS.items():
        problem = system.problem()
        # The first of these times is one at which rounding has not separated the orbits yet.
        for t_end in (200 * system.share, study.time * system.share):
            run = megno(problem, (0, t_end), system.y0, deviation=[1.0, 0.0, 0.0, 0.0], method=EIPDOP853, h=system.h)
            ours, theirs = float(run.log_size[-1] / t_end), None
            if heyoka is not None:
                theirs = heyoka.largest_exponent(
                    system.energy, system.y0, [1.0, 0.0, 0.0, 0.0], t_end=t_end, every=20.0
                )
            found[f"{name}, t = {t_end:g}"] = [ours, theirs, None if theirs is None else 100 * (ours / theirs - 1)]
    return found


def _sea(study: TangentMaps, session: Session, numba: Any) -> dict[str, Any]:
    """Return means and standard errors of the largest Lyapunov exponent over starts in the chaotic sea.

    The starts are states of one chaotic orbit at equally spaced times.

    Only the means of this package and of heyoka can agree: rounding separates two integrations of a chaotic orbit, and
    each of them stays near regular islands for long times now and then.
    """
    heyoka = session.peer("heyoka", "heyoka's variational equations")
    system = SYSTEMS["Hénon-Heiles, E = 1/6"]
    problem, t_end, vector = system.problem(), study.time / 4, [1.0, 0.0, 0.0, 0.0]
    times = 500.0 * np.arange(study.starts)
    starts = [np.array(system.y0)]
    if study.starts > 1:
        run = integrate(problem, (0, times[-1]), system.y0, method=EIPDOP853, h=system.h, t_eval=times)
        starts = list(run.y.T)
    options: dict[str, Any] = {"deviation": vector, "method": EIPDOP853, "h": system.h, "save_every": 100}
    ours = np.array([megno(problem, (0, t_end), y, **options).log_size[-1] / t_end for y in starts])
    found: dict[str, Any] = {"mean": ours.mean(), "error": _standard_error(ours), "each": ours.tolist()}
    if heyoka is not None:
        theirs = np.array([heyoka.largest_exponent(system.energy, y, vector, t_end=t_end, every=20.0) for y in starts])
        found |= {
            "their mean": theirs.mean(),
            "their error": _standard_error(theirs),
            "each of theirs": theirs.tolist(),
        }
    return found


def _followed(study: TangentMaps, session: Session, numba: Any) -> dict[str, list[float | None]]:
    """Return, for each of `SYSTEMS`, the largest Lyapunov exponent by this package, by heyoka, and the difference in %.

    The orbit is cut into pieces, so short that rounding does not separate the two runs; heyoka starts each piece at the
    state of this package.
    """
    heyoka = session.peer("heyoka", "heyoka's variational equations")
    found: dict[str, list[float | None]] = {}
    for name, system in SYSTEMS.items():
        problem, piece, pieces = system.problem(), 100 * system.share, max(1, round(study.time / 2000))
        y, vector, ours, theirs = np.array(system.y0), np.array([1.0, 0.0, 0.0, 0.0]), 0.0, 0.0
        for _ in range(pieces):
            run = integrate(problem, (0, piece), y, method=EIPDOP853, h=system.h, variations=vector)
            if heyoka is not None:
                theirs += heyoka.largest_exponent(system.energy, y, vector, t_end=piece, every=piece / 5) / pieces
            y, size = run.y[:, -1], float(np.linalg.norm(run.variations[-1]))
            vector = run.variations[-1][:, 0] / size
            ours += math.log(size) / (piece * pieces)
        apart = None if heyoka is None else 100 * (ours / theirs - 1)
        found[f"{name}, t = {pieces * piece:g}"] = [ours, None if heyoka is None else theirs, apart]
    return found


def _standard_error(values: np.ndarray) -> float:
    return float(values.std(ddof=1) / math.sqrt(values.size)) if values.size > 1 else math.nan


def _planets(study: TangentMaps, session: Session, numba: Any) -> dict[str, list[float | None]]:
    rebound = session.peer("rebound", "REBOUND's MEGNO")
    rates, energy = planets(numba)
    found: dict[str, list[float | None]] = {}
    t_end = study.periods * PERIOD
    for name, place in {"regular": REGULAR, "chaotic": CHAOTIC}.items():
        m, y0 = two_planets(*place)
        theirs, slope, deviation = None, None, None
        if rebound is not None:
            theirs, slope, deviation = rebound.megno(m, y0, t_end=t_end, dt=PERIOD / 60)
        run = megno(rates, (0, t_end), y0, deviation=deviation, params=m, in_place=True, method=EIPDOP853, h=STEP,
                    invariants=energy)  # fmt: skip
        found[f"{name}: a = {place[0]:g}, e = {place[1]:g}"] = [
            run.megno, theirs, run.lyapunov, None if slope is None else 2 * slope
        ]  # fmt: skip
    return found


def _costs(study: TangentMaps, session: Session, numba: Any) -> dict[str, float]:
    """Return times of runs with columns of the state-transition matrix, relative to plain runs.

    For Kepler's problem, the time with all four columns is divided by that of five plain runs, for each way to compute
    products of the Jacobian and a vector. The results of `_costs_of_ready_problems` are added.
    """

    def rates(t, y):
        r3 = (y[0] * y[0] + y[1] * y[1]) ** 1.5
        return np.array([y[2], y[3], -y[0] / r3, -y[1] / r3])

    def product(t, y, dy):
        r2 = y[0] * y[0] + y[1] * y[1]
        along = 3 * (y[0] * dy[0] + y[1] * dy[1]) / r2
        return np.array([dy[2], dy[3], (along * y[0] - dy[0]) / r2**1.5, (along * y[1] - dy[1]) / r2**1.5])

    problem = hamiltonian(KEPLER, invariants={"L": "x*py - y*px"})
    jitted, jitted_product = numba.njit(rates), numba.njit(product)
    cases: dict[str, tuple[Any, dict[str, Any], int]] = {
        "SymPy, both invariants": (problem, {}, 200),
        "SymPy, plain": (problem, {"invariants": ()}, 200),
        "dual numbers, plain": (jitted, {}, 200),
        "jitted jvp, plain": (jitted, {"jvp": jitted_product}, 200),
        "Python jvp, plain": (rates, {"jvp": product}, 2),
        "complex step, plain": (rates, {}, 2),
    }
    found = {}
    for name, (fun, options, n) in cases.items():
        common = {"method": EIPDOP853, "h": PERIOD / 60}
        plain = {key: value for key, value in options.items() if key != "jvp"}
        times = least(
            {
                "alone": partial(_seconds, fun, n, **common, **plain),
                "wide": partial(_seconds, fun, n, **common, **options, variations="state"),
            },
            turns=5,
        )
        found[name] = times["wide"] / (5 * times["alone"])
    return found | _costs_of_ready_problems()


def _costs_of_ready_problems() -> dict[str, float]:
    """Return times of runs of ready-made problems with k columns of derivatives; all runs keep the invariants.

    Each time is divided by that of k + 1 runs without columns.
    """
    bodies = solar_system()
    n = bodies.y0.size
    cases: dict[str, tuple[Any, float, Any, int]] = {
        "kepler()": (kepler(), 200 * PERIOD, "state", 4),
        "ten bodies, all columns": (bodies, 2.0, "state", n),
        "ten bodies, one column": (bodies, 20.0, np.ones((n, 1)), 1),
    }
    found = {}
    for name, (problem, end, asked, columns) in cases.items():

        def seconds(problem: Any = problem, end: float = end, **options: Any) -> float:
            return float(integrate(problem, (0, end), method=EIPDOP853, **options).wall_time)

        times = least({"alone": seconds, "wide": partial(seconds, variations=asked)}, turns=5)
        found[name] = times["wide"] / ((1 + columns) * times["alone"])
    return found


def _seconds(fun: Any, n: int, **options: Any) -> float:
    return float(integrate(fun, (0, n * PERIOD), PERICENTRE, **options).wall_time)
