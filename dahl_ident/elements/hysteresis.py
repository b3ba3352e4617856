r"""Dahl friction in the time domain: the exact force for any displacement history.

While the direction of motion s = sgn(xdot) is constant, Eqn. 2 reads dz/dd = -z^alpha, with the
margin to full slip z = 1 - s F/f_max and the path d = sigma |x - x_turn|/f_max since the last
turning point. At any speed, therefore,

    z(d) = z0 exp(-d)                                    alpha = 1
    z(d) = (z0^(1-alpha) - (1-alpha) d)^(1/(1-alpha))    otherwise; 0 if the bracket is not above 0

At a turning point z becomes 2 - z. So a history takes two steps: z at all turning points, one after
the other, then every sample from the turning point before it.
"""

from __future__ import annotations

from math import expm1, log1p

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.facts import HistoryGradient
from dahl_ident.elements.general_dahl import turning_force
from dahl_ident.elements.recursion import linear_recursion, stretches

_NO_MARGIN = 1e-300  # stands for a margin of 0, which has no negative power
_HUGE = 1e300  # longer than any path, and small enough to be scaled without overflow


def force_history(
    displacement: FloatArray, f_max: float, sigma: float, alpha: float, initial_force: float
) -> FloatArray:
    """Return the force at every sample of a displacement, which is monotone between them.

    Examples
    --------
    >>> force_history(np.array([0.0, 1.0, 1.0, 0.0]), 1.0, 1.0, 1.0, 0.0).round(6)
    array([ 0.      ,  0.632121,  0.632121, -0.399576])
    """
    if displacement.size < 2:
        return np.full(displacement.shape, initial_force)
    cut = stretches(displacement)
    legs, path = (_path(length, sigma / f_max) for length in (cut.length, cut.path))
    if alpha == 1.0:
        margin = 1.0 - cut.direction * _linear_turning_forces(
            initial_force / f_max, cut.direction, legs
        )
    else:
        margin = _turning_margins(1.0 - cut.direction[0] * initial_force / f_max, legs, alpha)
    start = cut.spread(margin)
    force = (1.0 - start) - _margin_change(start, path, alpha)
    force *= cut.spread(cut.direction * f_max)
    force[0] = initial_force
    return force


def linear_history_gradient(
    displacement: FloatArray, f_max: float, sigma: float, initial_force: float
) -> HistoryGradient:
    """Return the force for alpha = 1, with the derivatives with respect to f_max and sigma.

    While the direction s is constant, F = s f_max + (F0 - s f_max) exp(-d) with
    d = sigma path/f_max; the derivatives at the turning points follow a linear recursion.

    Examples
    --------
    >>> gradient = linear_history_gradient(np.array([0.0, 1.0]), 1.0, 1.0, 0.0)
    >>> [float(part[1].round(6)) for part in (gradient.by_state, *gradient.by_parameter)]
    [0.367879, 0.264241, 0.367879]
    """
    cut = stretches(displacement)
    legs, path = (_path(length, sigma / f_max) for length in (cut.length, cut.path))
    turning = f_max * _linear_turning_forces(initial_force / f_max, cut.direction, legs)

    def slopes(start: FloatArray, s: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        by_ln_d = (s * f_max - start) * d * np.exp(-d)
        return np.exp(-d), np.column_stack([-s * np.expm1(-d) - by_ln_d / f_max, by_ln_d / sigma])

    keep, terms = slopes(turning[:-1], cut.direction[:-1], legs)
    first = np.array([1.0, 0.0, 0.0])
    at_turns = linear_recursion(keep, np.column_stack([np.zeros(keep.size), terms]), first)
    start, s = cut.spread(turning), cut.spread(cut.direction)
    keep, terms = slopes(start, s, path)
    gradient = keep[:, None] * cut.spread(at_turns)
    gradient[:, 1:] += terms
    force = start + (start - s * f_max) * np.expm1(-path)
    return HistoryGradient(force, gradient[:, 0], tuple(gradient[:, 1:].T))


def transient_decay(beta: FloatArray, alpha: FloatArray | float) -> FloatArray:
    """Return the factor by which a deviation from the steady loop shrinks in one cycle.

    ((1 - f0)/(1 + f0))^(2 alpha), f0 the force at the turning point over f_max; exp(-4 beta)
    for alpha = 1.

    Examples
    --------
    >>> transient_decay(np.array([0.0, 0.02, 1.0]), 1.0).round(4)
    array([1.    , 0.9231, 0.0183])
    """
    if np.all(alpha == 1.0):
        return np.asarray(np.exp(-4.0 * beta))
    f0 = turning_force(beta, np.asarray(alpha))
    return np.asarray(((1.0 - f0) / (1.0 + f0)) ** (2.0 * alpha))


def _margin_change(margin: FloatArray, path: FloatArray, alpha: float) -> FloatArray:
    """Return z(d) - z(0), at most 0, after a path d in one direction."""
    if alpha == 1.0:
        return margin * np.expm1(-path)
    p = 1.0 - alpha
    fraction = np.maximum(np.abs(margin), _NO_MARGIN) ** -p
    with np.errstate(divide="ignore", over="ignore", under="ignore"):
        fraction *= p * path
        return np.asarray(margin * np.expm1(np.log1p(-np.minimum(fraction, 1.0)) / p))


def _path(length: FloatArray, rate: float) -> FloatArray:
    """Return the scaled path; where it would overflow, one that is as good as infinite."""
    with np.errstate(over="ignore"):
        return np.minimum(length * rate, _HUGE)


def _linear_turning_forces(start: float, heading: FloatArray, legs: FloatArray) -> FloatArray:
    """Return F/f_max at every turning point for alpha = 1."""
    terms = -heading[:-1] * np.expm1(-legs)
    return linear_recursion(np.exp(-legs), terms[:, None], np.array([start]))[:, 0]


def _turning_margins(start: float, legs: FloatArray, alpha: float) -> FloatArray:
    """Return the margin after every turning point for alpha other than 1."""
    p = 1.0 - alpha
    z = start
    margins = [z]
    for scaled in (p * legs).tolist():
        fraction = scaled * (abs(z) or _NO_MARGIN) ** -p  # a start may be beyond the limit
        z = 2.0 - (z + z * expm1(log1p(-fraction) / p)) if fraction < 1.0 else 2.0
        margins.append(z)
    return np.asarray(margins)
