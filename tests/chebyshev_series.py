"""The Chebyshev coefficients of dahl_ident/elements/casadi_series.py, from 50-digit arithmetic.

``python -m tests.chebyshev_series > dahl_ident/elements/casadi_series.py`` writes them anew.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import mpmath as mp

LOW, HIGH = 1, 8
NODES = 80
SMALLEST = 1e-18  # coefficients below this, relative to the largest, change nothing

HEADER = '''"""Chebyshev coefficients of N/sigma at alpha = 1, printed by tests/chebyshev_series.

`LOW` and `HIGH` are where beta changes from one expansion to the next.
"""

from __future__ import annotations

'''


def stiffness_below(u: Any) -> Any:
    """Re h = 2 I_1(beta)/(beta cosh beta) for beta below LOW; 2 beta^2 - 1 = u."""
    beta = mp.sqrt((u + 1) / 2)
    return 2 * mp.besseli(1, beta) / (beta * mp.cosh(beta))


def loss_below(u: Any) -> Any:
    """Im h/beta = (4/pi) (1 - tanh(beta)/beta)/beta^2 for beta below LOW; 2 beta^2 - 1 = u."""
    beta = mp.sqrt((u + 1) / 2)
    return 4 / mp.pi * (1 - mp.tanh(beta) / beta) / beta**2


def bessel_between(u: Any) -> Any:
    """I_1(beta) exp(-beta)/beta for beta from LOW to HIGH, linear in u."""
    beta = LOW + (HIGH - LOW) * (u + 1) / 2
    return mp.besseli(1, beta) * mp.exp(-beta) / beta


def bessel_above(u: Any) -> Any:
    """I_1(beta) exp(-beta) sqrt(beta) for beta above HIGH; 2 HIGH/beta - 1 = u."""
    beta = 2 * HIGH / (u + 1)
    return mp.besseli(1, beta) * mp.exp(-beta) * mp.sqrt(beta)


SERIES: dict[str, Callable[[Any], Any]] = {
    "STIFFNESS_BELOW": stiffness_below,
    "LOSS_BELOW": loss_below,
    "BESSEL_BETWEEN": bessel_between,
    "BESSEL_ABOVE": bessel_above,
}


def coefficients(function: Callable[[Any], Any]) -> tuple[float, ...]:
    """Return the Chebyshev coefficients of `function` on [-1, 1] that matter to a double."""
    with mp.workdps(50):
        theta = [(j + mp.mpf(1) / 2) * mp.pi / NODES for j in range(NODES)]
        values = [function(mp.cos(t)) for t in theta]
        exact = [
            mp.fsum(v * mp.cos(k * t) for v, t in zip(values, theta, strict=True)) * 2 / NODES
            for k in range(NODES // 2)
        ]
    exact[0] /= 2
    rounded = [float(c) for c in exact]
    least = SMALLEST * max(map(abs, rounded))
    return tuple(rounded[: 1 + max(k for k, c in enumerate(rounded) if abs(c) > least)])


def module() -> str:
    """Return the text of dahl_ident/elements/casadi_series.py."""
    why = "of beta: no series then has more than 28 terms"
    lines = [f"LOW, HIGH = {LOW:.1f}, {HIGH:.1f}  # {why}\n"]
    for name, function in SERIES.items():
        terms = "".join(f"    {c!r},\n" for c in coefficients(function))
        lines.append(f'\n{name} = (\n{terms})\n"""{function.__doc__}"""\n')
    return HEADER + "".join(lines)


if __name__ == "__main__":
    sys.stdout.write(module())
