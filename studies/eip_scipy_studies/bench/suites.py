"""The suites: problems with their exact final states, and the settings at which each package is run.

A record is the description of a problem in a request to the module `worker`: a dict with the fields of `Scene`, the
settings, and the kinds of functions with which the problem is run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy.problems import solar_system

from ..condensates.problems import soliton
from ..hard_cases import hard_cases, stored_cases
from ..work_precision import known_end
from .peers import COMPILED, OWN, PEERS, PYTHON, Peer

TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-13)
TIGHTEST = 1e-12  # for LSODA, which takes hundreds of times longer at smaller tolerances
HARD = ("kepler_e09", "arenstorf", "schwarzschild", "spherical_pendulum", "heisenberg", "three_wave")
MEMBERS, TURNS = 256, 10


@dataclass(frozen=True)
class Suite:
    """A group of problems for a task of the worker: "precision", "first", "asked" or "overhead".

    ``make()(peer)`` returns the records that the method `peer` runs, with the settings of this method; an empty list if
    it runs none. `note` is the explanation that the report prints.
    """

    name: str
    title: str
    task: str
    make: Callable[[], Callable[[Peer], list[dict[str, Any]]]]
    note: str


def _record(
    title: str,
    equations: str,
    y0: Any,
    end: Any,
    t_end: float,
    steps: Any = None,
    takes: Any = (PYTHON,),
    **params: Any,
) -> dict[str, Any]:
    y0, end = np.asarray(y0), np.asarray(end)
    flat = [np.ascontiguousarray(y).view(float) if np.iscomplexobj(y) else y for y in (y0, end)]
    return {
        "title": title, "equations": equations, "y0": flat[0].tolist(), "end": flat[1].tolist(), "t_end": t_end,
        "complex": bool(np.iscomplexobj(y0)), "params": params, "settings": steps or {}, "takes": takes,
    }  # fmt: skip


def _for(peer: Peer, records: list[dict[str, Any]], tolerances: tuple[float, ...] = TOLERANCES) -> list[dict[str, Any]]:
    """Return those of the records that the method `peer` runs, with the settings of this method.

    Settings are those that a record has for this kind of method, such as numbers of steps, or else `tolerances`.
    """
    if " LSODA" in peer.name.upper():
        tolerances = tuple(max(tolerance, TIGHTEST) for tolerance in tolerances)
    found = []
    for record in records:
        known = record["equations"] in peer.scenes or (not peer.scenes and record["equations"] != "members")
        if peer.takes in record["takes"] and known:
            family = next((name for name in record["settings"] if name in peer.name), None)
            if family is not None or not peer.steps:
                settings = tolerances if family is None else record["settings"][family]
                found.append({**record, "settings": list(settings)})
    return found


def _case(name: str, title: str, equations: str, steps: Any = None, takes: Any = (PYTHON, COMPILED, OWN)) -> Any:
    (case,) = hard_cases([name])
    params = {"name": name} if equations == "case" else {}
    return _record(title, equations, case.problem.y0, case.end, case.problem.t_span[1], steps, takes, **params)


def _geometric(first: int, last: int, count: int) -> list[int]:
    return [round(n) for n in np.geomspace(first, last, count)]


# Ends of the longer runs come from heyoka's Taylor series in 80-bit arithmetic at a tolerance of 1e-20; Kepler's is the
# start.
HENON_HEILES = {20_000: (0.2181875948347214, -0.17465537956592206, -0.33518077097563637, -0.2694826521686965)}
RIGID_BODY = {
    1_000: (0.17156870152565235, -0.593824253511304, 0.7860896492121903),
    20_000: (-0.1853169097078366, 0.5855033464441763, 0.7892043298658519),
}


def kepler() -> list[dict[str, Any]]:
    """Return six records: three small systems over a short time, and for compiled code the same over 20 times that.

    Compiled code needs longer runs, because the checks of a call take milliseconds.
    """
    orbit, regular, top = (case.problem for case in hard_cases(["kepler_e06", "henon_heiles_regular", "euler_top"]))
    compiled = COMPILED, OWN

    def steps(nystrom: tuple[int, int], multistep: tuple[int, int]) -> dict[str, list[int]]:
        return {"EIPRKN12": _geometric(*nystrom, 6), "EIPGJ12": _geometric(*multistep, 6)}

    def turning(turns: int, *takes: str) -> dict[str, Any]:
        counts = steps((22 * turns, 100 * turns), (390 * turns, 900 * turns))
        return _record(f"Kepler, {turns} turns", "kepler", orbit.y0, orbit.y0, 2 * math.pi * turns, counts, takes)

    def rolling(t_end: int, *takes: str) -> dict[str, Any]:
        assert regular.reference is not None
        end = HENON_HEILES.get(t_end, regular.reference(t_end))
        counts = steps((t_end * 6 // 10, t_end * 3), (t_end * 23, t_end * 60))
        return _record(f"Henon-Heiles, t = {t_end}", "henon_heiles", regular.y0, end, t_end, counts, takes)

    def tumbling(t_end: int, *takes: str) -> dict[str, Any]:
        return _record(f"rigid body, t = {t_end}", "rigid_body", top.y0, RIGID_BODY[t_end], t_end, (), takes)

    return [
        turning(32, PYTHON), rolling(1_000, PYTHON), tumbling(1_000, PYTHON),
        turning(640, *compiled), rolling(20_000, *compiled), tumbling(20_000, *compiled),
    ]  # fmt: skip


def solar() -> list[dict[str, Any]]:
    """Return three records: the outer solar system, and the full one over a year and, for compiled code, 100 years."""
    (outer,) = hard_cases(["outer_solar_system"])
    stored = stored_cases()[outer.name]["params"]
    gm = [stored["G"] * m for m in stored["masses"]]
    both = (PYTHON, COMPILED, OWN)
    few = (1e-9, 1e-13)  # heyoka compiles for ten seconds at each tolerance
    outer_steps = {
        "EIPRKN12": _geometric(150, 900, 6), "EIPGJ12": _geometric(4700, 12000, 4),
        "WHFast": _geometric(250, 16000, 6), "heyoka": few,
    }  # fmt: skip
    records = [_record("outer solar system", "bodies", outer.problem.y0, outer.end, 2e5, outer_steps, both, gm=gm)]
    for years, takes in ((1.0, (PYTHON,)), (100.0, (COMPILED, OWN))):
        problem = solar_system(years=years)
        assert problem.params is not None
        full_steps = {
            "EIPRKN12": [round(years * n) for n in (20, 25, 32, 40, 50, 64)],
            "EIPGJ12": [round(years * n) for n in (560, 650, 750, 900)],
            "EIPGJ14": [round(years * n) for n in (260, 300, 350, 412, 500, 600)],
            "WHFast": [round(years * n) for n in (15, 30, 60, 120, 240, 480)],
            "heyoka": few,
        }
        title = f"full solar system, {years:g} year{'s' if years > 1 else ''}"
        gm = problem.params[:10].tolist()
        records.append(_record(title, "bodies", problem.y0, known_end(problem), years, full_steps, takes, gm=gm))
    return records


def particle() -> list[dict[str, Any]]:
    """Return one record: a charge in a plane."""
    return [_case("boris_2d", "charged particle", "particle")]


def field() -> list[dict[str, Any]]:
    """Return one record: a soliton on a ring.

    The ring is so wide and so finely resolved that the closed form solves the discrete equations to 1e-10.
    """
    problem = soliton(points=256, length=50.0, t_end=2.0)
    return [_record("NLS soliton", "nls", problem.y0, known_end(problem), 2.0, length=50.0)]


def hard() -> list[dict[str, Any]]:
    """Return the records of the hard cases `HARD`, which are run with plain Python functions only."""
    return [_case(name, name.replace("_", " "), "case", takes=(PYTHON,)) for name in HARD]


def members() -> list[dict[str, Any]]:
    """Return one record: `MEMBERS` Kepler orbits of e = 0 ... 0.6 over whole revolutions, so that the end is the start.

    There are `TURNS` revolutions.
    """
    e = np.linspace(0.0, 0.6, MEMBERS)
    starts = np.array([1 - e, 0 * e, 0 * e, np.sqrt((1 + e) / (1 - e))]).T
    steps = {"EIPRKN12": _geometric(200, 1000, 5)}
    takes = (PYTHON, COMPILED, OWN)
    return [_record(f"{MEMBERS} Kepler orbits", "members", starts, starts, TURNS * 2 * math.pi, steps, takes)]


def first_use() -> list[dict[str, Any]]:
    """Return one record: a short Kepler orbit, which each method solves in a new process."""
    (orbit,) = hard_cases(["kepler_e03"])
    steps = {"EIPRKN12": [250], "EIPGJ12": [4000], "heyoka": [1e-9]}
    t_end = orbit.problem.t_span[1]
    takes = (PYTHON, COMPILED, OWN)
    return [_record("Kepler, e = 0.3, 10 turns", "kepler", orbit.problem.y0, orbit.end, t_end, steps, takes)]


def asking() -> list[dict[str, Any]]:
    """Return three records that ask for more than the solution of a real system: complex state, invariants, events."""
    (orbit,), (wave,) = hard_cases(["kepler_e03"]), hard_cases(["three_wave"])
    steps = {"EIPRKN12": [250], "EIPGJ12": [4000]}
    real = ("kepler", orbit.problem.y0, orbit.end, orbit.problem.t_span[1], steps, (PYTHON, COMPILED, OWN))
    state = ("case", wave.problem.y0, wave.end, wave.problem.t_span[1])
    return [
        {**_record("a complex state", *state, name="three_wave"), "extra": {}},
        {**_record("invariants=", *real), "extra": {"invariants": True}},
        {**_record("events=", *real), "extra": {"events": True}},
    ]


def _one_setting(records: list[dict[str, Any]]) -> Callable[[Peer], list[dict[str, Any]]]:
    """Return a function of a method, as a `make` of `Suite` returns it, that gives the records with one tolerance.

    Methods with fixed steps get the numbers of steps in the records. Only the first method of each package for each
    kind of function gets any records.
    """
    able = [peer for peer in PEERS.values() if _for(peer, records)]
    first = {(peer.distribution, peer.takes): peer.name for peer in reversed(able)}.values()
    return lambda peer: _for(peer, records, (1e-9,)) if peer.name in first else []


def _all(records: list[dict[str, Any]]) -> Callable[[Peer], list[dict[str, Any]]]:
    return lambda peer: _for(peer, records)


def _described() -> tuple[Suite, ...]:
    return (
        Suite("kepler", "Kepler, Henon-Heiles, a rigid body", "precision", lambda: _all(kepler()), KEPLER),
        Suite("solar", "Outer and full solar system", "precision", lambda: _all(solar()), SOLAR),
        Suite("particle", "A charged particle", "precision", lambda: _all(particle()), PARTICLE),
        Suite("field", "A field on a grid", "precision", lambda: _all(field()), FIELD),
        Suite("hard-cases", "Six of the hard cases", "precision", lambda: _all(hard()), HARD_CASES),
        Suite(
            "overhead", "What a package adds to each evaluation", "overhead", lambda: _one_setting(cheap()), OVERHEAD
        ),
        Suite("first-use", "Time to the first result", "first", lambda: _one_setting(first_use()), FIRST_USE),
        Suite("ensemble", "Many members", "precision", lambda: _all(members()), ENSEMBLE),
        Suite("asked", "Asked for more", "asked", lambda: _one_setting(asking()), ASKED),
    )


def cheap() -> list[dict[str, Any]]:
    """Return one record: a rigid body, whose right-hand side is cheap, because its three components are products."""
    return [record for record in kepler() if record["title"] == "rigid body, t = 1000"]


KEPLER = "The same function for all; compiled runs go on for twenty times as long."
SOLAR = "Six bodies over 200 000 days, ten bodies (DE440) over a year, and over a century in compiled code."
PARTICLE = "A charge in a field that grows with the radius (Qin et al. 2013), t = 500."
FIELD = "A soliton of the nonlinear Schroedinger equation, 256 complex components by FFT, t = 2."
HARD_CASES = "Kepler of e = 0.9, Arenstorf, a zoom-whirl orbit, constraints, spins, and a complex system."
OVERHEAD = (
    "A rigid body to t = 1000 at a tolerance of 1e-9: time of a run by its evaluations, less the function itself."
)
FIRST_USE = "From the start of a process to its first solution: imports, compilation, a short orbit."
ENSEMBLE = "Orbits of e = 0 ... 0.6 over ten turns, one core; the error is that of the worst member."
ASKED = "What the packages say to options of ours, and to a complex state."
SUITES: dict[str, Suite] = {suite.name: suite for suite in _described()}
