"""Rows whose force was controlled, predicted by the exact steady motion of the plant.

If no friction law and no damper feeds energy in, the motion is unique. Shooting then starts from
the row's orbit at the previous parameters, which affects the result far less than any noise.
Otherwise there may be several motions, and the rows of each level are followed as a sweep is
measured: in their order, from the orbit of the row before. Where an orbit is no longer stable, a
stable one is taken: the jump of the response. If none is stable, as for a row that should not be in
the table, the unstable one is used, so that a search can continue; a verdict names such rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from dahl_ident.elements import Model
from dahl_ident.elements.driven_motion import NEUTRAL, Shooting

_LEVEL_STEP = 0.1  # least difference of ln of the drive between levels; a held one varies less
# knee over the largest displacement from which friction counts as a spring: its third harmonic is
# 1e-3 of the force, and the error of a sine is the square of that
_MICROSLIP = 1e3
_SLIP = 1e-9  # knee over the smallest displacement, below which the knee has no effect
_OTHER_BRANCH = 0.2  # relative distance from the measurement that may mean another branch


class RowMotion(NamedTuple):
    """The harmonic X_k of each row, and its derivatives with respect to drive and parameters."""

    displacement: ComplexArray
    by_drive: ComplexArray
    by_parameter: ComplexArray
    stable: BoolArray


class _SteadyMotions(NamedTuple):
    """Motions at some points: X_k with derivatives, (points, K, ...), orbits, X_1, multipliers."""

    X: ComplexArray
    orbits: FloatArray
    fundamental: ComplexArray
    multiplier: FloatArray


class SteadyRows:
    """Steady motions of some rows at any parameters, with their last orbits.

    `drive` and `omega`, (n,) or (S, n), are as measured; levels are distinguished by the drive. The
    `measured` fundamental of the displacement chooses among several motions. `harmonic` is the k of
    each row, `fundamental` the index of the row with the fundamental of the same motion. `orbits`
    are the last ones, (n, order), for each order of the equations; they are updated.
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
        self._column = np.array([self._harmonics.index(k) for k in harmonic.tolist()])
        self._fundamental = fundamental
        self._orbits = orbits

    def at(self, values: Sequence[FloatArray], drive: FloatArray, chosen: list[int]) -> RowMotion:
        """Return the motions at values of all parameters, each (1,) or (S, 1).

        `chosen` are the indices of the parameters to differentiate by. Harmonics of one motion are
        computed together if their rows have the same drive.
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
        is_unique = self._is_unique(values, shape).reshape(-1, shape[-1]).all(axis=1)  # (S,)
        X = np.full((u.size, len(self._harmonics), 2 + len(chosen)), np.nan, dtype=np.complex128)
        stable = np.ones(u.size, dtype=np.bool_)
        unique = np.flatnonzero(np.repeat(is_unique, m))
        if unique.size:
            order = self._shooting.system.order
            last = self._orbits.get(order)
            starts = None if last is None else last[points][unique % m]
            motions = self._solve(p[unique], w[unique], u[unique], chosen, starts, stable=False)
            X[unique] = motions.X
            if last is None:
                last = self._orbits[order] = np.full((shape[-1], order), np.nan)
            orbits = motions.orbits[:m][point]
            last[:] = np.where(np.isfinite(orbits), orbits, last)
        for table in np.flatnonzero(~is_unique):
            part = slice(table * m, (table + 1) * m)
            X[part], stable[part] = self._followed(
                points, p[part], w[part], u[part], measured[part], chosen
            )
        X = X.reshape(*shape[:-1], m, *X.shape[1:])[..., point, self._column, :]
        stable = stable.reshape(*shape[:-1], m)[..., point]
        return RowMotion(X[..., 0], X[..., 1], X[..., 2:], stable)

    def is_linear(self, values: Sequence[FloatArray]) -> BoolArray:
        """Return whether friction is almost a spring in every row, () or (S,).

        Searches for limits get there. The motion is then a sine, but shooting would lose friction's
        losses to rounding relative to the spring.
        """
        lowest_knee = np.full((), np.inf)
        for element, law_values in self._model.of(values):
            if not element.is_linear:
                with np.errstate(all="ignore"):
                    lowest_knee = np.minimum(lowest_knee, element.knee(law_values)[0])
        largest = np.nanmax(np.abs(self._measured), axis=-1, keepdims=True)
        with np.errstate(invalid="ignore"):
            return np.asarray((lowest_knee > _MICROSLIP * largest).all(axis=-1))

    def _within_reach(self, values: Sequence[FloatArray]) -> list[FloatArray]:
        """Return values with a higher knee if friction slips at far smaller displacements.

        All lengths of the law are scaled by one factor, so that its forces do not change.
        """
        smallest = np.nanmin(np.abs(self._measured), axis=-1, keepdims=True)
        reachable = []
        for element, law_values in self._model.of(values):
            factor = np.ones(())
            if not element.is_linear:
                with np.errstate(all="ignore"):
                    factor = np.fmax(_SLIP * smallest / element.knee(law_values)[1], 1.0)
            for parameter, value in zip(element.parameters, law_values, strict=True):
                _, length, time = parameter.dimension
                is_scaled = length != 0 and time == 0 and (factor > 1.0).any()
                reachable.append(value * factor**length if is_scaled else value)
        return reachable

    def _is_unique(self, values: Sequence[FloatArray], shape: tuple[int, ...]) -> BoolArray:
        """Return whether each response is unique: no part of the plant feeds energy in."""
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
            values,
            omega,
            drive,
            chosen=chosen,
            harmonics=self._harmonics,
            starts=starts,
            again=again,
            stable=stable,
        )
        X = [motions.harmonics[..., None], motions.by_amplitude[..., None], motions.by_parameter]
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

        Each level is followed in the order of its rows. With derivatives the computation stops at
        the first motion that does not exist: a search needs all rows, or none.
        """
        point_of_row = np.full(self._fundamental.size, -1)
        point_of_row[points] = np.arange(points.size)
        sweep = point_of_row[np.argsort(self._fundamental, kind="stable")]
        sweep = sweep[sweep >= 0]
        sweeps = [sweep[level] for level in levels(np.atleast_2d(self._drive)[0][points[sweep]])]
        shape = (drive.size, len(self._harmonics), 2 + len(chosen))
        stable = np.ones(drive.size, dtype=np.bool_)
        result = np.full(shape, np.nan, dtype=np.complex128)
        order = self._shooting.system.order
        orbits = np.full((len(sweeps), order), np.nan)
        for step in range(max(map(len, sweeps))):
            running = [i for i, sweep in enumerate(sweeps) if step < len(sweep)]
            now = np.array([sweeps[i][step] for i in running])
            X, new_orbits, fundamental, _ = self._solve(
                values[now], omega[now], drive[now], chosen, orbits[running]
            )
            distance = np.abs(fundamental - measured[now])
            far = np.flatnonzero(~(distance < _OTHER_BRANCH * np.abs(measured[now])))
            if far.size:  # the row may have been measured on another branch
                retried = now[far]
                target = measured[retried]
                starts = np.zeros((far.size, order))
                starts[:, 0], starts[:, 1] = target.real, -omega[retried] * target.imag
                other = self._solve(
                    values[retried], omega[retried], drive[retried], chosen, starts, again=False
                )
                other_distance = np.abs(other.fundamental - target)
                nearer = ~(distance[far] <= other_distance) & np.isfinite(other.fundamental)
                X[far[nearer]] = other.X[nearer]
                new_orbits[far[nearer]] = other.orbits[nearer]
            missing = np.flatnonzero(np.isnan(X[:, 0, 0]))
            if missing.size:
                retried = now[missing]
                X[missing], new_orbits[missing], _, multiplier = self._solve(
                    values[retried],
                    omega[retried],
                    drive[retried],
                    chosen,
                    orbits[running][missing],
                    stable=False,
                )
                stable[retried] = ~(multiplier > 1.0 + NEUTRAL)
            result[now] = X
            if chosen and np.isnan(X).any():
                break
            orbits[running] = new_orbits
        return result, stable


def levels(drive: FloatArray) -> list[IntArray]:
    """Return the points of every level, in their order; a level is held to within a tenth."""
    rising = np.argsort(drive, kind="stable")
    steps = np.flatnonzero(np.diff(np.log(drive[rising])) > _LEVEL_STEP)
    return [np.sort(level) for level in np.split(rising, steps + 1)]
