"""The exact steady motion of driven plants, with all harmonics, and its stability.

The describing function takes the displacement for a sine. Friction makes it another periodic
motion, which the engine finds by shooting: the state after one cycle of the drive is that before.
The eigenvalues of that cycle's derivative, Floquet's multipliers, say whether a motion near it
comes back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.coefficients import Coefficients
from dahl_ident.elements.element import Element, as_model
from dahl_ident.elements.equations import plant_equations
from dahl_ident.errors import ModelError

if TYPE_CHECKING:
    from dahl_ident.engine import System

Steady = Literal["exact", "describing function"]
STEADY: tuple[Steady, ...] = ("exact", "describing function")
"""How the response to a force that is held is predicted."""

ACCURACY = 1e-9
"""Largest relative difference of two solutions of one motion from different starts."""

LINEAR = "the model is linear"
"""Why there is no exact motion to compute: the response is a sine."""

NEUTRAL = 1e-6  # beyond 1: the multiplier of a motion that may lie anywhere is 1, to rounding
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

    found: NDArray[np.bool_]
    harmonics: ComplexArray
    by_drive: ComplexArray
    by_parameter: ComplexArray
    starts: FloatArray
    multiplier: FloatArray


def obstacle(model: Element) -> str:
    """Return why a plant has no exact steady motion here; nothing where it has one.

    Examples
    --------
    >>> from dahl_ident import Dahl, Mass
    >>> obstacle(Dahl() + Mass(1.0)), obstacle(Dahl())
    ('', 'the model has no mass')
    """
    model = as_model(model)
    if all(element.is_linear for element in model.elements):
        return LINEAR
    try:
        model = Coefficients(model).model
        if not model.has_inertia:
            return "the model has no mass"
        plant_equations(model)
    except ModelError as error:
        return str(error).partition(";")[0].partition(", so")[0]
    return ""


class Shooting:
    """The steady motions of one model, its equations compiled when first asked for one.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl, Damper, Mass, Spring
    >>> plant = Shooting(Dahl() + Mass() + Damper() + Spring())
    >>> values = np.array([[0.1, 30.0, 1.0, 0.3, 0.24, 0.3]])
    >>> steady = plant(values, np.array([2.0 * np.pi]), np.array([0.2]), harmonics=(1, 3))
    >>> abs(steady.harmonics).round(5).tolist(), bool(steady.multiplier[0] < 1.0)
    ([[0.01811, 0.00028]], True)
    """

    def __init__(self, model: Element) -> None:
        self._model = as_model(model)
        self._coefficients = Coefficients(self._model)
        self._system: System | None = None

    @property
    def system(self) -> System:
        """The compiled equations."""
        if self._system is None:
            from dahl_ident.engine import translate

            self._system = translate(plant_equations(self._coefficients.model))
        return self._system

    def __call__(
        self,
        values: FloatArray,
        omega: FloatArray,
        drive: FloatArray,
        *,
        chosen: Sequence[int] = (),
        harmonics: Sequence[int] = (1,),
        starts: FloatArray | None = None,
        cycles: int | None = None,
        again: bool = True,
        stable: bool = True,
        one_sided: bool = False,
    ) -> SteadyMotion:
        """Return the steady motions of many rows, with values that the engine can resolve.

        They begin from the states `starts` at t = 0, NaN for rest, and go through some `cycles`
        before they are solved for; a row that leads nowhere is started `again`, from rest. If
        `stable`, a motion that is not stable counts as none. If `one_sided`, motions are sought
        that differ in both directions even if the law does not: they come in pairs, of one
        fundamental, where the motion between them is not stable.
        """
        how: dict[str, Any] = {
            "chosen": chosen, "harmonics": harmonics, "again": again, "stable": stable,
            "one_sided": one_sided,
        }  # fmt: skip
        result = self._motions(values, omega, drive, starts=starts, cycles=cycles, **how)
        with np.errstate(all="ignore"):
            A = np.hypot(result.starts[:, 0], result.starts[:, 1] / omega)
            resolved = np.stack(self._model.resolved(list(values.T), A), axis=-1)
            beyond = (resolved < values) & result.found[:, None]
        rows = np.flatnonzero(beyond.any(axis=1))
        if rows.size:
            near = result.starts[rows]
            repeated = self._motions(resolved[rows], omega[rows], drive[rows], starts=near, **how)
            repeated.by_parameter.swapaxes(1, 2)[beyond[rows][:, list(chosen)]] = 0.0
            for part, new in zip(result, repeated, strict=True):
                part[rows] = new
        return result

    def _motions(
        self,
        values: FloatArray,
        omega: FloatArray,
        drive: FloatArray,
        *,
        chosen: Sequence[int],
        harmonics: Sequence[int],
        again: bool,
        stable: bool,
        one_sided: bool,
        starts: FloatArray | None = None,
        cycles: int | None = None,
    ) -> SteadyMotion:
        """Return the steady motions of many rows at these very values."""
        slopes = None
        if not self._coefficients.are_values:
            wanted = tuple(chosen)
            values, slopes = self._coefficients(values)
            slopes = slopes[:, :, wanted]
            chosen = np.flatnonzero(slopes.any(axis=(0, 2))).tolist()
        ask = _Ask(values, omega, drive, tuple(chosen), tuple(harmonics), stable, one_sided)
        result = _empty(omega.size, len(harmonics), len(chosen), self.system.order)
        possible = np.isfinite(values).all(axis=1) & np.isfinite(omega) & np.isfinite(drive)
        if starts is not None:
            known = possible & np.isfinite(starts).all(axis=1)
            self._solve(result, known, ask, starts, cycles)
            possible &= again | ~known
        self._solve(result, possible & ~result.found, ask)
        unstable = np.isfinite(result.multiplier)
        lost = possible & ~result.found & ~unstable
        # a search passes values at which nothing settles; a few rows may take as long as the others
        if stable or np.all(values == values[0]) or _FINER * lost.sum() <= omega.size:
            self._solve(result, lost, ask, finer=_FINER)
        self._solve(result, possible & ~result.found & unstable, ask, cycles=_LONG)
        if stable and self.system.odd:
            unstable = np.isfinite(result.multiplier)
            which = possible & ~result.found & unstable
            runs = _PATIENT if one_sided else 0
            self._solve(result, which, ask._replace(one_sided=True), cycles=_LONG, runs=runs)
        if slopes is not None:
            result = result._replace(by_parameter=result.by_parameter @ slopes[:, chosen])
        return result

    def _solve(
        self,
        result: SteadyMotion,
        which: NDArray[np.bool_],
        ask: _Ask,
        starts: FloatArray | None = None,
        cycles: int | None = None,
        finer: float = 1.0,
        runs: int = 0,
    ) -> None:
        """Put the motions of some rows into the result, each after some `runs` of cycles alone."""
        from dahl_ident.engine import settled

        rows = np.flatnonzero(which)
        if not rows.size:
            return
        system = replace(self.system, odd=self.system.odd and not ask.one_sided)
        begin = None if starts is None else starts[rows]
        for count in (*[_ALONE] * runs, cycles):
            with np.errstate(all="ignore"):
                motions = settled(
                    system, ask.drive[rows], ask.omega[rows], ask.values[rows], chosen=ask.chosen,
                    harmonics=ask.harmonics, starts=begin, cycles=count, finer=finer,
                )  # fmt: skip
            begin = motions.starts
        multiplier = np.full(rows.size, np.nan)
        ok = motions.found & np.isfinite(motions.maps).all(axis=(1, 2))
        sizes = np.abs(np.linalg.eigvals(motions.maps[ok])).max(axis=1, initial=0.0)
        multiplier[ok] = sizes**2 if system.odd else sizes  # the map of half a cycle
        with np.errstate(invalid="ignore"):
            good = ok & (multiplier <= 1.0 + NEUTRAL) if ask.stable else ok
        put, at = np.flatnonzero(good), rows[good]
        result.found[at] = True
        result.harmonics[at] = motions.coefficients[put]
        result.by_drive[at] = motions.by_amplitude[put]
        result.by_parameter[at] = motions.by_parameter[put]
        result.starts[at] = motions.starts[put]
        result.multiplier[rows] = multiplier


class _Ask(NamedTuple):
    """The request for every row: values, drive, and harmonics."""

    values: FloatArray
    omega: FloatArray
    drive: FloatArray
    chosen: tuple[int, ...]
    harmonics: tuple[int, ...]
    stable: bool
    one_sided: bool


def _empty(rows: int, harmonics: int, chosen: int, order: int) -> SteadyMotion:
    return SteadyMotion(
        np.zeros(rows, dtype=np.bool_),
        np.full((rows, harmonics), np.nan, dtype=np.complex128),
        np.full((rows, harmonics), np.nan, dtype=np.complex128),
        np.full((rows, harmonics, chosen), np.nan, dtype=np.complex128),
        np.full((rows, order), np.nan),
        np.full(rows, np.nan),
    )
