"""Plots of a fit to a record: against time, as a loop, and the residuals."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from dahl_ident.errors import ValidationError
from dahl_ident.plots import style
from dahl_ident.plots.waveforms import plot_recorded_loops, plot_waveforms


def draw_record_fit(fit: Any, kind: str, number: int, ax: Axes | None = None) -> Axes:
    """Draw one record of a fit.

    Parameters
    ----------
    fit : RecordFit
    kind : {"time", "loop", "residuals", "residuals_displacement"}
    number : int
        Which record.
    ax : Axes, optional
        To draw residuals into.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    ValidationError
        If the kind is unknown, or displacement is wanted that the record does not have.
    """
    record, residual = fit.records[number], fit.residuals[number]
    measured = fit.problem.measured[number]
    labels = {name.partition(" ")[0]: str(name) for name in record.to_frame().columns}  # with units
    channel = "force" if fit.problem.output == "force" else record.motion_channel
    if kind == "time":
        axes = plot_waveforms(record.time, [(channel, measured)], fitted=[measured - residual])
        axis: Axes = axes[0]
        return axis
    if kind == "loop":
        if record.displacement is None:
            raise ValidationError("a loop needs displacement, which the record does not have")
        force = record.force_samples
        fitted = measured - residual if fit.problem.output == "force" else None
        return plot_recorded_loops(
            record.displacement,
            force,
            fitted=fitted,
            displacement_label=labels["displacement"],
            force_label=labels.get("force", "force"),
        )
    if kind not in ("residuals", "residuals_displacement"):
        raise ValidationError(
            f"kind is {kind!r}; expected time, loop, residuals or residuals_displacement"
        )
    over, label = record.time, "time [s]"
    if kind != "residuals":
        if record.displacement is None:
            raise ValidationError("the record has no displacement to draw residuals against")
        over, label = record.displacement, labels["displacement"]
    with style.house_style():
        axis = ax or style.new_axes(1, 1, size=(6.4, 3.0), sharex=True)[0, 0]
        axis.plot(over, residual, color=style.BLUE, lw=0.6)
        axis.axhline(0.0, color="0.5", lw=0.6)
        axis.set_xlabel(label)
        axis.set_ylabel(f"measured minus fitted {channel}")
        axis.set_title(f"{np.sqrt(np.mean(residual**2)):.3g} rms")
        return axis
