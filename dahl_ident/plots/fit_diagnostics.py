"""Plots of estimates: residuals, profiles, information, budgets, posteriors, devices."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import FloatArray, IntArray
from dahl_ident.errors import ValidationError
from dahl_ident.plots import style

if TYPE_CHECKING:
    import pandas as pd

_LARGEST_DISC = 250.0  # area, points squared
_MOST_JOINED = 6  # curves up to which lines join their points; more would confuse
_HATCHES = ("", "////", "....", "xxxx", "\\\\\\\\", "----")


@style.house_style()
def plot_residuals(
    x: ArrayLike,
    first: ArrayLike,
    second: ArrayLike,
    *,
    names: tuple[str, str] = ("real part", "imaginary part"),
    x_label: str = "displacement amplitude [m]",
    group: ArrayLike | None = None,
    suspicious: ArrayLike = (),
    ax: Axes | None = None,
) -> Axes:
    """Draw the two residuals of every point, in standard deviations.

    Points of a group are joined if no two of them share a position, so that sequences of one sign
    are visible; with many groups, points are not joined.

    Parameters
    ----------
    x : array_like, shape (n,)
        Amplitude or frequency.
    first, second : array_like, shape (n,)
        Residuals in units of the noise.
    names : tuple of str
        Names of the two residuals.
    x_label : str
        Axis label with unit.
    group : array_like, shape (n,), optional
        The curve to which each point belongs; by default there is one curve.
    suspicious : array_like of int
        Indices of the points to ring.

    Examples
    --------
    >>> plot_residuals([1.0, 2.0], [0.1, -0.2], [1.0, 0.3]).get_ylabel()
    'residual [standard deviations]'
    """
    axis = style.axes(ax)
    x = np.asarray(x)
    axis.axhspan(-2.0, 2.0, color=style.GREY, alpha=0.12, lw=0)
    axis.axhline(0.0, color=style.GREY, lw=0.8)
    for y, name, colour, marker in zip(
        (first, second), names, style.SERIES, style.MARKERS, strict=False
    ):
        axis.plot(x, y, marker, color=colour, label=name)
        for part in _curves(x, group):
            axis.plot(x[part], np.asarray(y)[part], lw=0.6, color=colour)
    for index in np.asarray(suspicious, dtype=int):
        for y in (first, second):
            axis.plot(x[index], np.asarray(y)[index], "o", mfc="none", mec=style.PURPLE, ms=10)
    if x.min() > 0.0 and x.max() > 5.0 * x.min():
        axis.set_xscale("log")
        style.readable_log_ticks(axis)
    axis.set(xlabel=x_label, ylabel="residual [standard deviations]")
    style.legend_above(axis)
    return axis


def _curves(x: FloatArray, group: ArrayLike | None) -> Iterator[IntArray]:
    """Yield the rows of each group in order of x, if no two of them have the same x."""
    groups = np.zeros(x.size) if group is None else np.asarray(group)
    names = np.unique(groups)
    for name in names if names.size <= _MOST_JOINED else ():
        rows = np.flatnonzero(groups == name)
        if np.unique(x[rows]).size == rows.size:
            yield rows[np.argsort(x[rows])]


@style.house_style()
def plot_profile(
    value: ArrayLike,
    deviance: ArrayLike,
    *,
    best: float,
    limits: Mapping[str, float],
    label: str,
    log: bool = False,
    ax: Axes | None = None,
) -> Axes:
    """Draw the profile of the deviance over one parameter, with the heights of its intervals.

    Parameters
    ----------
    value, deviance : array_like, shape (n,)
        Fixed values of the parameter, and the rise of -2 ln likelihood (or of F) there.
    best : float
        The estimate.
    limits : mapping of str to float
        Height of each confidence level, by its label.
    label : str
        The parameter with its unit.
    log : bool, default False
        Logarithmic axis, for a positive parameter.

    Examples
    --------
    >>> axis = plot_profile([1, 2, 3], [4, 0, 4], best=2, limits={"95 %": 3.84}, label="k [N/m]")
    >>> axis.get_xlabel()
    'k [N/m]'
    """
    axis = style.axes(ax)
    axis.plot(value, deviance, color=style.BLUE, marker=".", lw=1.2)
    axis.axvline(best, color=style.FIT, lw=0.8)
    for name, height in limits.items():
        axis.axhline(height, color=style.GREY, lw=0.8, ls="--")
        axis.annotate(
            name,
            (1.02, height),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=7,
            color=style.GREY,
            annotation_clip=False,
        )
    top = 1.2 * max(limits.values())
    axis.set(xlabel=label, ylabel="rise of deviance", ylim=(-0.02 * top, top))
    axis.set_xscale("log" if log else "linear")
    style.few_plain_ticks(axis.xaxis)
    return axis


@style.house_style()
def plot_correlation(
    names: Sequence[str], correlation: ArrayLike, *, ax: Axes | None = None
) -> Axes:
    """Draw a correlation matrix, with its numbers.

    Parameters
    ----------
    names : sequence of str
        The parameters.
    correlation : array_like, shape (p, p)
        Between -1 and 1.

    Examples
    --------
    >>> axis = plot_correlation(["f_max", "sigma"], [[1.0, -0.3], [-0.3, 1.0]])
    >>> len(axis.texts)
    4
    """
    axis = style.axes(ax, size=(3.6, 3.2))
    matrix = np.asarray(correlation)
    axis.imshow(matrix, cmap="PuOr", vmin=-1.0, vmax=1.0)
    for (i, j), value in np.ndenumerate(matrix):
        axis.text(
            j,
            i,
            f"{value:.2f}",
            ha="center",
            va="center",
            fontsize=8,
            color="white" if abs(value) > 0.6 else "black",
        )
    axis.set_xticks(range(len(names)), names, rotation=30, ha="right")
    axis.set_yticks(range(len(names)), names)
    axis.grid(visible=False)
    return axis


@style.house_style()
def plot_information(
    x: ArrayLike,
    shares: Mapping[str, ArrayLike],
    *,
    x_label: str = "displacement amplitude [m]",
    ax: Axes | None = None,
) -> Axes:
    """Draw the information of each point on each parameter (the identifiability map).

    Parameters
    ----------
    x : array_like, shape (n,)
        Amplitude of each point.
    shares : mapping of str to array_like, shape (n,)
        For each parameter, the share of each point in the information, summing to 1; NaN if there
        is none.
    x_label : str
        Axis label with unit.

    Examples
    --------
    >>> axis = plot_information([1.0, 2.0], {"f_max": [0.2, 0.8]})
    >>> [label.get_text() for label in axis.get_yticklabels()], axis.texts[0].get_text()
    (['f_max'], '80 %')
    """
    axis = style.axes(ax, size=(4.6, 1.2 + 0.5 * len(shares)))
    x = np.asarray(x, dtype=float)
    parts = [np.nan_to_num(np.asarray(share, dtype=float)) for share in shares.values()]
    area = _LARGEST_DISC / (max(float(part.max()) for part in parts) or 1.0)
    for line, (part, colour) in enumerate(zip(parts, itertools.cycle(style.SERIES), strict=False)):
        axis.scatter(
            x,
            np.full(x.size, line),
            s=area * part,
            color=colour,
            alpha=0.6,
            edgecolor=style.BLACK,
            lw=0.5,
            zorder=3,
        )
        largest = int(np.argmax(part))
        if part[largest] > 0.0:
            axis.annotate(
                f"{100.0 * part[largest]:.0f} %",
                (x[largest], line),
                (0, 10),
                textcoords="offset points",
                ha="center",
                fontsize=7,
            )
    axis.set(xlabel=x_label, xscale="log", ylim=(len(shares) - 0.4, -0.8))
    axis.set_title("share of the information, by area", fontsize=8, loc="left")
    axis.set_yticks(range(len(shares)), list(shares))
    axis.margins(x=0.08)
    style.readable_log_ticks(axis)
    return axis


@style.house_style()
def plot_budget(rows: Sequence[tuple[str, str, float]], *, ax: Axes | None = None) -> Axes:
    """Draw the contributions to each parameter's variance as a stacked bar.

    Parameters
    ----------
    rows : sequence of (parameter, source, share)
        Shares between 0 and 1; those of one parameter sum to 1. Parameters and sources are drawn in
        the order in which they first appear.

    Examples
    --------
    >>> axis = plot_budget([("f_max", "noise", 0.25), ("f_max", "force calibration", 0.75)])
    >>> [text.get_text() for text in axis.texts]
    ['25 %', '75 %']
    """
    parameters = list(dict.fromkeys(parameter for parameter, _, _ in rows))
    sources = list(dict.fromkeys(source for _, source, _ in rows))
    legend_rows = -(-len(sources) // 2)
    size = (5.6, 1.0 + 0.45 * len(parameters) + 0.2 * legend_rows)
    axis = style.axes(ax, size=size)
    ends = np.zeros(len(parameters))
    for i, source in enumerate(sources):
        widths = np.zeros(len(parameters))
        for parameter, name, share in rows:
            if name == source:
                widths[parameters.index(parameter)] += 100.0 * share
        colour = style.SERIES[i % len(style.SERIES)]
        axis.barh(
            range(len(parameters)),
            widths,
            left=ends,
            height=0.6,
            label=source,
            lw=1.0,
            color="white" if i else colour,
            edgecolor=colour,
            hatch=_HATCHES[i % len(_HATCHES)],
        )
        for line, (start, width) in enumerate(zip(ends, widths, strict=True)):
            if width >= 10.0:
                axis.text(
                    start + 0.5 * width,
                    line,
                    f"{width:.0f} %",
                    ha="center",
                    va="center",
                    fontsize=7,
                    bbox={"fc": "white", "ec": "none", "pad": 1.0},
                )
        ends += widths
    axis.set(xlim=(0.0, 100.0), ylim=(len(parameters) - 0.4, -0.6))
    axis.set_xlabel("share of the variance [%]")
    axis.set_yticks(range(len(parameters)), parameters)
    axis.grid(visible=False, axis="y")
    axis.legend(ncols=2, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2)
    return axis


@style.house_style()
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
        For each quantity: seconds, and its uncertainty with plans and with a logarithmic grid; NaN
        where a time is too short.
    target : mapping of str to float, optional
        Target uncertainties, drawn as dotted lines.

    Examples
    --------
    >>> axis = plot_bench_time({"f_max": ([10.0, 40.0], [0.02, 0.01], [0.04, 0.02])})
    >>> len(axis.lines)
    2
    """
    axis = style.axes(ax, size=(5.2, 3.4))
    for i, (name, (time, planned, grid)) in enumerate(curves.items()):
        colour = style.SERIES[i % len(style.SERIES)]
        axis.plot(time, 100.0 * np.asarray(planned), "o-", color=colour, label=f"{name}, plan")
        if np.isfinite(grid).any():
            axis.plot(
                time,
                100.0 * np.asarray(grid),
                "s--",
                color=colour,
                mfc="white",
                label=f"{name}, logarithmic grid",
            )
        if target and name in target:
            axis.axhline(100.0 * target[name], color=colour, ls=":", lw=1.0)
    axis.set(
        xscale="log",
        yscale="log",
        xlabel="bench time [s]",
        ylabel="relative uncertainty [%]",
    )
    style.readable_log_ticks(axis)
    style.legend_above(axis)
    return axis


@style.house_style()
def plot_devices(devices: pd.DataFrame, mean: float, *, label: str, ax: Axes | None = None) -> Axes:
    """Draw each device's own estimate, the one shrunk towards the population, and the mean.

    `devices` is the table of :class:`dahl_ident.campaigns.population.PopulationParameter`; up to 40
    devices are named.
    """
    axis = style.axes(ax, size=(6.4, 3.2))
    table = devices.sort_values("own", kind="stable")
    x = np.arange(len(table))
    axis.axhline(mean, color=style.GREY, lw=1.0, label="population mean")
    axis.errorbar(
        x,
        table["shrunken"],
        2.0 * table["u"],
        fmt="o",
        color=style.BLUE,
        capsize=0,
        lw=1.0,
        label="shrunk towards the population, with 2 u",
    )
    axis.plot(x, table["own"], "x", color=style.VERMILION, label="own estimate")
    marked = np.flatnonzero(table["outlying"])
    if marked.size:
        axis.plot(
            marked,
            table["own"].iloc[marked],
            "s",
            mfc="none",
            ms=9,
            color=style.BLACK,
            label="outside the population",
        )
    if len(table) <= 40:
        axis.set_xticks(x, table.index, rotation=90)
    else:
        axis.set_xlabel(f"{len(table)} devices in the order of their own estimate")
    axis.set_ylabel(label)
    style.legend_above(axis)
    return axis


@style.house_style()
def plot_control_charts(
    fits: pd.DataFrame, *, label: str, x_label: str = "fit", ax: Sequence[Axes] | None = None
) -> tuple[Axes, ...]:
    """Draw the individuals chart of fits and, if they have an order in time, the EWMA chart.

    `fits` is the table of :class:`dahl_ident.campaigns.population.PopulationParameter`; points
    outside the limits are marked.
    """
    charts = [(label, "value", "limit")]
    if "ewma" in fits:
        charts.append((f"{label}, EWMA", "ewma", "ewma_limit"))
    size = (6.4, 4.4 if "ewma" in fits else 2.6)
    axes = style.axes_column(ax, len(charts), size=size)
    n = np.arange(1, len(fits) + 1)
    centre = fits["centre"]
    for axis, (name, column, limit) in zip(axes, charts, strict=True):
        values, width = fits[column], fits[limit]
        axis.axhline(centre.iloc[0], color=style.GREY, lw=1.0)
        for bound in (centre + width, centre - width):
            axis.plot(n, bound, "--", color=style.GREY, lw=1.0)
        axis.plot(n, values, "-o", color=style.BLUE, lw=0.8, ms=3)
        outside = ((values - centre).abs() > width).to_numpy()
        axis.plot(n[outside], values[outside], "s", mfc="none", ms=8, color=style.VERMILION)
        axis.set_ylabel(name)
    axes[-1].set_xlabel(x_label)
    return tuple(axes)


_WIDE_RANGE = 3.0  # ratio, half a decade; logarithmic ticks of a narrower range are hard to read
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
        style.few_plain_ticks(axis.xaxis)
        style.few_plain_ticks(axis.yaxis)
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
        bottom = i == p - 1
        left = j == 0 and i > 0  # only outer panels have numbers and names
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
    """Return which axes are logarithmic: the requested ones, if their range is wide."""
    low, high = np.quantile(values, [0.001, 0.999], axis=0)
    requested = list(log) or [False] * values.shape[1]
    return [bool(r and b > _WIDE_RANGE * a) for r, a, b in zip(requested, low, high, strict=True)]


def _edges(values: Any, log: bool) -> Any:
    low, high = np.quantile(values, [0.001, 0.999])
    if not high > low:
        low, high = low - 0.5 * abs(low) - 1e-300, high + 0.5 * abs(high) + 1e-300
    return np.geomspace(low, high, 31) if log else np.linspace(low, high, 31)
