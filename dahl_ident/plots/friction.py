"""Friction in the complex plane and as hysteresis loops."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.plots import style


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
            f"{beta:g}", (value.real, value.imag), _inwards(value), textcoords="offset points",
            ha="center", va="center", fontsize=7, color=style.GREY,
        )  # fmt: skip
    axis.set(xlabel="Re N / sigma", ylabel="Im N / sigma")
    axis.margins(y=0.12)
    style.legend_above(axis)
    return axis


def _inwards(h: complex) -> tuple[float, float]:
    """Return the offset of a label from its point of the curve, clear of the data, in points."""
    way = 0.5 + 0.1j - h
    way *= 18.0 / abs(way)
    return way.real, way.imag


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
        Measured points, drawn as markers in the colour of the corresponding loop.
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
    axis = style.axes(ax)
    axis.plot(displacement, force, color=style.BLUE, lw=0.8, label="measured")
    if fitted is not None:
        axis.plot(displacement, fitted, "--", color=style.VERMILION, lw=1.0, label="fit")
        style.legend_above(axis)
    axis.set(xlabel=displacement_label, ylabel=force_label)
    style.few_plain_ticks(axis.xaxis, most=6)
    return axis
