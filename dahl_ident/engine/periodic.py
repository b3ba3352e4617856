"""The exact steady motion of a driven system, with all harmonics, and its stability, by shooting.

The state after one cycle of the drive equals that before it. The eigenvalues of the cycle's
derivative, the Floquet multipliers, decide whether a neighbouring motion returns to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dahl_ident.arrays import BoolArray, FloatArray
from dahl_ident.engine.motion import Settled, settled
from dahl_ident.engine.translate import System

_FINER_STEPS = 10.0  # factor: coarse steps may pass over two turning points that are close together
_LONG = 30  # cycles in which a motion leaves an unstable branch for a stable one
# runs of cycles without Newton's method, and cycles of each, more than the kernel computes
_LONG_RUNS, _ALL_CYCLES = 3, 1000


def steady_motions(
    system: System,
    parameters: FloatArray,
    omega: FloatArray,
    drive: FloatArray,
    *,
    chosen: Sequence[int] = (),
    harmonics: Sequence[int] = (1,),
    starts: FloatArray | None = None,
    cycles: int | None = None,
    again: bool = True,
    largest: float = np.inf,
    one_sided: bool = False,
) -> Settled:
    """Return the steady motions of a system at rows of parameters, frequency and drive.

    Each row begins from its states `starts` at t = 0, NaN for rest, and runs through some `cycles`
    before it is solved for; if that fails, it is started `again`, from rest. A motion with a
    multiplier above `largest` is rejected. If `one_sided`, the motion may differ in both directions
    even if the law does not: such motions come in pairs with the same fundamental if the symmetric
    motion is unstable.
    """
    rows, K = omega.size, len(harmonics)
    result = Settled(
        np.zeros(rows, dtype=np.bool_),
        np.full((rows, K), np.nan + 0j),
        np.full((rows, K), np.nan + 0j),
        np.full((rows, K, len(chosen)), np.nan + 0j),
        np.full((rows, system.order), np.nan),
        np.full(rows, np.nan),
    )

    def solve(
        which: BoolArray,
        starts: FloatArray | None = None,
        *runs: int | None,
        finer: float = 1.0,
        one_sided: bool = one_sided,
    ) -> None:
        """Put the motions of some rows into the result; each run begins where the last one ended.

        `runs` are the numbers of cycles before Newton's method.
        """
        solved = np.flatnonzero(which)
        if not solved.size:
            return
        symmetric = replace(system, odd=system.odd and not one_sided)
        states = None if starts is None else starts[solved]
        for count in runs or (None,):
            with np.errstate(all="ignore"):
                motions = settled(
                    symmetric,
                    drive[solved],
                    omega[solved],
                    parameters[solved],
                    chosen=chosen,
                    harmonics=harmonics,
                    starts=states,
                    cycles=count,
                    finer=finer,
                )
            states = motions.starts
        multiplier = result.multiplier[solved] = motions.multiplier
        with np.errstate(invalid="ignore"):
            good = multiplier <= largest
        # the first five fields of both tuples correspond
        for array, part in zip(result[:5], (good, *motions[1:5]), strict=True):
            array[solved[good]] = part[good]

    must_be_stable = largest < np.inf
    possible = np.isfinite(parameters).all(axis=1) & np.isfinite(omega) & np.isfinite(drive)
    if starts is not None:
        started = possible & np.isfinite(starts).all(axis=1)
        solve(started, starts, cycles)
        possible &= again | ~started
    solve(possible & ~result.found)
    unstable = np.isfinite(result.multiplier)
    failed = possible & ~result.found & ~unstable
    # a search passes values at which nothing settles; then only a few rows are worth the time
    if must_be_stable or np.all(parameters == parameters[0]) or _FINER_STEPS * failed.sum() <= rows:
        solve(failed, finer=_FINER_STEPS)
    solve(possible & ~result.found & unstable, None, _LONG)
    if must_be_stable and system.odd:
        unstable = np.isfinite(result.multiplier)
        long_runs = (_ALL_CYCLES,) * (_LONG_RUNS if one_sided else 0)
        solve(possible & ~result.found & unstable, None, *long_runs, _LONG, one_sided=True)
    return result
