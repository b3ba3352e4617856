"""The data as dynamic stiffness at measured amplitudes, for starts and tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import SMALLEST, ComplexArray, FloatArray, IntArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.elements import Element, Model
from dahl_ident.errors import DataError, ModelError, spelled

_GRID_STEP = 0.1  # of ln A; the slope of a curve changes by about 1 over a unit


@dataclass(frozen=True)
class StiffnessData:
    """Measured F_k/X_1 at measured amplitudes, with the sensors' initial values."""

    stiffness: ComplexArray
    """Z_k of each row, (n,) or (S, n), whatever the table's quantity."""
    amplitude: FloatArray
    omega: FloatArray
    harmonic: NDArray[np.int64]
    weights: FloatArray
    """One over the noise model's standard deviation of Z, up to an unknown scale; the shape of the
    noise ellipse is ignored."""

    @property
    def typical_stiffness(self) -> FloatArray:
        """Median of |Z|, shape () or (S,); positive even if most responses are zero."""
        return np.asarray(np.maximum(np.median(np.abs(self.stiffness), axis=-1), SMALLEST))

    def of_rows(self, rows: IntArray) -> StiffnessData:
        """Return some of the rows."""
        return StiffnessData(*(getattr(self, field.name)[..., rows] for field in fields(self)))

    def stiffness_of(
        self, element: Element, values: Sequence[FloatArray], *, at_nodes: bool = False
    ) -> ComplexArray:
        """Return an element's Z_k in every row, (..., n).

        With `at_nodes` the values belong to K nodes, () or (..., K), and the result has shape
        (..., K, n). This is meant for starts: over many rows a rate-independent law is
        interpolated, with an error of 0.002 of its largest value, or 0.01 at a kink.
        """
        A, omega = self.amplitude, self.omega
        harmonic = self.harmonic if len(self.orders) > 1 else self.orders[0]
        if not at_nodes:
            return np.asarray(element.stiffness(values, A, omega, harmonic))
        values = [v[..., None] for v in values]
        grid, cell, fraction = self._interpolation
        if not element.rate_independent or A.ndim > 1 or grid.size * len(self.orders) >= A.size:
            return element.stiffness(values, A[..., None, :], omega[..., None, :], harmonic)
        orders = np.array(self.orders)
        amplitudes = np.tile(np.exp(grid), orders.size)
        curves = element.stiffness(values, amplitudes, np.ones(()), np.repeat(orders, grid.size))
        cell = cell + grid.size * np.searchsorted(orders, self.harmonic)
        left, right = curves[..., cell], curves[..., cell + 1]
        right -= left
        right *= fraction
        return np.asarray(left + right)

    @cached_property
    def orders(self) -> tuple[int, ...]:
        """The harmonics that occur."""
        return tuple(np.unique(self.harmonic).tolist())

    @cached_property
    def _interpolation(self) -> tuple[FloatArray, IntArray, FloatArray]:
        """Return ln A of a grid over all rows, and each row's cell and position in that cell."""
        ln_A = np.log(np.maximum(self.amplitude, SMALLEST))
        low, high = ln_A.min(), ln_A.max()
        grid = np.linspace(low, high, 2 + int((high - low) / _GRID_STEP))
        position = (ln_A - low) / max(grid[1] - grid[0], SMALLEST)
        cell = np.minimum(position.astype(np.intp), grid.size - 2)
        return grid, cell, position - cell


def checked_table(data: object) -> FrequencyResponse:
    """Return `data` if it is a table; otherwise raise an error that states its type."""
    if isinstance(data, FrequencyResponse):
        return data
    raise DataError(
        f"data is a {type(data).__name__}; expected a FrequencyResponse, as "
        "read_frequency_response gives it, or extract from a Record"
    )


def as_response(data: FrequencyResponse, model: Model) -> FrequencyResponse:
    """Return a table of responses: a backbone is converted with the model's mass."""
    if data.quantity != "backbone":
        return data
    masses = [p for p in model.parameters if p.is_mass]
    if not masses or any(p.free for p in masses):
        raise ModelError(
            f"natural frequencies and damping ratios determine {model!r} up to the mass; give the "
            f"modal mass in it, such as {spelled('Mass(0.5)', '--mass 0.5')}"
        )
    return data.with_mass(sum(float(p.value or 0.0) for p in masses))
