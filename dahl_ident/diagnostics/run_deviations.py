"""Residuals of each run at its own parameters.

A force limit that differs by 5 % from day to day bends the response by second-order terms of
0.1 %, more than a quiet sensor's noise: residuals within runs are those at the run's parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.problem import Problem


@dataclass(frozen=True)
class RunDeviations:
    """How each of R runs deviates from theta.

    Attributes
    ----------
    labels : ndarray of str, shape (R,)
        The runs.
    theta : ndarray, shape (R, Q)
        Added to the search coordinates.
    gain, phase : ndarray, shape (R,)
        Added to ln gain, and to the phase of the fundamental, rad.
    """

    labels: NDArray[np.str_]
    theta: FloatArray
    gain: FloatArray
    phase: FloatArray


@dataclass(frozen=True)
class Linearization:
    """Residuals (m,) of a problem's data, linearised at theta and the deviations of runs.

    Attributes
    ----------
    residuals : ndarray, shape (m,)
        Residuals of each run at its own parameters.
    J : ndarray, shape (m, Q)
        Their derivatives with respect to theta.
    predicted : ndarray of complex, shape (n,)
        Responses, each run's at its own parameters.
    fitted : ndarray of complex, shape (n,)
        The same with each run's gain and phase.
    parts : sequence of (Problem, ndarray, ndarray)
        Problems, the rows (n,) that are theirs, and the theta of each.
    """

    residuals: FloatArray
    J: FloatArray
    predicted: ComplexArray
    fitted: ComplexArray
    parts: Sequence[tuple[Problem, NDArray[np.bool_], FloatArray]]

    def change(self, changes: ComplexArray) -> FloatArray:
        """Return what changes (k, n) of the measured responses add to residuals, shape (k, m)."""
        found = np.zeros((len(changes), 2 * changes.shape[1]))
        for problem, rows, theta in self.parts:
            found[:, np.repeat(rows, 2)] = -problem.residual_change(theta, changes[:, rows])
        return found


def linearization(
    problem: Problem, theta: FloatArray, runs: RunDeviations | None = None
) -> Linearization:
    """Return residuals and derivatives at theta, without the rows of priors."""
    m = problem.n_residuals
    if runs is None:
        y, J = problem.residuals_and_jacobian(theta, tails=False)
        every = np.ones(m // 2, dtype=bool)
        R = problem.predict(theta)
        return Linearization(y[:m], J[:m], R, R, [(problem, every, theta)])
    residuals = np.zeros(m)
    J = np.zeros((m, len(theta)))
    predicted, fitted = np.zeros((2, m // 2), dtype=np.complex128)
    labels, parts = np.asarray(problem.data.run), []
    for label, shift, gain, phase in zip(
        runs.labels, runs.theta, runs.gain.tolist(), runs.phase.tolist(), strict=True
    ):
        rows = labels == label
        own = problem.data.select(rows=rows)
        deviation = gain + 1j * phase * own.harmonic
        own = replace(own, response=own.response * np.exp(-deviation))
        part = problem.like(data=own)
        there, both = theta + shift, np.repeat(rows, 2)
        at, by = part.residuals_and_jacobian(there, tails=False)
        at, by = at[: 2 * own.n], by[: 2 * own.n]
        predicted[rows] = part.predict(there)
        fitted[rows] = predicted[rows] * np.exp(deviation)
        residuals[both], J[both] = at, by
        parts.append((part, rows, there))
    return Linearization(residuals, J, predicted, fitted, parts)


def run_deviations(
    problem: Problem, theta: FloatArray, mean: FloatArray, effects: FloatArray,
    spread: FloatArray, noise: float,
) -> RunDeviations:  # fmt: skip
    """Return how runs deviate, where each run's residuals and deviations together are least.

    Parameters
    ----------
    problem : Problem
        Its data have runs.
    theta, mean : ndarray, shape (Q,)
        Where residuals are known, and how far the mean of the runs is from there.
    effects : ndarray, shape (R, Q + 2)
        Deviations of parameters, gain and phase from the mean, to start from.
    spread : ndarray, shape (Q + 2,)
        Their standard deviations between runs, 0 where none scatters.
    noise : float
        Standard deviation of the residuals.
    """
    labels, scatters = np.unique(np.asarray(problem.data.run)), spread > 0.0
    unit, b = spread[scatters], effects.copy()
    for last in (False, False, True):
        runs = RunDeviations(labels, mean + b[:, :-2], b[:, -2], b[:, -1])
        if last:
            break
        near = linearization(problem, theta, runs)
        for i, (_, rows, _) in enumerate(near.parts):
            both, share = np.repeat(rows, 2), near.predicted * rows
            turns = near.change(np.array([-share, -1j * problem.data.harmonic * share]))
            columns = np.hstack([near.J[both], turns[:, both].T])[:, scatters] * unit
            left = np.concatenate([near.residuals[both], noise * b[i, scatters] / unit])
            every = np.vstack([columns, noise * np.eye(len(unit))])
            b[i, scatters] -= unit * np.linalg.lstsq(every, left, rcond=None)[0]
    return runs
