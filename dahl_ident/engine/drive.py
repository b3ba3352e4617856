"""Band-limited interpolation of a sampled drive, by piecewise polynomials of degree 9."""

from __future__ import annotations

import numpy as np
from scipy import fft

from dahl_ident.arrays import FloatArray

_DERIVATIVES = 4  # of a sine with five samples a period the polynomials miss 1e-9
_SMOOTH = 0.8  # fraction of half the sampling rate above which a smooth extension has little power


def band_limited(samples: FloatArray, interval: float) -> FloatArray:
    """Return polynomials of degree 9 between samples.

    The record is extended beyond its ends and differentiated four times by Fourier transform; each
    polynomial has the derivatives of both its ends (Hermite). The extension is periodic, as for
    whole periods of a multisine, or mirrored at the ends, whichever leaves less power above the
    band.

    Examples
    --------
    >>> t = np.arange(32) / 32.0
    >>> c = band_limited(np.sin(2.0 * np.pi * t), 1.0 / 32.0)
    >>> bool(abs(np.polyval(c[::-1, 4], 0.5) - np.sin(2.0 * np.pi * 4.5 / 32.0)) < 1e-8)
    True
    """
    n = samples.size
    line = np.linspace(samples[0], samples[-1], n)
    deviation = samples - line
    extensions = [samples, np.concatenate([deviation, -deviation[-2:0:-1]])]
    spectra = [fft.rfft(wave) for wave in extensions]
    beyond_band = [
        float(np.sum(np.abs(spectrum[int(_SMOOTH * spectrum.size) :]) ** 2)) / wave.size**2
        for spectrum, wave in zip(spectra, extensions, strict=True)
    ]
    periodic = beyond_band[0] <= beyond_band[1]
    choice = 0 if periodic else 1
    spectrum, m = spectra[choice], extensions[choice].size
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
