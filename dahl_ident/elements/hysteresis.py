r"""Dahl friction in the time domain: the exact force for any displacement history.

Along a stretch of one direction of motion, s = sgn(xdot), Eqn. 2 in the margin to full slip
z = 1 - s F/f_max and the travelled path d = sigma |x - x_turn|/f_max is dz/dd = -z^alpha, so

    z(d) = z0 exp(-d)                                    alpha = 1
    z(d) = (z0^(1-alpha) - (1-alpha) d)^(1/(1-alpha))    otherwise; 0 once the bracket is

whatever the speed. Where the motion turns back, the margin becomes 2 - z. So a history is two
steps: carry z over the turning points, then evaluate every sample from the turning point before
it. Nothing is integrated numerically, and how densely a stretch is sampled does not matter.
"""

from __future__ import annotations

from math import expm1, log1p

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.general_dahl import turning_force
from dahl_ident.elements.recursion import linear_recursion, stretches

_TINY = 1e-300  # stands for a margin of 0, which has no negative power
_HUGE = 1e300  # a path beyond any reach, small enough to be scaled without overflow


def force_history(
    displacement: FloatArray, f_max: float, sigma: float, alpha: float, initial_force: float
) -> FloatArray:
    """Return the friction force at every sample of a displacement, unchecked.

    Parameters
    ----------
    displacement : ndarray, shape (n,)
        m; the motion between two samples is a straight line.
    f_max, sigma, alpha : float
        Parameters of Eqn. 2: N, N/m and a number above 0.
    initial_force : float
        Force at the first sample, N; at most `f_max` in size.

    Returns
    -------
    ndarray, shape (n,)
        N.

    Examples
    --------
    >>> force_history(np.array([0.0, 1.0, 1.0, 0.0]), 1.0, 1.0, 1.0, 0.0).round(6)
    array([ 0.      ,  0.632121,  0.632121, -0.399576])
    """
    if displacement.size < 2:
        return np.full(displacement.shape, initial_force)
    direction = _directions(displacement)
    turns = np.concatenate(([0], np.flatnonzero(direction[1:] != direction[:-1]) + 1))
    heading = direction[turns]
    x_turn = displacement[turns]
    with np.errstate(over="ignore"):
        rate = sigma / f_max
        legs = _path(x_turn[1:] - x_turn[:-1], rate)
        lengths = np.diff(turns, append=displacement.size)
        path = _path(displacement - np.repeat(x_turn, lengths), rate)
    scaled_start = initial_force / f_max
    if alpha == 1.0:
        margin = 1.0 - heading * _linear_turning_forces(scaled_start, heading, legs)
    else:
        margin = _general_turning_margins(1.0 - heading[0] * scaled_start, legs, alpha)
    start = np.repeat(margin, lengths)
    force = (1.0 - start) - margin_change(start, path, alpha)
    force *= np.repeat(heading * f_max, lengths)
    force[0] = initial_force
    return force


def linear_history_gradient(
    displacement: FloatArray, f_max: float, sigma: float, initial_force: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the force for alpha = 1, its derivative by the initial force and by f_max, sigma.

    Along a stretch F = s f_max + (F0 - s f_max) exp(-d) with d = sigma path/f_max; the derivatives
    at the turning points are a linear recursion.

    Parameters
    ----------
    displacement, f_max, sigma, initial_force
        As for :func:`force_history`.

    Returns
    -------
    force, by_initial_force : ndarray, shape (n,)
    by_parameters : ndarray, shape (n, 2)

    Examples
    --------
    >>> _, by_start, by = linear_history_gradient(np.array([0.0, 1.0]), 1.0, 1.0, 0.0)
    >>> by_start.round(6).tolist(), by[1].round(6).tolist()
    ([1.0, 0.367879], [0.264241, 0.367879])
    """
    legs = stretches(displacement)
    heading = legs.heading
    legs_scaled = _path(legs.length, sigma / f_max)
    path = _path(legs.path, sigma / f_max)
    turning = f_max * _linear_turning_forces(initial_force / f_max, heading, legs_scaled)

    def slopes(start: FloatArray, s: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        left = (s * f_max - start) * d * np.exp(-d)
        return np.exp(-d), np.column_stack([-s * np.expm1(-d) - left / f_max, left / sigma])

    keep, terms = slopes(turning[:-1], heading[:-1], legs_scaled)
    first = np.array([1.0, 0.0, 0.0])
    at_turns = linear_recursion(keep, np.column_stack([np.zeros(keep.size), terms]), first)
    start, s = legs.spread(turning), legs.spread(heading)
    keep, terms = slopes(start, s, path)
    gradient = keep[:, None] * legs.spread(at_turns)
    gradient[:, 1:] += terms
    force = start + (start - s * f_max) * np.expm1(-path)
    return force, gradient[:, 0], gradient[:, 1:]


def steady_force(
    theta: FloatArray, amplitude: float, f_max: float, sigma: float, alpha: float
) -> FloatArray:
    """Return the force on the closed loop of x = A cos(theta), unchecked.

    Parameters
    ----------
    theta : ndarray
        From 0 to 2 pi.
    amplitude : float
        A >= 0, m.
    f_max, sigma, alpha : float
        Parameters of Eqn. 2.

    Returns
    -------
    ndarray, shape of `theta`
        N; Eqns. 10 and 11 for alpha = 1.

    Examples
    --------
    >>> steady_force(np.linspace(0.0, 2.0 * np.pi, 5), 1.0, 1.0, 1.0, 1.0).round(6)
    array([ 0.761594, -0.351946, -0.761594,  0.351946,  0.761594])
    """
    beta = sigma * amplitude / f_max
    margin = np.full(theta.shape, 1.0 + float(turning_force(np.asarray(beta), np.asarray(alpha))))
    back = theta <= np.pi
    path = 2.0 * beta * np.where(back, np.sin(theta / 2.0), np.cos(theta / 2.0)) ** 2
    margin += margin_change(margin, path, alpha)
    return np.asarray(f_max * np.where(back, margin - 1.0, 1.0 - margin))


def transient_decay(beta: FloatArray, alpha: FloatArray | float) -> FloatArray:
    """Return the factor by which a deviation from the steady loop shrinks in one cycle.

    ((1 - f0)/(1 + f0))^(2 alpha), f0 the force at the turning point over f_max; exp(-4 beta)
    for alpha = 1. Settling takes cycles, not seconds, and the more of them the smaller beta.

    Parameters
    ----------
    beta : ndarray
        sigma A/f_max >= 0 (Eqn. 7).
    alpha : float or ndarray
        Exponent of Eqn. 2; broadcast with `beta`.

    Returns
    -------
    ndarray
        Between 0 and 1.

    Examples
    --------
    >>> transient_decay(np.array([0.0, 0.02, 1.0]), 1.0).round(4)
    array([1.    , 0.9231, 0.0183])
    """
    if np.all(alpha == 1.0):
        return np.asarray(np.exp(-4.0 * beta))
    f0 = turning_force(beta, np.asarray(alpha))
    return np.asarray(((1.0 - f0) / (1.0 + f0)) ** (2.0 * alpha))


def margin_change(margin: FloatArray, path: FloatArray, alpha: float) -> FloatArray:
    """Return z(d) - z(0), at most 0, after a path d = sigma |dx|/f_max in one direction."""
    if alpha == 1.0:
        return margin * np.expm1(-path)
    p = 1.0 - alpha
    used = np.maximum(np.abs(margin), _TINY) ** -p
    with np.errstate(divide="ignore", over="ignore", under="ignore"):
        used *= p * path
        return np.asarray(margin * np.expm1(np.log1p(-np.minimum(used, 1.0)) / p))


def _directions(displacement: FloatArray) -> FloatArray:
    """Return +1 or -1 for every step; a step of 0 goes on as the motion before or after it."""
    steps = np.sign(np.diff(displacement))
    moves = steps != 0.0
    if moves.all():
        return steps
    last_move = np.maximum.accumulate(np.where(moves, np.arange(steps.size), moves.argmax()))
    return np.where(steps[last_move] < 0.0, -1.0, 1.0)


def _path(steps: FloatArray, rate: float) -> FloatArray:
    """Return sigma |dx|/f_max, finite even where the product is not: full slip either way."""
    return np.minimum(np.abs(steps) * rate, _HUGE)


def _linear_turning_forces(start: float, heading: FloatArray, legs: FloatArray) -> FloatArray:
    """Return F/f_max at every turning point for alpha = 1.

    A leg is the affine map F -> F + c F + b with c = exp(-d) - 1, b = -s c. The maps of blocks
    of about sqrt(n) legs are composed side by side, then carried from block to block; c rather
    than exp(-d) is kept, since many short legs would lose their sum when added to 1.
    """
    n = legs.size
    size = max(1, int(np.sqrt(n)))
    blocks = -(-n // size)
    c = np.zeros((2, size * blocks))
    c[0, :n] = np.expm1(-legs)
    c[1, :n] = -heading[:-1] * c[0, :n]
    # a row holds the same place of every block, so that one composition is contiguous
    C, B = c.reshape(2, blocks, size).transpose(0, 2, 1).copy()
    for i in range(1, size):
        B[i] += B[i - 1] + C[i] * B[i - 1]
        C[i] += C[i - 1] + C[i] * C[i - 1]
    into = np.empty(blocks)
    force = start
    for j, (last_c, last_b) in enumerate(zip(C[-1].tolist(), B[-1].tolist(), strict=True)):
        into[j] = force
        force += last_c * force + last_b
    after = (into + (C * into + B)).T.ravel()
    return np.concatenate(([start], after[:n]))


def _general_turning_margins(start: float, legs: FloatArray, alpha: float) -> FloatArray:
    """Return the margin after every turn for alpha other than 1: one leg after the other."""
    p = 1.0 - alpha
    power = -p
    z = start
    margins = [z]
    append = margins.append
    for scaled in (p * legs).tolist():
        used = scaled * (abs(z) or _TINY) ** power  # a start may be beyond the limit
        z = 2.0 - (z + z * expm1(log1p(-used) / p)) if used < 1.0 else 2.0
        append(z)
    return np.asarray(margins)
