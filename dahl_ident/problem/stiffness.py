"""The data as dynamic stiffness at known amplitudes, for starts and tests."""

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

    def of(
        self, element: Element, values: Sequence[FloatArray], *, at_nodes: bool = False
    ) -> ComplexArray:
        """Return an element's Z_k at every row, (..., n).

        With `at_nodes` the values are those of K nodes, () or (..., K), and so is the result,
        (..., K, n).
        """
        A, omega, shape = self.amplitude, self.omega, self.stiffness.shape
        if at_nodes:
            A, omega, values = A[..., None, :], omega[..., None, :], [v[..., None] for v in values]
            nodes = np.broadcast_shapes(*(v.shape for v in values))
            shape = np.broadcast_shapes((*shape[:-1], 1, shape[-1]), nodes)
        result = np.empty(shape, dtype=np.complex128)
        for k in self.orders:
            rows = slice(None) if len(self.orders) == 1 else self.harmonic == k
            result[..., rows] = element.stiffness(values, A[..., rows], omega[..., rows], k)
        return result
