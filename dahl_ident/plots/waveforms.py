"""Waveforms over time, cycles of an extraction, hysteresis loops, friction in the complex plane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray

from dahl_ident.plots import style


def _draw_measured(axis: Axes, x: ArrayLike, samples: ArrayLike, fitted: ArrayLike | None) -> None:
    """Draw samples and the prediction of a model."""
    axis.plot(x, samples, color=style.BLUE, lw=0.8, label="measured")
    if fitted is not None:
        axis.plot(x, fitted, "--", color=style.VERMILION, lw=1.0, label="fit")
        style.legend_above(axis)


@style.house_style()
def plot_waveforms(
    time: ArrayLike,
    channels: Sequence[tuple[str, ArrayLike]],
    *,
    fitted: Sequence[ArrayLike | None] = (),
    ax: Sequence[Axes] | None = None,
) -> NDArray[Any]:
    """Draw channels against time on separate axes, one above the other.

    Parameters
    ----------
    time : array_like, shape (n,)
        s.
    channels : sequence of (label, samples)
        Labels with units; samples have shape (n,).
    fitted : sequence of array_like or None, optional
        Prediction of a model for each channel, drawn over it; None for channels without one.

    Examples
    --------
    >>> rows = plot_waveforms([0.0, 1.0], [("force [N]", [0.0, 2.0])])
    >>> rows[0].get_ylabel(), rows[0].get_xlabel()
    ('force [N]', 'time [s]')
    """
    rows = style.axes_column(ax, len(channels), size=(6.4, 0.8 + 1.4 * len(channels)))
    predicted = [*fitted, *[None] * (len(channels) - len(fitted))]
    for axis, (label, samples), model in zip(rows, channels, predicted, strict=True):
        _draw_measured(axis, time, samples, model)
        axis.set_ylabel(label)
    rows[-1].set_xlabel("time [s]")
    return rows


@style.house_style()
def plot_recorded_loops(
    displacement: ArrayLike,
    force: ArrayLike,
    *,
    fitted: ArrayLike | None = None,
    displacement_label: str = "displacement [m]",
    force_label: str = "force [N]",
    ax: Axes | None = None,
) -> Axes:
    """Draw recorded force against motion, and over it the force predicted by a fit.

    Parameters
    ----------
    displacement, force : array_like, shape (n,)
        Samples; the motion may also be a velocity or an acceleration.
    fitted : array_like, shape (n,), optional
        The model's force at these samples.
    displacement_label, force_label : str
        Axis labels with units.

    Examples
    --------
    >>> plot_recorded_loops([0.0, 1.0], [0.0, 2.0]).get_xlabel()
    'displacement [m]'
    """
    axis = style.axes(ax)
    _draw_measured(axis, displacement, force, fitted)
    axis.set(xlabel=displacement_label, ylabel=force_label)
    style.few_plain_ticks(axis.xaxis, most=6)
    return axis


@style.house_style()
def plot_sample_residuals(
    x: ArrayLike,
    residuals: ArrayLike,
    *,
    x_label: str = "time [s]",
    channel: str = "force [N]",
    ax: Axes | None = None,
) -> Axes:
    """Draw the residuals of a record's samples, with their root mean square as title.

    Parameters
    ----------
    x, residuals : array_like, shape (n,)
        Time or displacement, and measured minus fitted samples.
    x_label : str
        Axis label with unit.
    channel : str, default "force [N]"
        The fitted channel with its unit.

    Examples
    --------
    >>> plot_sample_residuals([0.0, 1.0], [3.0, -3.0]).get_title("left")
    '3 N rms'
    """
    axis = style.axes(ax, size=(6.4, 3.0))
    axis.plot(x, residuals, color=style.BLUE, lw=0.6)
    axis.axhline(0.0, color="0.5", lw=0.6)
    axis.set(xlabel=x_label, ylabel=f"measured minus fitted {channel}")
    unit = channel.partition("[")[2].removesuffix("]")
    axis.set_title(f"{np.sqrt(np.mean(np.square(residuals))):.3g} {unit} rms")
    return axis


@style.house_style()
def plot_cycles(
    response: ArrayLike,
    force_mean: ArrayLike,
    *,
    left_out: int = 0,
    response_std: float | None = None,
    mean_std: float | None = None,
    ax: Sequence[Axes] | None = None,
) -> tuple[Axes, Axes]:
    """Draw how one point settled: deviation of the response, and mean force, cycle by cycle.

    Parameters
    ----------
    response : array_like of complex, shape (n,)
        Dynamic stiffness of each cycle, N/m.
    force_mean : array_like, shape (n,)
        Mean force of each cycle, N; if it decays, friction has not settled.
    left_out : int, default 0
        Leading cycles that were left out, shaded.
    response_std, mean_std : float, optional
        Standard deviation of the value of one cycle, drawn as a band around the median.

    Examples
    --------
    >>> top, bottom = plot_cycles([1 + 1j, 1 + 0.9j], [0.1, 0.0])
    >>> bottom.get_ylabel()
    'mean force [N]'
    """
    top, bottom = style.axes_pair(ax)
    R, mean = np.asarray(response), np.asarray(force_mean)
    cycle = np.arange(1, R.size + 1)
    middle = np.median(R[left_out:].real) + 1j * np.median(R[left_out:].imag)
    deviation = 100.0 * (R - middle) / np.abs(middle)
    top.plot(cycle, deviation.real, "o-", color=style.BLUE, lw=0.8, label="real part")
    top.plot(cycle, deviation.imag, "s-", color=style.VERMILION, lw=0.8, label="imaginary part")
    bottom.plot(cycle, mean, "o-", color=style.GREEN, lw=0.8)
    for axis, centre, half in (
        (top, 0.0, response_std and 200.0 * response_std / np.abs(middle)),
        (bottom, np.median(mean[left_out:]), mean_std and 2.0 * mean_std),
    ):
        if half is not None:
            axis.axhspan(centre - half, centre + half, color=style.GREY, alpha=0.15, lw=0)
        if left_out:
            axis.axvspan(0.5, left_out + 0.5, color=style.GREY, alpha=0.3, lw=0)
    top.set(ylabel="response, off its median [%]")
    bottom.set(xlabel="cycle", ylabel="mean force [N]")
    style.legend_above(top)
    return top, bottom


@style.house_style()
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
        Measured points, drawn as markers in the colour of their loop.
    displacement_label, force_label : str
        Axis labels with units.

    Examples
    --------
    >>> plot_loops([([0.0, 1.0], [0.0, 1.0], "1 m")]).get_ylabel()
    'force [N]'
    """
    axis = style.axes(ax)
    count = max(len(loops), len(measured))
    for (displacement, force), look in zip(measured, style.level_markers(count), strict=False):
        axis.plot(displacement, force, **look, markersize=3, alpha=0.6)
    for (displacement, force, label), look in zip(loops, style.level_lines(count), strict=False):
        axis.plot(displacement, force, **look, label=label)
    axis.set(xlabel=displacement_label, ylabel=force_label)
    style.few_plain_ticks(axis.xaxis, most=6)
    style.legend_above(axis)
    return axis


@style.house_style()
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
        inwards = 0.5 + 0.1j - value  # away from the data
        inwards *= 18.0 / abs(inwards)
        axis.annotate(
            f"{beta:g}",
            (value.real, value.imag),
            (inwards.real, inwards.imag),
            fontsize=7,
            textcoords="offset points",
            ha="center",
            va="center",
            color=style.GREY,
        )
    axis.set(xlabel="Re N / sigma", ylabel="Im N / sigma")
    axis.margins(y=0.12)
    style.legend_above(axis)
    return axis
