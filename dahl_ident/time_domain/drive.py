"""A sampled drive between its samples: band-limited, as piecewise polynomials of degree 7."""

from __future__ import annotations

import numpy as np
from scipy import fft

from dahl_ident.arrays import FloatArray

_BAND = 0.8  # above this share of half the sampling rate a good extension has little


def band_limited(samples: FloatArray, interval: float, substeps: int) -> FloatArray:
    """Return polynomials of degree 7 between the points of a finer grid.

    The record is extended beyond its ends and resampled by Fourier transform with its first
    three derivatives; between grid points the polynomial has them all (Hermite). A record that
    ends where it began, such as whole periods of a multisine, is continued periodically; any
    other is mirrored at its ends. Whichever leaves less above the band is taken.

    Parameters
    ----------
    samples : ndarray, shape (n,)
        Drive at even intervals.
    interval : float
        Between samples, s.
    substeps : int
        Intervals of the finer grid in each of the samples' intervals.

    Returns
    -------
    ndarray, shape (8, n - 1, substeps)
        Coefficients of powers 0 to 7 of the place, 0 to 1, in each fine interval.

    Examples
    --------
    >>> t = np.arange(32) / 32.0
    >>> c = band_limited(np.sin(2.0 * np.pi * t), 1.0 / 32.0, 2)
    >>> bool(abs(c[0, 4, 1] - np.sin(2.0 * np.pi * 4.5 / 32.0)) < 1e-12)
    True
    """
    n = samples.size
    line = np.linspace(samples[0], samples[-1], n)
    rest = samples - line
    candidates = [
        (samples, samples[:0]),
        (np.concatenate([rest, -rest[-2:0:-1]]), line),
    ]
    spectra = [fft.rfft(wave) for wave, _ in candidates]
    beyond = [
        float(np.sum(np.abs(s[int(_BAND * s.size) :]) ** 2)) / wave.size**2
        for s, (wave, _) in zip(spectra, candidates, strict=True)
    ]
    periodic = beyond[0] <= beyond[1]
    spectrum, (wave, _) = (spectra[0], candidates[0]) if periodic else (spectra[1], candidates[1])
    m, fine = wave.size, interval / substeps
    omega = 2.0 * np.pi * np.arange(spectrum.size) / (m * fine * substeps)
    padded = np.zeros(m * substeps // 2 + 1, dtype=np.complex128)
    if m % 2 == 0 and substeps > 1:
        spectrum = spectrum.copy()
        spectrum[-1] *= 0.5
    count = (n - 1) * substeps + 1
    derivatives = []
    for order in range(4):
        padded[: spectrum.size] = spectrum * (1j * omega) ** order * substeps
        derivatives.append(fft.irfft(padded, m * substeps)[:count])
    if not periodic:
        derivatives[0] = derivatives[0] + np.linspace(samples[0], samples[-1], count)
        derivatives[1] = derivatives[1] + (samples[-1] - samples[0]) / ((n - 1) * interval)
    ends = np.array([fine**k * d for k, d in enumerate(derivatives)])
    both = np.vstack([ends[:, :-1], ends[:, 1:]])
    return np.asarray(_HERMITE @ both).reshape(8, n - 1, substeps)


def _hermite() -> FloatArray:
    """Return the matrix from three derivatives at 0 and at 1 to a polynomial's coefficients."""
    powers = np.arange(8)
    rows, factor = [], np.ones(8)
    for order in range(4):
        rows.append(factor * (powers == order))
        rows.append(factor.copy())
        factor = factor * (powers - order)
    return np.asarray(np.linalg.inv(np.array(rows[::2] + rows[1::2])))


_HERMITE = _hermite()
