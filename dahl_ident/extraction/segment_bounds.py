r"""Ends of a segment: the cycles that belong to its level, by amplitude and phase.

Where a ramp begins or ends, the first cycles that depart are off by a percent, in amplitude or in
phase. The cycles inside tell how far is too far: a sine that may change linearly is fitted to
them, and what a fundamental explains of each cycle's residual, Q_i, scatters with the noise, be it
white or 1/f. With m cycles inside

    s^2 = sum_i Q_i / (2 m - 4),      F = Q / (2 (1 + h) s^2)

and for a cycle that belongs F follows F(2, 2 m - 4), h being the error of the fitted sine there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.extraction.sine_fit import (
    Segment,
    columns,
    normal_equations,
    solvable_inverse,
    thinned,
    whole_cycles,
)

_BY_CHANCE = 1e-3  # of the cycles that belong, how many seem to stray
_NEGLIGIBLE = 1e-4  # of the amplitude, that a cycle may stray in any case
_TOGETHER = 100_000  # samples: what is computed of them stays in the cache
_UNJUDGED = 2  # cycles at either end that are judged, and do not judge ...
_OF_THOSE = 5  # ... and a fifth of all at most
_SOLVABLE = 1e8  # condition of normal equations
_STRAYING = 0.005  # of the amplitude, that a further cycle may stray from the sine
_MOST_CYCLES_MORE = 2  # on either side
_MOST_CYCLES_LESS = 3  # on either side; where more stray, the motion is no ramp but changes slowly


def steady_part(
    time: FloatArray, motion: FloatArray, segment: Segment, part: slice, room: slice
) -> slice:
    """Return the part of a record without cycles at its ends that stray, or with more that fit.

    `segment` is the part with the phase of a steady sine, `room` where it may grow. Where the room
    ends there may be a partial cycle.
    """
    edges = cycle_edges(segment)
    start, stop = part.start, part.stop
    count, fewer = edges.size - 1, np.zeros(2, dtype=np.intp)
    while True:
        inside = _inside(segment, edges)
        if inside is None or 2 * edges.size <= count:
            break
        if fewer.max() > _MOST_CYCLES_LESS:
            return _extended(time, motion, segment, part, room, None)
        second, last = np.searchsorted(time, edges[[1, -2]]).tolist()
        early = inside.strays(time[start:second], motion[start:second])
        late = inside.strays(time[last:stop], motion[last:stop])
        if not early and not late:
            break
        start, stop = (second if early else start), (last if late else stop)
        edges = edges[int(early) : edges.size - int(late)]
        fewer += [early, late]
    if inside is not None:  # enough are left: the cycle next to a stray departs as well, if less
        start = int(np.searchsorted(time, edges[1])) if start > part.start else start
        stop = int(np.searchsorted(time, edges[-2])) if stop < part.stop else stop
    room = slice(
        room.start if start == part.start else start, room.stop if stop == part.stop else stop
    )
    return _extended(time, motion, segment, slice(start, stop), room, inside)


def highest_by_chance(share: float, dof: int) -> float:
    """Return what F(2, dof) exceeds in this share of all cases."""
    return float(0.5 * dof * (share ** (-2.0 / dof) - 1.0))


def cycle_edges(segment: Segment) -> FloatArray:
    """Return the bounds of the whole cycles; a partial one is before the first."""
    end = segment.time[-1] + 0.5 * segment.sample_phase / segment.omega
    cycle = 2.0 * np.pi / segment.omega
    return np.asarray(end - cycle * np.arange(whole_cycles(segment), -1.0, -1.0))


@dataclass(frozen=True)
class _Inside:
    """The sine of the cycles inside, which may change linearly, and their scatter about it."""

    segment: Segment
    coefficients: FloatArray
    inverse: FloatArray
    variance: float
    """Of white noise that scatters the cycles as much."""
    dof: int

    def columns(self, time: FloatArray) -> FloatArray:
        tau = (time - self.segment.centre) / self.segment.half_width
        return columns(np.asarray(self.segment.phase(tau)), tau, 1, 1)

    def strays(self, time: FloatArray, motion: FloatArray) -> bool:
        """Return whether samples of the record depart from the sine by more than by chance."""
        basis = self.columns(time)
        sine = basis[2:4] - basis[2:4].mean(axis=1, keepdims=True)  # the mean may wander
        inverse = np.linalg.pinv(sine @ sine.T)
        left = sine @ (motion - self.coefficients @ basis)
        explained = float(left @ inverse @ left)
        onto = sine @ basis.T
        fitted = 0.5 * float(np.trace(inverse @ onto @ self.inverse @ onto.T))
        bound = highest_by_chance(_BY_CHANCE, self.dof)
        amplitude = float(np.hypot(*self.coefficients[2:4]))
        least = 0.5 * time.size * (_NEGLIGIBLE * amplitude) ** 2
        return bool(explained > max(2.0 * bound * (1.0 + fitted) * self.variance, least))


def _inside(segment: Segment, edges: FloatArray) -> _Inside | None:
    """Return the sine of all but the cycles at the ends, None where too few are left."""
    unjudged = min(_UNJUDGED, (edges.size - 1) // _OF_THOSE)
    if unjudged == 0:
        return None
    cuts = np.searchsorted(segment.time, edges[unjudged:-unjudged])
    within = slice(int(cuts[0]), int(cuts[-1]))
    normal, right = normal_equations(
        segment.theta[within], segment.tau[within], segment.channels[:1, within], 1, 1
    )
    if not np.linalg.cond(normal) < _SOLVABLE:
        return None
    inverse = np.asarray(np.linalg.inv(normal), np.float64)
    coefficients = inverse @ right[:, 0]
    cc, ss, cs, c, s = _cycle_sums(segment, cuts, coefficients)
    determinant = cc * ss - cs**2
    full = determinant > 0.1 * cc * ss  # a cycle without samples carries no information
    dof = 2 * int(full.sum()) - 4
    if dof < 2:
        return None
    explained = (ss * c**2 + cc * s**2 - 2.0 * cs * c * s)[full] / determinant[full]
    variance = float(explained.sum()) / dof
    return _Inside(segment, coefficients, inverse, variance, dof)


def _cycle_sums(segment: Segment, cuts: NDArray[np.intp], coefficients: FloatArray) -> FloatArray:
    """Return sums over each cycle of cos^2, sin^2, cos sin, and of both times the residual."""
    sums = np.zeros((5, cuts.size - 1))
    groups = np.searchsorted(cuts, np.arange(cuts[0], cuts[-1], _TOGETHER), side="right") - 1
    for first, last in pairwise([*np.unique(groups).tolist(), cuts.size - 1]):
        part = slice(int(cuts[first]), int(cuts[last]))
        basis = columns(segment.theta[part], segment.tau[part], 1, 1)
        left = segment.channels[0, part] - coefficients @ basis
        cos, sin = basis[2:4]
        products = np.stack([cos * cos, sin * sin, cos * sin, cos * left, sin * left])
        running = np.cumsum(np.pad(products, ((0, 0), (1, 0))), axis=1)
        sums[:, first:last] = np.diff(running[:, cuts[first : last + 1] - cuts[first]], axis=1)
    return sums


def _extended(
    time: FloatArray, motion: FloatArray, segment: Segment, part: slice, room: slice,
    inside: _Inside | None,
) -> slice:  # fmt: skip
    """Return the slice with the cycles before and after it that the segment's sine fits as well."""
    few = thinned(segment)
    basis = columns(few.theta, few.tau, 1)
    fitted = solvable_inverse(basis @ basis.T, few) @ (basis @ few.channels[0])
    cycle = 2.0 * np.pi / segment.omega

    def misfit(where: slice) -> float:
        tau = (time[where] - segment.centre) / segment.half_width
        model = fitted @ columns(np.asarray(segment.phase(tau)), tau, 1)
        return float(np.sqrt(np.mean((motion[where] - model) ** 2)))

    start, stop = part.start, part.stop
    within = slice(start, int(np.searchsorted(time, time[start] + cycle)))
    allowed = 1.5 * misfit(within) + _STRAYING * float(np.hypot(*fitted[2:]))

    def fits(where: slice) -> bool:
        strays = inside is not None and inside.strays(time[where], motion[where])
        return misfit(where) <= allowed and not strays

    for _ in range(_MOST_CYCLES_MORE):
        earlier = max(int(np.searchsorted(time, time[start] - cycle)), room.start)
        if earlier < start and fits(slice(earlier, start)):
            start = earlier
        later = min(int(np.searchsorted(time, time[stop - 1] + cycle, side="right")), room.stop)
        if later > stop and fits(slice(stop, later)):
            stop = later
    return slice(start, stop)
