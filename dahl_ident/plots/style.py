"""One look for every plot: safe for colour-blind readers, in print, and at 400 px.

Colours are those of Okabe and Ito; series differ in marker as well, so that a grey print still
tells them apart. Levels, which have an order, take a sequential map.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from dahl_ident.errors import ValidationError

BLUE, VERMILION, GREEN, ORANGE, SKY, PURPLE, YELLOW, BLACK = (
    "#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7", "#F0E442", "#000000",
)  # fmt: skip
SERIES = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)
MARKERS = ("o", "s", "^", "D", "v", "P")
FIT = BLACK
GREY = "#767676"
_MOST_IN_A_ROW = 4  # of legends

RC: dict[Any, Any] = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "font.size": 9,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.5,
    "lines.markersize": 4,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}


def new_axes(rows: int, columns: int, *, size: tuple[float, float], sharex: bool) -> NDArray[Any]:
    """Return the axes, shape (rows, columns), of a new figure in the house style.

    The figure is made outside the style's context: the first figure of a session loads the
    backend, and what that sets (a notebook shows figures only while interactive) has to stay.
    """
    figure = plt.figure(figsize=size, layout="constrained")
    with mpl.rc_context(RC):
        return np.asarray(figure.subplots(rows, columns, sharex=sharex, squeeze=False))


def axes(ax: Axes | None, *, size: tuple[float, float] = (4.6, 3.4)) -> Axes:
    """Return `ax`, or the one axes of a new figure in the house style."""
    if ax is not None:
        return ax
    return cast("Axes", new_axes(1, 1, size=size, sharex=False)[0, 0])


def axes_pair(
    ax: Sequence[Axes] | None, *, size: tuple[float, float] = (4.6, 5.0)
) -> tuple[Axes, Axes]:
    """Return the two given axes, or two new ones, one above the other, that share x."""
    if ax is None:
        top, bottom = new_axes(2, 1, size=size, sharex=True)[:, 0]
        return top, bottom
    pair = np.ravel(np.asarray(ax, dtype=object))
    if pair.size != 2:
        raise ValidationError(f"ax holds {pair.size} axes; expected two, for gain and phase")
    return pair[0], pair[1]


def level_colours(count: int) -> list[Any]:
    """Return `count` colours from dark to light, in the order of the levels."""
    return list(mpl.colormaps["viridis"](np.linspace(0.0, 0.88, count)))


def labelled_levels(count: int, most: int = 8) -> set[int]:
    """Return which of many levels stand in the legend: evenly spread, the ends among them."""
    return set(np.linspace(0, count - 1, most).round().astype(int).tolist())


def legend_above(axis: Axes) -> None:
    """Put the legend above the axes, where it hides no data."""
    entries = len(axis.get_legend_handles_labels()[1])
    columns = entries if entries <= _MOST_IN_A_ROW else -(-entries // 2)
    axis.legend(
        ncols=columns, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2,
        columnspacing=1.0, handletextpad=0.5,
    )  # fmt: skip


def readable_log_ticks(axis: Axes) -> None:
    """Label 1, 2 and 5 on logarithmic axes of less than two decades, without crowding."""
    for scale, line in ((axis.get_xscale(), axis.xaxis), (axis.get_yscale(), axis.yaxis)):
        low, high = sorted(line.get_view_interval())
        if scale != "log" or not 0.0 < low < high < 100.0 * low:
            continue
        line.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        line.set_major_formatter(StrMethodFormatter("{x:g}"))
        line.set_minor_formatter(NullFormatter())
