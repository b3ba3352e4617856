"""The phasors of a segment with their errors, and the responses that follow from them.

With the phasors X of displacement and F of force and their errors e_X, e_F,

    X_1 = A exp(j phi)                dA + j A dphi = e_X exp(-j phi)
    N   = F_1/X_1                     dN  = (e_F - N e_X)/X_1
    N_k = F_k exp(-j k phi)/A         dN_k = e_Fk exp(-j k phi)/A - N_k (dA/A + j k dphi)
    N_0 = F_0/A                       dN_0 = e_F0/A - N_0 dA/A,   real

A velocity or an acceleration is divided by ``j k omega`` once or twice. If the force was controlled
and harmonics of the displacement are requested, X and F are exchanged. The channel in the
denominator is called the reference here, the other one the output.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.special import fdtri

from dahl_ident.arrays import (
    TINY,
    ComplexArray,
    FloatArray,
    finite_number,
    positive_number,
    whole_number,
)
from dahl_ident.data.columns import CONTROLLED, one_of, set_checked
from dahl_ident.data.plausibility import creates_energy
from dahl_ident.errors import ValidationError
from dahl_ident.extraction.cycles import MODES, Mode, scattered
from dahl_ident.extraction.segment_quality import (
    BY_CHANCE,
    EVEN,
    alias_error,
    asymmetry,
    clipped_share,
    crest_samples,
    distortion,
    fundamental_share,
    has_unmeasured_aliases,
    quantisation_errors,
)
from dahl_ident.extraction.sine_fit import (
    FEWEST_CYCLES,
    HARMONICS,
    LineNoise,
    Samples,
    Segment,
    SineFit,
    columns,
    line_noise,
    sine_fit,
)
from dahl_ident.extraction.transient import Transient
from dahl_ident.units import percent

_LOSS_DISTORTED = 0.02  # share of harmonics above which the fundamental misses percents of the loss
_MOVING_MEAN = 0.02  # drift of the mean over the amplitude, if the force is controlled
_BEYOND_NOISE = 5.0  # standard errors above which a drift is more than noise
_LEAST_RESPONSE_STD = 1e-9  # least relative standard deviation of a response
_ALIASED = 0.01  # alias as a fraction of the fundamental above which it is reported
_RESIDUAL_SAMPLES = 10_000  # most samples from which the residual is computed
_FEW_STEPS = 10.0  # amplitude in steps of the sensor below which rounding matters
Row = tuple[complex, FloatArray, FloatArray, float]
"""A response, its covariance, its covariance with the reference's size, and degrees of freedom."""


@dataclass(frozen=True)
class Settings:
    """How segments are turned into points; see :func:`dahl_ident.extraction.extract`."""

    harmonics: tuple[int, ...] = tuple(range(HARMONICS + 1))
    num_periods: int | None = None
    settling_periods: int | None = None
    min_share: float = 0.6
    controlled: str = "displacement"
    frequency: float | None = None
    mode: Mode = "auto"
    motion_channel: str = "displacement"

    def __post_init__(self) -> None:
        set_checked(self, partial(whole_number, minimum=FEWEST_CYCLES), "num_periods")
        set_checked(self, partial(whole_number, minimum=0), "settling_periods")
        set_checked(self, positive_number, "frequency")
        if not isinstance(self.harmonics, Iterable):
            raise ValidationError(f"harmonics is {self.harmonics!r}; expected several numbers")
        orders = tuple(whole_number(k, "harmonics", 0) for k in self.harmonics)
        if not orders or max(orders) > HARMONICS or len(set(orders)) < len(orders):
            raise ValidationError(
                f"harmonics is {list(self.harmonics)!r}; expected different numbers from 0 to "
                f"{HARMONICS}"
            )
        object.__setattr__(self, "harmonics", orders)
        one_of(self.controlled, "controlled", CONTROLLED)
        set_checked(self, finite_number, "min_share")
        if not 0.0 <= self.min_share < 1.0:
            raise ValidationError(
                f"min_share is {self.min_share!r}; expected a share from 0 to below 1"
            )
        one_of(self.mode, "mode", MODES)

    @property
    def of_displacement(self) -> bool:
        """Whether the rows are X_k/F_1 instead of F_k/X_1."""
        return self.controlled == "force" and self.harmonics != (1,)

    @property
    def integrations(self) -> int:
        """Number of integrations from the motion channel to displacement."""
        return ("displacement", "velocity", "acceleration").index(self.motion_channel)

    @property
    def transient_channel(self) -> int:
        """The channel with the transient: the force, or a displacement that is free to move."""
        free = self.controlled == "force" and self.motion_channel == "displacement"
        return 0 if free else 1


@dataclass(frozen=True)
class Phasors:
    """Displacement and force of one segment with their noise.

    `fit` excludes the transient if that is significant. `transient_derivatives` are those of its
    part in the phasors of its channel with respect to its size and ln(rate), (2, harmonics).
    `steps` are the resolutions of the two sensors, 0 if there is none.
    """

    fit: SineFit
    cycles: int
    settings: Settings
    noise: dict[int, LineNoise]
    transient: Transient
    transient_derivatives: ComplexArray
    steps: FloatArray
    samples: Samples

    @classmethod
    def of(
        cls,
        segment: Segment,
        transient: Transient,
        cycles: int,
        settings: Settings,
        steps: FloatArray,
        samples: Samples,
        *,
        sweep: bool = False,
    ) -> Phasors:
        """Fit a segment without its transient, and estimate the noise from the residual."""
        fit = sine_fit(without(transient, segment, settings), trend=sweep)
        orders = [1, *sorted({*settings.harmonics, *EVEN} - {1})]
        orders = [k for k in orders if k <= fit.orders]
        noise = dict(zip(orders, line_noise(fit, orders, cycles, fit.residual), strict=True))
        derivatives = transient.phasor_derivatives(fit)
        return cls(fit, cycles, settings, noise, transient, derivatives, steps, samples)

    @property
    def harmonics(self) -> list[int]:
        """The harmonics that become rows."""
        return [k for k in self.settings.harmonics if k <= self.fit.orders]

    @property
    def reference(self) -> int:
        """The channel in the denominator of responses: 0 is the motion, 1 the force."""
        return int(self.settings.of_displacement)

    def integrator(self, harmonic: int) -> ComplexArray:
        """Return displacement over the motion channel, and 1 for the force, shape (2,)."""
        s = 1j * max(harmonic, 1) * self.fit.segment.omega  # the mean is not integrated
        return np.array([s**-self.settings.integrations, 1.0], dtype=np.complex128)

    @property
    def transient_phasors(self) -> ComplexArray:
        """The transient's part in the phasors 0, 1, ... of its channel."""
        return np.asarray(self.transient.departure * self.transient_derivatives[0])

    def phasors(self, harmonic: int) -> ComplexArray:
        """Return the phasors of the motion channel and the force, shape (2,)."""
        phasors = self.fit.phasors(harmonic)
        if self.transient.significant and harmonic:  # the mean is that of the steady loop
            phasors[self.settings.transient_channel] += self.transient_phasors[harmonic]
        return phasors

    @cached_property
    def fundamentals(self) -> ComplexArray:
        """Phasors of displacement and force, shape (2,)."""
        return self.phasors(1) * self.integrator(1)

    @cached_property
    def rounding(self) -> FloatArray:
        """RMS error of a phasor of the motion channel and of the force due to quantisation."""
        if not self.steps.any():
            return np.zeros(2)
        fit, segment = self.fit, self.fit.segment
        residual = np.sqrt(fit.residual_variance)  # of single samples
        if segment.block > 1:
            time = scattered(self.samples.time, _RESIDUAL_SAMPLES)
            chosen = segment.with_samples(time, scattered(self.samples.channels, _RESIDUAL_SAMPLES))
            tau = (time - segment.centre) / segment.half_width
            sine = fit.coefficients.T @ columns(chosen.theta, tau, fit.orders, fit.trending)
            errors = without(self.transient, chosen, self.settings).channels - sine
            residual = np.sqrt(np.mean(errors**2, axis=1))
        amplitudes = np.abs(fit.phasors(1))
        samples = self.samples.time.size
        return quantisation_errors(amplitudes, self.steps, residual, samples / self.cycles)

    @cached_property
    def repeating(self) -> dict[int, FloatArray]:
        """Errors of the phasors of both channels that repeat in every cycle, by harmonic."""
        aliased = {k: alias_error(self.fit, k, self.cycles) for k in self.noise}
        return {k: np.hypot(self.rounding, error) for k, error in aliased.items()}

    @cached_property
    def errors(self) -> ComplexArray:
        """Errors of the fundamental phasors of displacement and force, (2, independent sources)."""
        scale = self.integrator(1)[:, None]
        noise = self.noise[1].lines * np.sqrt(self.fit.phasor_variance(1))
        return np.asarray(scale * np.hstack([noise, np.diag(self.repeating[1])]))

    def variance(self, harmonic: int) -> FloatArray:
        """Return E abs(error)^2 of the phasors of the motion channel and the force, shape (2,)."""
        noise = np.diagonal(self.noise[harmonic].matrix).real
        repeating = self.repeating[harmonic]
        return np.asarray(noise * self.fit.phasor_variance(harmonic) + repeating**2)

    @cached_property
    def distorted(self) -> float:
        """Harmonics of the reference channel, corrected for noise, over its fundamental."""
        # each adds about its size times the response to the same harmonic of the output
        power, channel = 0.0, self.reference
        for k in (k for k in self.noise if k > 1):
            scale = abs(self.integrator(k) / self.integrator(1))[channel] ** 2
            size, variance = abs(self.fit.phasors(k)[channel]), float(self.variance(k)[channel])
            if size**2 > fdtri(2, self.noise[k].dof, 1.0 - BY_CHANCE) * variance:
                power += (size**2 - variance) * scale
        return float(np.sqrt(power) / abs(self.fit.phasors(1)[channel]))

    def transient_std(self, harmonic: int) -> float:
        """Return the standard deviation of the output due to that of the transient."""
        if self.settings.transient_channel == self.reference:
            return 0.0
        J = self.transient_derivatives[:, harmonic]
        return float(np.sqrt(abs(J.conj() @ self.transient.covariance @ J)))

    @property
    def reference_variance(self) -> float:
        """Variance of the size of the reference's fundamental."""
        return 0.5 * float(np.sum(np.abs(self.errors[self.reference]) ** 2))

    def ratio(self, output: complex, harmonic: int) -> complex:
        """Return harmonic k over the reference's size, relative to k times its phase."""
        H = complex(self.fundamentals[self.reference])
        return complex(output * (abs(H) / H) ** harmonic / abs(H))

    def response(self, harmonic: int) -> complex:
        """Return the response at a harmonic."""
        phasors = self.phasors(harmonic) * self.integrator(harmonic)
        return self.ratio(complex(phasors[1 - self.reference]), harmonic)

    def changed(self, changes: dict[int, ComplexArray]) -> ComplexArray:
        """Return the changes of the responses due to `changes` of both channels' phasors."""
        relative = complex(changes[1][self.reference] / self.phasors(1)[self.reference])
        return np.array(
            [
                self.ratio(complex((changes[k] * self.integrator(k))[1 - self.reference]), k)
                - self.response(k) * complex(relative.real, k * relative.imag)
                for k in self.harmonics
            ]
        )

    @property
    def bias(self) -> ComplexArray:
        """The transient's contribution to the response of each harmonic."""
        channel = np.eye(2)[self.settings.transient_channel]
        # it adds nothing to the mean
        added = {k: self.transient_phasors[k] * channel * (k > 0) for k in (1, *self.harmonics)}
        return self.changed(added)

    @property
    def lag(self) -> ComplexArray:
        """Half the change of each harmonic's response in a cycle of a sweep; otherwise 0."""
        # the force lags the amplitude by less than half a cycle, whatever beta is
        if not self.fit.trending:
            return np.zeros(len(self.harmonics), dtype=np.complex128)
        slopes = {k: self.fit.slopes(k) for k in (1, *self.harmonics)}
        return self.changed(slopes) / self.cycles

    @property
    def mean_moves(self) -> bool:
        """Whether the mean of a free displacement has not settled."""
        # if only a soft spring centres it, its approach is not exponential
        if self.settings.transient_channel == 1:
            return False
        fit = self.fit
        moved = 2.0 * float(fit.coefficients[1, 0])
        if self.transient.significant:
            first, last = self.transient.waveform(fit.segment)[[0, -1]]
            moved += float(last - first)
        slow = line_noise(fit, [0], self.cycles, fit.residual)[0].matrix[0, 0].real
        variance = max(float(fit.residual_variance[0]), float(slow))
        stderr = 2.0 * float(np.sqrt(fit.inverse[1, 1] * variance))
        amplitude = float(abs(self.phasors(1)[0]))
        return abs(moved) > max(_MOVING_MEAN * amplitude, _BEYOND_NOISE * stderr)

    @property
    def fundamental(self) -> Row:
        """The row of the fundamental."""
        H, N = complex(self.fundamentals[self.reference]), self.response(1)
        e_H, e_output = self.errors[self.reference], self.errors[1 - self.reference]
        e_N = (e_output - N * e_H) / H
        variance = float(np.sum(np.abs(e_N) ** 2))
        product = 0.5 * complex(e_N @ e_H.conj()) * H / abs(H)
        cross = np.array([product.real, product.imag])
        return N, 0.5 * variance * np.eye(2), cross, self.noise[1].dof

    def harmonic(self, k: int, distorted: float) -> Row:
        """Return the row of a higher harmonic, or of the mean."""
        noise = self.noise[k]
        A, N = abs(self.fundamentals[self.reference]), self.response(k)
        radial = np.array([N.real, N.imag])
        tangential = np.array([-N.imag, N.real])
        relative = self.reference_variance / A**2
        scale = abs(self.integrator(k)[1 - self.reference]) / A
        of_output = float(self.variance(k)[1 - self.reference]) * scale**2
        if k == 0:
            of_output += (self.transient_std(0) * scale) ** 2
        of_output += (distorted * abs(self.response(1))) ** 2
        covariance = 0.5 * of_output * np.eye(2) if k else np.diag([of_output, 0.0])
        outer = np.outer(radial, radial) + k**2 * np.outer(tangential, tangential)
        covariance = covariance + relative * outer
        of_reference = relative * (1.0 + k**2) * abs(N) ** 2
        share = of_output / max(of_output + of_reference, TINY)
        dof = 1.0 / (share**2 / noise.dof + (1.0 - share) ** 2 / self.noise[1].dof)
        return N, covariance, -radial * relative * A, dof

    def rows(self, distorted: float) -> tuple[ComplexArray, FloatArray, FloatArray]:
        """Return the responses, their joint covariance with the reference's size, and dof."""
        rows = [self.fundamental if k == 1 else self.harmonic(k, distorted) for k in self.harmonics]
        response, covariance, cross, dof = (np.array(column) for column in zip(*rows, strict=True))
        joint = np.empty((len(rows), 3, 3))
        joint[:, 0, 0] = self.reference_variance
        joint[:, 0, 1:] = joint[:, 1:, 0] = cross
        joint[:, 1:, 1:] = covariance
        return response, joint, dof

    @property
    def asymmetry(self) -> float:
        """Even harmonics of the force over its fundamental; 0 if they are not significant."""
        fit = self.fit
        if fit.trending or self.settings.controlled == "force":
            return 0.0
        even = [k for k in EVEN if k <= fit.orders]
        motion, force = np.array([fit.phasors(k) for k in [1, *even]]).T
        # the transient has even harmonics too, and their error counts as noise
        variance = [float(self.variance(k)[1]) + self.transient_std(k) ** 2 for k in even]
        orders = np.array(even, dtype=np.float64)
        return asymmetry(
            orders,
            force[1:] / force[0],
            np.array(variance) / abs(force[0]) ** 2,
            np.array([self.noise[k].dof for k in even]),
            np.abs(motion[1:] / motion[0]) / orders**self.settings.integrations,
        )

    def channel_quality(self) -> dict[str, Any]:
        """Return the columns that judge the two waveforms."""
        fit, steps = self.fit, self.steps
        shares = fundamental_share(fit, fit.segment, self.samples.lost_variance(fit.segment))
        amplitudes, block = np.abs(fit.phasors(1)), fit.segment.block
        crest = crest_samples(amplitudes[0], steps[0], fit.segment.sample_phase / block)
        longest = (crest, np.inf)
        clipped = list(map(clipped_share, self.samples.channels, steps, longest))
        with np.errstate(divide="ignore"):
            in_steps = amplitudes / steps
        return {
            "displacement_share": shares[0],
            "force_share": shares[1],
            "displacement_distortion": distortion(fit, 0, self.settings.integrations),
            "force_distortion": distortion(fit, 1),
            "asymmetry": self.asymmetry,
            "displacement_steps": in_steps[0],
            "force_steps": in_steps[1],
            "displacement_clipped": clipped[0],
            "force_clipped": clipped[1],
        }

    def objections(self, settled: bool, quality: dict[str, Any]) -> list[str]:
        """Return the objections to all rows."""
        objections = []
        N, covariance, _, dof = self.fundamental
        std = np.hypot(np.sqrt(covariance[1, 1]), _LEAST_RESPONSE_STD * abs(N))
        loss = -N.imag if self.settings.of_displacement else N.imag
        if settled and creates_energy(np.asarray(loss), std, np.asarray(dof)):
            objections.append("creates energy: a sign is reversed")
        fit = self.fit
        aliased = alias_error(fit, 1, self.cycles) > _ALIASED * np.abs(fit.phasors(1))
        if aliased.any() or has_unmeasured_aliases(fit, self.cycles):
            samples = 2.0 * np.pi / fit.segment.sample_phase * fit.segment.block
            objections.append(f"harmonics alias at {samples:.3g} samples a cycle")
        reference = ("displacement", "force")[self.reference]  # assumed to be a sine
        distorted = quality[f"{reference}_distortion"]
        if distorted > _LOSS_DISTORTED:
            objections.append(f"{reference} distorted {percent(distorted)}")
        for name in ("displacement", "force"):
            steps, clipped = quality[f"{name}_steps"], quality[f"{name}_clipped"]
            if steps < _FEW_STEPS:
                objections.append(f"{name} only {steps:.2g} sensor steps")
            if clipped:
                objections.append(f"{name} clipped in {percent(clipped)} of samples")
        return objections


def without(transient: Transient, segment: Segment, settings: Settings) -> Segment:
    """Return the segment without its transient, if that is significant."""
    if not transient.significant:
        return segment
    channels = segment.channels.copy()
    part = transient.unfaded(segment.theta)
    channels[settings.transient_channel, part] -= transient.waveform(segment.part(part))
    return replace(segment, channels=channels)
