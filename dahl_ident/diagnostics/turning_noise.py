"""Errors of a measured displacement at its turning points, as the residuals show them.

A friction force goes on from where the motion turned. So an error of the displacement there stays
in the force for some x_c of path, where the parameters show most, while elsewhere it passes. White
noise is seen in the displacement itself; a correlated error, such as that of an encoder between its
lines, is hidden by the motion, but not in the residuals after each reversal.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np
from scipy import fft, special

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.correlated_residuals import autoregression, spectrum_of
from dahl_ident.elements.recursion import stretches
from dahl_ident.problem.record_problem import RecordProblem

_MOST = 40  # turning points of a record that are looked at
_STEP = 1e-5  # of the displacement's range, for slopes
_HIDDEN = 10.0  # times the noise in differences: a correlation of 0.98 leaves a tenth


def noise_at_turns(
    problem: RecordProblem,
    values: FloatArray,
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
) -> FloatArray:
    """Return the covariance of an estimate by errors of the displacement at its turning points.

    Their variance is that by which the residuals exceed what their mean spectrum explains in the
    directions of such errors; as it cannot be negative, its mean over a normal distribution cut
    off at zero is taken. It is at most ten times what noise the displacement's differences show.

    Parameters
    ----------
    problem : RecordProblem
        With forces as its output.
    values : ndarray, shape (P,)
        The estimate.
    jacobians, residuals : sequence of ndarray
        Derivatives of the prediction and measured minus predicted, of each record.

    Returns
    -------
    ndarray, shape (P, P)
    """
    size = np.sqrt(sum((J**2).sum(axis=0) for J in jacobians))
    size = np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv(sum((J / size).T @ (J / size) for J in jacobians), hermitian=True)
    excess, strength, scatter = 0.0, 0.0, 0.0
    moved = np.zeros((values.size, values.size))
    for number, (J, e) in enumerate(zip(jacobians, residuals, strict=True)):
        left, turns = _patterns(problem, values, number)
        change = inverse @ ((left @ J) / size).T
        left -= (change.T / size) @ J.T
        m = fft.next_fast_len(2 * e.size, real=True)
        spectrum = spectrum_of(autoregression(e, J[:, (J != 0.0).any(axis=0)]), m)
        explained = np.empty((len(left), len(left)))
        for i, row in enumerate(left):  # one at a time: all transforms would fill the memory
            explained[i] = left @ fft.irfft(fft.rfft(row, m) * spectrum, m)[: e.size]
        excess += float(((left @ e) ** 2).sum() - explained.trace())
        strength += float(((left @ left.T) ** 2).sum())
        scatter += 2.0 * float((explained**2).sum())
        moved += change @ change.T * (turns / max(len(left), 1))
    if strength == 0.0 or scatter == 0.0:
        return moved * 0.0
    error = scatter**0.5
    a = excess / error
    positive = a + np.exp(-0.5 * a**2 - special.log_ndtr(a)) / np.sqrt(2.0 * np.pi)
    variance = min(positive * error / strength, (_HIDDEN * problem.estimated_noise) ** 2)
    return np.asarray(variance * moved / np.outer(size, size))


def _patterns(problem: RecordProblem, values: FloatArray, number: int) -> tuple[FloatArray, int]:
    """Return derivatives of the force with respect to k turns, (k, n), and the number of turns."""
    x, v, a = problem.motions[number]
    samples = stretches(x).samples
    turns = (np.cumsum(samples) - samples)[1:]
    chosen = turns[np.unique(np.linspace(0, turns.size - 1, min(_MOST, turns.size)).astype(int))]
    step = _STEP * float(np.ptp(x))
    other, found = copy(problem), np.empty((chosen.size, x.size))
    for i, turn in enumerate(chosen):
        ends = []
        for sign in (1.0, -1.0):
            path = x.copy()
            path[turn] += sign * step
            motions = list(problem.motions)
            motions[number] = path, v, a
            other.motions = tuple(motions)
            ends.append(other.predict(values, number, derivatives=False).output)
        np.subtract(ends[0], ends[1], out=found[i])
        found[i] /= 2.0 * step
    return found, int(turns.size)
