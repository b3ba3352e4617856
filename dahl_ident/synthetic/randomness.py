"""Random numbers that depend only on a seed and a purpose.

Every effect of the synthetic laboratory has its own stream, so that adding an effect does not
change the others. The bits come from PCG64, and normal numbers from the inverse of their
distribution: no draw is ever rejected, so platform differences in the last digit cannot shift a
stream.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from dahl_ident.arrays import ComplexArray, FloatArray


class Draws:
    """The random streams of one seed, a whole number >= 0, each identified by its purpose."""

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def uniform(self, purpose: str, n: int) -> FloatArray:
        """Return `n` numbers between 0 and 1, both excluded."""
        key = np.random.SeedSequence(self._seed, spawn_key=tuple(purpose.encode()))
        bits = np.random.PCG64(key).random_raw(n)
        return np.asarray(((bits >> np.uint64(11)) + 0.5) * 2.0**-53)

    def normal(self, purpose: str, n: int) -> FloatArray:
        """Return `n` standard normal numbers."""
        return np.asarray(ndtri(self.uniform(purpose, n)))

    def complex_normal(self, purpose: str, n: int) -> ComplexArray:
        """Return `n` complex numbers of standard normal parts."""
        parts = (self.normal(f"{purpose}, {part}", n) for part in ("real", "imaginary"))
        return np.asarray(next(parts) + 1j * next(parts))

    def flicker(self, purpose: str, n: int) -> FloatArray:
        """Return `n` numbers of 1/f noise: power falling as 1/f, mean 0, expected variance 1."""
        spectrum = np.fft.rfft(self.normal(purpose, n))
        weight = np.zeros(spectrum.size)
        weight[1:] = np.arange(1, spectrum.size) ** -0.5
        lines = np.full(spectrum.size, 2.0)
        if n % 2 == 0:
            lines[-1] = 1.0
        # white noise has a power of n in each line; the inverse transform divides by n
        scale = np.sqrt(n / np.sum(lines * weight**2))
        return np.asarray(scale * np.fft.irfft(spectrum * weight, n))

    def permutation(self, purpose: str, n: int) -> list[int]:
        """Return the whole numbers below `n` in random order."""
        return [int(i) for i in np.argsort(self.uniform(purpose, n), kind="stable")]
