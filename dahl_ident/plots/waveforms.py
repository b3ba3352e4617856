"""Recorded waveforms against time, and hysteresis loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray

from dahl_ident.errors import ValidationError
from dahl_ident.plots import style


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
    with style.house_style():
        if ax is None:
            size = (6.4, 0.8 + 1.4 * len(channels))
            rows = style.new_axes(len(channels), 1, size=size, sharex=True)[:, 0]
        else:
            rows = np.ravel(np.asarray(ax, dtype=object))
            if rows.size != len(channels):
                raise ValidationError(
                    f"ax holds {rows.size} axes; expected {len(channels)}, one for each channel"
                )
        predicted = [*fitted, *[None] * (len(channels) - len(fitted))]
        for axis, (label, samples), model in zip(rows, channels, predicted, strict=True):
            axis.plot(time, samples, color=style.BLUE, lw=0.8, label="measured")
            if model is not None:
                axis.plot(time, model, "--", color=style.VERMILION, lw=1.0, label="fit")
                style.legend_above(axis)
            axis.set_ylabel(label)
        rows[-1].set_xlabel("time [s]")
        return rows


def plot_recorded_loops(
    displacement: ArrayLike,
    force: ArrayLike,
    *,
    fitted: ArrayLike | None = None,
    displacement_label: str = "displacement [m]",
    force_label: str = "force [N]",
    ax: Axes | None = None,
) -> Axes:
    """Draw recorded force against motion, with the force that a fit gives over it.

    Parameters
    ----------
    displacement, force : array_like, shape (n,)
        Samples; the motion may be a velocity or an acceleration as well.
    fitted : array_like, shape (n,), optional
        The model's force at these samples.
    displacement_label, force_label : str
        Axis labels with units.
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes
        Force over motion.

    Examples
    --------
    >>> plot_recorded_loops([0.0, 1.0], [0.0, 2.0]).get_xlabel()
    'displacement [m]'
    """
    with style.house_style():
        axis = style.axes(ax)
        axis.plot(displacement, force, color=style.BLUE, lw=0.8, label="measured")
        if fitted is not None:
            axis.plot(displacement, fitted, "--", color=style.VERMILION, lw=1.0, label="fit")
            style.legend_above(axis)
        axis.set(xlabel=displacement_label, ylabel=force_label)
        style.few_plain_ticks(axis.xaxis, most=6)
        return axis
