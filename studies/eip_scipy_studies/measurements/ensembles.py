"""Ensembles: what a member costs beside a single run, what more cores and workers bring, memory, and growth with size.

    python -m eip_scipy_studies.measurements.ensembles [--members 10000] [--steps 10000] [--repeats 5] [--largest 1000000] [--out DIR]

Kepler's problem with H and L, EIPRK4, fixed step. Everything that is compared runs in turns, and the least times count.
Beside the wall time stands the processor time that the same work took, which other load on the machine hardly touches:
where it does not grow with the workers, they hinder each other in nothing.

1. one thread against the loop of single runs that are set up already (their `wall_time`), per step;
2. two threads against one; two Dask workers on the loopback interface against one;
3. peak memory of processes with so many members, a tenth and ten times as many, their trajectories reduced;
4. the whole job, `members` of `steps` steps each, on all cores;
5. time against the number of members, 1e2 to the largest, with `--curve-steps` steps each: DIR/ensembles.png, .csv.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy import EIPRK4, ensemble, integrate
from eip_scipy.problems import kepler

from ..report import describe_machine, write_csv

H = 0.03
MEMORY = """
import resource, sys
sys.path.insert(0, {folder!r})
from .ensembles import starts
from eip_scipy import ensemble
from eip_scipy.problems import kepler
members = {members}
y0s = starts(members)
base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
run = ensemble(kepler(), (0, 300 * {h}), y0s, h={h}, save_every=3, reduce="state")
assert run.success and run.statistics.count.min() == members
print(base, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def starts(members: int) -> np.ndarray:
    return kepler().y0 * (1 + 1e-3 * np.random.default_rng(1).standard_normal((members, 4)))


def seconds(members: int, steps: int, executor: Any) -> float:
    """Wall time of an ensemble, from call to result."""
    y0s = starts(members)
    begin = time.perf_counter()
    run = ensemble(kepler(), (0.0, steps * H), y0s, h=H, executor=executor)
    elapsed = time.perf_counter() - begin
    assert run.success
    return elapsed


def single(members: int, steps: int) -> float:
    """Time of as many single runs, without what comes before their steps."""
    problem, y0s = kepler(), starts(members)
    return sum(integrate(problem, (0.0, steps * H), y0, method=EIPRK4, h=H, check=False).wall_time for y0 in y0s)


def in_turns(repeats: int, clocks: list[Callable[[], float]], actions: list[Callable[[], float]]) -> np.ndarray:
    """Least wall and processor time (2, actions); `clocks` tell the processor time of each action's workers."""
    found = []
    for _ in range(repeats):
        for clock, action in zip(clocks, actions, strict=True):
            begin = clock()
            wall = action()
            found.append((wall, clock() - begin))
    return np.array(found).reshape(repeats, len(actions), 2).min(axis=0).T


def overhead_and_threads(members: int, steps: int, repeats: int) -> None:
    actions = [
        lambda: single(members, steps),
        lambda: seconds(members, steps, 1),
        lambda: seconds(members, steps, 2),
    ]
    (alone, one, two), (_, cpu_one, cpu_two) = in_turns(repeats, [time.process_time] * 3, actions)
    scale = 1e6 / (members * steps)
    print(f"single runs, loop only: {alone * scale:.3f} us per step ({members} members x {steps} steps)")
    print(f"ensemble, one thread:   {one * scale:.3f} us per step, {one / alone:.3f} of the single runs'")
    print(f"ensemble, two threads:  {two * scale:.3f} us per step, {one / two:.2f} times as fast as one; ", end="")
    print(f"processor time {cpu_two / cpu_one:.3f} of one's", flush=True)


def dask_workers(members: int, steps: int, repeats: int) -> None:
    from eip_scipy.integrations.dask import local_client

    clients = [local_client(workers) for workers in (1, 2)]
    try:
        for client in clients:
            seconds(members, 10, client)  # what a worker does once
        clocks = [lambda c=c: sum(c.run(time.process_time).values()) for c in clients]
        actions = [lambda c=c: seconds(members, steps, c) for c in clients]
        (one, two), (cpu_one, cpu_two) = in_turns(repeats, clocks, actions)
    finally:
        for client in clients:
            client.close()
            client.cluster.close()
    print(f"Dask on loopback, {members} members x {steps} steps: one worker {one:.2f} s, two {two:.2f} s, ", end="")
    print(f"{one / two:.2f} times as fast; processor time {cpu_two / cpu_one:.3f} of one's", flush=True)


def memory(members: int) -> None:
    for count in (members // 10, members, 10 * members):
        code = MEMORY.format(folder=str(Path(__file__).parent), members=count, h=H)
        printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        base, peak = (int(text) / 1024 for text in printed.split())
        print(
            f"{count:>8} members, 101 states each ({count * 101 * 32 / 1e6:.0f} MB) reduced: peak {peak:.0f} MB, ",
            end="",
        )
        print(f"{peak - base:.0f} MB above the imports and starts", flush=True)


def curve(largest: int, steps: int, repeats: int) -> list[dict[str, Any]]:
    rows = []
    for members in [10**k for k in range(2, 10) if 10**k <= largest] or [largest]:
        best = min(seconds(members, steps, None) for _ in range(repeats if members < 10**5 else 1))
        rows.append({"members": members, "steps": steps, "seconds": best, "us per member": 1e6 * best / members})
        print(
            f"{members:>8} members x {steps} steps: {best:.3f} s, {1e6 * best / members:.1f} us per member", flush=True
        )
    return rows


def figure(rows: list[dict[str, Any]]) -> Any:
    """Time against members, with a line of slope 1, and time for each member."""
    from matplotlib.figure import Figure

    members, wall = (np.array([row[name] for row in rows]) for name in ("members", "seconds"))
    page = Figure(figsize=(10, 4.4), layout="constrained", dpi=160)
    page.suptitle(f"Kepler, EIPRK4 with H and L, {rows[0]['steps']} steps a member, all cores")
    left, right = page.subplots(1, 2, sharex=True)
    left.loglog(members, wall, color="#0072B2", marker="o", label="ensemble")
    left.loglog(members, wall[-1] * members / members[-1], color="0.5", ls=":", label="slope 1")
    left.set_ylabel("wall time [s]")
    left.legend(frameon=False)
    right.semilogx(members, 1e6 * wall / members, color="#0072B2", marker="o")
    right.set_ylim(bottom=0)
    right.set_ylabel("wall time of a member [µs]")
    for axis in (left, right):
        axis.set_xlabel("members")
        axis.grid(alpha=0.3)
    return page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--largest", type=int, default=1_000_000)
    parser.add_argument("--curve-steps", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("eip_results"))
    args = parser.parse_args()
    print(describe_machine())
    seconds(16, args.steps, None)  # compiled before
    overhead_and_threads(max(16, args.members // 10), args.steps, args.repeats)
    dask_workers(max(16, args.members // 10), args.steps, args.repeats)
    memory(args.members)
    whole = seconds(args.members, args.steps, None)
    print(f"{args.members} members x {args.steps} steps on all cores: {whole:.1f} s", flush=True)
    rows = curve(args.largest, args.curve_steps, args.repeats)
    args.out.mkdir(parents=True, exist_ok=True)
    print(f"wrote {write_csv(args.out / 'ensembles.csv', rows)}")
    figure(rows).savefig(args.out / "ensembles.png")
    print(f"wrote {args.out / 'ensembles.png'}")


if __name__ == "__main__":
    main()
