# ruff: noqa: D101, D102
"""Commands that are not Studies yet."""

from importlib import import_module
from typing import Any

from .condensates import gpe
from .paper import reproduce
from .report import UsageError
from .solar import frontier as solar_frontier
from .solar import solar_system
from .solar import truth as solar_truth


def _runner(peer: Any) -> Any:
    return None if peer is None else peer.run


def _ephemeris() -> solar_truth.Ephemeris:
    """JPL's kernels; what they need is looked for when they are read."""
    jpl = import_module("eip_scipy.integrations.jpl")

    return solar_truth.Ephemeris(jpl.initial_data, jpl.heliocentric)


class Gpe:
    add_arguments = staticmethod(gpe.add_arguments)

    @staticmethod
    def run(args: Any, session: Any) -> int:
        return gpe.run(args)


class Reproduce:
    add_arguments = staticmethod(reproduce.add_arguments)

    @staticmethod
    def run(args: Any, session: Any) -> int:
        return reproduce.run(args, lambda: _runner(session.peer("rebound", "WHFast and IAS15")))


class SolarSystem:
    add_arguments = staticmethod(solar_system.add_arguments)

    @staticmethod
    def run(args: Any, session: Any) -> int:
        if (args.truth or args.frontier) and (args.checkpoint is not None or args.resume):
            raise UsageError(
                "--checkpoint and --resume go with the comparison of methods, not with --truth or --frontier"
            )
        if args.truth:
            return solar_truth.run(args, _ephemeris())
        rebound = _runner(session.peer("rebound", "WHFast and IAS15"))
        if args.frontier:
            return solar_frontier.run(args, rebound, _runner(session.peer("heyoka", "heyoka")))
        return solar_system.run(args, rebound, lambda *where: _ephemeris().initial_data(*where))
