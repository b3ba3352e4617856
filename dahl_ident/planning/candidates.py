"""Levels within the limits of the bench, their information and their time.

A candidate is an amplitude of displacement, or of drive where force is controlled, at a frequency.
It is possible if 95 % of the draws stay within every limit. If force is controlled, it is left out
if any draw has no steady amplitude or several. The time is that of settling in the order of the
levels, of measured cycles and of change-over.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import BoolArray, FloatArray, IntArray
from dahl_ident.control_interop import response
from dahl_ident.elements import Model
from dahl_ident.errors import ValidationError
from dahl_ident.planning.knowledge import Knowledge
from dahl_ident.planning.question import BenchLimits, PlanRequest, limit
from dahl_ident.planning.trajectories import PlannedMotion

_CERTAIN = 0.95  # fraction of the draws that must stay within a limit
_FREQUENCIES = 12  # most frequencies: six in each decade of the default range
_BELOW, _ABOVE = 0.03, 30.0  # range of amplitudes over the knee, if no limit is given
_SOFTEST = 3e-3  # smallest drive as a fraction of the largest
_CHECKED_DRAWS = 25  # draws at which the number of steady amplitudes is counted
OF_DRAWS = ("amplitude", "force", "rows", "variance")  # fields with an axis of draws
LEAST_CYCLES = 2  # measured at each level: a single cycle does not show its noise
_LEAST_SETTLING = 1  # cycles before measuring
_QUANTILE = 0.9  # quantile of the draws by which the motion must have settled
_STEP = 1e-4  # relative step of frequency in differences: truncation error 1e-8, rounding 1e-12


@dataclass(frozen=True)
class Candidates:
    """Levels and frequencies with the data for the search."""

    controlled: str  # {"displacement", "force"} quantity of which `level` is an amplitude
    level: FloatArray  # (K,) SI
    frequency_hz: FloatArray
    amplitude: FloatArray  # (S, K) of displacement and of force, at every draw
    force: FloatArray
    # (S, K, m, P) derivatives of the whitened residuals of one cycle with respect to the parameters
    rows: FloatArray
    variance: FloatArray  # (S, K) of ln gain and phase in one cycle
    # motions in time, whose periods are the cycles; empty for sines
    motions: tuple[PlannedMotion, ...] = ()

    @property
    def count(self) -> int:
        """Number of candidates, K."""
        return len(self.level)

    @property
    def weight(self) -> FloatArray:
        """One over the standard deviation of ln gain and phase in one cycle, (S, K, 1, 1)."""
        return np.asarray(1.0 / np.sqrt(self.variance)[..., None, None])

    @property
    def offsets(self) -> FloatArray:
        """Derivatives with respect to the gain and phase of a run, (S, K, m, 2).

        They are those of the fundamental's two rows, the first ones; harmonics have other errors.
        """
        return np.asarray(np.eye(self.rows.shape[2], 2) * self.weight)

    def only(self, chosen: NDArray[Any]) -> Candidates:
        """Return some of the candidates."""
        return replace(
            self,
            level=self.level[chosen],
            frequency_hz=self.frequency_hz[chosen],
            motions=tuple(self.motions[k] for k in chosen.tolist()) if self.motions else (),
            **{name: getattr(self, name)[:, chosen] for name in OF_DRAWS},
        )


def grid(question: PlanRequest, limits: BenchLimits, count: int) -> tuple[FloatArray, FloatArray]:
    """Return levels and frequencies of about `count` candidates, before limits are applied."""
    if not np.isfinite(limits.frequency_hz[1]):
        raise ValidationError(
            f"{limit('frequency_hz')} is missing; give the highest frequency of the exciter, or "
            "lowest and highest: a cycle's time follows from it"
        )
    by_force = question.controlled == "force"
    low, high = level_range(question, limits)
    f_low, f_high = limits.frequency_hz
    levels = np.geomspace(low, high, max(count, 2))
    if question.knowledge.model.rate_independent and not by_force:
        with np.errstate(divide="ignore"):
            by_speed = limits.speed[1] / (2.0 * np.pi * levels)
            by_acceleration = np.sqrt(limits.acceleration[1] / levels) / (2.0 * np.pi)
        return levels, np.minimum(f_high, np.minimum(by_speed, by_acceleration))
    if f_low == f_high:
        return levels, np.full(levels.size, f_high)
    n = min(_FREQUENCIES, max(count // 4, 1))
    if by_force:
        n = max(int(np.sqrt(2.0 * count)), 1)
    levels = np.geomspace(low, high, max(count // n, 2))
    frequencies = np.geomspace(f_low or f_high / 100.0, f_high, n)
    return np.tile(levels, n), np.repeat(frequencies, len(levels))


def level_range(question: PlanRequest, limits: BenchLimits) -> tuple[float, float]:
    """Return the lowest and the highest level: the limits, or multiples of the knee."""
    low, high = getattr(limits, question.controlled)
    if question.controlled == "force":
        if not np.isfinite(high):
            raise ValidationError(f"{limit('force')} is missing; give the largest drive, N")
        return low or _SOFTEST * high, high
    knees = np.array(question.knowledge.model.knee(question.knowledge.model_values()))
    known = knees[np.isfinite(knees) & (knees > 0.0)]
    if known.size:
        low = low or _BELOW * float(np.quantile(known, 0.025))
        if not np.isfinite(high):
            high = max(_ABOVE * float(np.quantile(known, 0.975)), 2.0 * low)
    if not np.isfinite(high):
        raise ValidationError(f"{limit('displacement')} is missing; give the largest amplitude, m")
    return low or 1e-3 * high, high


def evaluate(
    question: PlanRequest, limits: BenchLimits, level: FloatArray, frequency_hz: FloatArray
) -> Candidates:
    """Return the candidates that every limit allows."""
    knowledge, by_force = question.knowledge, question.controlled == "force"
    problem = knowledge.problem_at(level, frequency_hz, question.controlled)
    predicted, changes = problem.prediction_and_jacobian(knowledge.theta)
    controlled = np.broadcast_to(level, predicted.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        amplitude = controlled / np.abs(predicted) if by_force else controlled
    force = controlled if by_force else controlled * np.abs(predicted)
    omega = 2.0 * np.pi * frequency_hz
    sizes = {
        "displacement": amplitude,
        "force": force,
        "speed": omega * amplitude,
        "acceleration": omega**2 * amplitude,
        "frequency_hz": frequency_hz[None],
    }
    possible = allowed(limits, sizes, len(frequency_hz))
    # within a gap there is no response
    possible &= (np.isfinite(predicted) & (predicted != 0.0)).all(axis=0)
    if by_force:
        possible &= _single_valued(knowledge, level, frequency_hz)
    kept = np.flatnonzero(possible)
    relative = changes[:, kept] / predicted[:, kept, None]
    amplitude, force = amplitude[:, kept], force[:, kept]
    candidates = Candidates(
        question.controlled,
        level[kept],
        frequency_hz[kept],
        amplitude,
        force,
        np.stack([relative.real, relative.imag], axis=2),
        question.noise.variance(force, amplitude),
    )
    return replace(candidates, rows=candidates.rows * candidates.weight)


def allowed(limits: BenchLimits, sizes: Mapping[str, FloatArray], count: int) -> BoolArray:
    """Return which of `count` candidates stay within every limit at nearly all draws."""
    possible, refused = np.ones(count, dtype=bool), {}
    for name, size in sizes.items():
        low, high = getattr(limits, name)
        inside = (size >= low * (1.0 - 1e-9)) & (size <= high * (1.0 + 1e-9))
        good = inside.mean(axis=0) >= _CERTAIN
        refused[name] = int((~good).sum())
        possible &= good
    if not possible.any():
        worst = max(refused, key=lambda name: refused[name])
        raise ValidationError(
            f"limits leave no level to measure: {worst} excludes {refused[worst]} of "
            f"{count} candidates; widen limits[{worst!r}], or give narrower ranges"
        )
    return possible


def _single_valued(knowledge: Knowledge, drive: FloatArray, frequency_hz: FloatArray) -> BoolArray:
    """Return where every draw has exactly one steady amplitude."""
    single = np.ones(len(drive), dtype=bool)
    known = {p.name for p in knowledge.model.parameters}
    for values in knowledge.thinned(_CHECKED_DRAWS).values:
        named = zip(knowledge.names, values.tolist(), strict=True)
        plant = knowledge.model.with_values({n: v for n, v in named if n in known})
        solutions = response(
            plant, frequency_hz, drive, all_roots=True, steady="describing function"
        )
        single &= solutions.number_of_solutions == 1
    if not single.any():
        raise ValidationError(
            "every candidate has several steady amplitudes, or none; control the displacement, "
            "or add damping"
        )
    return single


@dataclass(frozen=True)
class BenchTime:
    """The time that it takes to measure candidates.

    A transient starts with the size abs(F - F')/F relative to the friction force F, with F' that of
    the previous level, and is multiplied by `decay` in each cycle; measuring starts when it is
    below `settled`.
    """

    frequency_hz: FloatArray  # (K,)
    decay: FloatArray  # (K,) factor of a transient in a cycle
    force: FloatArray  # (K,) friction force
    change_over: float  # seconds from one level to the next
    settled: float  # transient over the friction force
    between_runs: float = 0.0  # seconds that a run takes in addition to its levels
    least_settling: float = _LEAST_SETTLING  # fewest cycles before measuring

    @classmethod
    def of(cls, candidates: Candidates, knowledge: Knowledge, **costs: float) -> BenchTime:
        """Return the bench time of the candidates, in which the slowest 10 % of the draws settle.

        `costs` are change_over, settled and between_runs, s.
        """
        f = candidates.frequency_hz
        if candidates.motions:  # records are fitted from their first sample
            size = np.median(candidates.force, axis=0)
            return cls(f, np.zeros(f.size), size, **costs, least_settling=0)
        model, omega, values = knowledge.model, 2.0 * np.pi * f, knowledge.model_values()
        A = np.where(np.isfinite(candidates.amplitude), candidates.amplitude, 1.0)
        omega = np.broadcast_to(omega, A.shape)
        decay = np.asarray(model.transient_decay(values, A, omega))
        if candidates.controlled == "force":
            decay, force = np.maximum(decay, _ring_down(model, values, A, omega)), candidates.force
        else:
            force = np.zeros(A.shape)
            for element, numbers in model.of(values):
                if element.has_memory:
                    force = force + A * np.abs(element.stiffness(numbers, A, omega))
        return cls(f, np.quantile(decay, _QUANTILE, axis=0), np.median(force, axis=0), **costs)

    def order(self, levels: Sequence[int] | IntArray) -> IntArray:
        """Return the levels, (..., m), in order of rising friction force.

        In this order no transient is larger than the friction force.
        """
        chosen = np.asarray(levels, dtype=np.intp)
        rising = np.lexsort((self.frequency_hz[chosen], self.force[chosen]), axis=-1)
        return np.take_along_axis(chosen, rising, axis=-1)

    def settling_cycles(self, ordered: Sequence[int] | IntArray) -> FloatArray:
        """Return the cycles before measuring at each level, (..., m), in this order; may be inf."""
        chosen = np.asarray(ordered, dtype=np.intp)
        force, decay = self.force[chosen], self.decay[chosen]
        before = np.concatenate([np.zeros_like(force[..., :1]), force[..., :-1]], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            start = np.where(force > 0.0, np.abs(force - before) / force, 0.0)
            cycles = np.log(start / self.settled) / -np.log(decay)
        cycles = np.where(start <= self.settled, 0.0, np.where(decay > 0.0, cycles, 0.0))
        return np.asarray(np.maximum(np.ceil(cycles - 1e-9), self.least_settling))

    def fixed(self, levels: Sequence[int] | IntArray) -> FloatArray:
        """Return the seconds of a run before anything is measured, for each set of levels."""
        ordered = self.order(levels)
        settling = self.settling_cycles(ordered) / self.frequency_hz[ordered]
        whole = self.between_runs + settling.sum(axis=-1) + self.change_over * ordered.shape[-1]
        return np.asarray(whole)

    @property
    def alone(self) -> FloatArray:
        """Seconds before anything is measured at each candidate alone, (K,)."""
        return self.fixed(np.arange(len(self.frequency_hz))[:, None])

    def seconds(self, levels: Sequence[int] | IntArray, cycles: FloatArray) -> float:
        """Return the seconds of one run."""
        measured = (cycles / self.frequency_hz[np.asarray(levels)]).sum()
        return float(self.fixed(levels) + measured)


def _ring_down(
    model: Model, values: Sequence[FloatArray], A: FloatArray, omega: FloatArray
) -> FloatArray:
    """Return the factor by which the plant's free vibration decays in a cycle of the drive.

    It is exp(-pi Im Z/(m omega^2)) with the mass m = -d Re Z/d(omega^2), at the steady amplitude.
    """
    Z = model.stiffness(values, A, omega)
    up, down = (model.stiffness(values, A, omega * (1.0 + s)).real for s in (_STEP, -_STEP))
    inertia = np.maximum(-(up - down) / (4.0 * _STEP), 0.0)  # m omega^2
    with np.errstate(divide="ignore", over="ignore"):
        rate = np.where(inertia > 1e-9 * np.abs(Z), np.maximum(Z.imag, 0.0) / inertia, np.inf)
    return np.asarray(np.exp(-np.pi * rate))
