"""Every steady motion of known plants, exactly: from the describing function's to the true one.

Motions that the describing function does not see are found from those of the neighbouring points:
each motion is followed in the order of the points, up and down, as far as it goes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.control_interop.force_balance import BoolArray, IntArray
from dahl_ident.elements.driven_motion import NEUTRAL, Shooting
from dahl_ident.elements.model import Model

if TYPE_CHECKING:
    from dahl_ident.engine import SteadyMotion

HARMONICS = tuple(range(10))
"""The harmonics of a motion that are returned."""
_SAME = 1e-6  # relative difference of two motions that are one
_CYCLES = 3  # that an estimate goes through, so that memory of its own start fades
_STEP = 0.005  # of ln of drive and frequency together, in which motions are followed
_MOST_STEPS = 40  # between two points: what lies far apart is not one sweep


class ExactMotions(NamedTuple):
    """Every motion of every point, (points, most), NaN beyond the last, by rising size.

    `harmonics` are X_k, k from 0 to 9, (points, most, 10); `multiplier` is the largest modulus of
    the multipliers of a cycle. `followed` is the place of the stable motion of each point that a
    sweep follows, -1 where there is none.
    """

    harmonics: ComplexArray
    multiplier: FloatArray
    followed: IntArray


class _Orbit(NamedTuple):
    harmonics: ComplexArray
    multiplier: float

    @property
    def fundamental(self) -> complex:
        return complex(self.harmonics[1])

    @property
    def stable(self) -> bool:
        return self.multiplier < 1.0 + NEUTRAL


def exact_motions(
    model: Model, omega: FloatArray, drive: FloatArray, near: ComplexArray, unique: BoolArray
) -> ExactMotions:
    """Return the exact motions of points, (n,), near estimates of their fundamentals, (n, most).

    Where the estimate is `unique`, so is the motion, and it is sought from rest. Elsewhere each
    estimate is a start, and so is each motion of the point before and after, followed in small
    steps.
    """
    shooting = Shooting(model)
    place = np.log([omega, drive])
    steps = np.ceil(np.abs(np.diff(place)).sum(axis=0) / _STEP)
    apart = np.append(True, steps > _MOST_STEPS)
    steps = steps.clip(1, _MOST_STEPS)
    steps[unique[1:] & unique[:-1]] = 1.0
    points = np.append(0, np.cumsum(steps)).astype(np.intp)  # the others lie between
    along = np.interp(np.arange(points[-1] + 1), points, np.arange(points.size))
    omega, drive = (np.exp(np.interp(along, np.arange(points.size), one)) for one in place)
    estimates, near = near, np.full((along.size, near.shape[1]), np.nan, dtype=np.complex128)
    alike, unique = unique, np.zeros(along.size, dtype=np.bool_)
    near[points], unique[points] = estimates, alike
    values = np.array([float(v) for v in model.known_values()])
    motions: list[list[_Orbit]] = [[] for _ in omega]

    def solved(rows: NDArray[np.intp], starts: FloatArray | None, **how: Any) -> SteadyMotion:
        return shooting(
            np.tile(values, (rows.size, 1)), omega[rows], drive[rows], harmonics=HARMONICS,
            starts=starts, **({"stable": False} | how),
        )  # fmt: skip

    def kept(rows: NDArray[np.intp], solution: SteadyMotion) -> NDArray[np.intp]:
        """Keep the motions that are new; return their places."""
        new = []
        for place in np.flatnonzero(solution.found & np.isfinite(solution.multiplier)).tolist():
            known = motions[rows[place]]
            motion = _Orbit(solution.harmonics[place], float(solution.multiplier[place]))
            X = motion.fundamental
            if all(abs(X - other.fundamental) >= _SAME * abs(X) for other in known):
                known.append(motion)
                new.append(place)
        return np.array(new, dtype=np.intp)

    alone = np.flatnonzero(unique)
    if alone.size:
        kept(alone, solved(alone, None))
    rows, column = np.nonzero(np.isfinite(near) & ~unique[:, None])
    starts = np.zeros((rows.size, shooting.system.order))
    starts[:, 0] = near[rows, column].real
    starts[:, 1] = -omega[rows] * near[rows, column].imag

    def follow(rows: NDArray[np.intp], starts: FloatArray | None, **how: Any) -> None:
        """Keep the motions to which starts lead, and those of the neighbouring points."""
        while rows.size:
            solution = solved(rows, starts, **how)
            new = kept(rows, solution)
            nearby = np.concatenate([rows[new] - 1, rows[new] + 1])
            inside = (nearby >= 0) & (nearby < omega.size)
            inside[inside] &= open_to[nearby[inside]]
            rows, starts = nearby[inside], np.tile(solution.starts[new], (2, 1))[inside]
            how |= {"again": False, "cycles": None, "stable": False}

    open_to = ~unique
    follow(rows, starts, cycles=_CYCLES)  # leads to what is stable
    follow(rows, starts, again=False)
    open_to = np.array([bool(m) and not any(one.stable for one in m) for m in motions])
    if shooting.system.odd:
        follow(np.flatnonzero(open_to), None, one_sided=True, stable=True)
    for one in motions:
        one.sort(key=lambda motion: abs(motion.fundamental))
    begins = np.zeros(along.size, dtype=np.bool_)
    begins[points] = apart
    followed = _followed(motions, begins)[points]
    most = max(near.shape[1], *(len(motions[point]) for point in points))
    harmonics = np.full((points.size, most, len(HARMONICS)), np.nan, dtype=np.complex128)
    multiplier = np.full((points.size, most), np.nan)
    for row, point in enumerate(points.tolist()):
        for order, motion in enumerate(motions[point]):
            harmonics[row, order], multiplier[row, order] = motion
    return ExactMotions(harmonics, multiplier, followed)


def _followed(motions: list[list[_Orbit]], begins: BoolArray) -> IntArray:
    """Return the stable motion of every point that a sweep follows: the nearest to the last.

    The smallest where a sweep begins.
    """
    result = np.full(len(motions), -1, dtype=np.intp)
    last: complex | None = None
    for point, (every, first) in enumerate(zip(motions, begins.tolist(), strict=True)):
        stable = [place for place, motion in enumerate(every) if motion.stable]
        last = None if first else last
        if stable:
            fundamentals = [every[place].fundamental for place in stable]
            nearest = 0 if last is None else int(np.argmin(np.abs(np.array(fundamentals) - last)))
            result[point], last = stable[nearest], fundamentals[nearest]
    return result
