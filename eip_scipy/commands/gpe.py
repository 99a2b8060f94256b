"""``eip-scipy gpe ground-state`` and ``eip-scipy gpe ring``: the rotating Gross-Pitaevskii equation (Experiment IV)."""

from __future__ import annotations

import argparse
from pathlib import Path

from .._names import nearest
from . import gpe_ring, gpe_states

__all__ = ["add_arguments", "run"]

TASKS = {"ground-state": gpe_states.run, "ring": gpe_ring.run}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``gpe``."""
    parser.add_argument("task", choices=tuple(TASKS), metavar="TASK", help=" or ".join(TASKS))
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
    states.add_argument("--seed", type=int, default=0, metavar="N", help="of the random starts (%(default)s)")
    ring = parser.add_argument_group("ring")
    ring.add_argument(
        "--start", type=Path, metavar="FILE", help="ring.npz of ground-state; default: the state is searched first"
    )
    ring.add_argument("--movie", action="store_true", help="write ring.gif, too")


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
    """
    return TASKS[args.task](args)
