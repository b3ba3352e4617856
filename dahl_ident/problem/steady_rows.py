"""Rows whose force was controlled, predicted by the exact steady motion of the plant.

Shooting starts from the row's orbit at the previous parameters, on which the result depends far
less than on any noise: where no friction law and no damper feeds energy in, the motion is unique.
Elsewhere there may be several, and the rows are followed as a sweep is measured: in the order of
the rows, at one level each from the orbit of the row before. Where an orbit is no longer stable, a
stable one is taken: the jump of the response. Where no stable one exists, as for a row that should
not be in the table, the unstable one is used, so that a search can go on; a verdict names such
rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from dahl_ident.elements import Model
from dahl_ident.elements.driven_motion import NEUTRAL, Shooting

_LEVEL = 0.1  # difference of ln of the drive between two levels; a held one varies less
# knee over the largest displacement from which friction is a spring: its third harmonic is 1e-3,
# and a sine errs by the square
_MICROSLIP = 1e3
_SLIP = 1e-9  # knee over the smallest displacement, below which its size has no effect
_ELSEWHERE = 0.2  # relative distance from the measurement that may mean another branch


class RowMotion(NamedTuple):
    """The harmonic X_k of each row, its derivatives with respect to drive and parameters."""

    displacement: ComplexArray
    by_drive: ComplexArray
    by_parameter: ComplexArray
    stable: BoolArray


class _SteadyMotions(NamedTuple):
    """Of some points: X_k with derivatives, (points, K, ...), orbits, X_1, multipliers."""

    X: ComplexArray
    orbits: FloatArray
    fundamental: ComplexArray
    multiplier: FloatArray


class SteadyRows:
    """Steady motions of some rows at any parameters, with the orbits where they were last found.

    `drive` and `omega`, (n,) or (S, n), are as measured; levels are distinguished by the drive. The
    `measured` fundamental of the displacement chooses among several motions. `harmonic` is the k of
    each row, `fundamental` the row, of these, that holds its fundamental. `orbits` are those last
    found, (n, order), by their order; kept up to date.
    """

    def __init__(
        self,
        model: Model,
        shooting: Shooting,
        drive: FloatArray,
        omega: FloatArray,
        measured: ComplexArray,
        harmonic: NDArray[np.int64],
        fundamental: IntArray,
        orbits: dict[int, FloatArray],
    ) -> None:
        self._model, self._shooting = model, shooting
        self._drive, self._omega, self._measured = drive, omega, measured
        self._unique_laws = all(e.is_linear or e.unique_response for e in model.elements)
        self._harmonics = (1, *sorted(set(harmonic.tolist()) - {1}))
        self._place = np.array([self._harmonics.index(k) for k in harmonic.tolist()])
        self._sweep = np.argsort(fundamental, kind="stable")
        self._fundamental = fundamental
        self._orbits = orbits

    def at(self, values: Sequence[FloatArray], drive: FloatArray, chosen: list[int]) -> RowMotion:
        """Return the motions at values of all parameters, each (1,) or (S, 1).

        `chosen` are the parameters whose derivatives are wanted, by index. Harmonics of one motion
        are solved for together where their rows have the same drive.
        """
        shape = np.broadcast_shapes(
            self._omega.shape, np.shape(drive), *(np.shape(v) for v in values)
        )
        u, w = (np.broadcast_to(v, shape) for v in (drive, self._omega))
        points, point = np.unique(self._fundamental, return_inverse=True)
        if not (u == u[..., points[point]]).all():
            points = point = np.arange(shape[-1])
        m = points.size
        values = self._within_reach(values)
        p = np.stack([np.broadcast_to(v, (*shape[:-1], m)).ravel() for v in values], axis=-1)
        u, w = (v[..., points].ravel() for v in (u, w))
        measured = np.broadcast_to(self._measured, shape)[..., points].ravel()
        several = ~self._is_unique(values, shape).reshape(-1, shape[-1]).all(axis=1)
        X = np.full((u.size, len(self._harmonics), 2 + len(chosen)), np.nan, dtype=np.complex128)
        stable = np.ones(u.size, dtype=np.bool_)
        alone = np.flatnonzero(np.repeat(~several, m))
        if alone.size:
            order = self._shooting.system.order
            last = self._orbits.get(order)
            starts = None if last is None else last[points][alone % m]
            motions = self._solve(p[alone], w[alone], u[alone], chosen, starts, stable=False)
            X[alone] = motions.X
            if last is None:
                last = self._orbits[order] = np.full((shape[-1], order), np.nan)
            orbits = motions.orbits[:m][point]
            last[:] = np.where(np.isfinite(orbits), orbits, last)
        for table in np.flatnonzero(several):
            rows = slice(table * m, (table + 1) * m)
            X[rows], stable[rows] = self._followed(
                points, p[rows], w[rows], u[rows], measured[rows], chosen
            )
        X = X.reshape(*shape[:-1], m, *X.shape[1:])[..., point, self._place, :]
        stable = stable.reshape(*shape[:-1], m)[..., point]
        return RowMotion(X[..., 0], X[..., 1], X[..., 2:], stable)

    def is_linear(self, values: Sequence[FloatArray]) -> BoolArray:
        """Return whether friction is hardly more than a spring at every row, () or (S,).

        Searches for limits go there. The motion is then a sine, while shooting would lose it to
        rounding relative to the spring.
        """
        low = np.full((), np.inf)
        for element, law_values in self._model.of(values):
            if not element.is_linear:
                with np.errstate(all="ignore"):
                    low = np.minimum(low, element.knee(law_values)[0])
        with np.errstate(invalid="ignore"):
            far = low > _MICROSLIP * np.nanmax(np.abs(self._measured), axis=-1, keepdims=True)
        return np.asarray(far.all(axis=-1))

    def _within_reach(self, values: Sequence[FloatArray]) -> list[FloatArray]:
        """Return values with a higher knee where friction slips at far smaller displacements.

        All lengths of the law grow in proportion, and so its forces stay.
        """
        smallest = np.nanmin(np.abs(self._measured), axis=-1, keepdims=True)
        reachable = []
        for element, law_values in self._model.of(values):
            longer = np.ones(())
            if not element.is_linear:
                with np.errstate(all="ignore"):
                    longer = np.fmax(_SLIP * smallest / element.knee(law_values)[1], 1.0)
            for parameter, value in zip(element.parameters, law_values, strict=True):
                _, length, time = parameter.dimension
                scaled = length != 0 and time == 0 and (longer > 1.0).any()
                reachable.append(value * longer**length if scaled else value)
        return reachable

    def _is_unique(self, values: Sequence[FloatArray], shape: tuple[int, ...]) -> BoolArray:
        """Return where the response is unique: no part of the plant feeds energy in."""
        if not self._unique_laws:
            return np.zeros(shape, dtype=np.bool_)
        loss = np.zeros(())
        for element, law_values in self._model.of(values):
            if element.is_linear:
                loss = loss + element.stiffness(law_values, np.zeros(()), self._omega).imag
        return np.broadcast_to(loss >= 0.0, shape)

    def _solve(
        self,
        values: FloatArray,
        omega: FloatArray,
        drive: FloatArray,
        chosen: list[int],
        starts: FloatArray | None,
        *,
        again: bool = True,
        stable: bool = True,
    ) -> _SteadyMotions:
        """Return the motions of some points of one or more tables."""
        motions = self._shooting(
            values, omega, drive, chosen=chosen, harmonics=self._harmonics, starts=starts,
            again=again, stable=stable,
        )  # fmt: skip
        X = [motions.harmonics[..., None], motions.by_drive[..., None], motions.by_parameter]
        return _SteadyMotions(
            np.concatenate(X, axis=-1), motions.starts, motions.harmonics[:, 0], motions.multiplier
        )

    def _followed(
        self,
        points: IntArray,
        values: FloatArray,
        omega: FloatArray,
        drive: FloatArray,
        measured: ComplexArray,
        chosen: list[int],
    ) -> tuple[ComplexArray, BoolArray]:
        """Return the motions of one table's points, and which are stable.

        Each level is followed in the order of its rows; with derivatives as far as there are
        motions: a search needs all rows, or none.
        """
        place_of = np.full(self._sweep.size, -1)
        place_of[points] = np.arange(points.size)
        sweep = place_of[self._sweep]
        sweep = sweep[sweep >= 0]
        order_of_levels = [
            sweep[rows] for rows in levels(np.atleast_2d(self._drive)[0][points[sweep]])
        ]
        shape = (drive.size, len(self._harmonics), 2 + len(chosen))
        stable = np.ones(drive.size, dtype=np.bool_)
        result = np.full(shape, np.nan, dtype=np.complex128)
        order = self._shooting.system.order
        orbits = np.full((len(order_of_levels), order), np.nan)
        for place in range(max(map(len, order_of_levels))):
            sweeps = [i for i, level in enumerate(order_of_levels) if place < len(level)]
            rows = np.array([order_of_levels[i][place] for i in sweeps])
            X, reached, first, _ = self._solve(
                values[rows], omega[rows], drive[rows], chosen, orbits[sweeps]
            )
            apart = np.abs(first - measured[rows])
            far = np.flatnonzero(~(apart < _ELSEWHERE * np.abs(measured[rows])))
            if far.size:  # the row may have been measured on another branch
                begin = np.zeros((far.size, order))
                at = measured[rows[far]]
                begin[:, 0], begin[:, 1] = at.real, -omega[rows[far]] * at.imag
                there = rows[far]
                X_there, orbits_there, first, _ = self._solve(
                    values[there], omega[there], drive[there], chosen, begin, again=False
                )
                nearer = ~(apart[far] <= np.abs(first - at)) & np.isfinite(first)
                X[far[nearer]] = X_there[nearer]
                reached[far[nearer]] = orbits_there[nearer]
            lost = np.flatnonzero(np.isnan(X[:, 0, 0]))
            if lost.size:
                there = rows[lost]
                X[lost], reached[lost], _, multiplier = self._solve(
                    values[there], omega[there], drive[there], chosen, orbits[sweeps][lost],
                    stable=False,
                )  # fmt: skip
                stable[there] = ~(multiplier > 1.0 + NEUTRAL)
            result[rows] = X
            if chosen and np.isnan(X).any():
                break  # of no use to a search
            orbits[sweeps] = reached
        return result, stable


def levels(drive: FloatArray) -> list[IntArray]:
    """Return the rows of every level, in their order; a level is held to within a tenth."""
    rising = np.argsort(drive, kind="stable")
    level = np.empty(drive.size, dtype=np.intp)
    level[rising] = np.cumsum(np.diff(np.log(drive[rising]), prepend=np.log(drive.min())) > _LEVEL)
    return [np.flatnonzero(level == i) for i in range(int(level.max()) + 1)]
