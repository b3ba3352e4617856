"""Pictures of a fit: their content; :mod:`dahl_ident.plots` decides how they look."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse, Record, curves
from dahl_ident.errors import ValidationError, choices
from dahl_ident.plots import (
    Axes,
    Curve,
    plot_budget,
    plot_recorded_loops,
    plot_residuals,
    plot_sample_residuals,
    plot_waveforms,
)
from dahl_ident.results.fitted_model import FittedModel
from dahl_ident.units import polar_std, si_unit

if TYPE_CHECKING:
    from dahl_ident.diagnostics.budget import Budget

_POINTS = 200  # points of a curve, which then looks smooth


def draw(fit: FittedModel, kind: str | None, ax: Any, record: int) -> Any:
    """Draw a fit in one of the kinds that its data have, by default the fit over the data."""
    of_table = fit.problem.response is not None
    kinds: dict[str, Callable[[], Any]] = {
        "fit": lambda: _fit_of_record(fit, ax, record),
        "residuals": lambda: draw_residuals(fit, None, ax, record),
        "budget": lambda: draw_budget(fit.budget(), ax),
    }
    if of_table:
        stds, fitted = partial(_stds, fit), partial(_curve, fit)
        kinds["fit"] = lambda: curves.draw(fit.data, ax, stds=stds, fitted=fitted)
    else:
        kinds["loop"] = lambda: _draw_loop(fit, ax, record)
    if kind is not None and kind not in kinds:
        raise ValidationError(f"kind is {kind!r}; expected one of {choices(kinds, kind)}")
    return kinds[kind or "fit"]()


def draw_residuals(fit: FittedModel, against: str | None, ax: Axes | None, record: int) -> Axes:
    """Draw residuals over a quantity, by default the one that suits the data."""
    if fit.problem.response is not None:
        return _residuals_of_table(fit, against, ax)
    return _residuals_of_record(fit, against, ax, record)


def draw_budget(budget: Budget, ax: Axes | None = None) -> Axes:
    """Draw the share of each source in the variance of each parameter."""
    shares = [(p.name, row.source, row.share) for p in budget.parameters for row in p.rows]
    return plot_budget(shares, ax=ax)


def standardized_residuals(fit: FittedModel) -> FloatArray:
    """Return both residuals of each row in standard deviations, (n, 2).

    A mean force is real, so that the second residual of its row is NaN.
    """
    scale = fit.scale if fit.scale > 0.0 else 1.0
    residuals = fit.residual[: fit.problem.n_residuals].reshape(-1, 2) / scale
    residuals[fit.data.harmonic == 0, 1] = np.nan
    return residuals


def _residuals_of_table(fit: FittedModel, against: str | None, ax: Axes | None) -> Axes:
    """Draw both residuals of every row over a quantity, by default the one that suits the table."""
    data = fit.data
    if against is None:
        over_frequency = curves.is_over_frequency(data.select(harmonic=1))
        against = "frequency" if over_frequency else "amplitude"
    amplitude = fit.problem.stiffness_data.amplitude
    units = {kind: si_unit(kind, data.motion) for kind in ("displacement", "velocity")}
    abscissae = {
        "amplitude": (amplitude, f"displacement amplitude [{units['displacement']}]"),
        "frequency": (data.frequency_hz, "frequency [Hz]"),
        "velocity": (
            2.0 * np.pi * data.frequency_hz * amplitude,
            f"velocity amplitude [{units['velocity']}]",
        ),
    }
    if against not in abscissae:
        expected = choices(abscissae, against)
        raise ValidationError(f"against is {against!r}; expected one of {expected}")
    x, label = abscissae[against]
    of_curve = np.stack([curves.curve_of_row(data), data.harmonic])
    first, second = standardized_residuals(fit).T
    return plot_residuals(
        x,
        first,
        second,
        names=("ln gain", "phase") if fit.noise == "relative" else ("real part", "imaginary part"),
        x_label=label,
        group=np.unique(of_curve, axis=1, return_inverse=True)[1],
        suspicious=[point.row for point in fit.goodness.suspicious],
        ax=ax,
    )


def _stds(fit: FittedModel, data: FrequencyResponse) -> tuple[FloatArray | None, FloatArray | None]:
    """Return the standard deviations of gain and phase that the noise model has."""
    gain = data.gain
    if fit.noise == "relative":
        return fit.scale * gain, np.full(gain.shape, fit.scale)
    if fit.noise == "absolute":
        return np.full(gain.shape, fit.scale), fit.scale / gain
    return (None, None) if data.covariance is None else polar_std(data.response, data.covariance)


def _curve(fit: FittedModel, part: FrequencyResponse, over_frequency: bool) -> Curve:
    """Return the fitted response between rows; the controlled amplitude is interpolated."""
    x = curves.abscissa(part, over_frequency)
    order = np.argsort(x)
    grid = np.geomspace(x[order[0]], x[order[-1]], _POINTS)

    def on_grid(values: FloatArray) -> FloatArray:
        return np.exp(np.interp(np.log(grid), np.log(x[order]), np.log(values[order])))

    if over_frequency:
        frequency, level = grid, on_grid(curves.held_amplitude(part))
    else:
        frequency, level = on_grid(part.frequency_hz), grid
    forced = curves.is_force_controlled(part)
    band = fit.predict(
        frequency, drive=level if forced else None, amplitude=None if forced else level
    )
    return Curve(grid, band.response, band.gain(), band.phase())


def _fit_of_record(fit: FittedModel, ax: Axes | None, record: int) -> Axes:
    """Draw the measured and the fitted output of a record over time."""
    measured, _, channel = _output(fit, record)
    waves, axes = [(channel, measured)], None if ax is None else [ax]
    fitted = [fit.best_fit[record]]
    axis: Axes
    (axis,) = plot_waveforms(fit.data[record].time, waves, fitted=fitted, ax=axes)
    return axis


def _draw_loop(fit: FittedModel, ax: Axes | None, record: int) -> Axes:
    """Draw the measured force over displacement and, if force was predicted, the fitted one."""
    data = fit.data[record]
    x, labels = _displacement(data), _labels(data)
    fitted = fit.best_fit[record] if fit.problem.output == "force" else None
    return plot_recorded_loops(
        x,
        data.force_samples,
        fitted=fitted,
        ax=ax,
        displacement_label=labels["displacement"],
        force_label=labels.get("force", "force"),
    )


def _residuals_of_record(
    fit: FittedModel, against: str | None, ax: Axes | None, record: int
) -> Axes:
    """Draw measured minus fitted output of a record over time or displacement."""
    data = fit.data[record]
    _, residual, channel = _output(fit, record)
    x, label = data.time, "time [s]"
    if against == "displacement":
        x, label = _displacement(data), _labels(data)["displacement"]
    elif against not in (None, "time"):
        raise ValidationError(f"against is {against!r}; expected time or displacement")
    return plot_sample_residuals(x, residual, x_label=label, channel=channel, ax=ax)


def _output(fit: FittedModel, record: int) -> tuple[FloatArray, FloatArray, str]:
    """Return the measured output, its residuals, and its label with the unit."""
    channel = "force" if fit.problem.output == "force" else fit.data[record].motion_channel
    label = _labels(fit.data[record]).get(channel, channel)
    return fit.problem.measured[record], fit.residuals[record], label


def _displacement(record: Record) -> FloatArray:
    if record.displacement is None:
        raise ValidationError(
            f"the record has {record.motion_channel} and no displacement to draw over; draw the "
            "fit or its residuals over time"
        )
    return np.asarray(record.displacement)


def _labels(record: Record) -> dict[str, str]:
    """Return the labels of a record's channels with units."""
    return {name.partition(" ")[0]: str(name) for name in record.to_frame().columns}
