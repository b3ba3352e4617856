"""Bench time of a plan: settling in the order of the levels, measured cycles, change-over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray

LEAST_CYCLES = 2  # measured at a level: a single cycle does not show its noise
_LEAST_SETTLING = 1  # cycle: no change of level is instant


@dataclass(frozen=True)
class BenchTime:
    """The cost of visiting candidates.

    A transient starts as the fraction abs(F - F')/F of the friction force F, where F' is that of
    the previous level, and shrinks by `decay` per cycle; measuring starts when it is below
    `settled`.
    """

    # (K,): frequency, factor by which a transient shrinks in a cycle, and friction force
    frequency_hz: FloatArray
    decay: FloatArray
    force: FloatArray
    change_over: float  # seconds from one level to the next
    settled: float  # share of the friction force
    between_runs: float = 0.0  # seconds that a run takes in addition to its levels
    least_settling: int = _LEAST_SETTLING  # cycles before measuring, at least

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
        """Return the seconds of one run before anything is measured, in the best order.

        Of each set of levels, (..., m).
        """
        ordered = self.order(levels)
        settling = self.settling_cycles(ordered) / self.frequency_hz[ordered]
        whole = self.between_runs + settling.sum(axis=-1) + self.change_over * ordered.shape[-1]
        return np.asarray(whole)

    def seconds(self, levels: Sequence[int] | NDArray[np.intp], cycles: FloatArray) -> float:
        """Return the seconds of one run."""
        measured = (cycles / self.frequency_hz[np.asarray(levels)]).sum()
        return float(self.fixed(levels) + measured)
