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
    response_std: float | None = None,
    mean_std: float | None = None,
    ax: Sequence[Axes] | None = None,
) -> tuple[Axes, Axes]:
    """Draw how one point settled: its response and the force's mean, cycle by cycle.

    Parameters
    ----------
    response : array_like of complex, shape (n,)
        Dynamic stiffness of each cycle, N/m.
    force_mean : array_like, shape (n,)
        Mean force of each cycle, N: its decay is where unsettled friction shows first.
    response_std, mean_std : float, optional
        Standard deviation of one cycle's value, drawn as a band around the last cycle's.
    ax : sequence of two Axes, optional
        New where left out.

    Returns
    -------
    tuple of Axes
        Change of the response above, mean force below.

    Examples
    --------
    >>> top, bottom = plot_cycles([1 + 1j, 1 + 0.9j], [0.1, 0.0])
    >>> bottom.get_ylabel()
    'mean force [N]'
    """
    top, bottom = style.axes_pair(ax)
    R, mean = np.asarray(response), np.asarray(force_mean)
    cycle = np.arange(1, R.size + 1)
    change = 100.0 * (R - R[-1]) / np.abs(R[-1])
    top.plot(cycle, change.real, "o-", color=style.BLUE, lw=0.8, label="real part")
    top.plot(cycle, change.imag, "s-", color=style.VERMILION, lw=0.8, label="imaginary part")
    bottom.plot(cycle, mean, "o-", color=style.GREEN, lw=0.8)
    if response_std is not None:
        half = 200.0 * response_std / np.abs(R[-1])
        top.axhspan(-half, half, color=style.GREY, alpha=0.15, lw=0)
    if mean_std is not None:
        half = 2.0 * mean_std
        bottom.axhspan(mean[-1] - half, mean[-1] + half, color=style.GREY, alpha=0.15, lw=0)
    top.set(ylabel="change to last cycle [%]")
    bottom.set(xlabel="cycle", ylabel="mean force [N]")
    top.legend()
    return top, bottom
