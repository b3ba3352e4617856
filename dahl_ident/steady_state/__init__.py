"""The steady response of a plant to a sinusoidal force: displacement amplitude from drive.

Under a force u_0 cos(omega t) a plant with friction moves with a displacement amplitude A that is
not proportional to u_0, because its dynamic stiffness depends on A (Eqn. 53):

    A |Z(A, omega)| = u_0,    Z = L(omega) + N(A),    L = k - m omega^2 + j omega c + ...

N is the sum of the describing functions of the friction elements, L the dynamic stiffness of all
other elements.

- :func:`response` is for users: one plant with known parameters, checked arguments, every
  amplitude on request.
- :func:`solve` is for estimation: many parameter vectors at once, unchecked.
- :class:`Shooting` gives the exact motion, of which this balance of fundamentals is an
  approximation: it takes the displacement for a sine.

Where L is passive (Im L >= 0), A |Z| rises with A for any exponents, so the amplitude is unique.
Only an active linear part (negative damping) can have several amplitudes, or self-sustained
oscillation. An undamped resonance (L = 0) driven with 4 f_max/pi or more has no steady amplitude at
all.
"""

from __future__ import annotations

from dahl_ident.steady_state.forced import SteadyResponse, response
from dahl_ident.steady_state.roots import solve
from dahl_ident.steady_state.shooting import ACCURACY, STEADY, Shooting, Steady, obstacle

__all__ = [
    "ACCURACY",
    "STEADY",
    "Shooting",
    "Steady",
    "SteadyResponse",
    "obstacle",
    "response",
    "solve",
]
