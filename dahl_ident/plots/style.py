"""The style of all plots: readable for colour-blind readers, in print, and at a width of 400 px.

Every colour of a line or marker has a contrast of at least 3:1 against white paper. Series also
differ in marker, so that they can be distinguished in a greyscale print. Levels, which have an
order, use a sequential map from dark to bright, with alternating line styles and markers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import Locator, MaxNLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from dahl_ident.errors import ValidationError

BLUE, VERMILION, GREEN, PURPLE, BROWN, INDIGO, BLACK = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#A0317E",
    "#6B4E00",
    "#222255",
    "#000000",
)
PALE_BLUE = "#B9DDF2"  # fills only, under an outline
SERIES = (BLUE, VERMILION, GREEN, PURPLE, BROWN, INDIGO)
MARKERS = ("o", "s", "^", "D", "v", "P")
LINE_STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
FIT = BLACK
GREY = "#767676"
_MOST_LABELS, _MOST_IN_A_ROW = 8, 4  # entries of a legend
_LEVEL_COLOURS = (0.05, 0.66)  # of the map inferno; brighter ones have less contrast than 3:1

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


@contextmanager
def house_style() -> Iterator[None]:
    """Draw in the package's style, and restore the user's settings afterwards.

    Only the settings changed by the style are restored, because the first figure of a session loads
    the backend, whose settings must remain (a notebook shows figures only in interactive mode).
    """
    before = {name: mpl.rcParams[name] for name in RC}
    mpl.rcParams.update(RC)
    try:
        yield
    finally:
        mpl.rcParams.update(before)


def new_axes(rows: int, columns: int, *, size: tuple[float, float], sharex: bool) -> NDArray[Any]:
    """Return the axes, shape (rows, columns), of a new figure in the package's style."""
    with house_style():
        figure = plt.figure(figsize=size, layout="constrained")
        return np.asarray(figure.subplots(rows, columns, sharex=sharex, squeeze=False))


def axes(ax: Axes | None, *, size: tuple[float, float] = (4.6, 3.4)) -> Axes:
    """Return `ax`, or the axes of a new figure in the package's style."""
    if ax is not None:
        return ax
    return cast("Axes", new_axes(1, 1, size=size, sharex=False)[0, 0])


def axes_pair(ax: Sequence[Axes] | None) -> tuple[Axes, Axes]:
    """Return the two given axes, or two new ones, one above the other, that share x."""
    top, bottom = axes_column(ax, 2, size=(4.6, 5.0))
    return top, bottom


def axes_column(
    ax: Sequence[Axes] | None, count: int, *, size: tuple[float, float]
) -> NDArray[Any]:
    """Return `count` axes, those given or new ones, one above the other, that share x."""
    if ax is None:
        return np.asarray(new_axes(count, 1, size=size, sharex=True)[:, 0])
    column = np.ravel(np.asarray(ax, dtype=object))
    if column.size != count:
        raise ValidationError(f"ax holds {column.size} axes; expected {count}")
    return column


def level_colours(count: int) -> list[Any]:
    """Return `count` colours from dark to bright, in the order of the levels."""
    return list(mpl.colormaps["inferno"](np.linspace(*_LEVEL_COLOURS, count)))


def level_lines(count: int) -> list[dict[str, Any]]:
    """Return colour and line style of `count` levels, in the order of the levels."""
    looks = zip(level_colours(count), itertools.cycle(LINE_STYLES), strict=False)
    return [{"color": colour, "linestyle": line} for colour, line in looks]


def level_markers(count: int) -> list[dict[str, Any]]:
    """Return colour and marker of `count` levels that are drawn as points."""
    looks = zip(level_colours(count), itertools.cycle(MARKERS), strict=False)
    return [{"color": colour, "marker": mark, "linestyle": "none"} for colour, mark in looks]


def level_names(labels: Sequence[str]) -> list[str | None]:
    """Return the labels of levels for the legend; of many levels, some evenly spread ones."""
    labelled = set(np.linspace(0, len(labels) - 1, _MOST_LABELS).round().astype(int).tolist())
    return [label if label and i in labelled else None for i, label in enumerate(labels)]


def legend_above(axis: Axes) -> None:
    """Put the legend above the axes, where it hides no data, in as many rows as it needs."""
    entries = len(axis.get_legend_handles_labels()[1])
    columns = entries if entries <= _MOST_IN_A_ROW else -(-entries // 2)
    for ncols in range(max(columns, 1), 0, -1):
        legend = axis.legend(
            ncols=ncols,
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            borderaxespad=0.2,
            columnspacing=1.0,
            handletextpad=0.5,
        )
        if legend.get_window_extent().width <= axis.bbox.width:
            break


def readable_log_ticks(axis: Axes) -> None:
    """Label logarithmic axes of less than two decades with a few plain numbers."""
    for scale, line in ((axis.get_xscale(), axis.xaxis), (axis.get_yscale(), axis.yaxis)):
        low, high = sorted(line.get_view_interval())
        if scale == "log" and 0.0 < low < high < 100.0 * low:
            few_plain_ticks(line, most=6)


def few_plain_ticks(line: Axis, most: int = 3) -> None:
    """Limit the number of tick labels of an axis; plain numbers without an offset."""
    logarithmic = line.get_scale() == "log"
    line.set_major_locator(_FewLogTicks(most) if logarithmic else MaxNLocator(most - 1))
    line.set_major_formatter(StrMethodFormatter("{x:.10g}"))
    line.set_minor_formatter(NullFormatter())


class _FewLogTicks(Locator):
    """A limited number of round values: 1-2-5 steps or decades; even steps on a narrow range."""

    def __init__(self, most: int) -> None:
        self.most = most

    def __call__(self) -> Any:
        assert self.axis is not None  # set by the axis that uses the locator
        return self.tick_values(*self.axis.get_view_interval())

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """Return the tick positions between two limits."""
        low, high = sorted((vmin, vmax))
        decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
        for steps in ((1.0, 2.0, 5.0), (1.0, 3.0), (1.0,)):
            ticks = np.ravel(np.outer(10.0**decades, steps))
            ticks = ticks[(low <= ticks) & (ticks <= high)]
            if ticks.size < 2:
                return MaxNLocator(self.most - 1).tick_values(low, high)
            if ticks.size <= self.most:
                return ticks
        return ticks[:: -(-ticks.size // self.most)]


def on_two_lines(label: str) -> str:
    """Return a label with its unit on a second line, for small panels."""
    return label.replace(" [", "\n[", 1)
