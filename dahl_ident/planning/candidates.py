"""Levels that can be measured within the limits of the bench, and the information in each.

A candidate is an amplitude of displacement, or of drive where force is controlled, at a frequency.
It is possible if 95 % of the draws stay within every limit there. Where force is controlled, a
point is left out if any draw has no steady amplitude or several.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident import steady_state
from dahl_ident.arrays import FloatArray, positive_array, positive_number
from dahl_ident.elements import Model
from dahl_ident.errors import ValidationError
from dahl_ident.planning.bench_time import BenchTime
from dahl_ident.planning.criteria import LevelInformation
from dahl_ident.planning.knowledge import Knowledge
from dahl_ident.planning.trajectories import PlannedMotion
from dahl_ident.problem import Problem

CONTROLLED = ("displacement", "force")
_LIMITS = ("displacement", "force", "speed", "acceleration", "frequency_hz", "time")
_CERTAIN = 0.95  # fraction of the draws that stay within a limit
_FREQUENCIES = 12  # at most: six a decade of the default range
_BELOW, _ABOVE = 0.03, 30.0  # range of amplitudes over the knee where no limit is given
_SOFTEST = 3e-3  # of the largest drive
_STEP = 1e-4  # relative, of the frequency: truncation 1e-8, rounding 1e-12
_CHECKED_DRAWS = 25  # at which the number of steady amplitudes is counted


@dataclass(frozen=True)
class BenchLimits:
    """Limits of the bench; lower limits are 0 where only the upper limit is given."""

    displacement: tuple[float, float] = (0.0, np.inf)  # zero-to-peak, SI
    force: tuple[float, float] = (0.0, np.inf)
    speed: tuple[float, float] = (0.0, np.inf)
    acceleration: tuple[float, float] = (0.0, np.inf)
    frequency_hz: tuple[float, float] = (0.0, np.inf)
    time: float = np.inf  # seconds for everything

    @classmethod
    def of(cls, given: Mapping[str, Any] | None) -> BenchLimits:
        """Return the limits of a mapping."""
        if not isinstance(given, Mapping):
            raise ValidationError(
                "limits: expected a mapping, such as {'displacement': 1e-3, 'frequency_hz': 5, "
                f"'time': 600}}, got {given!r}"
            )
        unknown = sorted(set(given) - set(_LIMITS))
        if unknown:
            raise ValidationError(
                f"limits has {', '.join(map(str, unknown))}; expected some of {', '.join(_LIMITS)}"
            )
        found: dict[str, Any] = {}
        for name, value in given.items():
            if name == "time":
                found[name] = positive_number(value, "limits['time']")
                continue
            ends = positive_array(value, f"limits[{name!r}]")
            pair = [0.0, float(ends)] if ends.ndim == 0 else ends.tolist()
            if len(pair) != 2 or not pair[0] <= pair[1]:
                raise ValidationError(
                    f"limits[{name!r}] is {value!r}; expected the highest value, or lowest and "
                    "highest"
                )
            found[name] = tuple(pair)
        return cls(**found)

    def relaxed(self, name: str, factor: float) -> BenchLimits:
        """Return the limits with one of them `factor` times wider at both ends."""
        low, high = getattr(self, name)
        changed: dict[str, Any] = {name: (low / factor, high * factor)}
        return replace(self, **changed)

    @property
    def stated(self) -> tuple[str, ...]:
        """Names of the limits that were given, time aside."""
        return tuple(n for n in _LIMITS[:-1] if getattr(self, n) != (0.0, np.inf))


@dataclass(frozen=True)
class CycleNoise:
    """Noise of one cycle: relative to the response, and floors of force and displacement."""

    relative: float  # standard deviation of ln gain and of phase
    force: float = 0.0  # standard deviation of each part of the fundamental, N and m
    displacement: float = 0.0

    def variance(self, force: FloatArray, amplitude: FloatArray) -> FloatArray:
        """Return the variance of ln gain and of phase in one cycle."""
        return np.asarray(
            self.relative**2 + (self.force / force) ** 2 + (self.displacement / amplitude) ** 2
        )


@dataclass(frozen=True)
class Candidates:
    """Levels and frequencies with all data that the search needs."""

    controlled: str  # what `level` is an amplitude of
    level: FloatArray  # (K,): SI
    frequency_hz: FloatArray
    amplitude: FloatArray  # (S, K): of displacement and of force, at every draw
    force: FloatArray
    # (S, K, 2, P): derivatives of the whitened residuals of one cycle, by parameters and by a run's
    # gain and phase
    rows: FloatArray
    offsets: FloatArray
    variance: FloatArray  # (S, K): of ln gain and phase in one cycle
    # motions in time whose periods the cycles are; empty for sines
    motions: tuple[PlannedMotion, ...] = ()

    @property
    def count(self) -> int:
        """K."""
        return len(self.level)

    def only(self, chosen: NDArray[Any]) -> Candidates:
        """Return some of the candidates."""
        parts = ("amplitude", "force", "rows", "offsets", "variance")
        return replace(
            self,
            level=self.level[chosen],
            frequency_hz=self.frequency_hz[chosen],
            motions=tuple(self.motions[k] for k in chosen.tolist()) if self.motions else (),
            **{name: getattr(self, name)[:, chosen] for name in parts},
        )

    def at_draws(self, draws: NDArray[np.intp]) -> Candidates:
        """Return the candidates at some of the draws."""
        parts = ("amplitude", "force", "rows", "offsets", "variance")
        return replace(self, **{name: getattr(self, name)[draws] for name in parts})

    def information(self, scatter: float) -> LevelInformation:
        """Return the information in one cycle at each candidate."""
        return LevelInformation.of(self.rows, self.offsets, scatter)


def grid(
    knowledge: Knowledge, limits: BenchLimits, controlled: str, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return levels and frequencies of about `count` candidates, before limits are applied."""
    if not np.isfinite(limits.frequency_hz[1]):
        raise ValidationError(
            "limits has no frequency_hz; give the highest frequency of the exciter, or lowest "
            "and highest: a cycle's time follows from it"
        )
    low, high = level_range(knowledge, limits, controlled)
    f_low, f_high = limits.frequency_hz
    free_of_rate = knowledge.model.rate_independent and controlled == "displacement"
    if free_of_rate or f_low == f_high:
        levels = np.geomspace(low, high, max(count, 2))
        with np.errstate(divide="ignore"):
            fastest = limits.speed[1] / (2.0 * np.pi * levels) if free_of_rate else np.inf
            if free_of_rate:
                fastest = np.minimum(
                    fastest, np.sqrt(limits.acceleration[1] / levels) / (2.0 * np.pi)
                )
        return levels, np.minimum(f_high, fastest) + 0.0 * levels
    f_low = f_low or f_high / 100.0
    n = min(_FREQUENCIES, max(count // 4, 1))
    if controlled == "force":
        n = max(int(np.sqrt(2.0 * count)), 1)
    frequencies = np.geomspace(f_low, f_high, n)
    levels = np.geomspace(low, high, max(count // n, 2))
    return np.tile(levels, n), np.repeat(frequencies, len(levels))


def level_range(knowledge: Knowledge, limits: BenchLimits, controlled: str) -> tuple[float, float]:
    """Return the lowest and the highest level: the limits, or what the knee suggests."""
    low, high = getattr(limits, controlled)
    if controlled == "force":
        if not np.isfinite(high):
            raise ValidationError("limits has no force; give the largest drive, N")
        return low or _SOFTEST * high, high
    knees = np.array(knowledge.model.knee(knowledge.model_values()))
    known = knees[np.isfinite(knees) & (knees > 0.0)]
    if known.size:
        low = low or _BELOW * float(np.quantile(known, 0.025))
        if not np.isfinite(high):
            high = max(_ABOVE * float(np.quantile(known, 0.975)), 2.0 * low)
    if not np.isfinite(high):
        raise ValidationError("limits has no displacement; give the largest amplitude, m")
    return low or 1e-3 * high, high


def evaluate(
    knowledge: Knowledge,
    level: FloatArray,
    frequency_hz: FloatArray,
    controlled: str,
    limits: BenchLimits,
    noise: CycleNoise,
) -> Candidates:
    """Return the candidates that every limit allows."""
    problem = knowledge.problem_at(level, frequency_hz, controlled)
    predicted, changes = problem.prediction_and_jacobian(knowledge.theta)
    if controlled == "force":
        force = np.broadcast_to(level, predicted.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            amplitude = force / np.abs(predicted)
    else:
        amplitude = np.broadcast_to(level, predicted.shape)
        force = amplitude * np.abs(predicted)
    omega = 2.0 * np.pi * frequency_hz
    sizes = {
        "displacement": amplitude,
        "force": force,
        "speed": omega * amplitude,
        "acceleration": omega**2 * amplitude,
        "frequency_hz": frequency_hz[None],
    }
    possible = allowed(limits, sizes, len(frequency_hz))
    if controlled == "force":
        possible &= np.isfinite(predicted).all(axis=0)
        possible &= _single_valued(knowledge, level, frequency_hz)
    kept = np.flatnonzero(possible)
    relative = changes[:, kept] / predicted[:, kept, None]
    amplitude, force = amplitude[:, kept], force[:, kept]
    variance = noise.variance(force, amplitude)
    size = 1.0 / np.sqrt(variance)[..., None, None]
    rows = np.stack([relative.real, relative.imag], axis=2) * size
    return Candidates(
        controlled, level[kept], frequency_hz[kept], amplitude, force, rows,
        np.broadcast_to(np.eye(2), (*size.shape[:2], 2, 2)) * size, variance,
    )  # fmt: skip


def allowed(limits: BenchLimits, sizes: Mapping[str, FloatArray], count: int) -> NDArray[np.bool_]:
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


def _single_valued(
    knowledge: Knowledge, drive: FloatArray, frequency_hz: FloatArray
) -> NDArray[np.bool_]:
    """Return where every draw has exactly one steady amplitude."""
    single = np.ones(len(drive), dtype=bool)
    draws = np.unique(np.linspace(0, len(knowledge.theta) - 1, _CHECKED_DRAWS).astype(int))
    for values in knowledge.values[draws]:
        own = dict(zip(knowledge.names, values.tolist(), strict=True))
        known = {p.name for p in knowledge.model.parameters}
        plant = knowledge.model.with_values({n: v for n, v in own.items() if n in known})
        found = steady_state.response(
            plant, frequency_hz, drive, all_roots=True, steady="describing function"
        )
        single &= found.number_of_solutions == 1
    if not single.any():
        raise ValidationError(
            "every candidate has several steady amplitudes, or none; control the displacement, "
            "or add damping"
        )
    return single


def bench_time(
    candidates: Candidates,
    knowledge: Knowledge,
    *,
    change_over: float,
    settled: float,
    between_runs: float,
) -> BenchTime:
    """Return the bench time of the candidates, so that the slowest tenth of the draws settles."""
    if candidates.motions:  # records are fitted from their first sample
        nothing = np.zeros(candidates.count)
        size = np.median(candidates.force, axis=0)
        return BenchTime(
            candidates.frequency_hz, nothing, size, change_over, settled, between_runs, 0
        )
    model, omega = knowledge.model, 2.0 * np.pi * candidates.frequency_hz
    values = knowledge.model_values()
    A = np.where(np.isfinite(candidates.amplitude), candidates.amplitude, 1.0)
    decay = np.asarray(model.transient_decay(values, A, omega + 0.0 * A))
    force = np.zeros(A.shape)
    for element, own in model.of(values):
        if element.has_memory:
            force = force + A * np.abs(element.stiffness(own, A, omega + 0.0 * A))
    if candidates.controlled == "force":
        decay = np.maximum(decay, _ring_down(model, values, A, omega))
        force = candidates.force
    return BenchTime(
        candidates.frequency_hz,
        np.quantile(decay, 0.9, axis=0),
        np.median(force, axis=0),
        change_over,
        settled,
        between_runs,
    )


def _ring_down(
    model: Model, values: Sequence[FloatArray], A: FloatArray, omega: FloatArray
) -> FloatArray:
    """Return the factor by which free vibration of the plant shrinks in one cycle of the drive.

    exp(-pi Im Z/(m omega^2)) with the mass m = -d Re Z/d(omega^2), at the steady amplitude.
    """
    w = omega + 0.0 * A
    Z = model.stiffness(values, A, w)
    up, down = (model.stiffness(values, A, w * (1.0 + s)).real for s in (_STEP, -_STEP))
    inertia = np.maximum(-(up - down) / (4.0 * _STEP), 0.0)  # m omega^2
    with np.errstate(divide="ignore", over="ignore"):
        rate = np.where(inertia > 1e-9 * np.abs(Z), np.maximum(Z.imag, 0.0) / inertia, np.inf)
    return np.asarray(np.exp(-np.pi * rate))


def larger_rows(
    larger: Model, knowledge: Knowledge, candidates: Candidates
) -> tuple[tuple[str, ...], FloatArray, FloatArray, Problem, FloatArray]:
    """Return the information in one cycle at each candidate on a larger model.

    Where displacement is controlled, the second harmonic counts in addition to the fundamental,
    because only it shows asymmetry; the noise of a harmonic's force is that of the fundamental's.
    """
    places = candidates.level, candidates.frequency_hz, candidates.controlled
    problem = knowledge.problem_at(*places, model=larger)
    drawn = dict(zip(knowledge.names, knowledge.values.T, strict=True))
    columns = []
    for p in problem.parameters:
        if p.name not in drawn and p.value is None:
            raise ValidationError(
                f"the larger model has the free parameter {p.name}, about which nothing is known; "
                "give it a value there"
            )
        one = drawn.get(p.name, np.full(len(knowledge.theta), p.value))
        columns.append(one)
    theta = problem.to_search(np.stack(columns, axis=-1))
    fundamental = problem.predict(theta)
    orders = [1]
    if candidates.controlled == "displacement" and any(e.answers(2) for e in larger.elements):
        orders.append(2)
    size = 1.0 / np.sqrt(candidates.variance)[..., None, None]
    rows, offsets = [], []
    for k in orders:
        one = knowledge.problem_at(*places, model=larger, harmonic=k, noise="absolute")
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = one.prediction_jacobian(theta) / fundamental[..., None]
        # within a gap there is no response, and no information
        relative = np.where(np.isfinite(relative), relative, 0.0)
        rows.append(np.stack([relative.real, relative.imag], axis=2) * size)
        shared = np.eye(2) if k == 1 else np.zeros((2, 2))
        offsets.append(np.broadcast_to(shared, (*size.shape[:2], 2, 2)) * size)
    return (
        problem.names,
        np.concatenate(rows, axis=2),
        np.concatenate(offsets, axis=2),
        problem,
        theta,
    )
