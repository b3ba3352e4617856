"""The data seen as dynamic stiffness at known amplitudes: what starts and first looks work on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import SMALLEST, ComplexArray, FloatArray
from dahl_ident.elements import Element


@dataclass(frozen=True)
class StiffnessData:
    """Measured F_k/X_1 at measured amplitudes, sensors taken at their starts.

    Attributes
    ----------
    stiffness : ndarray of complex, shape (n,) or (S, n)
        Z_k of each row, whatever the table's quantity.
    amplitude, omega : ndarray, shape (n,) or (S, n)
        True amplitude and angular frequency.
    harmonic : ndarray of int, shape (n,)
    orders : tuple of int
        The harmonics that occur.
    weights : ndarray, shape (n,) or (S, n)
        One over the standard deviation of Z that the noise model has at the data, up to the
        unknown scale and the ellipse's shape.
    """

    stiffness: ComplexArray
    amplitude: FloatArray
    omega: FloatArray
    harmonic: NDArray[np.int64]
    orders: tuple[int, ...]
    weights: FloatArray

    @property
    def typical_stiffness(self) -> FloatArray:
        """Median of |Z|, shape () or (S,); above zero also where most responses are zero."""
        return np.asarray(np.maximum(np.median(np.abs(self.stiffness), axis=-1), SMALLEST))

    def of(self, element: Element, values: Sequence[FloatArray]) -> ComplexArray:
        """Return an element's Z_k at every row."""
        if len(self.orders) == 1:
            return element.stiffness(values, self.amplitude, self.omega, self.orders[0])
        result = np.empty(self.stiffness.shape, dtype=np.complex128)
        for k in self.orders:
            rows = self.harmonic == k
            A, w = self.amplitude[..., rows], self.omega[..., rows]
            result[..., rows] = element.stiffness(values, A, w, k)
        return result
