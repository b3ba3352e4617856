"""The exact steady motion of a driven system, with all harmonics, and its stability, by shooting.

The state after one cycle of the drive is that before. The eigenvalues of that cycle's derivative,
Floquet's multipliers, say whether a motion near it comes back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray
from dahl_ident.engine.motion import settled
from dahl_ident.engine.translate import System

_FINER = 10.0  # times: a motion that hardly turns is lost where steps pass over its two turns
_LONG = 30  # cycles by which a motion leaves an unstable branch for a stable one
_PATIENT, _ALONE = 3, 1000  # runs of cycles without Newton's method, each until the kernel ends it


class SteadyMotion(NamedTuple):
    """Steady motions under forces ``u_0 cos(omega t)``, one row each.

    Attributes
    ----------
    found : ndarray of bool, shape (rows,)
        Whether there is one.
    harmonics : ndarray of complex, shape (rows, K)
        X_k, x(t) = sum of Re X_k exp(j k omega t). NaN where not found.
    by_drive : ndarray of complex, shape (rows, K)
    by_parameter : ndarray of complex, shape (rows, K, chosen)
    starts : ndarray, shape (rows, order)
        States at t = 0.
    multiplier : ndarray, shape (rows,)
        Largest modulus of the multipliers of a whole cycle; above 1 a motion is unstable.
    """

    found: BoolArray
    harmonics: ComplexArray
    by_drive: ComplexArray
    by_parameter: ComplexArray
    starts: FloatArray
    multiplier: FloatArray


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
) -> SteadyMotion:
    """Return the steady motions of a system at rows of parameters, frequency and drive.

    They begin from the states `starts` at t = 0, NaN for rest, and go through some `cycles` before
    they are solved for; a row that leads nowhere is started `again`, from rest. A motion with a
    multiplier above `largest` counts as none. If `one_sided`, motions are sought that differ in
    both directions even if the law does not: they come in pairs, of one fundamental, where the
    motion between them is not stable.
    """
    rows, K = omega.size, len(harmonics)
    result = SteadyMotion(
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

        A run is its number of cycles before Newton's method.
        """
        at = np.flatnonzero(which)
        if not at.size:
            return
        symmetric = replace(system, odd=system.odd and not one_sided)
        begin = None if starts is None else starts[at]
        for count in runs or (None,):
            with np.errstate(all="ignore"):
                motions = settled(
                    symmetric, drive[at], omega[at], parameters[at], chosen=chosen,
                    harmonics=harmonics, starts=begin, cycles=count, finer=finer,
                )  # fmt: skip
            begin = motions.starts
        multiplier = np.full(at.size, np.nan)
        ok = motions.found & np.isfinite(motions.maps).all(axis=(1, 2))
        sizes = np.abs(np.linalg.eigvals(motions.maps[ok])).max(axis=1, initial=0.0)
        multiplier[ok] = sizes**2 if symmetric.odd else sizes  # the map of half a cycle
        result.multiplier[at] = multiplier
        with np.errstate(invalid="ignore"):
            good = ok & (multiplier <= largest)
        for whole, part in zip(
            result[:5], (good, *motions[1:5]), strict=True
        ):  # settled motions hold the same, in the same order
            whole[at[good]] = part[good]

    stable = largest < np.inf
    possible = np.isfinite(parameters).all(axis=1) & np.isfinite(omega) & np.isfinite(drive)
    if starts is not None:
        known = possible & np.isfinite(starts).all(axis=1)
        solve(known, starts, cycles)
        possible &= again | ~known
    solve(possible & ~result.found)
    unstable = np.isfinite(result.multiplier)
    lost = possible & ~result.found & ~unstable
    # a search passes values at which nothing settles; a few rows may take as long as the others
    if stable or np.all(parameters == parameters[0]) or _FINER * lost.sum() <= rows:
        solve(lost, finer=_FINER)
    solve(possible & ~result.found & unstable, None, _LONG)
    if stable and system.odd:
        unstable = np.isfinite(result.multiplier)
        patient = (_ALONE,) * (_PATIENT if one_sided else 0)
        solve(possible & ~result.found & unstable, None, *patient, _LONG, one_sided=True)
    return result
