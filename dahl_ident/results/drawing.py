"""Pictures of a fit: what to draw is decided here, how it looks in :mod:`dahl_ident.plots`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.plots import (
    Axes,
    Curve,
    plot_amplitude_response,
    plot_frequency_response,
    plot_residuals,
)

if TYPE_CHECKING:
    from dahl_ident.results.fit_result import FitResult

_POINTS = 200


def draw_fit(fit: FitResult, ax: Sequence[Axes] | None) -> tuple[Axes, Axes]:
    """Draw data and fit: over amplitude with a band, or over frequency by levels."""
    data = fit.data.select(harmonic=1)
    amplitude = data.amplitude
    if amplitude is not None and _is_over_amplitude(data, amplitude):
        return _over_amplitude(fit, data, amplitude, ax)
    levels, fitted = [], []
    for label, part in _levels(data):
        levels.append((label, part.frequency_hz, part.response))
        fitted.append(_curve(fit, part))
    return plot_frequency_response(levels, fitted=fitted, gain_label=f"gain [{data.unit}]", ax=ax)


def draw_residuals(fit: FitResult, ax: Axes | None) -> Axes:
    """Draw both residuals of every row over what varies most: amplitude or frequency."""
    data, m = fit.data, fit.problem.n_residuals
    amplitude = fit.problem.stiffness_data.amplitude
    unit = "rad" if data.motion == "rotation" else "m"
    x, label = amplitude, f"displacement amplitude [{unit}]"
    if np.ptp(np.log(data.frequency_hz)) > np.ptp(np.log(amplitude)):
        x, label = data.frequency_hz, "frequency [Hz]"
    residuals = fit.residual[:m] / (fit.scale if fit.scale > 0.0 else 1.0)
    names = ("ln gain", "phase") if fit.noise == "relative" else ("real part", "imaginary part")
    suspicious = [point.row for point in fit.goodness.suspicious]
    return plot_residuals(
        x,
        residuals[0::2],
        residuals[1::2],
        names=names,
        x_label=label,
        suspicious=suspicious,
        ax=ax,
    )


def _is_over_amplitude(data: FrequencyResponse, amplitude: FloatArray) -> bool:
    """Return whether the table is a curve over amplitude rather than curves over frequency."""
    return bool(
        (data.controlled == "displacement").all()
        and np.ptp(np.log(amplitude)) >= np.ptp(np.log(data.frequency_hz))
    )


def _over_amplitude(
    fit: FitResult, data: FrequencyResponse, amplitude: FloatArray, ax: Sequence[Axes] | None
) -> tuple[Axes, Axes]:
    grid = np.geomspace(amplitude.min(), amplitude.max(), _POINTS)
    band = fit.predict(float(np.median(data.frequency_hz)), amplitude=grid)
    gain_std, phase_std = _errors(fit, data)
    unit = "rad" if data.motion == "rotation" else "m"
    return plot_amplitude_response(
        amplitude,
        data.response,
        gain_std=gain_std,
        phase_std=phase_std,
        curve=Curve(grid, band.response, band.gain(), band.phase()),
        amplitude_label=f"displacement amplitude [{unit}]",
        gain_label=f"gain [{data.unit}]",
        ax=ax,
    )


def _errors(fit: FitResult, data: FrequencyResponse) -> tuple[FloatArray | None, FloatArray | None]:
    """Return the standard deviations of gain and phase that the noise model has."""
    R = data.response
    if fit.noise == "relative":
        return fit.scale * np.abs(R), np.full(R.shape, fit.scale)
    if fit.noise == "absolute":
        return np.full(R.shape, fit.scale), fit.scale / np.abs(R)
    if data.covariance is None:
        return None, None
    along = np.stack([R.real, R.imag], axis=-1) / np.abs(R)[:, None]
    across = np.stack([-R.imag, R.real], axis=-1) / np.abs(R)[:, None]
    gain, phase = (
        np.sqrt(np.einsum("ni,nij,nj->n", v, data.covariance, v)) for v in (along, across)
    )
    return gain, phase / np.abs(R)


def _levels(data: FrequencyResponse) -> Iterator[tuple[str, FrequencyResponse]]:
    if data.level is None:
        yield "data", data
        return
    for label in data.levels:
        yield f"{label:.3g}" if isinstance(label, float) else str(label), data.select(level=label)


def _curve(fit: FitResult, part: FrequencyResponse) -> tuple[FloatArray, ComplexArray]:
    """Return the fitted response over a level's frequencies, what was controlled interpolated."""
    order = np.argsort(part.frequency_hz)
    f = part.frequency_hz[order]
    if f[-1] <= f[0]:
        return f, fit.best_fit[:0]
    grid = np.geomspace(f[0], f[-1], _POINTS)
    forced = bool((part.controlled == "force").all())
    held: Any = part.drive if forced else part.amplitude
    level = np.exp(np.interp(np.log(grid), np.log(f), np.log(held[order])))
    band = fit.predict(grid, drive=level) if forced else fit.predict(grid, amplitude=level)
    return grid, band.response
