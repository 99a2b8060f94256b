"""``eip-scipy gpe``: ground states and dynamics of the rotating Gross-Pitaevskii equation (Experiment IV)."""

from __future__ import annotations

import argparse
from pathlib import Path

from ...core.names import nearest
from .. import long_runs
from ..report import UsageError
from . import lines as gpe_lines
from . import ring as gpe_ring
from . import states as gpe_states

__all__ = ["add_arguments", "run"]

TASKS = {"ground-state": gpe_states.run, "ring": gpe_ring.run, "vortex-lines": gpe_lines.run}
# What each task takes; the other options are not to be ignored in silence.
OPTIONS = {
    "ground-state": {"scene", "starts", "seed"},
    "ring": {"start", "t_end", "movie", "seed", "checkpoint", "resume"},
    "vortex-lines": {"seed", "checkpoint", "resume"},
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``gpe``."""
    parser.add_argument("task", choices=tuple(TASKS), metavar="TASK", help=" or ".join(TASKS))
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the random starts (%(default)s)")
    states = parser.add_argument_group("ground-state")
    states.add_argument(
        "--scene",
        action="append",
        type=_scene,
        metavar="NAME",
        help=f"one scene, may be repeated; default: all ({', '.join(gpe_states.SCENES)})",
    )
    states.add_argument(
        "--starts", type=_count, default=4, metavar="N", help="starts for each rotation in the trap (%(default)s)"
    )
    ring = parser.add_argument_group("ring")
    ring.add_argument(
        "--start", type=Path, metavar="FILE", help="ring.npz of ground-state; default: the state is searched first"
    )
    ring.add_argument(
        "--t-end",
        type=long_runs.positive,
        default=gpe_ring.T_END,
        metavar="T",
        help="end of the run (%(default)s); 10 in the paper's figure of the errors",
    )
    ring.add_argument("--movie", action="store_true", help="write ring.gif, too")
    long_runs.add_arguments(parser.add_argument_group("ring and vortex-lines"), "the runs")
    parser.set_defaults(parser=parser)


def _scene(name: str) -> str:
    if name in gpe_states.SCENES:
        return name
    known = ", ".join(gpe_states.SCENES)
    raise argparse.ArgumentTypeError(
        f"unknown scene {name!r}, expected one of {known}{nearest(name, gpe_states.SCENES)}"
    )


def _count(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected an integer >= 1, got {text!r}")
    return value


def run(args: argparse.Namespace) -> int:
    """Run the task.

    Parameters
    ----------
    args : argparse.Namespace
        Options of `add_arguments`, and ``out``, ``json`` (Path or None) and ``quiet``.

    Returns
    -------
    int
        Exit status: 0 done, 1 a check failed, 130 interrupted.

    Raises
    ------
    UsageError
        For options of another task, and arguments or files that cannot be used.
    """
    for name in set().union(*OPTIONS.values()) - OPTIONS[args.task]:
        if getattr(args, name) != args.parser.get_default(name):
            tasks = " and ".join(task for task, names in OPTIONS.items() if name in names)
            raise UsageError(f"--{name.replace('_', '-')} goes with {tasks}, not with {args.task}")
    return TASKS[args.task](args)
