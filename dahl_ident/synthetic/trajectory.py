"""Chebyshev polynomials on short intervals, in which solutions are computed and stored.

A function is known by its values at the 13 Chebyshev points of every interval. From them come
its integral (for the solver), its derivative (where the motion turns back), the size of its
last coefficients (whether the interval was short enough), and its value at any time.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev

from dahl_ident.arrays import FloatArray

DEGREE = 12  # high: few intervals for a tolerance of 1e-11
_ANGLES = np.pi * np.arange(DEGREE, -1, -1) / DEGREE  # of Chebyshev's extreme points
NODES = 0.5 * (1.0 + np.cos(_ANGLES))
"""Places in an interval [0, 1], both ends included, rising."""

TO_COEFFICIENTS = np.linalg.inv(chebyshev.chebvander(np.cos(_ANGLES), DEGREE))
"""Matrix from the values at the nodes to the Chebyshev coefficients on [-1, 1]."""


def _integration() -> FloatArray:
    columns = []
    for unit in np.eye(DEGREE + 1):
        integral = chebyshev.chebint(TO_COEFFICIENTS @ unit, lbnd=-1.0, scl=0.5)
        columns.append(chebyshev.chebval(np.cos(_ANGLES), integral))
    return np.asarray(np.array(columns).T, dtype=np.float64)


INTEGRATION = _integration()
"""Matrix from the values at the nodes to the integrals from 0 to each node of [0, 1]."""

DERIVATIVE = np.array([np.pad(chebyshev.chebder(c), (0, 1)) for c in TO_COEFFICIENTS.T]).T
"""Matrix from the values at the nodes to the coefficients of the derivative by 2 tau - 1."""

FINE = np.linspace(0.0, 1.0, 4 * DEGREE + 1)  # four a node: no reversal is missed between
FINE_DERIVATIVE = chebyshev.chebvander(2.0 * FINE - 1.0, DEGREE) @ DERIVATIVE
"""Matrix from the values at the nodes to the derivative on a fine grid over [0, 1]."""


def row_at(tau: float) -> FloatArray:
    """Return the weights of the values at the nodes that give the value at `tau` in [0, 1]."""
    return np.asarray(chebyshev.chebvander(2.0 * tau - 1.0, DEGREE)[0] @ TO_COEFFICIENTS)


class Trajectory:
    """A function of time on consecutive intervals; constant outside, at its end values.

    Parameters
    ----------
    starts : ndarray, shape (m,)
        Where each interval begins, s, rising.
    lengths : ndarray, shape (m,)
        Length on which its polynomial is defined; the next interval may begin before its end.
    coefficients : ndarray, shape (m, 13)
        Chebyshev coefficients on [-1, 1].
    stop : float
        End of the last interval, s.
    """

    def __init__(
        self, starts: FloatArray, lengths: FloatArray, coefficients: FloatArray, stop: float
    ) -> None:
        self._starts = starts
        self._lengths = lengths
        self._coefficients = np.ascontiguousarray(coefficients.T)
        self._stop = stop

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the value at any times."""
        t = np.clip(time, self._starts[0], self._stop)
        which = np.searchsorted(self._starts, t, side="right") - 1
        place = 2.0 * (t - self._starts[which]) / self._lengths[which] - 1.0
        # Clenshaw's recurrence
        high = highest = np.zeros_like(t)
        for row in self._coefficients[:0:-1]:
            high, highest = row[which] + 2.0 * place * high - highest, high
        return np.asarray(self._coefficients[0][which] + place * high - highest)
