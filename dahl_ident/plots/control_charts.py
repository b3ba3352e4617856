"""Many devices: their estimates side by side, and control charts of fits over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from dahl_ident.arrays import FloatArray
from dahl_ident.plots import style


@style.house_style()
def plot_devices(
    names: Sequence[str],
    own: FloatArray,
    u: FloatArray,
    shrunken: FloatArray,
    mean: float,
    outlying: Sequence[str],
    *,
    label: str,
    ax: Axes | None = None,
) -> Axes:
    """Draw each device's own estimate, the estimate shrunk towards the population, and the mean.

    Parameters
    ----------
    names : sequence of str, length n
        Devices; their names are written where there are at most 40.
    own, u, shrunken : ndarray, shape (n,)
        Own estimate, and that of the population with its standard uncertainty.
    mean : float
        Of the population.
    outlying : sequence of str
        Devices to mark.
    label : str
        Axis label: parameter and unit.
    ax : Axes, optional
        New where left out.

    Returns
    -------
    Axes
        Devices in the order of their own estimate.

    Examples
    --------
    >>> import numpy as np
    >>> values = np.array([1.0, 3.0, 2.0])
    >>> axis = plot_devices("abc", values, 0.1 * values, values, 2.0, ["b"], label="f_max [N]")
    >>> [tick.get_text() for tick in axis.get_xticklabels()]
    ['a', 'c', 'b']
    """
    axis = style.axes(ax, size=(6.4, 3.2))
    order = np.argsort(own, kind="stable")
    place = np.arange(order.size)
    axis.axhline(mean, color=style.GREY, lw=1.0, label="population mean")
    axis.errorbar(
        place, shrunken[order], 2.0 * u[order], fmt="o", color=style.BLUE, capsize=0,
        lw=1.0, label="shrunk towards the population, with 2 u",
    )  # fmt: skip
    axis.plot(place, own[order], "x", color=style.VERMILION, label="own estimate")
    marked = [i for i, k in enumerate(order) if names[k] in set(outlying)]
    if marked:
        axis.plot(
            marked, own[order][marked], "s", mfc="none", ms=9, color=style.BLACK,
            label="outside the population",
        )  # fmt: skip
    if order.size <= 40:
        axis.set_xticks(place, [names[k] for k in order], rotation=90)
    else:
        axis.set_xlabel(f"{order.size} devices in the order of their own estimate")
    axis.set_ylabel(label)
    axis.legend(loc="upper left")
    return axis


@style.house_style()
def plot_control_charts(
    value: FloatArray,
    ewma: FloatArray | None,
    centre: float,
    limit: float,
    ewma_limit: FloatArray | None = None,
    *,
    label: str,
    x_label: str = "fit",
    ax: Sequence[Axes] | None = None,
) -> tuple[Axes, ...]:
    """Draw the individuals chart of fits and, where they have an order in time, the EWMA chart.

    Parameters
    ----------
    value : ndarray, shape (n,)
        The fits; NaN is not drawn.
    ewma : ndarray, shape (n,), or None
        Their exponentially weighted mean; None where the fits have no order in time.
    centre : float
        Centre line.
    limit : float
        Distance of the individuals' limits from it.
    ewma_limit : ndarray, shape (n,), optional
        The same of the EWMA chart.
    label, x_label : str
        Axis labels.
    ax : two Axes, optional
        New where left out.

    Returns
    -------
    tuple of Axes
        Individuals, then EWMA. Points outside the limits are marked.

    Examples
    --------
    >>> import numpy as np
    >>> n = np.zeros(5)
    >>> upper, lower = plot_control_charts(n, n, 0.0, 1.0, n + 0.3, label="ln f_max")
    >>> upper.get_ylabel()
    'ln f_max'
    """
    charts = [(label, value, np.full(value.size, limit))]
    if ewma is None or ewma_limit is None:
        axes: tuple[Axes, ...] = (style.axes(ax[0] if ax else None, size=(6.4, 2.6)),)
    else:
        charts.append((f"{label}, EWMA", ewma, ewma_limit))
        axes = style.axes_pair(ax, size=(6.4, 4.4))
    n = np.arange(1, value.size + 1)
    for axis, (name, line, width) in zip(axes, charts, strict=True):
        axis.axhline(centre, color=style.GREY, lw=1.0)
        axis.plot(n, centre + width, "--", color=style.GREY, lw=1.0)
        axis.plot(n, centre - width, "--", color=style.GREY, lw=1.0)
        axis.plot(n, line, "-o", color=style.BLUE, lw=0.8, ms=3)
        beyond = np.abs(line - centre) > width
        axis.plot(n[beyond], line[beyond], "s", mfc="none", ms=8, color=style.VERMILION)
        axis.set_ylabel(name)
    axes[-1].set_xlabel(x_label)
    return axes
