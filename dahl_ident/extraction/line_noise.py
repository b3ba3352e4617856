"""Noise of the phasors, from what does not repeat from cycle to cycle.

Over P whole cycles whatever repeats falls on the harmonics. What lies on the lines between them, at
``f = (k + m/P) f_0``, is noise, seen at the frequency where it counts. With Z_i the two channels'
content of the lines, the cross-spectral matrix at the harmonic is

    C = sum_i f_i Z_i Z_i^H / sum_i f_i

The lines lie evenly about the harmonic, so the expectation is right for every noise spectrum
``a + b/f``. With P >= 4, lines within half a harmonic are taken, else all up to the next harmonics.
The noise is taken as circular: n lines of equal weight give 2 n degrees of freedom. The noise of
the mean (k = 0) is that of the lowest lines, white from there down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.extraction.sine_fit import SineFit

CYCLES_FOR_SCATTER = 4  # with fewer, lines next to the harmonic are few and far
_MOST_LINES = 10  # a side: about 40 degrees of freedom, beyond which a region hardly shrinks
_MEAN_LINES = 4  # the lowest ones, from which the noise of the mean is judged
_INDEPENDENT = 0.05  # of the largest eigenvalue: lines that gaps make alike are left out
_BLOCK = 16384  # samples whose columns stay in the cache, as in the sine fit
_BLOCKS_PER_CYCLE = 128  # slow noise loses 1 % on the line of the ninth harmonic


@dataclass(frozen=True)
class LineNoise:
    """Noise next to one harmonic: `lines`, (2, lines), whose products sum to a sample's errors."""

    lines: ComplexArray
    dof: float

    @property
    def matrix(self) -> ComplexArray:
        """``E[e e^H]`` of a sample's errors (motion, force), Hermitian."""
        return self.lines @ self.lines.conj().T


def line_noise(
    fit: SineFit, harmonics: Sequence[int], cycles: int, residual: FloatArray
) -> list[LineNoise]:
    """Return the noise next to each harmonic of a fit over two or more whole cycles."""
    reach = cycles // 2 if cycles >= CYCLES_FOR_SCATTER else cycles - 1
    side = min(reach, _MOST_LINES)
    content, window = _line_content(fit, harmonics, cycles, side, residual)
    lines = np.concatenate([np.arange(-side, 0), np.arange(1, side + 1)])
    half, free = _orthogonal(window, lines)
    noise = []
    for harmonic, sums in zip(harmonics, content, strict=True):
        frequency = harmonic + lines / cycles
        if harmonic:
            weights, sides = frequency, 1
        else:
            weights, sides = (np.abs(lines) <= _MEAN_LINES).astype(np.float64), 2
        weights = weights / (weights @ free)
        # a straight line, which the fit removes, holds 6/(pi p)^2 of the sine with p periods in the
        # record and nothing of the cosine; its part in the harmonics, about 1/P^2, is theirs
        drift = 3.0 / (np.pi * frequency * cycles) ** 2 / (1.0 - 1.0 / cycles**2)
        weighted = np.sqrt(weights / (1.0 - drift)) * (sums @ half.T)
        noise.append(LineNoise(weighted, 2.0 / sides / float(weights**2 @ free)))
    return noise


def _line_content(
    fit: SineFit, harmonics: Sequence[int], cycles: int, side: int, residual: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return ``sum r exp(-j (k + m/P) theta)`` and the window's own ``sum exp(-j q theta/P)``."""
    theta, residual, counts = _block_sums(fit.segment.theta, residual)
    products = np.zeros((2, len(harmonics), 2, 2, side))
    window = np.zeros(2 * side + 1, dtype=np.complex128)
    for start in range(0, theta.size, _BLOCK):
        part = slice(start, start + _BLOCK)
        tones = powers(np.exp(-1j / cycles * theta[part]), side)
        window[: side + 1] += tones @ counts[part]
        window[side + 1 :] += tones[1:] @ (counts[part] * tones[side])
        turned = powers(np.exp(-1j * theta[part]), max(harmonics))[list(harmonics), None]
        turned = turned * residual[:, part]
        left = np.stack([turned.real, turned.imag])
        right = np.concatenate([tones[1:].real, tones[1:].imag])
        products += np.tensordot(left, right, axes=(-1, -1)).reshape(products.shape)
    (re_re, re_im), (im_re, im_im) = np.moveaxis(products, 3, 1)
    above = re_re - im_im + 1j * (re_im + im_re)
    below = re_re + im_im + 1j * (im_re - re_im)
    return np.concatenate([below[..., ::-1], above], axis=-1), window


def _block_sums(
    theta: FloatArray, residual: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return phases, sums of the residual and numbers of samples, about 128 blocks a cycle."""
    block = np.floor((theta - theta[0]) * (_BLOCKS_PER_CYCLE / (2.0 * np.pi)))
    starts = np.flatnonzero(np.diff(block, prepend=-1.0))
    if 2 * starts.size > theta.size:
        return theta, residual, np.ones(theta.size)
    counts = np.diff(starts, append=theta.size).astype(np.float64)
    middle = np.add.reduceat(theta, starts) / counts
    return middle, np.add.reduceat(residual, starts, axis=1), counts


def powers(rotor: ComplexArray, highest: int) -> ComplexArray:
    """Return the powers 0 to `highest`, one a row."""
    powers = np.ones((highest + 1, rotor.size), dtype=np.complex128)
    for k in range(1, highest + 1):
        np.multiply(powers[k - 1], rotor, out=powers[k])
    return powers


def _orthogonal(window: ComplexArray, lines: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Return the matrix that gives each line the variance of a sample, and how free each is."""
    apart = lines[:, None] - lines
    gram = np.where(apart >= 0, window[np.abs(apart)], window[np.abs(apart)].conj())
    onto = np.where(lines >= 0, window[np.abs(lines)], window[np.abs(lines)].conj())
    gram -= np.outer(onto, onto.conj()) / window[0]
    values, vectors = np.linalg.eigh(gram)
    kept = vectors[:, values > _INDEPENDENT * values[-1]]
    half = (kept / np.sqrt(values[-kept.shape[1] :])) @ kept.conj().T
    return half, np.sum(np.abs(kept) ** 2, axis=1)
