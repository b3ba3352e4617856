"""The data as dynamic stiffness at known amplitudes, for starts and tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import SMALLEST, ComplexArray, FloatArray, IntArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.elements import Element, Model
from dahl_ident.errors import DataError, ModelError

_CELL = 0.1  # step of ln A between which curves are read; they bend by about 1 over a unit


@dataclass(frozen=True)
class StiffnessData:
    """Measured F_k/X_1 at measured amplitudes, sensors taken at their starts."""

    stiffness: ComplexArray
    """Z_k of each row, (n,) or (S, n), whatever the table's quantity."""
    amplitude: FloatArray
    omega: FloatArray
    harmonic: NDArray[np.int64]
    weights: FloatArray
    """One over the standard deviation of Z that the noise model has at the data, up to the unknown
    scale and the ellipse's shape."""

    @property
    def typical_stiffness(self) -> FloatArray:
        """Median of |Z|, shape () or (S,); above zero also where most responses are zero."""
        return np.asarray(np.maximum(np.median(np.abs(self.stiffness), axis=-1), SMALLEST))

    def of_rows(self, rows: IntArray) -> StiffnessData:
        """Return some of the rows."""
        return StiffnessData(*(getattr(self, one.name)[..., rows] for one in fields(self)))

    def of(
        self, element: Element, values: Sequence[FloatArray], *, at_nodes: bool = False
    ) -> ComplexArray:
        """Return an element's Z_k at every row, (..., n).

        With `at_nodes` the values are those of K nodes, () or (..., K), and so is the result,
        (..., K, n). Meant for starts: over many rows a law that does not depend on the rate is
        interpolated, to two thousandths of its largest value, a hundredth at a kink.
        """
        A, omega = self.amplitude, self.omega
        harmonic = self.harmonic if len(self.orders) > 1 else self.orders[0]
        if not at_nodes:
            return np.asarray(element.stiffness(values, A, omega, harmonic))
        values = [v[..., None] for v in values]
        x, cell, share = self._places
        if not element.rate_independent or A.ndim > 1 or x.size * len(self.orders) >= A.size:
            return element.stiffness(values, A[..., None, :], omega[..., None, :], harmonic)
        orders = np.array(self.orders)
        at = np.tile(np.exp(x), orders.size)
        curves = element.stiffness(values, at, np.ones(()), np.repeat(orders, x.size))
        cell = cell + x.size * np.searchsorted(orders, self.harmonic)
        left, right = curves[..., cell], curves[..., cell + 1]
        right -= left
        right *= share
        return np.asarray(left + right)

    @cached_property
    def orders(self) -> tuple[int, ...]:
        """The harmonics that occur."""
        return tuple(np.unique(self.harmonic).tolist())

    @cached_property
    def _places(self) -> tuple[FloatArray, IntArray, FloatArray]:
        """Return ln A of a grid over all rows, each row's cell of it, and its place in the cell."""
        ln_A = np.log(np.maximum(self.amplitude, SMALLEST))
        low, high = ln_A.min(), ln_A.max()
        x = np.linspace(low, high, 2 + int((high - low) / _CELL))
        place = (ln_A - low) / max(x[1] - x[0], SMALLEST)
        cell = np.minimum(place.astype(np.intp), x.size - 2)
        return x, cell, place - cell


def checked_table(data: object) -> FrequencyResponse:
    """Return `data` if it is a table, or say what it is instead."""
    if isinstance(data, FrequencyResponse):
        return data
    raise DataError(
        f"data is a {type(data).__name__}; expected a FrequencyResponse, as "
        "read_frequency_response gives it, or extract from a Record"
    )


def as_response(data: FrequencyResponse, model: Model) -> FrequencyResponse:
    """Return a table that a model predicts: a backbone with the model's mass."""
    if data.quantity != "backbone":
        return data
    masses = [p for p in model.parameters if p.is_mass]
    if not masses or any(p.free for p in masses):
        raise ModelError(
            f"natural frequencies and damping ratios determine {model!r} up to the mass; give the "
            "modal mass in it, such as Mass(0.5)"
        )
    return data.with_mass(sum(float(p.value or 0.0) for p in masses))
