"""Friction over amplitude: gain and phase, the universal curve, hysteresis loops."""

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
    """A model's response over amplitude, with its band where known.

    Parameters
    ----------
    amplitude : ndarray, shape (m,)
        m, increasing.
    response : ndarray of complex, shape (m,)
        N/m.
    gain_band, phase_band : tuple of two ndarrays, shape (m,), optional
        Lower and upper limits, N/m and rad.
    label : str
        For the legend.
    """

    amplitude: FloatArray
    response: ComplexArray
    gain_band: tuple[FloatArray, FloatArray] | None = None
    phase_band: tuple[FloatArray, FloatArray] | None = None
    label: str = "fit"


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
    top, bottom = style.axes_pair(ax)
    A, R = np.asarray(amplitude), np.asarray(response)
    degrees = np.degrees(np.angle(R))
    if curve is not None:
        top.plot(curve.amplitude, np.abs(curve.response), color=style.FIT, label=curve.label)
        bottom.plot(curve.amplitude, np.degrees(np.angle(curve.response)), color=style.FIT)
        if curve.gain_band is not None:
            top.fill_between(curve.amplitude, *curve.gain_band, color=style.FIT, alpha=0.2, lw=0)
        if curve.phase_band is not None:
            low, high = (np.degrees(limit) for limit in curve.phase_band)
            bottom.fill_between(curve.amplitude, low, high, color=style.FIT, alpha=0.2, lw=0)
    marks: dict[str, Any] = {
        "fmt": "o",
        "color": style.BLUE,
        "capsize": 2,
        "elinewidth": 1,
        "zorder": 3,
    }
    top.errorbar(A, np.abs(R), yerr=gain_std, label="data", **marks)
    phase_error = None if phase_std is None else np.degrees(phase_std)
    bottom.errorbar(A, degrees, yerr=phase_error, **marks)
    top.set(xscale="log", yscale="log", ylabel=gain_label)
    bottom.set(xscale="log", xlabel=amplitude_label, ylabel="phase [degrees]")
    style.readable_log_ticks(top)
    style.readable_log_ticks(bottom)
    top.legend()
    return top, bottom


def plot_universal_curve(
    normalised: ArrayLike,
    *,
    curve: ArrayLike,
    marked_beta: Sequence[tuple[float, complex]] = (),
    ax: Axes | None = None,
) -> Axes:
    """Draw N/sigma of the data on h(beta), the curve that every linear Dahl element follows.

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
    axis = style.axes(ax)
    h, N = np.asarray(curve), np.asarray(normalised)
    axis.plot(h.real, h.imag, color=style.FIT, label="h(beta), linear Dahl")
    axis.plot(N.real, N.imag, "o", color=style.BLUE, label="data / sigma", zorder=3)
    for beta, value in marked_beta:
        axis.plot(value.real, value.imag, "|", color=style.FIT, markersize=9)
        axis.annotate(
            f"{beta:g}", (value.real, value.imag), (0, -13), textcoords="offset points",
            ha="center", fontsize=7, color=style.GREY,
        )  # fmt: skip
    axis.set(xlabel="Re N / sigma", ylabel="Im N / sigma")
    axis.legend()
    return axis


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
        Measured samples, drawn as dots behind the loops.
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
    axis = style.axes(ax)
    for displacement, force in measured:
        axis.plot(displacement, force, ".", color=style.GREY, markersize=2, alpha=0.5)
    colours = style.level_colours(len(loops))
    for (displacement, force, label), colour in zip(loops, colours, strict=True):
        axis.plot(displacement, force, color=colour, label=label)
    axis.set(xlabel=displacement_label, ylabel=force_label)
    axis.legend(ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    return axis
