"""Figure of the hard cases."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from eip_scipy.plotting import PALETTE

from .command import Comparison


def gains_figure(results: Sequence[Comparison], rtol: float, title: str) -> Any:
    """Draw errors with projection against errors without, with the names of the six largest gains and of all losses."""
    figure = Figure(figsize=(7.4, 6.4), dpi=160, layout="constrained")
    figure.suptitle(f"{title}: {len(results)} hard cases", fontsize="large")
    axis = figure.subplots()
    good = [r for r in results if 0 < r.gain < math.inf]
    x, y = np.array([(r.plain.error, r.projected.error) for r in good]).T / rtol
    ends = np.array([min(x.min(), y.min()) / 3, max(x.max(), y.max()) * 3])
    for factor, style in ((1, "-"), (0.1, ":"), (0.01, ":"), (0.001, ":")):
        axis.plot(ends, factor * ends, color="0.6", lw=0.8, ls=style)
    less = y <= x
    for kind, color, marker, label in ((less, 0, "o", "less with projection"), (~less, 2, "s", "more with projection")):
        axis.plot(x[kind], y[kind], ls="", marker=marker, color=PALETTE[color], mec="white", ms=7, label=label)
    for k in {*np.argsort(y / x)[:6], *np.flatnonzero(~less)}:  # to the left above the diagonal, where no points are
        offset, side = ((6, -3), "left") if less[k] else ((-6, 3), "right")
        axis.annotate(good[k].case.name, (x[k], y[k]), offset, textcoords="offset points", fontsize="x-small", ha=side)
    axis.set(xscale="log", yscale="log", xlim=(ends[0], 40 * ends[1]), ylim=ends, aspect="equal")
    axis.set(xlabel="final error / rtol, without projection", ylabel="final error / rtol, with projection")
    axis.grid(alpha=0.25)
    axis.legend(loc="upper left", fontsize="small")
    return figure
