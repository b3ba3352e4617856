"""Response over frequency at several levels: Fig. 7 of the paper and its measured relatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.plots import style

_MOST_LABELS = 8


def plot_frequency_response(
    levels: Sequence[tuple[str, ArrayLike, ArrayLike]],
    *,
    fitted: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    gain_label: str = "gain [m/N]",
    x_label: str = "frequency [Hz]",
    marker: str = "",
    ax: Sequence[Axes] | None = None,
) -> tuple[Axes, Axes]:
    """Draw gain and phase against frequency, one curve a level.

    Parameters
    ----------
    levels : sequence of (label, frequency in Hz, complex response)
        In the order of the levels; colours run from dark to light.
    fitted : sequence of (frequency in Hz, complex response), optional
        The model's curves, drawn as lines; the levels are then drawn as points.
    gain_label : str
        Axis label with unit.
    x_label : str
        The same for the abscissa, which may be an amplitude as well.
    marker : str, default no marker
        A matplotlib marker for the levels.
    ax : sequence of two Axes, optional
        For gain and for phase; new ones where left out.

    Returns
    -------
    tuple of Axes
        Gain above, phase in degrees below.

    Examples
    --------
    >>> top, _ = plot_frequency_response([("1 N", [1.0, 9.0], [1.0, 0.5j])])
    >>> top.get_xscale()
    'log'
    """
    top, bottom = style.axes_pair(ax)
    colours = style.level_colours(len(levels))
    labelled = np.unique(np.linspace(0, len(levels) - 1, _MOST_LABELS).round().astype(int))
    drawn: dict[str, Any] = {"marker": marker or None}
    if fitted:
        drawn = {"marker": marker or "o", "linestyle": "none"}
    for i, ((label, frequency, response), colour) in enumerate(zip(levels, colours, strict=True)):
        name = label if label and i in labelled else None
        order = np.argsort(frequency)
        f, R = np.asarray(frequency)[order], np.asarray(response)[order]
        top.plot(f, np.abs(R), color=colour, label=name, **drawn)
        bottom.plot(f, np.degrees(np.unwrap(np.angle(R))), color=colour, **drawn)
    for (frequency, response), colour in zip(fitted, colours, strict=False):
        order = np.argsort(frequency)
        f, R = np.asarray(frequency)[order], np.asarray(response)[order]
        top.plot(f, np.abs(R), color=colour)
        bottom.plot(f, np.degrees(np.unwrap(np.angle(R))), color=colour)
    frequencies = np.concatenate([np.ravel(np.asarray(f)) for _, f, _ in levels])
    wide = frequencies.max() > 3.0 * frequencies.min()
    for axis in (top, bottom):
        axis.set_xscale("log" if wide else "linear")
        style.readable_log_ticks(axis)
    top.set(yscale="log", ylabel=gain_label)
    bottom.set(xlabel=x_label, ylabel="phase [degrees]")
    if any(label for label, _, _ in levels):
        top.legend(ncols=4, loc="lower left", bbox_to_anchor=(0.0, 1.0), columnspacing=1.0)
    return top, bottom
