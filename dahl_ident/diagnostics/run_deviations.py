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
    """How each of R runs deviates from theta."""

    labels: NDArray[np.str_]  # (R,): the runs
    theta: FloatArray  # (R, Q): added to the search coordinates
    gain: FloatArray  # (R,): added to ln gain, and to the phase of the fundamental, rad
    phase: FloatArray


@dataclass(frozen=True)
class Linearization:
    """Residuals (m,) of a problem's data, linearised at theta and the deviations of runs."""

    residuals: FloatArray  # (m,): residuals of each run at its own parameters
    J: FloatArray  # (m, Q): their derivatives with respect to theta
    predicted: ComplexArray  # (n,): responses, each run's at its own parameters
    fitted: ComplexArray  # (n,): the same with each run's gain and phase
    # problems, the rows (n,) that are theirs, and the theta of each
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
    """Return how runs deviate, where each run's residuals and deviations together are least."""
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
