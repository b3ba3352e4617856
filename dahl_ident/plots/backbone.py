"""Natural frequency and damping ratio over amplitude."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from dahl_ident.arrays import FloatArray
from dahl_ident.plots import style


def plot_backbone(
    amplitude: FloatArray,
    rows: Sequence[tuple[str, FloatArray, FloatArray]],
    *,
    amplitude_label: str,
    ax: Sequence[Axes] | None = None,
) -> tuple[Axes, Axes]:
    """Draw two quantities over the amplitude, one above the other, with error bars.

    Parameters
    ----------
    amplitude : ndarray, shape (n,)
    rows : sequence of two (label, values, standard deviations)
    amplitude_label : str
        Axis label with unit.
    ax : sequence of two Axes, optional
        New ones where left out.

    Returns
    -------
    tuple of Axes

    Examples
    --------
    >>> A = np.array([1e-4, 1e-3])
    >>> pair = plot_backbone(A, [("f", A, A), ("zeta", A, A)], amplitude_label="amplitude [m]")
    >>> pair[1].get_xlabel()
    'amplitude [m]'
    """
    with style.house_style():
        pair = top, bottom = style.axes_pair(ax)
        order = np.argsort(amplitude)
        for axis, (label, values, std) in zip(pair, rows, strict=True):
            axis.errorbar(amplitude[order], values[order], std[order], marker="o", capsize=2)
            axis.set(xscale="log", ylabel=label)
        bottom.set_xlabel(amplitude_label)
        style.readable_log_ticks(bottom)
        return top, bottom
