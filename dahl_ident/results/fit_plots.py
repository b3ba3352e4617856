"""Pictures of a fit: what to draw is decided here, how it looks in :mod:`dahl_ident.plots`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse, curves
from dahl_ident.data.quantities import polar_std
from dahl_ident.errors import ValidationError, choices
from dahl_ident.plots import Axes, Curve, plot_budget, plot_residuals
from dahl_ident.plots.waveforms import KINDS as OF_RECORDS
from dahl_ident.plots.waveforms import draw_record_fit
from dahl_ident.units import si_unit

if TYPE_CHECKING:
    from dahl_ident.diagnostics.budget import Budget
    from dahl_ident.results.fit_result import FitResult

_POINTS = 200  # of a curve that looks smooth


def draw(fit: FitResult, kind: str | None, ax: Any, record: int) -> Any:
    """Draw a fit in one of the kinds that its data have; the first where none is given."""
    kinds: dict[str, Callable[[], Any]] = {
        "fit": lambda: draw_fit(fit, ax),
        "residuals": lambda: draw_residuals(fit, None, ax),
    }
    if not fit.problem.settled:
        kinds = {k: partial(draw_record_fit, fit, k, record, ax) for k in OF_RECORDS}
    kinds["budget"] = lambda: _draw_budget(fit.budget(), ax)
    if kind is not None and kind not in kinds:
        raise ValidationError(f"kind is {kind!r}; expected one of {choices(kinds, kind)}")
    return kinds[kind or next(iter(kinds))]()


def _draw_budget(budget: Budget, ax: Any) -> Axes:
    shares = [(name, row.source, row.share) for name in budget for row in budget[name].rows]
    return plot_budget(shares, ax=ax)


def draw_fit(fit: FitResult, ax: Sequence[Axes] | None) -> tuple[Axes, Axes]:
    """Draw data with error bars and fit with its band, over amplitude or over frequency."""
    return curves.draw(
        fit.data,
        ax,
        stds=lambda part: _stds(fit, part),
        fitted=lambda part, over_frequency: _curve(fit, part, over_frequency),
    )


def standardized_residuals(fit: FitResult) -> FloatArray:
    """Return both residuals of each row in standard deviations, (n, 2); NaN where there is none.

    A mean force is real, so that its row has a first residual only.
    """
    scale = fit.scale if fit.scale > 0.0 else 1.0
    residuals = fit.residual[: fit.problem.n_residuals].reshape(-1, 2) / scale
    residuals[fit.data.harmonic == 0, 1] = np.nan
    return residuals


def draw_residuals(fit: FitResult, against: str | None, ax: Axes | None) -> Axes:
    """Draw both residuals of every row over a quantity, by default the one that suits the table."""
    data = fit.data
    if against is None:
        over_frequency = curves.is_over_frequency(data.select(harmonic=1))
        against = "frequency" if over_frequency else "amplitude"
    amplitude = fit.problem.stiffness_data.amplitude
    units = {kind: si_unit(kind, data.motion) for kind in ("displacement", "velocity")}
    places = {
        "amplitude": (amplitude, f"displacement amplitude [{units['displacement']}]"),
        "frequency": (data.frequency_hz, "frequency [Hz]"),
        "velocity": (
            2.0 * np.pi * data.frequency_hz * amplitude,
            f"velocity amplitude [{units['velocity']}]",
        ),
    }
    if against not in places:
        raise ValidationError(f"against is {against!r}; expected one of {choices(places, against)}")
    x, label = places[against]
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


def _stds(fit: FitResult, data: FrequencyResponse) -> tuple[FloatArray | None, FloatArray | None]:
    """Return the standard deviations of gain and phase that the noise model has."""
    gain = data.gain
    if fit.noise == "relative":
        return fit.scale * gain, np.full(gain.shape, fit.scale)
    if fit.noise == "absolute":
        return np.full(gain.shape, fit.scale), fit.scale / gain
    return (None, None) if data.covariance is None else polar_std(data.response, data.covariance)


def _curve(fit: FitResult, part: FrequencyResponse, over_frequency: bool) -> Curve:
    """Return the fitted response between some rows, what was held interpolated between them."""
    x = curves.abscissa(part, over_frequency)
    order = np.argsort(x)
    grid = np.geomspace(x[order[0]], x[order[-1]], _POINTS)

    def between(values: FloatArray) -> FloatArray:
        return np.exp(np.interp(np.log(grid), np.log(x[order]), np.log(values[order])))

    if over_frequency:
        frequency, held = grid, between(curves.held_amplitude(part))
    else:
        frequency, held = between(part.frequency_hz), grid
    forced = curves.is_force_controlled(part)
    band = fit.predict(
        frequency, drive=held if forced else None, amplitude=None if forced else held
    )
    return Curve(grid, band.response, band.gain(), band.phase())
