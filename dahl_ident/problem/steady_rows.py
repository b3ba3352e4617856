"""Rows whose force was controlled, predicted by the exact steady motion of the plant.

Shooting starts from the orbit that the row had at the parameters before, of which the result
depends by far less than any noise: where no friction law and no damper feeds energy in, the motion
is unique. Elsewhere there may be several, and the rows are followed as a sweep is measured: in
the order of the rows, at one level each from the orbit of the row before. An orbit that is no
longer stable is left for a stable one, which is the jump of the response.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements import Model
from dahl_ident.steady_state import Shooting

_LEVEL = 0.1  # of ln of the drive: a held level varies by less, and two levels differ by more
_MICROSLIP = 1e3  # knees over the largest displacement: a third harmonic of 1e-3, off by 1e-6
_SLIP = 1e-9  # knees over the smallest displacement, below which stiffness no longer matters
_STIFFNESS = (1, -1, 0)  # powers of force, displacement and time
_ELSEWHERE = 0.2  # relative difference from the measured displacement: perhaps another branch


class RowMotion(NamedTuple):
    """The fundamental X of the displacement, its derivatives with respect to drive, parameters."""

    displacement: ComplexArray
    by_drive: ComplexArray
    by_parameter: ComplexArray


class SteadyRows:
    """Steady motions of some rows at any parameters, with the orbits where they were last found.

    Parameters
    ----------
    model : Model
    shooting : Shooting
        Of that model.
    drive, omega : ndarray, shape (n,) or (S, n)
        As measured; levels are told apart by the drive.
    measured : ndarray of complex, shape (n,) or (S, n)
        Displacement phasor, which chooses among several motions.
    orbits : dict of int to ndarray
        The orbits last found, (n, order), by their order; kept up to date.
    """

    def __init__(
        self,
        model: Model,
        shooting: Shooting,
        drive: FloatArray,
        omega: FloatArray,
        measured: ComplexArray,
        orbits: dict[int, FloatArray],
    ) -> None:
        self._model, self._shooting = model, shooting
        self._omega, self._measured = omega, measured
        self._unique_laws = all(e.is_linear or e.unique_response for e in model.elements)
        self._order = levels(np.atleast_2d(drive)[0])
        self._orbits = orbits

    def at(self, values: Sequence[FloatArray], drive: FloatArray, chosen: list[int]) -> RowMotion:
        """Return the motions at values of all parameters, each (1,) or (S, 1).

        `chosen` are the parameters whose derivatives are wanted, by index.
        """
        shape = np.broadcast_shapes(
            self._omega.shape, np.shape(drive), *(np.shape(v) for v in values)
        )
        n = shape[-1]
        values = self._within_reach(values)
        p = np.stack([np.broadcast_to(v, shape).ravel() for v in values], axis=-1)
        u, w = (np.broadcast_to(v, shape).ravel() for v in (drive, self._omega))
        several = ~self._is_unique(values, shape).reshape(-1, n).all(axis=1)
        X = np.full((u.size, 2 + len(chosen)), np.nan, dtype=np.complex128)
        alone = np.flatnonzero(np.repeat(~several, n))
        if alone.size:
            last = self._orbits.get(self._shooting.system.order)
            starts = None if last is None else last[alone % n]
            X[alone], found = self._solve(
                p[alone], w[alone], u[alone], chosen, starts, stable=False
            )
            first = found[:n]
            if last is not None:
                first = np.where(np.isfinite(first), first, last)
            self._orbits[self._shooting.system.order] = first
        measured = np.broadcast_to(self._measured, shape).ravel()
        for table in np.flatnonzero(several):
            rows = slice(table * n, (table + 1) * n)
            X[rows] = self._followed(p[rows], w[rows], u[rows], measured[rows], chosen)
        X = X.reshape(*shape, -1)
        return RowMotion(X[..., 0], X[..., 1], X[..., 2:])

    def is_linear(self, values: Sequence[FloatArray]) -> NDArray[np.bool_]:
        """Return whether friction is hardly more than a spring at every row, () or (S,).

        Searches for limits go there. The motion is then a sine, while shooting would lose it to
        rounding relative to the spring.
        """
        low = np.full((), np.inf)
        for element, own in self._model.of(values):
            if not element.is_linear:
                with np.errstate(all="ignore"):
                    low = np.minimum(low, element.knee(own)[0])
        with np.errstate(invalid="ignore"):
            far = low > _MICROSLIP * np.nanmax(np.abs(self._measured), axis=-1, keepdims=True)
        return np.asarray(far.all(axis=-1))

    def _within_reach(self, values: Sequence[FloatArray]) -> list[FloatArray]:
        """Return values with the stiffness of friction that slips at once brought within reach."""
        smallest = np.nanmin(np.abs(self._measured), axis=-1, keepdims=True)
        found = []
        for element, own in self._model.of(values):
            kept = list(own)
            if not element.is_linear:
                with np.errstate(all="ignore"):
                    share = element.knee(own)[1] / (_SLIP * smallest)
                for i, parameter in enumerate(element.parameters):
                    if parameter.dimension == _STIFFNESS and (share < 1.0).any():
                        kept[i] = own[i] * np.where(share < 1.0, share, 1.0)
            found += kept
        return found

    def _is_unique(self, values: Sequence[FloatArray], shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """Return where the response is unique: no part of the plant feeds energy in."""
        if not self._unique_laws:
            return np.zeros(shape, dtype=np.bool_)
        loss = np.zeros(())
        for element, own in self._model.of(values):
            if element.is_linear:
                loss = loss + element.stiffness(own, np.zeros(()), self._omega).imag
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
    ) -> tuple[ComplexArray, FloatArray]:
        """Return X, its derivatives with respect to drive and parameters, and the orbits."""
        found = self._shooting(
            values, omega, drive, chosen=chosen, starts=starts, again=again, stable=stable
        )
        X = [found.harmonics, found.by_drive, found.by_parameter[:, 0]]
        return np.concatenate(X, axis=1), found.starts

    def _followed(
        self,
        values: FloatArray,
        omega: FloatArray,
        drive: FloatArray,
        measured: ComplexArray,
        chosen: list[int],
    ) -> ComplexArray:
        """Return the motions of one table, each level followed in the order of its rows.

        With derivatives, as far as there are any: a search needs all rows, or none.
        """
        result = np.full((drive.size, 2 + len(chosen)), np.nan, dtype=np.complex128)
        order = self._shooting.system.order
        orbits = np.full((len(self._order), order), np.nan)
        for place in range(max(map(len, self._order))):
            sweeps = [i for i, sweep in enumerate(self._order) if place < len(sweep)]
            rows = np.array([self._order[i][place] for i in sweeps])
            X, own = self._solve(values[rows], omega[rows], drive[rows], chosen, orbits[sweeps])
            apart = np.abs(X[:, 0] - measured[rows])
            far = np.flatnonzero(~(apart < _ELSEWHERE * np.abs(measured[rows])))
            if far.size:  # the row may have been measured on another branch
                begin = np.zeros((far.size, order))
                at = measured[rows[far]]
                begin[:, 0], begin[:, 1] = at.real, -omega[rows[far]] * at.imag
                there = rows[far]
                other, orbit = self._solve(
                    values[there], omega[there], drive[there], chosen, begin, again=False
                )
                nearer = ~(apart[far] <= np.abs(other[:, 0] - at)) & np.isfinite(other[:, 0])
                X[far[nearer]], own[far[nearer]] = other[nearer], orbit[nearer]
            result[rows] = X
            if chosen and np.isnan(X).any():
                break  # of no use to a search
            orbits[sweeps] = own
        return result


def levels(drive: FloatArray) -> list[NDArray[np.intp]]:
    """Return the rows of every level, in their order; a level is held to within a tenth."""
    rising = np.argsort(drive, kind="stable")
    level = np.empty(drive.size, dtype=np.intp)
    level[rising] = np.cumsum(np.diff(np.log(drive[rising]), prepend=np.log(drive.min())) > _LEVEL)
    return [np.flatnonzero(level == i) for i in range(int(level.max()) + 1)]
