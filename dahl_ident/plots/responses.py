"""Responses over amplitude, over frequency and in the complex plane; margins of control loops."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.plots import style

Band = tuple[FloatArray, FloatArray] | None


@dataclass(frozen=True)
class Curve:
    """The response of a model along an axis, with its band if known.

    Parameters
    ----------
    x : ndarray, shape (m,)
        Amplitude or frequency, increasing.
    response : ndarray of complex, shape (m,)
        Complex response in the unit of the gain.
    gain_band, phase_band : tuple of two ndarrays, shape (m,), optional
        Lower and upper limits, in the unit of the gain and in rad.
    label : str
        For the legend.
    """

    x: FloatArray
    response: ComplexArray
    gain_band: Band = None
    phase_band: Band = None
    label: str = "fit"


@dataclass(frozen=True)
class Points:
    """Measured responses along an axis, with standard deviations (phase in rad) if known."""

    x: ArrayLike
    response: ArrayLike
    gain_std: ArrayLike | None = None
    phase_std: ArrayLike | None = None

    def draw(self, axes: Sequence[Axes], **look: Any) -> None:
        """Draw the points with error bars, in order of their abscissa."""
        order = np.argsort(np.asarray(self.x))
        x, R = np.asarray(self.x)[order], np.asarray(self.response)[order]
        errors = [
            None if std is None else factor * np.asarray(std)[order]
            for std, factor in ((self.gain_std, 1.0), (self.phase_std, 180.0 / np.pi))
        ]
        marks = {"capsize": 2, "elinewidth": 1, "zorder": 3, **look}
        axes[0].errorbar(x, np.abs(R), yerr=errors[0], **marks)
        axes[1].errorbar(x, _degrees(R), yerr=errors[1], **marks)

    def draw_fitted(self, axes: Sequence[Axes], curve: Curve, **look: Any) -> None:
        """Draw a curve and its band, its phase shifted by whole turns to match the points."""
        order = np.argsort(np.asarray(self.x))
        measured = _degrees(np.asarray(self.response)[order])
        phase = _degrees(curve.response)
        difference = measured - np.interp(np.asarray(self.x)[order], curve.x, phase)
        phase = phase + 360.0 * float(np.round(np.median(difference) / 360.0))
        axes[0].plot(curve.x, np.abs(curve.response), **look)
        axes[1].plot(curve.x, phase, **look)
        band: dict[str, Any] = {"color": look.get("color"), "alpha": 0.2, "lw": 0}
        if curve.gain_band is not None:
            axes[0].fill_between(curve.x, *curve.gain_band, **band)
        if curve.phase_band is not None:
            middle = np.angle(curve.response)
            low, high = (phase + np.degrees(limit - middle) for limit in curve.phase_band)
            axes[1].fill_between(curve.x, low, high, **band)


def _degrees(response: ComplexArray) -> FloatArray:
    return np.asarray(np.degrees(np.unwrap(np.angle(response))))


def _decibels(gain: ArrayLike) -> FloatArray:
    """Return 20 lg of a gain; minus infinity if it is zero."""
    with np.errstate(divide="ignore"):
        return np.asarray(20.0 * np.log10(np.asarray(gain, dtype=np.float64)))


def _label_pair(top: Axes, bottom: Axes, *, x_label: str, wide: bool = True, **of_top: Any) -> None:
    """Label the axes of gain above phase; the abscissa is logarithmic over a wide range."""
    scale = "log" if wide else "linear"
    top.set(xscale=scale, **of_top)
    bottom.set(xscale=scale, xlabel=x_label)
    style.readable_log_ticks(top)
    style.readable_log_ticks(bottom)


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
    """Draw gain and phase against frequency, one curve per level.

    The points of a level are joined by lines unless some have the same frequency; repeated
    measurements are drawn as single points.

    Parameters
    ----------
    levels : sequence of (label, frequency in Hz, complex response)
        In the order of the levels; colours run from dark to bright.
    errors : sequence of (gain_std, phase_std), optional
        Standard deviations of each level's points, in the gain's unit and in rad.
    fitted : sequence of Curve, optional
        The model's curves, one per level; the levels are then drawn as points.
    gain_label, x_label : str
        Axis labels with units; the abscissa may also be an amplitude.
    marker : str, default ""
        A matplotlib marker for the points of a joined level.

    Examples
    --------
    >>> top, _ = plot_frequency_response([("1 N", [1.0, 9.0], [1.0, 0.5j])])
    >>> top.get_xscale()
    'log'
    """
    pair = top, bottom = style.axes_pair(ax)
    lines, markers = style.level_lines(len(levels)), style.level_markers(len(levels))
    names = style.level_names([label for label, _, _ in levels])
    with_errors = [*errors, *[(None, None)] * (len(levels) - len(errors))]
    points = [Points(x, R, *std) for (_, x, R), std in zip(levels, with_errors, strict=True)]
    for i, part in enumerate(points):
        joined = not fitted and np.unique(part.x).size == np.size(part.x)
        look = lines[i] | ({"marker": marker} if marker else {}) if joined else markers[i]
        part.draw(pair, label=names[i], **look)
    for curve, part, look in zip(fitted, points, lines, strict=False):
        part.draw_fitted(pair, curve, **look)
    x = np.concatenate([np.ravel(np.asarray(x)) for _, x, _ in levels])
    wide = bool(x.max() > 3.0 * x.min())
    bottom.set(ylabel="phase [degrees]")
    _label_pair(top, bottom, x_label=x_label, wide=wide, yscale="log", ylabel=gain_label)
    if any(names):
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

    Examples
    --------
    >>> top, bottom = plot_amplitude_response([1e-3, 1e-2], [1.0 + 0.1j, 0.5 + 0.5j])
    >>> bottom.get_ylabel()
    'phase [degrees]'
    """
    pair = top, bottom = style.axes_pair(ax)
    points = Points(amplitude, response, gain_std, phase_std)
    if curve is not None:
        points.draw_fitted(pair, curve, color=style.FIT, label=curve.label)
    points.draw(pair, fmt="o", color=style.BLUE, label="data")
    bottom.set(ylabel="phase [degrees]")
    _label_pair(top, bottom, x_label=amplitude_label, yscale="log", ylabel=gain_label)
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
    """Draw two quantities (label, values, standard deviations) over the amplitude."""
    pair = top, bottom = style.axes_pair(ax)
    order = np.argsort(amplitude)
    for axis, (label, values, std) in zip(pair, rows, strict=True):
        axis.errorbar(amplitude[order], values[order], std[order], marker="o", capsize=2)
        axis.set(xscale="log", ylabel=label)
    bottom.set_xlabel(amplitude_label)
    style.readable_log_ticks(bottom)
    return top, bottom


@style.house_style()
def plot_nyquist(
    levels: Sequence[tuple[str, ArrayLike]], *, label: str = "response", ax: Axes | None = None
) -> Axes:
    """Draw complex responses in the complex plane, with equal scales, one curve per level.

    Parameters
    ----------
    levels : sequence of (label, complex response)
        In the order of the levels; colours run from dark to light.
    label : str
        The quantity drawn, with its unit.

    Examples
    --------
    >>> plot_nyquist([("1 N", [1.0, 0.5 - 0.5j, 0.0])]).get_xlabel()
    'Re response'
    """
    axis = style.axes(ax)
    for R, look in _levels(levels):
        axis.plot(R.real, R.imag, **look)
    axis.set(xlabel=f"Re {label}", ylabel=f"Im {label}")
    axis.set_aspect("equal", adjustable="datalim")
    return _with_legend(axis, levels)


@style.house_style()
def plot_nichols(
    levels: Sequence[tuple[str, ArrayLike]], *, gain_label: str = "gain", ax: Axes | None = None
) -> Axes:
    """Draw gain in dB over phase in degrees, one curve per level.

    Parameters
    ----------
    levels : sequence of (label, complex response)
        In the order of the levels, each with increasing frequency.
    gain_label : str
        Name of the gain, to which "dB" is added, with the reference of 0 dB if it ends in a unit:
        ``"receptance [m/N]"`` becomes "receptance [dB re m/N]".

    Examples
    --------
    >>> plot_nichols([("1 N", [1.0, 0.5 - 0.5j])], gain_label="receptance [m/N]").get_ylabel()
    'receptance [dB re m/N]'
    """
    axis = style.axes(ax)
    for R, look in _levels(levels):
        axis.plot(_degrees(R), _decibels(np.abs(R)), **look)
    label = gain_label.replace("[", "[dB re ") if "[" in gain_label else f"{gain_label} [dB]"
    axis.set(xlabel="phase [degrees]", ylabel=label)
    return _with_legend(axis, levels)


def _levels(
    levels: Sequence[tuple[str, ArrayLike]],
) -> Iterator[tuple[ComplexArray, dict[str, Any]]]:
    """Yield the response of each level with its line style."""
    names = style.level_names([label for label, _ in levels])
    for (_, R), name, look in zip(levels, names, style.level_lines(len(levels)), strict=True):
        yield np.asarray(R, dtype=np.complex128), {**look, "label": name}


def _with_legend(axis: Axes, levels: Sequence[tuple[str, ArrayLike]]) -> Axes:
    if any(name for name, _ in levels):
        style.legend_above(axis)
    return axis


@style.house_style()
def plot_margins(
    amplitude: ArrayLike,
    gain_margin: ArrayLike,
    phase_margin_deg: ArrayLike,
    *,
    gain_band: Band = None,
    phase_band: Band = None,
    ax: Sequence[Axes] | None = None,
) -> tuple[Axes, Axes]:
    """Draw the stability margins of a loop against the amplitude of its displacement.

    Parameters
    ----------
    amplitude : array_like, shape (m,)
        m.
    gain_margin, phase_margin_deg : array_like, shape (m,)
        A factor > 0, drawn in dB, and an angle in degrees. Infinite margins (no crossover) are
        marked at the top of the axes.
    gain_band, phase_band : tuple of two ndarrays, shape (m,), optional
        Lower and upper limits.

    Examples
    --------
    >>> top, bottom = plot_margins([1e-3, 1.0], [2.0, 3.0], [30.0, 50.0])
    >>> bottom.get_ylabel()
    'phase margin [degrees]'
    """
    top, bottom = style.axes_pair(ax)
    A = np.asarray(amplitude, dtype=np.float64)
    decibel_band = None if gain_band is None else tuple(_decibels(g) for g in gain_band)
    rows = (
        (top, _decibels(gain_margin), decibel_band),
        (bottom, np.asarray(phase_margin_deg, dtype=np.float64), phase_band),
    )
    for axis, values, band in rows:
        axis.plot(A, np.where(np.isfinite(values), values, np.nan), color=style.FIT)
        if band is not None:
            low, high = (np.where(np.isfinite(limit), limit, np.nan) for limit in band)
            axis.fill_between(A, low, high, color=style.FIT, alpha=0.2, lw=0)
        infinite = np.isposinf(values)
        if infinite.any():
            axis.plot(
                A[infinite],
                np.full(infinite.sum(), 0.97),
                "^",
                color=style.FIT,
                label="infinite",
                clip_on=False,
                transform=axis.get_xaxis_transform(),
            )
            if infinite.all():
                axis.set_yticks([])
            style.legend_above(axis)
    bottom.set(ylabel="phase margin [degrees]")
    _label_pair(top, bottom, x_label="amplitude [m]", ylabel="gain margin [dB]")
    return top, bottom
