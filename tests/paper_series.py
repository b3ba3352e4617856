"""The Fourier coefficients of the linear Dahl model as the paper writes them, in mpmath.

Eqns. 33 to 36 and 50 of Helmick and Messner, *Describing Function Analysis of Dahl Model
Friction*, over f_max, with what is misprinted there set right: every term of Eqn. 33 carries a
factor pi, and the bracket of Eqn. 36 depends on n, so it stands inside the sum over n. The sums
are carried until nothing changes at the working precision; those for b_k cancel at small beta,
which asks for twice as many digits as beta is small.
"""

from __future__ import annotations

from typing import Any

import mpmath as mp


def gamma(beta: Any) -> Any:
    """Eqn. 17 over f_max; Psi/omega of Eqn. 39 is the same number."""
    return 2 / mp.pi * (1 + mp.tanh(beta)) * mp.exp(-beta)


def cosine_coefficient(beta: Any, k: int) -> Any:
    """a_k/f_max for odd k, Eqns. 33 to 36."""
    total, n = mp.mpf(0), 1
    while True:
        half = (n + 1) // 2
        term = mp.pi * beta**n * mp.fac2(n) / (mp.factorial(n) * 2**half * mp.factorial(half))
        total += term * _cosine_bracket(n, k)
        if n > k and term < mp.eps * abs(total):
            return gamma(beta) * total
        n += 2


def sine_coefficient(beta: Any, k: int) -> Any:
    """b_k/f_max for odd k, Eqn. 50."""
    total, n = mp.mpf(0), 0
    while True:
        term = beta**n / mp.factorial(n)
        total += term * _sine_bracket(n, k)
        if n > k and term < mp.eps * abs(total):
            break
        n += 2
    upsilon = -4 / (k * mp.pi)
    return upsilon + 2 * gamma(beta) * (-1) ** ((k - 1) // 2) * total


def _cosine_bracket(n: int, k: int) -> Any:
    """The parenthesis of Eqn. 36."""
    total = mp.mpf(1)
    for j in range(1, (k - 1) // 2 + 1):
        quotient = mp.fprod(n + 1 + 2 * j - 2 * m for m in range(j))
        total += (
            (-1) ** j * mp.fac2(2 * j - 1) / mp.factorial(2 * j) * _odd_product(j, k) / quotient
        )
    return total


def _sine_bracket(n: int, k: int) -> Any:
    """The bracket of Eqn. 50."""
    total = mp.mpf(1) / (n + 1)
    for j in range(1, (k - 1) // 2 + 1):
        total += (-1) ** j * _odd_product(j, k) / (mp.factorial(2 * j) * (2 * j + n + 1))
    return total


def _odd_product(j: int, k: int) -> Any:
    """(k^2 - 1^2)(k^2 - 3^2)...(k^2 - (2j - 1)^2)."""
    return mp.fprod(k**2 - (2 * m - 1) ** 2 for m in range(1, j + 1))
