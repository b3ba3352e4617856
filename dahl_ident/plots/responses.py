"""Responses over amplitude or frequency: gain above phase, and backbones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.plots import style


@dataclass(frozen=True)
class Curve:
    """A model's response along an axis, with its band where known.

    Parameters
    ----------
    x : ndarray, shape (m,)
        Amplitude or frequency, increasing.
    response : ndarray of complex, shape (m,)
        In the unit of the gain.
    gain_band, phase_band : tuple of two ndarrays, shape (m,), optional
        Lower and upper limits, in the unit of the gain and rad.
    label : str
        For the legend.
    """

    x: FloatArray
    response: ComplexArray
    gain_band: tuple[FloatArray, FloatArray] | None = None
    phase_band: tuple[FloatArray, FloatArray] | None = None
    label: str = "fit"


@dataclass(frozen=True)
class Points:
    """Measured responses along an axis, with standard deviations where known.

    Parameters
    ----------
    x : array_like, shape (n,)
        Amplitude or frequency.
    response : array_like of complex, shape (n,)
        In the unit of the gain.
    gain_std, phase_std : array_like, shape (n,), optional
        In the unit of the gain and rad.
    """

    x: ArrayLike
    response: ArrayLike
    gain_std: ArrayLike | None = None
    phase_std: ArrayLike | None = None


def draw_points(axes: Sequence[Axes], points: Points, **look: Any) -> None:
    """Draw points with error bars, in order of their place."""
    order = np.argsort(np.asarray(points.x))
    x, R = np.asarray(points.x)[order], np.asarray(points.response)[order]
    errors = [
        None if std is None else factor * np.asarray(std)[order]
        for std, factor in ((points.gain_std, 1.0), (points.phase_std, 180.0 / np.pi))
    ]
    marks = {"capsize": 2, "elinewidth": 1, "zorder": 3, **look}
    axes[0].errorbar(x, np.abs(R), yerr=errors[0], **marks)
    axes[1].errorbar(x, _degrees(R), yerr=errors[1], **marks)


def draw_curve(axes: Sequence[Axes], curve: Curve, *, near: Points, **look: Any) -> None:
    """Draw a curve and its band, with its phase shifted by whole turns to match the points."""
    phase = _degrees(curve.response)
    turns = _turns_away(curve.x, phase, near)
    axes[0].plot(curve.x, np.abs(curve.response), **look)
    axes[1].plot(curve.x, phase + turns, **look)
    band: dict[str, Any] = {"color": look.get("color"), "alpha": 0.2, "lw": 0}
    if curve.gain_band is not None:
        axes[0].fill_between(curve.x, *curve.gain_band, **band)
    if curve.phase_band is not None:
        middle = np.angle(curve.response)
        low, high = (phase + turns + np.degrees(limit - middle) for limit in curve.phase_band)
        axes[1].fill_between(curve.x, low, high, **band)


def _degrees(response: ComplexArray) -> FloatArray:
    return np.asarray(np.degrees(np.unwrap(np.angle(response))))


def _turns_away(x: FloatArray, phase: FloatArray, near: Points) -> float:
    """Return by how many degrees, whole turns, the points lie above a curve."""
    order = np.argsort(np.asarray(near.x))
    there = _degrees(np.asarray(near.response)[order])
    away = there - np.interp(np.asarray(near.x)[order], x, phase)
    return 360.0 * float(np.round(np.median(away) / 360.0))


@style.house_style()
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
    pair = top, bottom = style.axes_pair(ax)
    lines, markers = style.level_lines(len(levels)), style.level_markers(len(levels))
    labelled = style.labelled_levels(len(levels))
    with_errors = [*errors, *[(None, None)] * (len(levels) - len(errors))]
    points = [Points(x, R, *std) for (_, x, R), std in zip(levels, with_errors, strict=True)]
    for i, (part, (label, x, _)) in enumerate(zip(points, levels, strict=True)):
        joined = not fitted and np.unique(x).size == np.size(x)  # no two share a position
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


@style.house_style()
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


@style.house_style()
def plot_backbone(
    amplitude: FloatArray,
    rows: Sequence[tuple[str, FloatArray, FloatArray]],
    *,
    amplitude_label: str,
    ax: Sequence[Axes] | None = None,
) -> tuple[Axes, Axes]:
    """Draw two quantities over the amplitude, one above the other, with error bars.

    Parameters
    ----------
    amplitude : ndarray, shape (n,)
    rows : sequence of two (label, values, standard deviations)
    amplitude_label : str
        Axis label with unit.
    ax : sequence of two Axes, optional
        New ones where left out.

    Returns
    -------
    tuple of Axes

    Examples
    --------
    >>> A = np.array([1e-4, 1e-3])
    >>> pair = plot_backbone(A, [("f", A, A), ("zeta", A, A)], amplitude_label="amplitude [m]")
    >>> pair[1].get_xlabel()
    'amplitude [m]'
    """
    pair = top, bottom = style.axes_pair(ax)
    order = np.argsort(amplitude)
    for axis, (label, values, std) in zip(pair, rows, strict=True):
        axis.errorbar(amplitude[order], values[order], std[order], marker="o", capsize=2)
        axis.set(xscale="log", ylabel=label)
    bottom.set_xlabel(amplitude_label)
    style.readable_log_ticks(bottom)
    return top, bottom
