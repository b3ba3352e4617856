"""Block means: a record with many samples a cycle needs no more than 256 of them.

The mean of m samples spaced evenly by the phase p is, of harmonic k in the middle of the block,

    D_k = sin(m k p/2) / (m sin(k p/2))

times as large, exactly. The sine fit takes its columns smaller by the same factor, so nothing is
biased; of white noise 0.2 % more reaches the ninth harmonic. What judges single samples (sensor
step, clipping, share of the power) looks at the samples themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.extraction.sine_fit import Segment

BLOCKS_PER_CYCLE = 256  # means lose 3e-5 of the fundamental, 0.2 % of the ninth harmonic
_EVEN = 0.05  # of a step, by which a sample may be off an even grid
_TOGETHER = 1 << 18  # samples: what is computed of them stays in the cache


@dataclass(frozen=True)
class Samples:
    """Waveforms of motion and force as they were recorded."""

    time: FloatArray
    motion: FloatArray
    force: FloatArray

    @property
    def step(self) -> float:
        """Mean time from one sample to the next, s."""
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    def block_size(self, highest_hz: float) -> int:
        """Return how many samples make a block; 1 where they are few a cycle, or uneven."""
        size = int(1.0 / (highest_hz * self.step * BLOCKS_PER_CYCLE))
        return size if size > 1 and self._even() else 1

    def _even(self) -> bool:
        step = self.step
        for start in range(0, self.time.size, _TOGETHER):
            part = self.time[start : start + _TOGETHER]
            grid = self.time[0] + step * np.arange(start, start + part.size)
            if np.abs(part - grid).max() > _EVEN * step:
                return False
        return True

    def means(self, size: int) -> tuple[FloatArray, FloatArray]:
        """Return time and channels (motion, force) as means of blocks; the last one may miss."""
        if size == 1:
            return self.time, np.stack([self.motion, self.force])
        count = self.time.size // size
        time, *channels = (
            v[: count * size].reshape(count, size).mean(axis=1)
            for v in (self.time, self.motion, self.force)
        )
        return time, np.stack(channels)

    def of(self, segment: Segment) -> Samples:
        """Return the samples that a segment's block means are made of."""
        reach = (0.5 * segment.block - 0.25) * self.step if segment.block > 1 else 0.0
        first = int(np.searchsorted(self.time, segment.time[0] - reach))
        last = int(np.searchsorted(self.time, segment.time[-1] + reach, side="right"))
        part = slice(first, last)
        return Samples(self.time[part], self.motion[part], self.force[part])

    def within_blocks(self, segment: Segment) -> FloatArray:
        """Return the variance of both channels that the means of a segment do not show."""
        if segment.block == 1:
            return np.zeros(2)
        own = self.of(segment)
        whole = np.array([np.var(own.motion), np.var(own.force)], dtype=np.float64)
        return np.asarray(whole - np.var(segment.channels, axis=1))
