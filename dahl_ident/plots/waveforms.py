"""Waveforms against time, cycles of an extraction, and fits of records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray

from dahl_ident.plots import style


@style.house_style()
def plot_waveforms(
    time: ArrayLike,
    channels: Sequence[tuple[str, ArrayLike]],
    *,
    fitted: Sequence[ArrayLike | None] = (),
    ax: Sequence[Axes] | None = None,
) -> NDArray[Any]:
    """Draw channels against time, one above the other.

    Parameters
    ----------
    time : array_like, shape (n,)
        s.
    channels : sequence of (label, samples)
        Labels with units; samples have shape (n,).
    fitted : sequence of array_like or None, optional
        What a model predicts for each channel, drawn over it; None where it predicts nothing.
    ax : sequence of Axes, one a channel, optional
        New where left out.

    Returns
    -------
    ndarray of Axes
        One for each channel.

    Raises
    ------
    ValidationError
        If `ax` holds another number of axes than there are channels.

    Examples
    --------
    >>> rows = plot_waveforms([0.0, 1.0], [("force [N]", [0.0, 2.0])])
    >>> rows[0].get_ylabel(), rows[0].get_xlabel()
    ('force [N]', 'time [s]')
    """
    rows = style.axes_column(ax, len(channels), size=(6.4, 0.8 + 1.4 * len(channels)))
    predicted = [*fitted, *[None] * (len(channels) - len(fitted))]
    for axis, (label, samples), model in zip(rows, channels, predicted, strict=True):
        axis.plot(time, samples, color=style.BLUE, lw=0.8, label="measured")
        if model is not None:
            axis.plot(time, model, "--", color=style.VERMILION, lw=1.0, label="fit")
            style.legend_above(axis)
        axis.set_ylabel(label)
    rows[-1].set_xlabel("time [s]")
    return rows


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
    """Draw how one point settled: its response and mean force, cycle by cycle.

    Parameters
    ----------
    response : array_like of complex, shape (n,)
        Dynamic stiffness of each cycle, N/m.
    force_mean : array_like, shape (n,)
        Mean force of each cycle, N; its decay is the first sign of unsettled friction.
    left_out : int, default 0
        Leading cycles that were left out, shaded.
    response_std, mean_std : float, optional
        Standard deviation of one cycle's value, drawn as a band around the median.
    ax : sequence of two Axes, optional
        New where left out.

    Returns
    -------
    tuple of Axes
        Response above, in percent of its median and relative to it; mean force below.

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
    away = 100.0 * (R - middle) / np.abs(middle)
    top.plot(cycle, away.real, "o-", color=style.BLUE, lw=0.8, label="real part")
    top.plot(cycle, away.imag, "s-", color=style.VERMILION, lw=0.8, label="imaginary part")
    bottom.plot(cycle, mean, "o-", color=style.GREEN, lw=0.8)
    if response_std is not None:
        half = 200.0 * response_std / np.abs(middle)
        top.axhspan(-half, half, color=style.GREY, alpha=0.15, lw=0)
    if mean_std is not None:
        centre, half = np.median(mean[left_out:]), 2.0 * mean_std
        bottom.axhspan(centre - half, centre + half, color=style.GREY, alpha=0.15, lw=0)
    for axis in (top, bottom) if left_out else ():
        axis.axvspan(0.5, left_out + 0.5, color=style.GREY, alpha=0.3, lw=0)
    top.set(ylabel="response, off its median [%]")
    bottom.set(xlabel="cycle", ylabel="mean force [N]")
    style.legend_above(top)
    return top, bottom


@style.house_style()
def plot_sample_residuals(
    x: ArrayLike,
    residuals: ArrayLike,
    *,
    x_label: str = "time [s]",
    channel: str = "force",
    ax: Axes | None = None,
) -> Axes:
    """Draw the residuals of a record, sample by sample.

    Parameters
    ----------
    x, residuals : array_like, shape (n,)
        Time or displacement, and measured minus fitted samples.
    x_label : str
        Axis label with unit.
    channel : str, default "force"
        What was fitted.
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes
        With the residuals' root mean square as title.

    Examples
    --------
    >>> plot_sample_residuals([0.0, 1.0], [3.0, -3.0]).get_title("left")
    '3 rms'
    """
    axis = style.axes(ax, size=(6.4, 3.0))
    axis.plot(x, residuals, color=style.BLUE, lw=0.6)
    axis.axhline(0.0, color="0.5", lw=0.6)
    axis.set(xlabel=x_label, ylabel=f"measured minus fitted {channel}")
    axis.set_title(f"{np.sqrt(np.mean(np.square(residuals))):.3g} rms")
    return axis
