"""Bench time of a plan: settling in the order of the levels, measured cycles, change-over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Model
from dahl_ident.planning.candidates import Candidates
from dahl_ident.planning.knowledge import Knowledge

LEAST_CYCLES = 2  # measured at a level: a single cycle does not show its noise
_LEAST_SETTLING = 1  # cycle: no change of level is instant
_SLOW = 0.9  # quantile of the draws that have settled
_STEP = 1e-4  # relative, of the frequency: truncation 1e-8, rounding 1e-12


@dataclass(frozen=True)
class BenchTime:
    """The time that visiting candidates takes.

    A transient starts as the fraction abs(F - F')/F of the friction force F, where F' is that of
    the previous level, and shrinks by `decay` per cycle; measuring starts when it is below
    `settled`.
    """

    # (K,) frequency, factor by which a transient shrinks in a cycle, and friction force
    frequency_hz: FloatArray
    decay: FloatArray
    force: FloatArray
    change_over: float  # seconds from one level to the next
    settled: float  # share of the friction force
    between_runs: float = 0.0  # seconds that a run takes in addition to its levels
    least_settling: float = _LEAST_SETTLING  # cycles before measuring, at least

    @classmethod
    def of(cls, candidates: Candidates, knowledge: Knowledge, **costs: float) -> BenchTime:
        """Return the bench time of the candidates, so that the slowest tenth of the draws settles.

        `costs` are change_over, settled and between_runs, s.
        """
        f = candidates.frequency_hz
        if candidates.motions:  # records are fitted from their first sample
            size = np.median(candidates.force, axis=0)
            return cls(f, np.zeros(f.size), size, **costs, least_settling=0)
        model, omega, values = knowledge.model, 2.0 * np.pi * f, knowledge.model_values()
        A = np.where(np.isfinite(candidates.amplitude), candidates.amplitude, 1.0)
        decay = np.asarray(model.transient_decay(values, A, omega + 0.0 * A))
        if candidates.controlled == "force":
            decay, force = np.maximum(decay, _ring_down(model, values, A, omega)), candidates.force
        else:
            force = np.zeros(A.shape)
            for element, numbers in model.of(values):
                if element.has_memory:
                    force = force + A * np.abs(element.stiffness(numbers, A, omega + 0.0 * A))
        return cls(f, np.quantile(decay, _SLOW, axis=0), np.median(force, axis=0), **costs)

    def order(self, levels: Sequence[int] | NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the levels, (..., m), in order of rising friction force.

        In this order no transient starts larger than the friction force itself; the transient of a
        level that follows a larger one would.
        """
        chosen = np.asarray(levels, dtype=np.intp)
        rising = np.lexsort((self.frequency_hz[chosen], self.force[chosen]), axis=-1)
        return np.take_along_axis(chosen, rising, axis=-1)

    def settling_cycles(self, ordered: Sequence[int] | NDArray[np.intp]) -> FloatArray:
        """Return the cycles before measuring at each level, (..., m), in this order; may be inf."""
        chosen = np.asarray(ordered, dtype=np.intp)
        force, decay = self.force[chosen], self.decay[chosen]
        before = np.concatenate([np.zeros_like(force[..., :1]), force[..., :-1]], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            start = np.where(force > 0.0, np.abs(force - before) / force, 0.0)
            cycles = np.log(start / self.settled) / -np.log(decay)
        cycles = np.where(start <= self.settled, 0.0, np.where(decay > 0.0, cycles, 0.0))
        return np.asarray(np.maximum(np.ceil(cycles - 1e-9), self.least_settling))

    def fixed(self, levels: Sequence[int] | NDArray[np.intp]) -> FloatArray:
        """Return the seconds of a run before anything is measured, for each set of levels."""
        ordered = self.order(levels)
        settling = self.settling_cycles(ordered) / self.frequency_hz[ordered]
        whole = self.between_runs + settling.sum(axis=-1) + self.change_over * ordered.shape[-1]
        return np.asarray(whole)

    @property
    def alone(self) -> FloatArray:
        """The same of each candidate alone, (K,)."""
        return self.fixed(np.arange(len(self.frequency_hz))[:, None])

    def seconds(self, levels: Sequence[int] | NDArray[np.intp], cycles: FloatArray) -> float:
        """Return the seconds of one run."""
        measured = (cycles / self.frequency_hz[np.asarray(levels)]).sum()
        return float(self.fixed(levels) + measured)


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
