"""An uncertainty budget as bars: the share of each source in the variance of each parameter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from dahl_ident.plots import style

_HATCHES = ("", "////", "....", "xxxx", "\\\\\\\\", "----")


def plot_budget(
    rows: Sequence[tuple[str, str, float]],
    *,
    x_label: str = "share of the variance [%]",
    ax: Axes | None = None,
) -> Axes:
    """Draw the contributions to each parameter's variance as a stacked bar.

    Parameters
    ----------
    rows : sequence of (parameter, source, share)
        Shares between 0 and 1; those of one parameter sum to 1. Bars stand in the order in which
        parameters first appear, sources likewise.
    x_label : str
        Axis label.
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes
        One bar for each parameter. Sources differ in colour and hatching; shares of 10 % and more
        are written on them.

    Examples
    --------
    >>> axis = plot_budget([("f_max", "noise", 0.25), ("f_max", "force calibration", 0.75)])
    >>> [text.get_text() for text in axis.texts]
    ['25 %', '75 %']
    """
    with style.house_style():
        parameters = list(dict.fromkeys(parameter for parameter, _, _ in rows))
        sources = list(dict.fromkeys(source for _, source, _ in rows))
        legend_rows = -(-len(sources) // 3)
        size = (5.6, 1.0 + 0.45 * len(parameters) + 0.2 * legend_rows)
        axis = style.axes(ax, size=size)
        ends = np.zeros(len(parameters))
        for i, source in enumerate(sources):
            widths = np.zeros(len(parameters))
            for parameter, name, share in rows:
                if name == source:
                    widths[parameters.index(parameter)] += 100.0 * share
            colour = style.SERIES[i % len(style.SERIES)]
            axis.barh(
                range(len(parameters)), widths, left=ends, height=0.6, label=source, lw=1.0,
                color="white" if i else colour, edgecolor=colour, hatch=_HATCHES[i % len(_HATCHES)],
            )  # fmt: skip
            for line, (start, width) in enumerate(zip(ends, widths, strict=True)):
                if width >= 10.0:
                    axis.text(
                        start + 0.5 * width, line, f"{width:.0f} %", ha="center", va="center",
                        fontsize=7, bbox={"fc": "white", "ec": "none", "pad": 1.0},
                    )  # fmt: skip
            ends += widths
        axis.set(xlabel=x_label, xlim=(0.0, 100.0), ylim=(len(parameters) - 0.4, -0.6))
        axis.set_yticks(range(len(parameters)), parameters)
        axis.grid(visible=False, axis="y")
        axis.legend(ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2)
        return axis
