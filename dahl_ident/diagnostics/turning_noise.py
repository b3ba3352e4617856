"""Errors of a measured displacement at its turning points, as the residuals show them.

A friction force goes on from where the motion turned. So an error of the displacement there stays
in the force for some x_c of path, where the parameters show most, while elsewhere it passes. White
noise is seen in the displacement itself; a correlated error, such as that of an encoder between its
lines, is hidden by the motion, but not in the residuals after each reversal.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.correlated_residuals import correlated, inverse_normal
from dahl_ident.elements.recursion import stretches
from dahl_ident.problem.record_problem import RecordProblem

_MOST = 40  # turning points of a record that are looked at
_STEP = 1e-5  # of the displacement's range, for slopes
_HIDDEN = 10.0  # times the noise in differences: a correlation of 0.98 leaves a tenth
_FORGOTTEN = 1e-3  # of a pattern's peak, below which the force has forgotten the turn

IntArray = NDArray[np.intp]


def noise_at_turns(
    problem: RecordProblem,
    values: FloatArray,
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    noise: Sequence[FloatArray],
) -> FloatArray:
    """Return the covariance (P, P) of an estimate by errors of displacements at turning points.

    Their variance is that by which the residuals exceed what their mean spectrum explains in the
    directions of such errors; as it cannot be negative, its mean over a normal distribution cut
    off at zero is taken. It is at most ten times what noise the displacement's differences show.
    """
    inverse = inverse_normal(jacobians)
    excess, strength, scatter = 0.0, 0.0, 0.0
    moved = np.zeros((values.size, values.size))
    for number, (J, e, covariance) in enumerate(zip(jacobians, residuals, noise, strict=True)):
        pattern, first, turns = _patterns(problem, values, number)
        if not first.size:
            continue
        sums = np.add.reduceat(pattern[:, None] * J[first[0] :], first - first[0])
        change = sums @ inverse  # of the estimate with each turn, (k, P)
        smooth = correlated(J, covariance)
        crossed = np.add.reduceat(pattern[:, None] * smooth[first[0] :], first - first[0])
        mixed = crossed @ change.T
        explained = _between(pattern, first - first[0], covariance)
        explained += change @ (J.T @ smooth) @ change.T - mixed - mixed.T
        seen = np.add.reduceat(pattern * e[first[0] :], first - first[0]) - change @ (J.T @ e)
        product = np.diag(np.add.reduceat(pattern**2, first - first[0])) - sums @ change.T
        excess += float((seen**2).sum() - explained.trace())
        strength += float((product**2).sum())
        scatter += 2.0 * float((explained**2).sum())
        moved += change.T @ change * (turns / first.size)
    if strength == 0.0 or scatter == 0.0:
        return moved * 0.0
    error = scatter**0.5
    a = excess / error
    positive = a + np.exp(-0.5 * a**2 - special.log_ndtr(a)) / np.sqrt(2.0 * np.pi)
    variance = min(positive * error / strength, (_HIDDEN * problem.estimated_noise) ** 2)
    return np.asarray(variance * moved)


def _patterns(
    problem: RecordProblem, values: FloatArray, number: int
) -> tuple[FloatArray, IntArray, int]:
    """Return derivatives of the force with respect to some turns, one after the other.

    All turns are moved at once; of these, so few that each is forgotten before the next. The
    derivatives begin at the first of them; with it the samples of the turns, and the number of all.
    """
    x, v, a = problem.motions[number]
    samples = stretches(x).samples
    turns = (np.cumsum(samples) - samples)[1:]
    chosen = turns[np.unique(np.linspace(0, turns.size - 1, min(_MOST, turns.size)).astype(int))]
    step, pattern = _STEP * float(np.ptp(x)), x[:0]
    while chosen.size:
        ends = []
        for sign in (1.0, -1.0):
            path = x.copy()
            path[chosen] += sign * step
            motions = list(problem.motions)
            motions[number] = path, v, a
            turned = problem.altered("latest", motions=tuple(motions))
            ends.append(turned.predict(values, number, derivatives=False).output[chosen[0] :])
        pattern = (ends[0] - ends[1]) / (2.0 * step)
        size = np.abs(pattern)
        last = np.abs(pattern[np.append(chosen[1:] - chosen[0], pattern.size) - 1])
        peaks = np.maximum.reduceat(size, chosen - chosen[0])
        if chosen.size == 1 or (last <= _FORGOTTEN * peaks)[:-1].all():
            break
        chosen = chosen[::2]
    return pattern, chosen, int(turns.size)


def _between(pattern: FloatArray, first: IntArray, covariance: FloatArray) -> FloatArray:
    """Return the covariances of the patterns' products with noise of such autocovariances."""
    ends = np.append(first[1:], pattern.size)
    size = np.abs(pattern)
    windows = []
    for start, end in zip(first.tolist(), ends.tolist(), strict=True):
        beyond = size[start:end] > _FORGOTTEN * size[start:end].max()
        windows.append(pattern[start : start + int(beyond.nonzero()[0].max(initial=0)) + 1])
    width = max(w.size for w in windows)
    m = fft.next_fast_len(2 * width, real=True)
    waves = np.array([fft.rfft(w, m) for w in windows])
    lags = np.arange(m)
    lags[lags > m // 2] -= m
    covariances = np.zeros((first.size, first.size))
    for apart in range(first.size):
        earlier = np.arange(first.size - apart)
        later = np.arange(apart, first.size)
        distance = np.abs((first[later] - first[earlier])[:, None] + lags)
        near = distance < covariance.size
        if not near.any():
            break
        crossed = fft.irfft(waves[earlier].conj() * waves[later], m)
        weights = np.where(near, covariance[np.minimum(distance, covariance.size - 1)], 0.0)
        covariances[earlier, later] = covariances[later, earlier] = (crossed * weights).sum(axis=1)
    return covariances
