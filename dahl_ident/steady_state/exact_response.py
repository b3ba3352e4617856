"""Every steady motion of known plants, exactly: from the describing function's to the true one.

Motions that the describing function does not see are found from those of the neighbouring points:
each motion is followed in the order of the points, up and down, as far as it goes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.element import Model
from dahl_ident.steady_state.plant import BoolArray
from dahl_ident.steady_state.shooting import NEUTRAL, Shooting, SteadyMotion

_HARMONICS = (1, 0, *range(2, 10))
_SAME = 1e-6  # relative difference of two motions that are one
_CYCLES = 3  # that an estimate goes through, so that memory of its own start fades
_STEP = 0.005  # of ln of drive and frequency together, in which motions are followed
_MOST_STEPS = 40  # between two points: what lies far apart is not one sweep


class ExactMotions(NamedTuple):
    """Fundamentals X of every motion of every point, (points, most), NaN beyond the last.

    By rising size; `share` is the root sum of squares of the mean and the harmonics 2 to 9 over the
    fundamental, `multiplier` the largest modulus of the multipliers of a cycle.
    """

    displacement: ComplexArray
    share: FloatArray
    multiplier: FloatArray


def exact_motions(
    model: Model,
    omega: FloatArray,
    drive: FloatArray,
    near: ComplexArray,
    unique: BoolArray,
    *,
    every: bool,
) -> ExactMotions:
    """Return the exact motions of points, (n,), near estimates of their fundamentals, (n, most).

    Where the estimate is `unique`, so is the motion, and it is sought from rest. Elsewhere each
    estimate is a start, and so is each motion of the point before and after, followed in small
    steps. Stable motions come first unless `every` one is wanted, by rising size.
    """
    shooting = Shooting(model)
    place = np.log([omega, drive])
    steps = np.ceil(np.abs(np.diff(place)).sum(axis=0) / _STEP).clip(1, _MOST_STEPS)
    steps[unique[1:] & unique[:-1]] = 1.0
    points = np.append(0, np.cumsum(steps)).astype(np.intp)  # the others lie between
    along = np.interp(np.arange(points[-1] + 1), points, np.arange(points.size))
    omega, drive = (np.exp(np.interp(along, np.arange(points.size), one)) for one in place)
    given, near = near, np.full((along.size, near.shape[1]), np.nan, dtype=np.complex128)
    alike, unique = unique, np.zeros(along.size, dtype=np.bool_)
    near[points], unique[points] = given, alike
    values = np.array([float(v) for v in model.known_values()])
    motions: list[list[tuple[complex, float, float]]] = [[] for _ in omega]

    def solved(rows: NDArray[np.intp], starts: FloatArray | None, **how: Any) -> SteadyMotion:
        return shooting(
            np.tile(values, (rows.size, 1)), omega[rows], drive[rows], harmonics=_HARMONICS,
            starts=starts, stable=False, **how,
        )  # fmt: skip

    def kept(rows: NDArray[np.intp], found: SteadyMotion) -> NDArray[np.intp]:
        """Keep the motions that are new; return their places."""
        new = []
        for place in np.flatnonzero(found.found & np.isfinite(found.multiplier)).tolist():
            known, harmonics = motions[rows[place]], found.harmonics[place]
            X = complex(harmonics[0])
            if all(abs(X - other) >= _SAME * abs(X) for other, _, _ in known):
                rest = float(np.sqrt((np.abs(harmonics[1:]) ** 2).sum()))
                known.append((X, rest / abs(X), float(found.multiplier[place])))
                new.append(place)
        return np.array(new, dtype=np.intp)

    alone = np.flatnonzero(unique)
    if alone.size:
        kept(alone, solved(alone, None))
    rows, column = np.nonzero(np.isfinite(near) & ~unique[:, None])
    starts = np.zeros((rows.size, shooting.system.order))
    starts[:, 0] = near[rows, column].real
    starts[:, 1] = -omega[rows] * near[rows, column].imag
    settling: dict[str, Any] = {"cycles": _CYCLES}  # leads to what is stable
    directly: dict[str, Any] = {"again": False}
    fronts = [(rows, starts, settling), (rows, starts, directly)]
    while fronts:
        rows, starts, how = fronts.pop(0)
        if not rows.size:
            continue
        found = solved(rows, starts, **how)
        new = kept(rows, found)
        nearby = np.concatenate([rows[new] - 1, rows[new] + 1])
        inside = (nearby >= 0) & (nearby < omega.size)
        inside[inside] &= ~unique[nearby[inside]]
        fronts.append((nearby[inside], np.tile(found.starts[new], (2, 1))[inside], directly))
    wanted = [motions[point] for point in points]
    most = max(near.shape[1], *map(len, wanted))
    arrays = np.full((len(wanted), most, 3), np.nan, dtype=np.complex128)
    for point, own in enumerate(wanted):
        own.sort(key=lambda one: (not every and not one[2] < 1.0 + NEUTRAL, abs(one[0])))
        arrays[point, : len(own)] = np.reshape(own, (-1, 3))
    return ExactMotions(arrays[..., 0], arrays[..., 1].real, arrays[..., 2].real)
