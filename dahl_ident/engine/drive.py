"""A sampled drive between its samples: band-limited, as piecewise polynomials of degree 9."""

from __future__ import annotations

import numpy as np
from scipy import fft

from dahl_ident.arrays import FloatArray

_DERIVATIVES = 4  # at five samples a period, the polynomials between miss 1e-9 of a sine
_BAND = 0.8  # above this share of half the sampling rate a good extension has little


def band_limited(samples: FloatArray, interval: float) -> FloatArray:
    """Return polynomials of degree 9 between samples.

    The record is extended beyond its ends and differentiated four times by Fourier transform;
    between samples the polynomial has all derivatives (Hermite). A record that
    ends where it began, such as whole periods of a multisine, is continued periodically; any
    other is mirrored at its ends. Whichever leaves less above the band is taken.

    Examples
    --------
    >>> t = np.arange(32) / 32.0
    >>> c = band_limited(np.sin(2.0 * np.pi * t), 1.0 / 32.0)
    >>> bool(abs(np.polyval(c[::-1, 4], 0.5) - np.sin(2.0 * np.pi * 4.5 / 32.0)) < 1e-8)
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
    m = wave.size
    omega = 2.0 * np.pi * np.arange(spectrum.size) / (m * interval)
    derivatives = [
        fft.irfft(spectrum * (1j * omega) ** order, m)[:n] for order in range(_DERIVATIVES + 1)
    ]
    if not periodic:
        derivatives[0] = derivatives[0] + line
        derivatives[1] = derivatives[1] + (samples[-1] - samples[0]) / ((n - 1) * interval)
    ends = np.array([interval**k * d for k, d in enumerate(derivatives)])
    return np.asarray(_HERMITE @ np.vstack([ends[:, :-1], ends[:, 1:]]))


def _hermite() -> FloatArray:
    """Return the matrix from derivatives at 0 and at 1 to a polynomial's coefficients."""
    count = 2 * (_DERIVATIVES + 1)
    powers, rows, factor = np.arange(count), [], np.ones(count)
    for order in range(_DERIVATIVES + 1):
        rows.append(factor * (powers == order))
        rows.append(factor.copy())
        factor = factor * (powers - order)
    return np.asarray(np.linalg.inv(np.array(rows[::2] + rows[1::2])))


_HERMITE = _hermite()
