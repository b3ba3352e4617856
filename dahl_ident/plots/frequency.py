"""Responses at several levels, as in Fig. 7 of the paper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.plots import style
from dahl_ident.plots.gain_phase import Curve, Points, draw_curve, draw_points


def plot_frequency_response(
    levels: Sequence[tuple[str, ArrayLike, ArrayLike]],
    *,
    errors: Sequence[tuple[ArrayLike | None, ArrayLike | None]] = (),
    fitted: Sequence[Curve] = (),
    gain_label: str = "gain [m/N]",
    x_label: str = "frequency [Hz]",
    marker: str = "",
    ax: Sequence[Axes] | None = None,
) -> tuple[Axes, Axes]:
    """Draw gain and phase against frequency, one curve a level.

    The points of a level are joined where no two of them share a position; repeated measurements
    are drawn as points.

    Parameters
    ----------
    levels : sequence of (label, frequency in Hz, complex response)
        In the order of the levels; colours run from dark to bright.
    errors : sequence of (gain_std, phase_std), optional
        Standard deviations of each level's points, in the gain's unit and in rad.
    fitted : sequence of Curve, optional
        The model's curves, one a level; the levels are then drawn as points.
    gain_label : str
        Axis label with unit.
    x_label : str
        The same for the abscissa, which may be an amplitude as well.
    marker : str, default no marker
        A matplotlib marker at the points of a joined level.
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
    with style.house_style():
        pair = top, bottom = style.axes_pair(ax)
        lines, markers = style.level_lines(len(levels)), style.level_markers(len(levels))
        labelled = style.labelled_levels(len(levels))
        given = [*errors, *[(None, None)] * (len(levels) - len(errors))]
        points = [Points(x, R, *std) for (_, x, R), std in zip(levels, given, strict=True)]
        for i, (part, (label, x, _)) in enumerate(zip(points, levels, strict=True)):
            joined = not fitted and _is_one_curve(x)
            look = lines[i] | ({"marker": marker} if marker else {}) if joined else markers[i]
            name = label if label and i in labelled else None
            draw_points(pair, part, label=name, **look)
        for curve, part, look in zip(fitted, points, lines, strict=False):
            draw_curve(pair, curve, near=part, **look)
        places = np.concatenate([np.ravel(np.asarray(x)) for _, x, _ in levels])
        wide = places.max() > 3.0 * places.min()
        top.set(xscale="log" if wide else "linear", yscale="log", ylabel=gain_label)
        bottom.set(xscale="log" if wide else "linear", xlabel=x_label, ylabel="phase [degrees]")
        style.readable_log_ticks(top)
        style.readable_log_ticks(bottom)
        if any(label for label, _, _ in levels):
            style.legend_above(top)
        return top, bottom


def _is_one_curve(x: ArrayLike) -> bool:
    """Return whether no two points of a level share a position on the axis."""
    places = np.ravel(np.asarray(x))
    return bool(np.unique(places).size == places.size)
