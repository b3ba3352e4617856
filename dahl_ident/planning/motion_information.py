"""Information in the records of motions in time.

A motion is a period of displacement that is repeated; one record holds all its repeats and is
fitted in time, so nothing has to settle. Its information is that of the record's fit
(:mod:`dahl_ident.problem.record_problem`): J'J/s^2 of the predicted force with white noise s, from
which the record's own unknowns (state at the first sample, offset, drift) are eliminated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.errors import ValidationError
from dahl_ident.planning.bench_time import LEAST_CYCLES
from dahl_ident.planning.candidates import BenchLimits, Candidates, allowed
from dahl_ident.planning.knowledge import Knowledge
from dahl_ident.planning.trajectories import SAMPLES_PER_CYCLE, Multisine, PlannedMotion, Trapezoid
from dahl_ident.problem.record_problem import RecordProblem

_PER_PERIOD = 400  # samples at which derivatives are computed: integrals hold to about 1e-3
_LEAST_SAMPLES = 16  # in a period, however low the sample rate
_SIMULATED = 4  # repeats from rest: in the last one the friction repeats itself
_REPEATS = 8  # for which the search computes the information of a repeat
_LEVELS, _SPEEDS, _BANDS = 24, 4, 4  # of the candidates that a kind stands for
_SLOWER = 2.0  # times, from speed to speed and from band to band
_LINES = 10  # of a multisine, its highest frequency over its lowest


def motions_of(kind: str, limits: BenchLimits, levels: tuple[float, float]) -> list[PlannedMotion]:
    """Return the candidates that a kind of motion stands for, within the limits."""
    amplitudes = np.geomspace(*levels, _LEVELS).tolist()
    found: list[PlannedMotion] = []
    if kind == "trapezoid":
        for name in ("speed", "acceleration"):
            if not np.isfinite(getattr(limits, name)[1]):
                raise ValidationError(
                    f"limits has no {name}; give the highest one of the exciter: the time of a "
                    "trapezoidal trajectory follows from it"
                )
        for size in amplitudes:
            fastest = min(limits.speed[1], float(np.sqrt(2.0 * size * limits.acceleration[1])))
            found += [
                Trapezoid(2.0 * size, fastest / _SLOWER**i, limits.acceleration[1])
                for i in range(_SPEEDS)
            ]
        return found
    low, high = limits.frequency_hz
    if not np.isfinite(high):
        raise ValidationError("limits has no frequency_hz; give the highest one of the multisine")
    for size in amplitudes:
        for i in range(_BANDS):
            top = high / _SLOWER**i
            one = Multisine(max(top / _LINES, low), top, size) if top >= low else None
            found += [one] if one is not None else []
    return found


@dataclass(frozen=True)
class RecordedForce:
    """What records of motions say: white noise of a force sample, and samples a second."""

    noise: float
    sample_rate: float

    def information(self, knowledge: Knowledge, motion: PlannedMotion, repeats: int) -> FloatArray:
        """Return the information of one record, (S, P, P): all its repeats, own unknowns out."""
        rate = min(self.sample_rate, _PER_PERIOD / motion.period)
        return _of_record(_sums(knowledge, motion, rate), repeats, motion.period) * (
            self.sample_rate / rate / self.noise**2
        )


@dataclass(frozen=True)
class _RepeatSums:
    """Products of derivatives, (S, repeats, n, n), n = P + states + 2, and what repeats add."""

    products: FloatArray
    parameters: int
    force: FloatArray  # (S,), largest


def _sums(knowledge: Knowledge, motion: PlannedMotion, rate: float) -> _RepeatSums:
    m = max(round(motion.period * rate), _LEAST_SAMPLES)
    time = np.arange(float(_SIMULATED * m)) * (motion.period / m)
    record = Record(time, displacement=motion.displacement(time), force=np.zeros(time.size))
    problem = RecordProblem([record], knowledge.model, output="force")
    P, n = len(problem.free), len(problem.parameters)
    if tuple(p.name for p in problem.free) != knowledge.names:
        raise ValidationError("plan: the model of the earlier data has parameters of sensors")
    found, force = [], []
    for values in knowledge.values:
        whole = np.concatenate([values, np.zeros(n - P)])
        predicted = problem.predict(whole, 0)
        by = predicted.by * np.concatenate([knowledge.space.slopes(values), np.ones(n - P)])
        by[:, -1] = np.mod(time + 0.5 * time[1], motion.period)  # drift, within its repeat
        blocks = by.reshape(_SIMULATED, m, n)
        found.append(blocks.swapaxes(1, 2) @ blocks)
        force.append(float(np.abs(predicted.output).max()))
    return _RepeatSums(np.array(found), P, np.array(force))


def _of_record(sums: _RepeatSums, repeats: int, period: float) -> FloatArray:
    """Return the information of the parameters after elimination, for unit noise."""
    n, P = sums.products.shape[-1], sums.parameters
    whole = np.zeros((len(sums.products), n, n))
    later = np.arange(_SIMULATED, repeats) * period
    for k in range(min(repeats, _SIMULATED)):
        shift = np.eye(n)
        shift[-2, -1] = k * period  # drift = within the repeat + the time of its start
        whole += shift.T @ sums.products[:, k] @ shift
    if later.size:
        last = sums.products[:, -1]
        one = np.zeros((n, n))
        one[-2, -1] = 1.0
        cross = last @ one
        whole += later.size * last + later.sum() * (cross + cross.swapaxes(1, 2))
        whole += (later**2).sum() * (one.T @ last @ one)
    own = whole[:, P:, P:]
    size = np.sqrt(np.maximum(np.diagonal(own, axis1=1, axis2=2), 1e-300))
    units = size[:, :, None] * size[:, None, :]
    inverse = np.linalg.pinv(own / units, hermitian=True, rcond=1e-10) / units
    return np.asarray(whole[:, :P, :P] - whole[:, :P, P:] @ inverse @ whole[:, P:, :P])


def evaluate_motions(
    knowledge: Knowledge,
    motions: Sequence[PlannedMotion],
    limits: BenchLimits,
    recorded: RecordedForce,
    lasting: float | None = None,
) -> Candidates:
    """Return the candidates that every limit allows, with the information of a repeat.

    It is the mean over the repeats of a record of `lasting` s, or of `_REPEATS` repeats.
    """
    rate = recorded.sample_rate
    resolved = [one for one in motions if one.fastest_hz * SAMPLES_PER_CYCLE <= rate]
    if not resolved:
        slowest = min(one.fastest_hz for one in motions)
        raise ValidationError(
            f"sample_rate is {rate:g} Hz; expected at least {SAMPLES_PER_CYCLE} samples in a "
            f"trapezoid's way from end to end or a multisine's shortest cycle: "
            f"{SAMPLES_PER_CYCLE * slowest:.3g} Hz for the slowest motion; or slow the motions down"
        )
    motions = resolved
    peaks = np.array([motion.peaks for motion in motions])
    rates = [min(rate, _PER_PERIOD / motion.period) for motion in motions]
    sums = [_sums(knowledge, one, r) for one, r in zip(motions, rates, strict=True)]
    force = np.stack([one.force for one in sums], axis=1)
    sizes: dict[str, Any] = {
        "displacement": peaks[None, :, 0],
        "force": force,
        "speed": peaks[None, :, 1],
        "acceleration": peaks[None, :, 2],
        "frequency_hz": np.array([[one.fastest_hz for one in motions]]),
    }
    if all(one.kind == "trapezoid" for one in motions):
        del sizes["frequency_hz"]
    kept = np.flatnonzero(allowed(limits, sizes, len(motions)))
    repeats = [
        _REPEATS if lasting is None else max(int(lasting / one.period), LEAST_CYCLES)
        for one in motions
    ]
    rows = np.stack(
        [
            root(
                _of_record(sums[k], repeats[k], motions[k].period)
                * (rate / rates[k] / recorded.noise**2 / repeats[k])
            )
            for k in kept.tolist()
        ],
        axis=1,
    )
    S, K = len(knowledge.theta), kept.size
    return Candidates(
        "displacement", peaks[kept, 0], np.array([1.0 / motions[k].period for k in kept.tolist()]),
        np.broadcast_to(peaks[kept, 0], (S, K)), force[:, kept], rows, np.zeros((S, K, 2, 2)),
        np.ones((S, K)), tuple(motions[k] for k in kept.tolist()),
    )  # fmt: skip


def root(information: FloatArray) -> FloatArray:
    """Return J, (..., P, P), with J'J the information."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[..., None] * vectors.swapaxes(-1, -2))
