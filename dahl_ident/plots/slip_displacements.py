"""The density of slip displacements of parallel Jenkins elements."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from dahl_ident.arrays import FloatArray
from dahl_ident.plots import style


def plot_slip_density(
    slip: FloatArray, stiffness: FloatArray, *, unit: str = "m", ax: Axes | None = None
) -> Axes:
    """Draw the share of the stiffness that slips at each displacement.

    Parameters
    ----------
    slip : ndarray, shape (n,)
        Slip displacements, in `unit`, rising.
    stiffness : ndarray, shape (n,)
        Stiffness that slips at each, N/m; drawn as its share of the sum.
    unit : str
        Of the slip displacements.
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes

    Examples
    --------
    >>> axis = plot_slip_density(np.array([1e-4, 1e-3, 1e-2]), np.array([1.0, 2.0, 1.0]))
    >>> axis.get_xlabel(), axis.get_xscale()
    ('slip displacement [m]', 'log')
    """
    with style.house_style():
        axis = style.axes(ax, size=(5.6, 3.2))
        ends = np.sqrt(slip[1:] * slip[:-1])
        first, last = slip[0] ** 2 / ends[0], slip[-1] ** 2 / ends[-1]
        edges = np.concatenate([[first], ends, [last]])
        share = 100.0 * stiffness / max(float(np.sum(stiffness)), np.finfo(float).tiny)
        axis.stairs(share, edges, fill=True, color=style.SERIES[0], alpha=0.5)
        axis.set(xscale="log", xlabel=f"slip displacement [{unit}]", ylabel="stiffness [% of sum]")
        axis.set_ylim(bottom=0.0)
        return axis
