"""Plots of control loops with friction: Nyquist, Nichols, margins against amplitude."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray
from dahl_ident.plots import style


@style.house_style()
def plot_nyquist(
    levels: Sequence[tuple[str, ArrayLike]], *, label: str = "response", ax: Axes | None = None
) -> Axes:
    """Draw complex responses in the complex plane, one curve a level.

    Parameters
    ----------
    levels : sequence of (label, complex response)
        In the order of the levels; colours run from dark to light.
    label : str
        What is drawn, with its unit.
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes
        Imaginary part over real part, to one scale.

    Examples
    --------
    >>> plot_nyquist([("1 N", [1.0, 0.5 - 0.5j, 0.0])]).get_xlabel()
    'Re response'
    """
    axis = style.axes(ax)
    for (name, values), look in _styled(levels):
        R = np.asarray(values, dtype=np.complex128)
        axis.plot(R.real, R.imag, **look, label=name)
    axis.set(xlabel=f"Re {label}", ylabel=f"Im {label}")
    axis.set_aspect("equal", adjustable="datalim")
    return _with_legend(axis, levels)


@style.house_style()
def plot_nichols(
    levels: Sequence[tuple[str, ArrayLike]], *, gain_label: str = "gain", ax: Axes | None = None
) -> Axes:
    """Draw gain in dB over phase, one curve a level.

    Parameters
    ----------
    levels : sequence of (label, complex response)
        In the order of the levels, each over rising frequency.
    gain_label : str
        Name of the gain; the label adds "dB", and the reference of 0 dB if the name ends in a unit:
        ``"receptance [m/N]"`` becomes "receptance [dB re m/N]".
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes
        Gain in dB over phase in degrees.

    Examples
    --------
    >>> plot_nichols([("1 N", [1.0, 0.5 - 0.5j])], gain_label="receptance [m/N]").get_ylabel()
    'receptance [dB re m/N]'
    """
    axis = style.axes(ax)
    for (name, values), look in _styled(levels):
        R = np.asarray(values, dtype=np.complex128)
        axis.plot(np.degrees(np.unwrap(np.angle(R))), _decibels(np.abs(R)), **look, label=name)
    label = gain_label.replace("[", "[dB re ") if "[" in gain_label else f"{gain_label} [dB]"
    axis.set(xlabel="phase [degrees]", ylabel=label)
    return _with_legend(axis, levels)


@style.house_style()
def plot_margins(
    amplitude: ArrayLike,
    gain_margin: ArrayLike,
    phase_margin_deg: ArrayLike,
    *,
    gain_band: tuple[FloatArray, FloatArray] | None = None,
    phase_band: tuple[FloatArray, FloatArray] | None = None,
    ax: Sequence[Axes] | None = None,
) -> tuple[Axes, Axes]:
    """Draw the margins of a loop against the amplitude of its displacement.

    Parameters
    ----------
    amplitude : array_like, shape (m,)
        m.
    gain_margin, phase_margin_deg : array_like, shape (m,)
        A factor > 0, and degrees. Where one is infinite (no gain or phase reaches -1) the top
        of the axes is marked.
    gain_band, phase_band : tuple of two ndarrays, shape (m,), optional
        Lower and upper limits.
    ax : sequence of two Axes, optional
        For gain and for phase; new ones where left out.

    Returns
    -------
    tuple of Axes
        Gain margin in dB above, phase margin in degrees below.

    Examples
    --------
    >>> top, bottom = plot_margins([1e-3, 1.0], [2.0, 3.0], [30.0, 50.0])
    >>> bottom.get_ylabel()
    'phase margin [degrees]'
    """
    top, bottom = style.axes_pair(ax)
    gain = _decibels(gain_margin)
    decibel_band = None if gain_band is None else tuple(_decibels(g) for g in gain_band)
    rows = ((top, gain, decibel_band), (bottom, phase_margin_deg, phase_band))
    for axis, values, band in rows:
        axis.plot(amplitude, _drawable(values), color=style.FIT)
        if band is not None:
            low, high = (_drawable(limit) for limit in band)
            axis.fill_between(np.asarray(amplitude), low, high, color=style.FIT, alpha=0.2, lw=0)
        _mark_infinite(axis, amplitude, values)
    top.set(xscale="log", ylabel="gain margin [dB]")
    bottom.set(xscale="log", xlabel="amplitude [m]", ylabel="phase margin [degrees]")
    for axis in (top, bottom):
        style.readable_log_ticks(axis)
    return top, bottom


def _decibels(gain: ArrayLike) -> FloatArray:
    """Return 20 lg of a gain; minus infinity where it is zero."""
    with np.errstate(divide="ignore"):
        return np.asarray(20.0 * np.log10(np.asarray(gain, dtype=np.float64)))


def _mark_infinite(axis: Axes, amplitude: ArrayLike, values: ArrayLike) -> None:
    """Mark at the top of the axes where a margin is infinite."""
    infinite = np.isposinf(np.asarray(values, dtype=np.float64))
    if not infinite.any():
        return
    where = np.asarray(amplitude, dtype=np.float64)[infinite]
    axis.plot(
        where, np.full(where.shape, 0.97), "^", color=style.FIT, label="infinite", clip_on=False,
        transform=axis.get_xaxis_transform(),
    )  # fmt: skip
    if infinite.all():
        axis.set_yticks([])
    style.legend_above(axis)


def _drawable(values: ArrayLike) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    return np.where(np.isfinite(array), array, np.nan)


def _styled(
    levels: Sequence[tuple[str, ArrayLike]],
) -> list[tuple[tuple[str | None, ArrayLike], dict[str, Any]]]:
    """Return each level with its look; of many levels only some are labelled."""
    labelled = style.labelled_levels(len(levels))
    return [
        ((name if name and i in labelled else None, values), look)
        for i, ((name, values), look) in enumerate(
            zip(levels, style.level_lines(len(levels)), strict=True)
        )
    ]


def _with_legend(axis: Axes, levels: Sequence[tuple[str, ArrayLike]]) -> Axes:
    if any(name for name, _ in levels):
        style.legend_above(axis)
    return axis
