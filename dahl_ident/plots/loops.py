"""Pictures of control loops with friction: Nyquist, Nichols, margins over amplitude."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray
from dahl_ident.plots import style


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
    for (name, values), colour in _styled(levels):
        R = np.asarray(values, dtype=np.complex128)
        axis.plot(R.real, R.imag, color=colour, label=name)
    axis.set(xlabel=f"Re {label}", ylabel=f"Im {label}")
    axis.set_aspect("equal", adjustable="datalim")
    return _with_legend(axis, levels)


def plot_nichols(
    levels: Sequence[tuple[str, ArrayLike]], *, gain_label: str = "gain", ax: Axes | None = None
) -> Axes:
    """Draw gain over phase, one curve a level.

    Parameters
    ----------
    levels : sequence of (label, complex response)
        In the order of the levels, each over rising frequency.
    gain_label : str
        Axis label with unit.
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes
        Gain, logarithmic, over phase in degrees.

    Examples
    --------
    >>> plot_nichols([("1 N", [1.0, 0.5 - 0.5j])]).get_yscale()
    'log'
    """
    axis = style.axes(ax)
    for (name, values), colour in _styled(levels):
        R = np.asarray(values, dtype=np.complex128)
        axis.plot(np.degrees(np.unwrap(np.angle(R))), np.abs(R), color=colour, label=name)
    axis.set(yscale="log", xlabel="phase [degrees]", ylabel=gain_label)
    return _with_legend(axis, levels)


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
        A factor, and degrees; infinite ones are not drawn.
    gain_band, phase_band : tuple of two ndarrays, shape (m,), optional
        Lower and upper limits.
    ax : sequence of two Axes, optional
        For gain and for phase; new ones where left out.

    Returns
    -------
    tuple of Axes
        Gain margin above, phase margin below.

    Examples
    --------
    >>> top, bottom = plot_margins([1e-3, 1.0], [2.0, 3.0], [30.0, 50.0])
    >>> bottom.get_ylabel()
    'phase margin [degrees]'
    """
    top, bottom = style.axes_pair(ax)
    rows = ((top, gain_margin, gain_band), (bottom, phase_margin_deg, phase_band))
    for axis, values, band in rows:
        axis.plot(amplitude, _drawable(values), color=style.FIT)
        if band is not None:
            low, high = (_drawable(limit) for limit in band)
            axis.fill_between(np.asarray(amplitude), low, high, color=style.FIT, alpha=0.2, lw=0)
    top.set(xscale="log", yscale="log", ylabel="gain margin")
    bottom.set(xscale="log", xlabel="amplitude [m]", ylabel="phase margin [degrees]")
    return top, bottom


def _drawable(values: ArrayLike) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    return np.where(np.isfinite(array), array, np.nan)


def _styled(
    levels: Sequence[tuple[str, ArrayLike]],
) -> list[tuple[tuple[str | None, ArrayLike], object]]:
    """Return each level with its colour; of many levels only some are labelled."""
    labelled = style.labelled_levels(len(levels))
    return [
        ((name if name and i in labelled else None, values), colour)
        for i, ((name, values), colour) in enumerate(
            zip(levels, style.level_colours(len(levels)), strict=True)
        )
    ]


def _with_legend(axis: Axes, levels: Sequence[tuple[str, ArrayLike]]) -> Axes:
    if any(name for name, _ in levels):
        style.legend_above(axis)
    return axis
