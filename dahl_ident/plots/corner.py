"""Plots of a posterior: corner and trace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import ValidationError
from dahl_ident.plots import style

_WIDE = 3.0  # half a decade; narrower, logarithmic ticks are hard to read
_QUANTILES = (0.16, 0.5, 0.84)  # median, and one standard deviation to either side


@style.house_style()
def plot_corner(
    names: Sequence[str],
    draws: ArrayLike,
    *,
    log: Sequence[bool] = (),
    truth: Mapping[str, float] | None = None,
    ax: NDArray[Any] | None = None,
) -> NDArray[Any]:
    """Draw every parameter's marginal and every pair's joint density.

    Parameters
    ----------
    names : sequence of str
        Labels with units.
    draws : array_like, shape (n, p)
        Independent or thinned draws.
    log : sequence of bool, shape (p,), optional
        Which axes are logarithmic, where their values span a factor of three at least.
    truth : mapping of str to float, optional
        Values to mark, by label.

    Examples
    --------
    >>> draws = np.random.default_rng(1).normal(size=(500, 2))
    >>> plot_corner(["a", "b"], draws).shape
    (2, 2)
    """
    values = np.asarray(draws, dtype=float)
    p = values.shape[1]
    logs = _logarithmic(values, log)
    if ax is None:
        side = 1.6 + 1.1 * p
        grid = style.new_axes(p, p, size=(side, side), sharex=False)
    else:
        grid = np.asarray(ax, dtype=object)
        if grid.shape != (p, p):
            raise ValidationError(f"ax has shape {grid.shape}; expected {(p, p)}")
    edges = [_edges(values[:, i], logs[i]) for i in range(p)]
    for (i, j), axis in np.ndenumerate(grid):
        if j > i:
            axis.set_axis_off()
            continue
        axis.set_xscale("log" if logs[j] else "linear")
        axis.set_yscale("log" if logs[i] and i != j else "linear")
        for line in (axis.xaxis, axis.yaxis):
            style.few_plain_ticks(line)
        if i == j:
            axis.hist(
                values[:, i], edges[i], color=style.PALE_BLUE, ec=style.BLUE, histtype="stepfilled"
            )
            for q in np.quantile(values[:, i], _QUANTILES):
                axis.axvline(q, color=style.BLUE, lw=0.8, ls="--")
            axis.set_yticks([])
        else:
            pair = [edges[j], edges[i]]
            axis.hist2d(values[:, j], values[:, i], pair, cmap="Blues", rasterized=True)
        if truth and names[j] in truth:
            axis.axvline(truth[names[j]], color=style.VERMILION, lw=1)
        if truth and i != j and names[i] in truth:
            axis.axhline(truth[names[i]], color=style.VERMILION, lw=1)
        bottom, left = i == p - 1, j == 0 and i > 0  # only outer panels have numbers and names
        axis.grid(visible=False)
        axis.tick_params(labelbottom=bottom, labelleft=left, which="both")
        axis.tick_params(axis="x", labelrotation=30, which="both")
        axis.set_xlabel(style.on_two_lines(names[j]) if bottom else "", fontsize=8)
        axis.set_ylabel(style.on_two_lines(names[i]) if left else "", fontsize=8)
    return grid


@style.house_style()
def plot_trace(
    names: Sequence[str],
    chain: ArrayLike,
    *,
    discard: int = 0,
    log: Sequence[bool] = (),
    ax: Sequence[Axes] | None = None,
) -> NDArray[Any]:
    """Draw the walkers' paths, and where the warm-up ends.

    Parameters
    ----------
    names : sequence of str
        Labels with units.
    chain : array_like, shape (steps, walkers, p)
        All steps.
    discard : int, default 0
        Steps of warm-up, shaded.
    log : sequence of bool, shape (p,), optional
        Which axes are logarithmic, where their values span a factor of three at least.

    Examples
    --------
    >>> chain = np.random.default_rng(1).normal(size=(50, 8, 2))
    >>> len(plot_trace(["a", "b"], chain, discard=10))
    2
    """
    values = np.asarray(chain, dtype=float)
    p = values.shape[2]
    logs = _logarithmic(values.reshape(-1, p), log)
    rows = style.axes_column(ax, p, size=(5.4, 1.0 + 1.3 * p))
    shown = values[:, :: max(1, values.shape[1] // 32)]
    for i, axis in enumerate(rows):
        axis.plot(shown[:, :, i], color=style.BLUE, alpha=0.35, lw=0.5, rasterized=True)
        if discard:
            axis.axvspan(0, discard, color=style.GREY, alpha=0.25, lw=0)
        axis.set_yscale("log" if logs[i] else "linear")
        style.few_plain_ticks(axis.yaxis, most=4)
        axis.set_ylabel(style.on_two_lines(names[i]))
    rows[-1].set_xlabel("step")
    return rows


def _logarithmic(values: FloatArray, log: Sequence[bool]) -> list[bool]:
    """Return which axes are logarithmic: on a narrow range logarithmic ticks are hard to read."""
    low, high = np.quantile(values, [0.001, 0.999], axis=0)
    wanted = list(log) or [False] * values.shape[1]
    return [bool(w and b > _WIDE * a) for w, a, b in zip(wanted, low, high, strict=True)]


def _edges(values: Any, log: bool) -> Any:
    low, high = np.quantile(values, [0.001, 0.999])
    if not high > low:
        low, high = low - 0.5 * abs(low) - 1e-300, high + 0.5 * abs(high) + 1e-300
    return np.geomspace(low, high, 31) if log else np.linspace(low, high, 31)
