"""Process that runs one package: it reads a request in JSON on stdin and answers in lines of JSON on stdout.

    python -m eip_scipy_studies.bench.worker < request.json

A request names the method, a task and problems. Each answer is written as soon as it is known, so that a stopped worker
keeps its results. Output of the package goes to stderr.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from time import perf_counter
from typing import Any

import numpy as np

from .equations import Functions, Scene, scene_from
from .peers import PEERS, Peer

Answers = Iterator[dict[str, Any]]


def precision(peer: Peer, request: Mapping[str, Any]) -> Answers:
    """Yield time [s], error and drift of the method for each problem, at each of the problem's settings in order.

    A setting is a tolerance or a number of steps; `Scene.error` and `Scene.drift` define error and drift. If a run
    fails, its error, shortened by `first_line`, is yielded instead of the three numbers. After a run that takes longer
    than the request's `patience` in seconds, the further settings of the problem are left out.
    """
    for record in request["scenes"]:
        try:
            scene = scene_from(record)
            solve = peer.prepare(scene)
            yield from _points(solve, scene, record, request, peer.warm)
        except ImportError:
            raise
        except Exception as error:  # any error of a package is its answer, and the next problem follows
            yield {"scene": record["title"], "said": first_line(error)}


def _points(
    solve: Callable[[float], np.ndarray],
    scene: Scene,
    record: Mapping[str, Any],
    request: Mapping[str, Any],
    warm: bool,
) -> Answers:
    for k, setting in enumerate(record["settings"]):
        try:
            if warm or k == 0:  # compilation and caches are not timed
                solve(setting)
            seconds, y = _least(partial(solve, setting), request["enough"], request["repeats"])
        except ImportError:
            raise
        except Exception as error:
            yield {"scene": scene.title, "setting": setting, "said": first_line(error)}
            continue
        finite = np.isfinite(y).all()
        yield {
            "scene": scene.title,
            "setting": setting,
            "seconds": seconds,
            "error": scene.error(y) if finite else None,
            "drift": scene.drift(y) if finite else None,
        }
        if seconds > request["patience"]:
            return


def _least(action: Callable[[], np.ndarray], enough: float, repeats: int) -> tuple[float, np.ndarray]:
    """Return the least time of a call in seconds, and the result of the last call.

    There are at most `repeats` calls, and none after `enough` seconds in all.
    """
    least, spent, y = np.inf, 0.0, np.empty(0)
    for _ in range(repeats):
        begin = perf_counter()
        y = action()
        taken = perf_counter() - begin
        least, spent = min(least, taken), spent + taken
        if spent > enough:
            break
    return least, y


def first(peer: Peer, request: Mapping[str, Any]) -> Answers:
    """Yield the error of one run: that of the request's only problem at its first setting.

    The parent process times the run together with the start of this process.
    """
    (record,) = request["scenes"]
    scene = scene_from(record)
    yield {"scene": record["title"], "error": scene.error(peer.prepare(scene)(record["settings"][0]))}


def asked(peer: Peer, request: Mapping[str, Any]) -> Answers:
    """Yield the response of the package to each problem, as text.

    It is the first line of the package's error or warning, or else the error of the state and the change of the
    invariants.
    """
    for record in request["scenes"]:
        scene, extra = scene_from(record), dict(record["extra"])
        functions = scene.plain()
        if extra.pop("invariants", False) and not peer.keeps:
            extra["invariants"] = [functions.values]
        if "events" in extra:
            extra["events"] = [_crossing]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                solve = peer.prepare(scene, **extra)
                y = solve(record["settings"][0])
            said = f"done, error {scene.error(y):.0e}, change of the invariants {scene.drift(y):.0e}"
            yield {"scene": record["title"], "said": said}
        except ImportError:
            raise
        except Exception as error:
            yield {"scene": record["title"], "said": first_line(error)}


def _crossing(t: float, y: np.ndarray) -> float:
    return float(np.real(y[0]))


def overhead(peer: Peer, request: Mapping[str, Any]) -> Answers:
    """Yield the seconds that a package adds to each evaluation of the user's function in a run, and the run's error."""
    (record,) = request["scenes"]
    scene = scene_from(record)
    setting = record["settings"][0]
    counting = _Counting(**{field.name: getattr(scene, field.name) for field in fields(scene)})
    _Counting.calls = 0
    peer.prepare(counting)(setting)
    solve, fun = peer.prepare(scene), scene.plain().fun
    seconds, y = _least(lambda: solve(setting), request["enough"], request["repeats"])
    alone, _ = _least(lambda: _call(fun, scene.y0), request["enough"], request["repeats"])
    each = seconds / _Counting.calls - alone / CALLS
    told = f"{_Counting.calls} evaluations of {alone / CALLS * 1e6:.1f} us"
    yield {"scene": record["title"], "seconds": each, "error": scene.error(y), "said": told}


CALLS = 2000


def _call(fun: Callable[..., Any], y: np.ndarray) -> Any:
    for _ in range(CALLS):
        fun(0.0, y)
    return y


class _Counting(Scene):
    """A problem that counts the calls of its plain `fun` and `acc` in the class attribute ``calls``."""

    calls = 0

    def plain(self) -> Functions:
        """Return the functions of the problem; calls of `fun` and `acc` are counted."""
        functions = super().plain()

        def counted(fun: Callable[..., Any]) -> Callable[..., Any]:
            def call(t: float, y: np.ndarray) -> Any:
                _Counting.calls += 1
                return fun(t, y)

            return call

        acc = None if functions.acc is None else counted(functions.acc)
        return functions._replace(fun=counted(functions.fun), acc=acc)


TASKS: dict[str, Callable[[Peer, Mapping[str, Any]], Answers]] = {
    "precision": precision, "first": first, "asked": asked, "overhead": overhead,
}  # fmt: skip


def first_line(error: BaseException) -> str:
    """Return the class of an error and the first line of its message, as text."""
    said = str(error).strip().split("\n")[0]
    return f"{type(error).__name__}: {said}" if said else type(error).__name__


def main() -> None:
    """Read one request, and write the answers and then the version of the package."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # output of a package is not an answer

    def say(answer: Mapping[str, Any]) -> None:
        answers.write(json.dumps(answer) + "\n")
        answers.flush()

    request = json.loads(sys.stdin.read())
    peer = PEERS[request["peer"]]
    warnings.simplefilter("ignore")
    try:
        for answer in TASKS[request["task"]](peer, request):
            say(answer)
    except ImportError as error:
        say({"absent": first_line(error)})
    except Exception as error:
        say({"said": first_line(error)})
    say({"version": _version(peer.distribution)})


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


if __name__ == "__main__":
    main()
