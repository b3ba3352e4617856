"""Information in the records of motions in time.

A motion is a period of displacement that is repeated. One record holds all repeats and is fitted in
time, so nothing has to settle. Its information is that of a fit of the record
(:mod:`dahl_ident.problem.record_problem`): J'J/s^2 of the predicted force with white noise s, after
elimination of the record's unknowns (state at the first sample, offset, drift).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.errors import ValidationError
from dahl_ident.planning.candidates import LEAST_CYCLES, Candidates, allowed
from dahl_ident.planning.knowledge import Knowledge
from dahl_ident.planning.question import BenchLimits, RecordedForce, limit
from dahl_ident.planning.trajectories import SAMPLES_PER_CYCLE, Multisine, PlannedMotion, Trapezoid
from dahl_ident.problem.record_problem import RecordProblem

_PER_PERIOD = 400  # most samples at which derivatives are computed: integrals err by 1e-3
_LEAST_SAMPLES = 16  # in a period, even if the sample rate is low
_SIMULATED = 4  # repeats from rest, after which the friction force is periodic as well
_FEW_REPEATS = 8  # repeats for which the search computes the information
_LEVELS, _SPEEDS, _BANDS = 24, 4, 4  # numbers of candidates for each kind of motion
_SLOWER = 2.0  # factor from one speed or band to the next
_LINES = 10  # highest over lowest frequency of a multisine


def motions_of(kind: str, limits: BenchLimits, levels: tuple[float, float]) -> list[PlannedMotion]:
    """Return the candidates of a kind of motion within the limits."""
    amplitudes = np.geomspace(*levels, _LEVELS).tolist()
    low, high = limits.frequency_hz
    if kind == "multisine":
        if not np.isfinite(high):
            raise ValidationError(
                f"{limit('frequency_hz')} is missing; give the highest one of the multisine"
            )
        tops = [top for i in range(_BANDS) if (top := high / _SLOWER**i) >= low]
        return [Multisine(max(top / _LINES, low), top, size) for size in amplitudes for top in tops]
    for name in ("speed", "acceleration"):
        if not np.isfinite(getattr(limits, name)[1]):
            raise ValidationError(
                f"{limit(name)} is missing; give the highest one of the exciter: the time of a "
                "trapezoidal trajectory follows from it"
            )
    v, a = limits.speed[1], limits.acceleration[1]
    return [
        Trapezoid(2.0 * size, min(v, float(np.sqrt(2.0 * size * a))) / _SLOWER**i, a)
        for size in amplitudes
        for i in range(_SPEEDS)
    ]


@dataclass(frozen=True)
class RepeatSums:
    """Information in the repeats of a motion, before the record's unknowns are eliminated."""

    # (S, repeats, n, n) J'J of each repeat for unit noise; n = P + states + offset + drift, the
    # drift from the start of the repeat
    products: FloatArray
    parameters: int  # P
    period: float  # seconds
    force: FloatArray  # (S,) largest force, N
    weight: float  # number of measured samples per computed one, over the variance of the noise

    @classmethod
    def of(cls, knowledge: Knowledge, motion: PlannedMotion, recorded: RecordedForce) -> RepeatSums:
        """Return the sums of a motion at every draw of the parameters."""
        rate = min(recorded.sample_rate, _PER_PERIOD / motion.period)
        m = max(round(motion.period * rate), _LEAST_SAMPLES)
        time = np.arange(float(_SIMULATED * m)) * (motion.period / m)
        record = Record(time, displacement=motion.displacement(time), force=np.zeros(time.size))
        problem = RecordProblem([record], knowledge.model, output="force")
        P, n = len(problem.free), len(problem.parameters)
        if tuple(p.name for p in problem.free) != knowledge.names:
            raise ValidationError("plan: the model of the earlier data has parameters of sensors")
        products, force = [], []
        for values in knowledge.values:
            predicted = problem.predict(np.concatenate([values, np.zeros(n - P)]), 0)
            J = predicted.by * np.concatenate([knowledge.space.slopes(values), np.ones(n - P)])
            J[:, -1] = np.mod(time + 0.5 * time[1], motion.period)  # drift, within its repeat
            blocks = J.reshape(_SIMULATED, m, n)
            products.append(blocks.swapaxes(1, 2) @ blocks)
            force.append(float(np.abs(predicted.output).max()))
        weight = recorded.sample_rate / rate / recorded.noise**2
        return cls(np.array(products), P, motion.period, np.array(force), weight)

    def rows(self, repeats: int) -> FloatArray:
        """Return J of an average repeat in a record, (S, P, P), with the unknowns eliminated."""
        n, P = self.products.shape[-1], self.parameters
        total = np.zeros((len(self.products), n, n))
        for k in range(min(repeats, _SIMULATED)):
            shift = np.eye(n)
            shift[-2, -1] = k * self.period  # drift from the start of the record
            total += shift.T @ self.products[:, k] @ shift
        later = np.arange(_SIMULATED, repeats) * self.period
        last, drift = self.products[:, -1], np.zeros((n, n))
        drift[-2, -1] = 1.0
        cross = last @ drift
        total += later.size * last + later.sum() * (cross + cross.swapaxes(1, 2))
        total += (later**2).sum() * (drift.T @ last @ drift)
        unknowns = total[:, P:, P:]
        size = np.sqrt(np.maximum(np.diagonal(unknowns, axis1=1, axis2=2), 1e-300))
        units = size[:, :, None] * size[:, None, :]
        inverse = np.linalg.pinv(unknowns / units, hermitian=True, rcond=1e-10) / units
        information = total[:, :P, :P] - total[:, :P, P:] @ inverse @ total[:, P:, :P]
        values, vectors = np.linalg.eigh(information * (self.weight / repeats))
        return np.asarray(np.sqrt(np.maximum(values, 0.0))[..., None] * vectors.swapaxes(-1, -2))


def evaluate_motions(
    knowledge: Knowledge,
    motions: Sequence[PlannedMotion],
    limits: BenchLimits,
    recorded: RecordedForce,
    lasting: float | None = None,
) -> Candidates:
    """Return the candidates that all limits allow, with the information of an average repeat.

    The average is over the repeats in a record of `lasting` s, by default over `_FEW_REPEATS`.
    """
    rate = recorded.sample_rate
    resolved = [motion for motion in motions if motion.fastest_hz * SAMPLES_PER_CYCLE <= rate]
    if not resolved:
        slowest = min(motion.fastest_hz for motion in motions)
        raise ValidationError(
            f"sample_rate is {rate:g} Hz; expected at least {SAMPLES_PER_CYCLE} samples in a "
            f"trapezoid's move from end to end or a multisine's shortest cycle: "
            f"{SAMPLES_PER_CYCLE * slowest:.3g} Hz for the slowest motion; or slow the motions down"
        )
    peaks = np.array([motion.peaks for motion in resolved])
    sums = [RepeatSums.of(knowledge, motion, recorded) for motion in resolved]
    sizes: dict[str, Any] = {
        "displacement": peaks[None, :, 0],
        "force": np.stack([of_motion.force for of_motion in sums], axis=1),
        "speed": peaks[None, :, 1],
        "acceleration": peaks[None, :, 2],
    }
    if any(motion.kind != "trapezoid" for motion in resolved):
        sizes["frequency_hz"] = np.array([[motion.fastest_hz for motion in resolved]])
    within = np.flatnonzero(allowed(limits, sizes, len(resolved)))
    period = np.array([motion.period for motion in resolved])[within]
    rows = [
        sums[k].rows(_FEW_REPEATS if lasting is None else max(int(lasting / T), LEAST_CYCLES))
        for k, T in zip(within.tolist(), period.tolist(), strict=True)
    ]
    S, level = len(knowledge.theta), peaks[within, 0]
    return Candidates(
        "displacement",
        level,
        1.0 / period,
        np.broadcast_to(level, (S, within.size)),
        sizes["force"][:, within],
        np.stack(rows, axis=1),
        np.ones((S, within.size)),
        tuple(resolved[k] for k in within.tolist()),
    )
