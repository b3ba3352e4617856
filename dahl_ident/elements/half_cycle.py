"""Places on half a cycle x = A cos(theta), without sines: t = tan(theta/4), from 0 to 1.

Sine and cosine of theta are rational in t, so that integrals over t need no trigonometric function
at their nodes; its poles, at t = ±j, are far enough for Gauss points.
"""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray


def place(versed: FloatArray) -> FloatArray:
    """Return t where sin^2(theta/2) = (1 - cos theta)/2 has a value, at most 1."""
    versed = np.minimum(versed, 1.0)
    return np.asarray(np.sqrt(versed) / (1.0 + np.sqrt(1.0 - versed)))


def angles(t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return sin^2(theta/2), sin theta and dtheta/dt."""
    share = t * t
    share += 1.0
    np.divide(1.0, share, out=share)
    half = t * share
    half *= 2.0
    sine = 1.0 - t
    sine *= 1.0 + t
    sine *= share
    sine *= half
    sine *= 2.0
    half *= half
    share *= 4.0
    return half, sine, share


def multiple(versed: FloatArray, sine: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
    """Return cos(k theta) and sin(k theta) from sin^2(theta/2) and sin theta, for k >= 1."""
    cosine = 1.0 - 2.0 * versed
    real, imag = cosine, sine
    for _ in range(k - 1):
        real, imag = real * cosine - imag * sine, imag * cosine + real * sine
    return real, imag


def transform(weight: FloatArray, real: FloatArray, imag: FloatArray) -> ComplexArray:
    """Return the sum over nodes, the first axis, of weight times exp(-j k theta)."""
    return np.asarray(
        np.einsum("nr,nr->r", weight, real) - 1j * np.einsum("nr,nr->r", weight, imag)
    )
