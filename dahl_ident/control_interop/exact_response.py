"""All exact steady motions of plants with known parameters, from those of the describing function.

Motions that the describing function misses are found by continuation: each motion is followed from
point to point, forwards and backwards, as long as it exists.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from dahl_ident.elements.driven_motion import NEUTRAL, Shooting
from dahl_ident.elements.element import Model

if TYPE_CHECKING:
    from dahl_ident.engine import Settled

HARMONICS = tuple(range(10))
"""The harmonics of a motion that are returned."""
_SAME_MOTION = 1e-6  # relative difference below which two motions are the same
_CYCLES = 3  # cycles simulated from an estimate, so that the memory of its start fades
_CONTINUATION_STEP = 0.005  # of a continuation: change of ln of drive and of frequency together
_MOST_STEPS = 40  # between two points; points farther apart do not belong to one sweep


class _Orbit(NamedTuple):
    harmonics: ComplexArray
    multiplier: float

    @property
    def stable(self) -> bool:
        return self.multiplier < 1.0 + NEUTRAL


def exact_motions(
    model: Model, omega: FloatArray, drive: FloatArray, near: ComplexArray, unique: BoolArray
) -> tuple[ComplexArray, FloatArray, IntArray]:
    """Return the exact motions of points, (n,), near estimates of their fundamentals, (n, most).

    The harmonics X_k, (n, most, 10), in order of amplitude, NaN after the last; the largest moduli
    of Floquet's multipliers of a cycle, (n, most); and the index of the stable motion of each point
    that a sweep follows, -1 where there is none.

    If the estimate of a point is `unique`, so is the motion, which is computed from rest. Otherwise
    the starts are all estimates, and all motions of the adjacent points, followed in small steps.
    """
    shooting = Shooting(model)
    log_points = np.log([omega, drive])
    steps = np.ceil(np.abs(np.diff(log_points)).sum(axis=0) / _CONTINUATION_STEP)
    begins_sweep = np.append(True, steps > _MOST_STEPS)
    steps = steps.clip(1, _MOST_STEPS)
    steps[unique[1:] & unique[:-1]] = 1.0
    points = np.append(0, np.cumsum(steps)).astype(np.intp)  # rows of the points; steps between
    along = np.interp(np.arange(points[-1] + 1), points, np.arange(points.size))
    omega, drive = (np.exp(np.interp(along, np.arange(points.size), logs)) for logs in log_points)
    estimates = np.full((along.size, near.shape[1]), np.nan, dtype=np.complex128)
    is_unique, is_start = np.zeros((2, along.size), dtype=np.bool_)
    estimates[points], is_unique[points], is_start[points] = near, unique, begins_sweep
    values = np.array([float(v) for v in model.known_values()])
    motions: list[list[_Orbit]] = [[] for _ in omega]

    def solve(rows: IntArray, starts: FloatArray | None, **options: Any) -> Settled:
        return shooting(
            np.tile(values, (rows.size, 1)),
            omega[rows],
            drive[rows],
            harmonics=HARMONICS,
            starts=starts,
            **({"stable": False} | options),
        )

    def add_new(rows: IntArray, solution: Settled) -> IntArray:
        """Add the motions that are new; return their indices."""
        new = []
        for i in np.flatnonzero(solution.found & np.isfinite(solution.multiplier)).tolist():
            at_point = motions[rows[i]]
            motion = _Orbit(solution.harmonics[i], float(solution.multiplier[i]))
            X = motion.harmonics[1]
            if all(abs(X - other.harmonics[1]) >= _SAME_MOTION * abs(X) for other in at_point):
                at_point.append(motion)
                new.append(i)
        return np.array(new, dtype=np.intp)

    single = np.flatnonzero(is_unique)
    if single.size:
        add_new(single, solve(single, None))
    rows, column = np.nonzero(np.isfinite(estimates) & ~is_unique[:, None])
    starts = np.zeros((rows.size, shooting.system.order))
    starts[:, 0] = estimates[rows, column].real
    starts[:, 1] = -omega[rows] * estimates[rows, column].imag

    def follow(rows: IntArray, starts: FloatArray | None, **options: Any) -> None:
        """Add the motions found from the starts, and continue each one to the adjacent points."""
        while rows.size:
            solution = solve(rows, starts, **options)
            new = add_new(rows, solution)
            neighbours = np.concatenate([rows[new] - 1, rows[new] + 1])
            inside = (neighbours >= 0) & (neighbours < omega.size)
            inside[inside] &= continues[neighbours[inside]]
            rows, starts = neighbours[inside], np.tile(solution.starts[new], (2, 1))[inside]
            options |= {"again": False, "cycles": None, "stable": False}

    continues = ~is_unique
    follow(rows, starts, cycles=_CYCLES)  # leads to stable motions
    follow(rows, starts, again=False)
    continues = np.array([bool(m) and not any(orbit.stable for orbit in m) for m in motions])
    if shooting.system.odd:
        follow(np.flatnonzero(continues), None, one_sided=True, stable=True)
    for at_point in motions:
        at_point.sort(key=lambda motion: abs(motion.harmonics[1]))
    followed = _followed(motions, is_start)[points]
    most = max(near.shape[1], *(len(motions[point]) for point in points))
    harmonics = np.full((points.size, most, len(HARMONICS)), np.nan, dtype=np.complex128)
    multiplier = np.full((points.size, most), np.nan)
    for row, point in enumerate(points.tolist()):
        for order, motion in enumerate(motions[point]):
            harmonics[row, order], multiplier[row, order] = motion
    return harmonics, multiplier, followed


def _followed(motions: list[list[_Orbit]], is_start: BoolArray) -> IntArray:
    """Return the index of the stable motion that a sweep follows at each point.

    It is the nearest to that of the previous point, or the smallest at the start of a sweep.
    """
    result = np.full(len(motions), -1, dtype=np.intp)
    last: complex | None = None
    for point, (at_point, starts) in enumerate(zip(motions, is_start.tolist(), strict=True)):
        stable = [i for i, motion in enumerate(at_point) if motion.stable]
        last = None if starts else last
        if stable:
            fundamentals = [complex(at_point[i].harmonics[1]) for i in stable]
            nearest = 0 if last is None else int(np.argmin(np.abs(np.array(fundamentals) - last)))
            result[point], last = stable[nearest], fundamentals[nearest]
    return result
