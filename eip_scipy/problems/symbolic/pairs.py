"""Division of the names in a Hamiltonian into coordinates and their momenta."""

from __future__ import annotations

import re
from collections.abc import Iterable

__all__ = ["paired"]

# Coordinates whose momenta may occur alone in H: a coordinate that H does not depend on is cyclic.
KNOWN = ("x", "y", "z", "r", "rho", "theta", "phi", "psi", "X", "Y", "Z", "R")


def paired(names: Iterable[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the coordinates and, in the same order, the momenta for the names in a Hamiltonian.

    A coordinate on which the Hamiltonian does not depend may be missing from `names`. Pairs are x and px, q1 and p1,
    theta and p_theta or ptheta; p belongs to the one remaining coordinate, or to q. A ValueError is raised if a name
    has no partner.
    """
    free = set(names)
    pairs = []
    for momentum in sorted(free, key=_natural):
        coordinate = _coordinate(momentum, free)
        if coordinate is not None:
            pairs.append((coordinate, momentum))
    left = sorted(free - {name for pair in pairs for name in pair}, key=_natural)
    if "p" in left and (coordinate := _partner_of_p([name for name in left if name != "p"])) is not None:
        pairs.append((coordinate, "p"))
        left = [name for name in left if name not in ("p", coordinate)]
    if left or not pairs:
        raise ValueError(_unpaired(left, pairs))
    pairs.sort(key=lambda pair: _natural(pair[0]))
    return tuple(q for q, _ in pairs), tuple(p for _, p in pairs)


def _unpaired(left: list[str], pairs: list[tuple[str, str]]) -> str:
    """Return the error message for the names `left`, which have no partner, or for an H without names."""
    rule = "Names are paired as x with px, q1 with p1, theta with p_theta; others by hamiltonian(H, 'a b', 'pa pb')."
    if not left:
        return f"hamiltonian: H contains neither coordinates nor momenta. {rule}"
    are = "is" if len(left) == 1 else "are"
    known = "; ".join(f"{q} with {p}" for q, p in pairs) or "none"
    values = ", ".join(f"{name!r}: 1.0" for name in left)
    return (
        f"hamiltonian: it is not clear what {' and '.join(left)} {are}: no coordinate or momentum among the names of H "
        f"goes with {'it' if len(left) == 1 else 'them'} (pairs found: {known}). A constant needs a value: "
        f"params={{{values}}}. {rule}"
    )


def _coordinate(momentum: str, free: set[str]) -> str | None:
    """Return the coordinate, perhaps not in H, to which `momentum` belongs; None if it is not a momentum."""
    if not momentum.startswith("p") or momentum == "p":
        return None
    rest = momentum[1:].removeprefix("_")
    if rest.isdigit():
        likely = (f"q{momentum[1:]}", f"q{rest}", f"x{momentum[1:]}", f"x{rest}")
        return next((name for name in likely if name in free), likely[0])
    return rest if rest in free or rest in KNOWN or (momentum.startswith("p_") and rest.isidentifier()) else None


def _partner_of_p(others: list[str]) -> str | None:
    """Return q, the only usual name of a coordinate, or the only name among `others`; None if that is not clear."""
    if "q" in others or not others:
        return "q"
    likely = [name for name in others if name in KNOWN] or others
    return likely[0] if len(likely) == 1 else None


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key for sorting that puts q2 before q10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
