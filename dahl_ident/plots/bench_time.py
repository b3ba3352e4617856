"""Predicted uncertainty against bench time, of a plan and of a logarithmic grid."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.plots import style


def plot_bench_time(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike, ArrayLike]],
    target: Mapping[str, float] | None = None,
    *,
    ax: Axes | None = None,
) -> Axes:
    """Draw relative standard uncertainties over bench time.

    Parameters
    ----------
    curves : mapping of str to (time, planned, grid)
        For each quantity: seconds, and its uncertainty by plans and by a logarithmic grid; NaN
        where a time is too short.
    target : mapping of str to float, optional
        Wanted uncertainties, drawn as dotted lines.
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes
        Plans solid, grids dashed; both axes logarithmic.

    Examples
    --------
    >>> axis = plot_bench_time({"f_max": ([10.0, 40.0], [0.02, 0.01], [0.04, 0.02])})
    >>> len(axis.lines)
    2
    """
    with style.house_style():
        axis = style.axes(ax, size=(5.2, 3.4))
        for i, (name, (time, planned, grid)) in enumerate(curves.items()):
            colour = style.SERIES[i % len(style.SERIES)]
            axis.plot(time, 100.0 * np.asarray(planned), "o-", color=colour, label=f"{name}, plan")
            if np.isfinite(grid).any():
                axis.plot(
                    time, 100.0 * np.asarray(grid), "s--", color=colour, mfc="white",
                    label=f"{name}, logarithmic grid",
                )  # fmt: skip
            if target and name in target:
                axis.axhline(100.0 * target[name], color=colour, ls=":", lw=1.0)
        axis.set(
            xscale="log", yscale="log", xlabel="bench time [s]",
            ylabel="relative uncertainty [%]",
        )  # fmt: skip
        style.readable_log_ticks(axis)
        axis.legend()
        return axis
