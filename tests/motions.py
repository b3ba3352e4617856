"""Motions of driven plants for tests, by the engine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Element, Excitation, FirstState, Model, plant_equations
from dahl_ident.engine import Marched, band_limited, march, translate


class Driven:
    """A plant under samples of its drive at an even rate; `values` are those of free parameters."""

    def __init__(
        self, model: Element, wave: FloatArray, rate: float, excitation: Excitation = "force"
    ) -> None:
        self.model = Model(model)
        self.system = translate(plant_equations(self.model, excitation))
        self.time = np.arange(wave.size) / rate
        self._drive = band_limited(wave, 1.0 / rate)
        self.free = [i for i, p in enumerate(self.model.parameters) if p.free]

    @property
    def order(self) -> int:
        return self.system.order

    def all_values(self, values: Sequence[float] | FloatArray) -> FloatArray:
        full = np.array([p.value or 0.0 for p in self.model.parameters])
        full[self.free] = values
        return full

    def motion(
        self,
        first: Sequence[float] | FloatArray,
        values: Sequence[float] | FloatArray = (),
        *,
        derivatives: bool = False,
        finer: float = 1.0,
    ) -> Marched:
        return march(
            self.system, self.time, self._drive, self.time, np.asarray(first, dtype=np.float64),
            self.all_values(values), chosen=self.free, derivatives=derivatives, finer=finer,
        )  # fmt: skip

    def first(
        self, starts: FloatArray, values: Sequence[float] | FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the first state from what records leave unknown, and its derivatives."""
        state, by_start, by_value = FirstState(self.model)(starts, self.all_values(values))
        return state, by_start, by_value[:, self.free]


def slopes(driven: Driven, starts: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return displacements and their derivatives with respect to starts and free values."""
    first, by_start, by_value = driven.first(starts, values)
    found = driven.motion(first, values, derivatives=True)
    by = [found.by_first @ by_start, found.by_parameter + found.by_first @ by_value]
    return found.output, np.column_stack(by)


def differences(
    driven: Driven, starts: FloatArray, values: FloatArray, step: float
) -> list[FloatArray]:
    """Return the derivatives with respect to starts and free values by differences.

    Of motions with finer steps, whose errors the step divides.
    """
    point, found = np.concatenate([starts, values]), []
    for i in range(point.size):
        h = np.zeros(point.size)
        h[i] = step * abs(point[i])

        def at(p: FloatArray) -> FloatArray:
            own = p[starts.size :]
            return driven.motion(driven.first(p[: starts.size], own)[0], own, finer=10.0).output

        near = (at(point + h) - at(point - h)) / (2.0 * h[i])
        far = (at(point + 2.0 * h) - at(point - 2.0 * h)) / (4.0 * h[i])
        found.append((4.0 * near - far) / 3.0)
    return found
