"""Quality of an extraction, cycle by cycle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.plots import style


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
    with style.house_style():
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
