"""Errors of the Dahl kernel for any exponent, against 50-digit integration over the phase.

The reference shares nothing with the kernel but Eqn. 2: z in closed form over the displacement,
the turning force by bisection, tanh-sinh quadrature of Eqns. 13 and 14 over ``theta = omega t``,
and derivatives by differences at a step of 1e-18. ``python -m benchmarks.general_dahl_accuracy``
prints the worst errors for each exponent; it takes some minutes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import mpmath as mp
import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.general_dahl import stiffness

DIGITS = 50
STEP = mp.mpf(10) ** -18


class Harmonic(NamedTuple):
    """c_k = (a_k - j b_k)/f_max with its derivatives by ln f_max (at fixed A), ln sigma, alpha.

    The first two are of ``f_max c_k``, over f_max; for k = 1 all are beta times those of N/sigma.
    """

    value: complex
    by_ln_f_max: complex
    by_ln_sigma: complex
    by_alpha: complex


def exact_harmonics(beta: float, alpha: float, harmonics: Sequence[int]) -> list[Harmonic]:
    """Return the odd harmonics of the steady loop with their derivatives."""
    with mp.workdps(DIGITS):
        b, a = mp.mpf(beta), mp.mpf(alpha)
        found = []
        for value, up, down, more, less in zip(
            _coefficients(b, a, harmonics),
            _coefficients(b * (1 + STEP), a, harmonics),
            _coefficients(b * (1 - STEP), a, harmonics),
            _coefficients(b, a + STEP, harmonics),
            _coefficients(b, a - STEP, harmonics),
            strict=True,
        ):
            by_ln_beta, by_alpha = (up - down) / (2 * STEP), (more - less) / (2 * STEP)
            exact = (value, value - by_ln_beta, by_ln_beta, by_alpha)
            found.append(Harmonic(*map(complex, exact)))
        return found


def kernel_harmonics(beta: float, alpha: float, harmonics: Sequence[int]) -> list[Harmonic]:
    """Return the same from the kernel."""
    b, a = np.asarray(beta), np.asarray(alpha)
    rows = [[beta * part for part in stiffness(b, a, k, 2)] for k in harmonics]
    return [Harmonic(*map(complex, row)) for row in rows]


def errors(beta: float, alpha: float, harmonics: Sequence[int]) -> FloatArray:
    """Return an array (harmonics, 4) of the kernel's errors in the fields of `Harmonic`.

    Those of values are relative to the larger of |a_k| and |b_k|, of derivatives to the modulus.
    """
    exact = np.array(exact_harmonics(beta, alpha, harmonics))
    scale = np.abs(exact)
    scale[:, 0] = np.maximum(np.abs(exact[:, 0].real), np.abs(exact[:, 0].imag))
    return np.asarray(np.abs(np.array(kernel_harmonics(beta, alpha, harmonics)) - exact) / scale)


def exact_turning_force(beta: mp.mpf, alpha: mp.mpf) -> mp.mpf:
    """Return f_0, where the path 2 beta takes z from 1 + f_0 to 1 - f_0."""
    p = 1 - alpha
    if p == 0:
        return mp.tanh(beta)
    if p > 0 and 2**p <= 2 * beta * p:
        return mp.mpf(1)

    def closes_late(y: mp.mpf) -> mp.mpf:  # f_0 = tanh(y)
        return mp.log(mp.sinh(p * y) / p) - p * mp.log(mp.cosh(y)) > mp.log(beta)

    low = high = beta
    while closes_late(low):
        low /= 2
    while not closes_late(high):
        high *= 2
    while high - low > high * mp.eps:
        middle = (low + high) / 2
        low, high = (low, middle) if closes_late(middle) else (middle, high)
    return mp.tanh(high)


def _coefficients(beta: mp.mpf, alpha: mp.mpf, harmonics: Sequence[int]) -> list[mp.mpc]:
    """Integrate the force over the half cycle of falling displacement."""
    p = 1 - alpha
    z_0 = 1 + exact_turning_force(beta, alpha)
    reach = z_0**p / p if p > 0 else mp.inf  # the path to full slip

    @cache
    def force(theta: mp.mpf) -> mp.mpf:
        path = 2 * beta * mp.sin(theta / 2) ** 2
        if path >= reach:
            return mp.mpf(-1)
        return z_0 * mp.exp(mp.log1p(-p * path * z_0**-p) / p if p else -path) - 1

    panels = _panels(beta, reach)
    return [
        2 / mp.pi * mp.quad(lambda theta, k=k: force(theta) * mp.expj(-k * theta), panels)
        for k in harmonics
    ]


def _panels(beta: mp.mpf, reach: mp.mpf) -> list[mp.mpf]:
    """Return panels that grow geometrically from both ends of the stretch that is not yet slip."""
    end = mp.pi if 2 * beta <= reach else 2 * mp.asin(mp.sqrt(reach / (2 * beta)))
    edges = [end / 2]
    while edges[-1] > end / 4 * min(1, 1 / mp.sqrt(beta)):
        edges.append(edges[-1] / 8)
    return sorted({mp.mpf(0), *edges, *(end - edge for edge in edges), end, mp.pi})


HARMONICS = (1, 3, 9, 15)
NEAR_ONE = (1 - 1e-4, 1 - 1e-8, 1 - 1e-12, 1.0, 1 + 1e-12, 1 + 1e-8, 1 + 1e-4)
EXPONENTS = (0.25, 0.3, 0.5, 0.8, *NEAR_ONE, 1.2, 1.5, 2.0, 3.0, 4.0)


def onset(alpha: float) -> float:
    """Return the amplitude from which friction slips fully in every half cycle."""
    return 2.0**-alpha / (1.0 - alpha) if alpha < 1.0 else np.inf


def amplitudes(alpha: float, rng: np.random.Generator) -> FloatArray:
    """Return beta at one random place in each decade, and about the onset of full slip."""
    beta = 10.0 ** (np.arange(-6, 6) + rng.random(12))
    near = onset(alpha) * (1.0 + np.array([-1e-2, -1e-5, -1e-9, 1e-9, 1e-5, 1e-2]))
    return np.concatenate([beta, near[near < 1e6]])


def main() -> None:
    """Print the worst errors over amplitudes from 1e-6 to 1e6, for each exponent."""
    rng = np.random.Generator(np.random.PCG64(0))
    print("| alpha | k | N, or c_k | by ln f_max | by ln sigma | by alpha |")
    print("|---|---|---|---|---|---|")
    for alpha in EXPONENTS:
        worst = np.max([errors(b, alpha, HARMONICS) for b in amplitudes(alpha, rng)], axis=0)
        print_rows(alpha, HARMONICS, worst)
    print("\nAt the onset of full slip itself, to the last place of beta\n")
    for alpha in (a for a in EXPONENTS if a < 0.9):
        print_rows(alpha, HARMONICS[:1], errors(onset(alpha), alpha, HARMONICS[:1]))


def print_rows(alpha: float, harmonics: Sequence[int], found: FloatArray) -> None:
    """Print the errors of each harmonic as a row of a Markdown table."""
    for k, row in zip(harmonics, found, strict=True):
        print(f"| {alpha!r} | {k} |", " | ".join(f"{e:.1e}" for e in row), "|", flush=True)


if __name__ == "__main__":
    main()
