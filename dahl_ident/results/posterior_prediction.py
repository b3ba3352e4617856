"""Responses that a posterior predicts, with bands, at its draws: without any linearization."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.diagnostics.confidence_levels import checked_levels


@dataclass(frozen=True)
class PredictiveBand:
    """A predicted response at draws from the posterior; noise is not included.

    Attributes
    ----------
    draws : ndarray of complex, shape (draws, n)
        The response at each draw.

    Examples
    --------
    >>> import dahl_ident as di
    >>> grid = di.posterior(di.load_dataset("noisy"), di.Dahl(alpha=1.0), method="grid")
    >>> band = grid.predict([1.0, 1.0], amplitude=[0.002, 0.004])
    >>> low, high = band.gain()
    >>> print(abs(band.response).round(1), (high - low).round(1))
    [27.3 22. ] [0.2 0.2]
    """

    draws: ComplexArray

    @property
    def response(self) -> ComplexArray:
        """The posterior mean, shape (n,)."""
        return np.asarray(self.draws.mean(axis=0))

    def gain(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the gain at each point."""
        return _central(np.abs(self.draws), level)

    def phase(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the phase at each point, rad."""
        centre = np.angle(self.response)
        low, high = _central(np.angle(self.draws * np.exp(-1j * centre)), level)
        return centre + low, centre + high

    def real(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the real part at each point."""
        return _central(self.draws.real, level)

    def imag(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the imaginary part at each point."""
        return _central(self.draws.imag, level)


def _central(values: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
    tail = 0.5 * (1.0 - float(checked_levels([level])[0]))
    low, high = np.quantile(values, [tail, 1.0 - tail], axis=0)
    return low, high
