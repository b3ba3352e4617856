"""The transient of friction: whether a segment has settled, and the remaining bias if not.

For Dahl friction the departure from the steady loop decays with the path s travelled,

    D(s) = D_0 exp(-beta s/A),     beta = sigma A/f_max;     exp(-4 beta) per cycle

so settling takes cycles, not seconds. D has one sign, so it appears in the mean of the force, or of
the displacement if the force is controlled. It is estimated by least squares together with
harmonics, offset and drift, and its part in each harmonic is the remaining bias. If the decay does
not determine its rate, the rate is drawn to the beta at which Dahl friction has the measured phase.
The covariance of D_0 and ln(4 beta) is that of least squares with both free (variable projection).
The noise of D_0 is taken from the lines below the fundamental, as 1/f noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from dahl_ident.arrays import TINY, ComplexArray, FloatArray
from dahl_ident.elements import Dahl
from dahl_ident.extraction.sine_fit import (
    HARMONICS,
    Segment,
    SineFit,
    columns,
    powers,
    resolvable_orders,
)

SIGNIFICANT = 3.0  # standard deviations at which D_0 differs from zero
_FIRST_RATES = np.geomspace(1e-3, 64.0, 29)  # first grid of the rate, 4 beta
_REFINEMENTS = 5  # times that the grid of rates is refined, each time five times finer
_RATE_SPREAD = 1.0  # standard deviation of ln(rate) about the value derived from the phase
_FADED = 28.0  # decay constants after which a departure of 1 is 1e-12
_SLOW_LINES = 24  # spectral lines below the fundamental that give the noise of D_0
_ENOUGH_LINES = 5  # that are not all small by chance
MOST_CYCLES = 256  # cycles at most from which D_0 and the rate are estimated


@dataclass(frozen=True)
class Transient:
    """Departure D_0 of one channel from its steady loop, and its `rate`, 4 beta.

    D_0 is that where the path of ``cos(theta + displacement_phase)`` is `start` amplitudes.
    `covariance` is that of D_0 and ln(rate).
    """

    departure: float
    rate: float
    covariance: FloatArray
    displacement_phase: float
    start: float

    @property
    def departure_std(self) -> float:
        """Standard deviation of the departure; the uncertainty of the rate counts."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def significant(self) -> bool:
        """Whether the departure stands out of the noise."""
        return abs(self.departure) > SIGNIFICANT * self.departure_std

    def waveform(self, segment: Segment) -> FloatArray:
        """Return D at every sample of a segment that continues the phase."""
        return np.asarray(self.departure * self.derivatives(segment)[0])

    def derivatives(self, segment: Segment) -> FloatArray:
        """Return the derivatives of D with respect to D_0 and ln(rate), shape (2, n)."""
        path = _path(segment.theta + self.displacement_phase) - self.start
        return _derivatives(self.departure, 0.25 * self.rate * path)

    def phasor_derivatives(self, fit: SineFit) -> ComplexArray:
        """Return the derivatives of the phasors 0, 1, ... fitted to D, shape (2, harmonics)."""
        part = self.unfaded(fit.segment.theta)
        return fit.phasors_of(self.derivatives(fit.segment.part(part)))

    def unfaded(self, theta: FloatArray) -> slice:
        """Return the samples before it has faded to 1e-12 of its size."""
        faded = theta[0] + 2.0 * np.pi * _FADED / self.rate
        return slice(0, max(2, int(np.searchsorted(theta, faded))))


def estimate_transient(
    fit: SineFit, channel: int, displacement_phase: float, response: complex
) -> Transient:
    """Return the departure at the first sample of a segment, and its rate.

    The phase of the response, a dynamic stiffness, determines the rate if the decay does not.
    """
    thinned = replace(fit.segment, channels=fit.residual[channel][None]).thinned()
    y = thinned.channels[0]
    # offset, drift and harmonics, from which a departure is distinguished
    steady = columns(thinned.theta, thinned.tau, min(HARMONICS, resolvable_orders(thinned)))
    steady = np.linalg.solve(np.linalg.cholesky(steady @ steady.T), steady)  # orthonormal
    path = _path(thinned.theta + displacement_phase)
    start = float(_path(fit.segment.theta[:1] + displacement_phase)[0])
    path -= start

    angle = thinned.theta - thinned.theta[0]
    cycles = max(2, round(float(angle[-1]) / (2.0 * np.pi)))
    p = np.arange(1.0, min(cycles, _SLOW_LINES + 1))  # the lines p/T below the fundamental
    tones = powers(np.exp(-1j / cycles * angle), p.size)[1:]
    remaining = y - steady.T @ (steady @ y)
    content = tones @ remaining

    def variance_of(departure: float, decay: FloatArray, estimator: FloatArray) -> float:
        """Return the variance of white noise with the same effect on ``estimator @ y``.

        If the lines are few, they may be small by chance: it is then no less than that of the
        residuals.
        """
        power = np.abs(tones @ estimator) ** 2
        noise = np.abs(content - departure * (tones @ decay)) ** 2
        level = float(np.mean(p * noise)) / decay.size
        variance = max(level * float(np.sum(power / p) / np.sum(power)), TINY)
        if p.size >= _ENOUGH_LINES:
            return variance
        residual = remaining - departure * decay
        white = float(residual @ residual / max(y.size - len(steady) - 2, 1))
        return max(variance, white)

    rates = _FIRST_RATES
    friction_rates, phases = _friction_phases()
    centre = np.log(np.interp(np.angle(response), phases, friction_rates))
    for _ in range(_REFINEMENTS):
        decays = np.exp(-0.25 * rates[:, None] * path)
        decays -= decays @ steady.T @ steady
        power = np.einsum("ij,ij->i", decays, decays)
        sizes = decays @ y / power
        gain = sizes**2 * power
        best = int(np.argmax(gain))
        variance = variance_of(sizes[best], decays[best], decays[best])
        i = int(np.argmin(((np.log(rates) - centre) / _RATE_SPREAD) ** 2 - gain / variance))
        departure, rate = float(sizes[i]), float(rates[i])
        rates = np.geomspace(rates[max(i - 1, 0)], rates[min(i + 1, rates.size - 1)], 11)
    J = _derivatives(departure, 0.25 * rate * path)
    J -= J @ steady.T @ steady
    normal = J @ J.T
    of_rate = normal[1, 1] + variance / _RATE_SPREAD**2
    variance = variance_of(departure, J[0], J[0] - normal[0, 1] / of_rate * J[1])
    normal[1, 1] += variance / _RATE_SPREAD**2
    covariance = np.asarray(variance * np.linalg.inv(normal), dtype=np.float64)
    return Transient(departure, rate, covariance, displacement_phase, start)


def _derivatives(departure: float, decay: FloatArray) -> FloatArray:
    """Return the derivatives of ``departure exp(-decay)`` with respect to D_0 and ln(rate)."""
    factor = np.exp(-decay)
    return np.stack([factor, -departure * decay * factor])


def _path(theta: FloatArray) -> FloatArray:
    """Return the path of cos(theta) from theta = 0, in amplitudes: 4 per cycle."""
    strokes = np.floor(theta / np.pi)
    return 2.0 * strokes + 1.0 - np.cos(theta - np.pi * strokes)


@cache
def _friction_phases() -> tuple[FloatArray, FloatArray]:
    """Return rates 4 beta of Dahl friction, and the phases of its response."""
    beta = np.geomspace(_FIRST_RATES[0] / 4.0, 1e3, 600)
    phase = Dahl(f_max=1.0, sigma=1.0).phase(beta)
    return 4.0 * beta, phase
