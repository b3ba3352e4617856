"""Pictures of a fit: what to draw is decided here, how it looks in :mod:`dahl_ident.plots`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse, layout
from dahl_ident.data.quantities import polar_std
from dahl_ident.plots import (
    Axes,
    Curve,
    plot_amplitude_response,
    plot_frequency_response,
    plot_residuals,
)
from dahl_ident.units import si_unit

if TYPE_CHECKING:
    from dahl_ident.results.fit_result import FitResult

_POINTS = 200


def draw_fit(fit: FitResult, ax: Sequence[Axes] | None) -> tuple[Axes, Axes]:
    """Draw data with error bars and fit with its band, over amplitude or over frequency."""
    data = fit.data.select(harmonic=1)
    over_frequency = layout.is_over_frequency(data)
    parts = layout.curves(data)
    drawn: dict[str, Any] = {"gain_label": layout.gain_label(data), "ax": ax}
    if over_frequency or len(parts) > 1:
        return plot_frequency_response(
            [(name, layout.abscissa(part, over_frequency), part.response) for name, part in parts],
            errors=[_stds(fit, part) for _, part in parts],
            fitted=[_curve(fit, part, over_frequency) for _, part in parts],
            x_label=layout.abscissa_label(data),
            **drawn,
        )
    gain_std, phase_std = _stds(fit, data)
    return plot_amplitude_response(
        layout.held_amplitude(data),
        data.response,
        gain_std=gain_std,
        phase_std=phase_std,
        curve=_curve(fit, data, over_frequency),
        amplitude_label=layout.held_label(data),
        **drawn,
    )


def draw_residuals(fit: FitResult, ax: Axes | None) -> Axes:
    """Draw both residuals of every row over amplitude or frequency, as suits the table."""
    data = fit.data
    if layout.is_over_frequency(data.select(harmonic=1)):
        x, label = data.frequency_hz, "frequency [Hz]"
    else:
        x = fit.problem.stiffness_data.amplitude
        label = f"displacement amplitude [{si_unit('displacement', data.motion)}]"
    of_curve = np.stack([layout.curve_of_row(data), data.harmonic])
    residuals = fit.residual[: fit.ndata] / (fit.scale if fit.scale > 0.0 else 1.0)
    return plot_residuals(
        x,
        residuals[0::2],
        residuals[1::2],
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
    x = layout.abscissa(part, over_frequency)
    order = np.argsort(x)
    grid = np.geomspace(x[order[0]], x[order[-1]], _POINTS)

    def between(values: FloatArray) -> FloatArray:
        return np.exp(np.interp(np.log(grid), np.log(x[order]), np.log(values[order])))

    if over_frequency:
        frequency, held = grid, between(layout.held_amplitude(part))
    else:
        frequency, held = between(part.frequency_hz), grid
    forced = layout.is_force_controlled(part)
    band = fit.predict(
        frequency, drive=held if forced else None, amplitude=None if forced else held
    )
    return Curve(grid, band.response, band.gain(), band.phase())
