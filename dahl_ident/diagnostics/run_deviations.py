r"""Residuals linearised where each run is: the deviations of runs may exceed what is linear.

A force limit that differs by 5 % from day to day bends the response by second-order terms of
0.1 %, more than a quiet sensor's noise. So run i has a deviation b_i of the parameters, gain and
phase that scatter, and its residuals are expanded there,

    y_i(theta) ~ r_i(theta + b_i) - (dr_i/db) b_i,

with b_i the best linear predictions of the last expansion. Source: Lindstrom and Bates, *Nonlinear
mixed effects models for repeated measures data*, Biometrics 46 (1990) 673.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.problem import Problem

_CLOSE = 1e-3  # of a deviation b: the expansion leaves out b times this, 1e-4 where b is 10 %


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

    @classmethod
    def none(cls, labels: NDArray[np.str_], parameters: int) -> RunDeviations:
        """Return those of runs that are all alike."""
        runs = np.unique(labels)
        return cls(runs, np.zeros((len(runs), parameters)), *np.zeros((2, len(runs))))

    def about(self, moved: FloatArray, columns: Sequence[int]) -> RunDeviations:
        """Return the same runs as deviations from a theta moved so far, in some of its columns."""
        return replace(self, theta=self.theta[:, columns] - moved)


def alike(one: RunDeviations | None, other: RunDeviations | None) -> bool:
    """Return whether the residuals' expansion about one holds for the other."""
    if one is None or other is None:
        return one is other
    first, second = (np.column_stack([r.theta, r.gain, r.phase]) for r in (one, other))
    return bool(np.abs(second - first).max() <= _CLOSE * np.abs(second).max())


@dataclass(frozen=True)
class Linearization:
    """Residuals (m,) of a problem's data, linearised at theta and the deviations of runs.

    Attributes
    ----------
    residuals : ndarray, shape (m,)
        Residuals of each run at its own parameters.
    y : ndarray, shape (m,)
        The same, taken linearly to theta.
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
    y: FloatArray
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
        return Linearization(y[:m], y[:m], J[:m], R, R, [(problem, every, theta)])
    residuals, y = np.zeros((2, m))
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
        moved = part.residual_change(there, predicted[rows] * deviation)
        residuals[both], y[both], J[both] = at, at - by @ shift - moved, by
        parts.append((part, rows, there))
    return Linearization(residuals, y, J, predicted, fitted, parts)
