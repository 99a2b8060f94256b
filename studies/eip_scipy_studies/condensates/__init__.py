"""The commands ``eip-scipy gpe ...`` and ``reproduce fig-efficiency``: Bose-Einstein condensates."""

from importlib import import_module
from typing import Any

from ..output import Output


def draw(out: Output, file: str, figure: str, *arguments: Any) -> None:
    """Write the figure that a function of the module `figures` draws; matplotlib is not imported before."""
    out.figure(file, lambda: getattr(import_module(".figures", __name__), figure)(*arguments))
