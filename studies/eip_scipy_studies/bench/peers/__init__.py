"""Adapters that call each package, which is imported only in the process that runs it."""

from __future__ import annotations

from . import compiled_functions, members, ours, own_equations, python_functions
from ._common import COMPILED, OWN, PYTHON, Peer

__all__ = ["COMPILED", "OWN", "PEERS", "PYTHON", "Peer"]

PEERS: dict[str, Peer] = {
    peer.name: peer
    for peer in (*ours.PEERS, *python_functions.PEERS, *compiled_functions.PEERS, *own_equations.PEERS, *members.PEERS)
}
