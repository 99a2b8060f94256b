"""Kill runs that write checkpoints, at random instants and repeatedly, and check that they resume as if not killed.

    python -m tests.fuzz.kills --kills 300

Needs the signals of POSIX. Each chain of kills is made from a number. A violation prints the number and the command
that runs the chain again; the exit status is then 1.
"""

import argparse
import multiprocessing
import os
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from functools import cache, partial
from pathlib import Path

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, EIPRKN12, Invariant, checkpoint, ensemble, integrate
from eip_scipy_studies.bench import families

# Exit statuses after a signal: SIGTERM raises KeyboardInterrupt where a checkpoint is written, and kills elsewhere.
SIGNALS = {signal.SIGKILL: (0, -9), signal.SIGINT: (0, 1), signal.SIGTERM: (0, 1, -15)}
LONGEST = 0.9  # seconds from the start of a run to its kill; a whole run takes about as long
MOST = 4  # kills of one run before it may end
PATIENCE = 30.0
ORBIT = families.kepler(np.random.default_rng(5))
KEPT = [Invariant(k.fun, k.grad, name=k.name) for k in ORBIT.kept]
STARTS = ORBIT.y0 * np.linspace(0.95, 1.05, 30)[:, None]


def crossing(t, y):
    return y[1]


def ending(t, y):
    return y[0] - 1e3


ending.terminal = True


def highest(run):
    return run.y.max(axis=1)


FIXED = {"method": EIPRK4, "h": 0.01, "every": "auto", "save_every": 5}
ADAPTIVE = {"method": EIPDOP853, "rtol": 1e-8, "events": crossing, "t_eval": np.arange(0, 120, 0.5)}
NYSTROM = {"method": EIPRKN12, "h": 0.05, "every": 7, "compensated": True, "save_every": 10}
MEMBERS = {"method": EIPRK4, "h": 0.02, "chunk": 2, "save_every": 20, "reduce": highest}
TRAJECTORIES = {"method": EIPRK4, "rtol": 1e-6, "chunk": 2, "events": ending, "t_eval": [0.0, 1.0, 2.5]}
KINDS = {
    "fixed": partial(integrate, ORBIT.fun, (0, 60), ORBIT.y0, **FIXED),
    "adaptive": partial(integrate, ORBIT.fun, (0, 120), ORBIT.y0, **ADAPTIVE),
    "nystrom": partial(integrate, acceleration=ORBIT.acc, t_span=(0, 200), y0=ORBIT.y0, **NYSTROM),
    "members": partial(ensemble, ORBIT.fun, (0, 3), STARTS, **MEMBERS),
    "trajectories": partial(ensemble, ORBIT.fun, (0, 3), STARTS, **TRAJECTORIES),
}
OTHERWISE = ("wall_time", "message", "diagnostics", "one_by_one")  # fields that may differ from those of the whole run


def run(kind, **options):
    return KINDS[kind](invariants=KEPT, compiled=False, **options)


whole = cache(run)


def resumed(kind, path):
    return run(kind, checkpoint=path, checkpoint_every=0.02, resume=True)


def work(kind, path):
    """Run in the process that is killed."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # Ctrl-C prints where it came
    resumed(kind, path)


def alike(one, other):
    if isinstance(one, list):
        return len(one) == len(other) and all(map(alike, one, other))
    return np.array_equal(one, other, equal_nan=np.asarray(one).dtype.kind in "fc")


def done(path):
    """Return the number of steps or members in a checkpoint; -1 without one."""
    if not path.exists():
        return -1
    header, _ = checkpoint.read(path)
    return int(header.get("step", header.get("finished")))


def chain(seed, path, context, most, killed):
    """Kill one run up to `most` times, then let it end; yield the faults."""
    rng, kind, before = np.random.default_rng(seed), list(KINDS)[seed % len(KINDS)], -1
    for _ in range(min(most, int(rng.integers(1, MOST + 1)))):
        number = list(SIGNALS)[max(0, rng.integers(4) - 1)]
        process = context.Process(target=work, args=(kind, path))
        process.start()
        time.sleep(LONGEST * rng.random() ** 2)
        if process.is_alive():
            os.kill(process.pid, number)
        process.join(PATIENCE)
        if process.exitcode not in SIGNALS[number]:
            process.kill()
            yield f"exit status {process.exitcode} after {number.name} and at most {PATIENCE:g} s"
            return
        killed["ended before" if process.exitcode == 0 else number.name] += 1
        if done(path) < before:
            yield f"the checkpoint held {before}, and {done(path)} after {number.name}"
        before = done(path)
    found = resumed(kind, path)
    if "message" in found and isinstance(found.message, str):
        held = re.search(r"resumed at step (\d+)|started at the beginning", found.message)
        if held is None or int(held[1] or -1) != before:
            yield f"the checkpoint held step {before}, and the message is {found.message!r}"
    for name in whole(kind).keys() - OTHERWISE:
        if not alike(whole(kind)[name], found[name]):
            yield f"{name}: {found[name]!r} where the whole run has {whole(kind)[name]!r}"


def main(arguments=None):
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.kills", description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=60, help="stop after this number")
    parser.add_argument("--seed", type=int, default=0, help="the number of the first chain of kills")
    given = parser.parse_args(arguments)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["eip_scipy", "eip_scipy_studies.bench.families"])
    killed, seed, violations = Counter(), given.seed, 0
    while (left := given.kills - sum(killed.values())) > 0:
        with tempfile.TemporaryDirectory() as folder:
            for text in chain(seed, Path(folder) / "run", context, left, killed):
                violations += 1
                print(f"VIOLATION in chain {seed}: {text}\n  again: python -m tests.fuzz.kills --kills 1 --seed {seed}")
        seed += 1
    print(f"{seed - given.seed} runs: " + ", ".join(f"{name} {n}" for name, n in sorted(killed.items())))
    print(f"violations: {violations}")
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
