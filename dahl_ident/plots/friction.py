"""Friction against amplitude: gain and phase, the universal curve, hysteresis loops."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.plots import style
from dahl_ident.plots.gain_phase import Curve, Points, draw_curve, draw_points


def plot_amplitude_response(
    amplitude: ArrayLike,
    response: ArrayLike,
    *,
    gain_std: ArrayLike | None = None,
    phase_std: ArrayLike | None = None,
    curve: Curve | None = None,
    amplitude_label: str = "displacement amplitude [m]",
    gain_label: str = "gain [N/m]",
    ax: Sequence[Axes] | None = None,
) -> tuple[Axes, Axes]:
    """Draw gain and phase against amplitude: data with error bars, fit, prediction band.

    Parameters
    ----------
    amplitude, response : array_like, shape (n,)
        Measured amplitude and complex response.
    gain_std, phase_std : array_like, shape (n,), optional
        Standard deviations, in the gain's unit and in rad.
    curve : Curve, optional
        The fitted response.
    amplitude_label, gain_label : str
        Axis labels with units.
    ax : sequence of two Axes, optional
        For gain and for phase; new ones where left out.

    Returns
    -------
    tuple of Axes
        Gain above, phase in degrees below.

    Examples
    --------
    >>> top, bottom = plot_amplitude_response([1e-3, 1e-2], [1.0 + 0.1j, 0.5 + 0.5j])
    >>> bottom.get_ylabel()
    'phase [degrees]'
    """
    with style.house_style():
        pair = top, bottom = style.axes_pair(ax)
        points = Points(amplitude, response, gain_std, phase_std)
        if curve is not None:
            draw_curve(pair, curve, near=points, color=style.FIT, label=curve.label)
        draw_points(pair, points, fmt="o", color=style.BLUE, label="data")
        top.set(xscale="log", yscale="log", ylabel=gain_label)
        bottom.set(xscale="log", xlabel=amplitude_label, ylabel="phase [degrees]")
        style.readable_log_ticks(top)
        style.readable_log_ticks(bottom)
        style.legend_above(top)
        return top, bottom


def plot_universal_curve(
    normalised: ArrayLike,
    *,
    curve: ArrayLike,
    marked_beta: Sequence[tuple[float, complex]] = (),
    ax: Axes | None = None,
) -> Axes:
    """Draw N/sigma of the data with h(beta), the curve of every linear Dahl element.

    Parameters
    ----------
    normalised : array_like of complex, shape (n,)
        Measured friction, divided by the fitted sigma.
    curve : array_like of complex, shape (m,)
        h over a range of beta.
    marked_beta : sequence of (beta, h(beta))
        Points of the curve to label.
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes
        The complex plane.

    Examples
    --------
    >>> plot_universal_curve([0.9 + 0.1j], curve=[1.0, 0.73 + 0.3j]).get_xlabel()
    'Re N / sigma'
    """
    with style.house_style():
        axis = style.axes(ax)
        h, N = np.asarray(curve), np.asarray(normalised)
        axis.plot(h.real, h.imag, color=style.FIT, label="h(beta), linear Dahl")
        axis.plot(N.real, N.imag, "o", color=style.BLUE, label="data / sigma", zorder=3)
        for beta, value in marked_beta:
            axis.plot(value.real, value.imag, "|", color=style.FIT, markersize=9)
            axis.annotate(
                f"{beta:g}", (value.real, value.imag), _inwards(value), textcoords="offset points",
                ha="center", va="center", fontsize=7, color=style.GREY,
            )  # fmt: skip
        axis.set(xlabel="Re N / sigma", ylabel="Im N / sigma")
        axis.margins(y=0.12)
        style.legend_above(axis)
        return axis


def _inwards(h: complex) -> tuple[float, float]:
    """Return the offset of a label from its point of the curve, clear of the data, in points."""
    way = 0.5 + 0.1j - h
    way *= 18.0 / abs(way)
    return way.real, way.imag


def plot_loops(
    loops: Sequence[tuple[ArrayLike, ArrayLike, str]],
    *,
    measured: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    displacement_label: str = "displacement [m]",
    force_label: str = "force [N]",
    ax: Axes | None = None,
) -> Axes:
    """Draw hysteresis loops, force against displacement.

    Parameters
    ----------
    loops : sequence of (displacement, force, label)
        The model's loops.
    measured : sequence of (displacement, force), optional
        Measured points, drawn as markers in the colour of the corresponding loop.
    displacement_label, force_label : str
        Axis labels with units.
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes
        Force over displacement.

    Examples
    --------
    >>> plot_loops([([0.0, 1.0], [0.0, 1.0], "1 m")]).get_ylabel()
    'force [N]'
    """
    with style.house_style():
        axis = style.axes(ax)
        count = max(len(loops), len(measured))
        for (displacement, force), look in zip(measured, style.level_markers(count), strict=False):
            axis.plot(displacement, force, **look, markersize=3, alpha=0.6)
        for (displacement, force, label), look in zip(
            loops, style.level_lines(count), strict=False
        ):
            axis.plot(displacement, force, **look, label=label)
        axis.set(xlabel=displacement_label, ylabel=force_label)
        style.few_plain_ticks(axis.xaxis, most=6)
        style.legend_above(axis)
        return axis
