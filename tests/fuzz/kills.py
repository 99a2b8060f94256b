"""Kill runs that write checkpoints, at random instants and repeatedly, and check that they resume as if not killed.

    python -m tests.fuzz.kills --kills 300

Needs the signals of POSIX. Each chain of kills is made from a number. A violation prints the number and the command
that runs the chain again; the exit status is then 1.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy import checkpoint

from .runs import KINDS, SINGLE, kept_in, whole, work

SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
LONGEST = 0.9  # seconds from the start of a run to its kill; a whole run takes about as long
MOST = 4  # kills of one run before it may end
PATIENCE = 30.0


def differences(kind: str, run: Any) -> Iterator[str]:
    """Yield the parts of a run that differ from those of the whole one in any bit."""
    names = ["t", "y", "status", "max_defect", "trusted", "nfev", "njev", "nlu"]
    names += ["invariants"] if kind in SINGLE else ["failed", "max_correction", "message"]
    pairs = {name: (getattr(whole(kind), name), getattr(run, name)) for name in names}
    if kind == "adaptive":
        pairs |= {name: (whole(kind)[name][0], run[name][0]) for name in ("t_events", "y_events")}
    if kind in ("members", "trajectories"):
        name = "reduced" if kind == "members" else "trajectories"
        pairs[name] = whole(kind)[name], run[name]
    for name, (a, b) in pairs.items():
        if not np.array_equal(a, b, equal_nan=np.asarray(a).dtype.kind == "f"):
            yield f"{name}: {b!r} where the whole run has {a!r}"


def done(kind: str, path: Path) -> int:
    """Return the number of steps or members in a checkpoint; -1 without one."""
    if not path.exists():
        return -1
    header, _ = checkpoint.read(path)
    return int(header["step" if kind in SINGLE else "finished"])


def chain(seed: int, folder: Path, context: Any, most: int, killed: Counter[str]) -> Iterator[str]:
    """Kill one run up to `most` times, then let it end; yield the faults."""
    rng = np.random.default_rng(seed)
    kind = list(KINDS)[seed % len(KINDS)]
    path, before = folder / f"{kind}-{seed}", -1
    for _ in range(min(most, int(rng.integers(1, MOST + 1)))):
        number = SIGNALS[rng.integers(len(SIGNALS))]
        process = context.Process(target=work, args=(kind, path))
        process.start()
        time.sleep(LONGEST * rng.random() ** 2)
        if process.is_alive():
            os.kill(process.pid, number)
        process.join(PATIENCE)
        if process.exitcode is None:
            process.kill()
            process.join()
            yield f"{kind}: {number.name} did not end it within {PATIENCE:g} s"
            return
        ended = process.exitcode == 0
        # SIGTERM raises KeyboardInterrupt where a checkpoint is written, and ends the process elsewhere.
        statuses = {signal.SIGINT: (0, 1), signal.SIGTERM: (0, 1, -number), signal.SIGKILL: (0, -number)}
        if process.exitcode not in statuses[number]:
            yield f"{kind}: exit status {process.exitcode} after {number.name}"
        killed["ended before"] += ended
        killed[number.name] += not ended
        after = done(kind, path)
        if after < before:
            yield f"{kind}: the checkpoint held {before}, and {after} after {number.name}"
        before = after
        if ended:
            break
    run = KINDS[kind](**kept_in(kind, path))
    if kind in SINGLE:
        killed["killed before the first write"] += before < 0
        resumed_at = re.search(r"resumed at step (\d+)|started at the beginning", run.message)
        if resumed_at is None or int(resumed_at[1] or -1) != before:
            yield f"{kind}: the checkpoint held step {before}, and the message is {run.message!r}"
    for text in differences(kind, run):
        yield f"{kind}: {text}"


def kill(kills: int, seed: int, seconds: float = math.inf) -> tuple[Counter[str], list[str]]:
    """Kill the runs `kills` times; return the counts, and the faults."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.fuzz.warm"])  # where the run starts in the repository's root
    killed, wrong, begin = Counter[str](), [], time.monotonic()
    names = {number.name for number in SIGNALS}
    while (left := kills - sum(killed[name] for name in names)) > 0 and time.monotonic() - begin < seconds:
        with tempfile.TemporaryDirectory() as folder:
            for text in chain(seed, Path(folder), context, left, killed):
                wrong.append(text)
                print(f"VIOLATION in chain {seed}: {text}\n  again: python -m tests.fuzz.kills --kills 1 --seed {seed}")
        killed["runs"] += 1
        seed += 1
    return killed, wrong


def main(arguments: list[str] | None = None) -> int:
    """Run the script; return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.kills", description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=60, help="stop after this number")
    parser.add_argument("--seed", type=int, default=0, help="the number of the first chain of kills")
    given = parser.parse_args(arguments)
    begin = time.monotonic()
    killed, wrong = kill(given.kills, given.seed)
    print(f"in {time.monotonic() - begin:.0f} s: " + ", ".join(f"{name} {n}" for name, n in sorted(killed.items())))
    print(f"violations: {len(wrong)}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
