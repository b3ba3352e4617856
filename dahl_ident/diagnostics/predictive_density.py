r"""How well a model predicts tests that it was not fitted to: the log density of each, left out.

Deviations count relative to the fundamental of the same test. Their errors are the stated
covariance and beyond it a variance each for fundamentals and for harmonics, estimated from what
this model leaves; so harmonics with a tiny covariance cannot dominate, and a larger misfit lowers
the density. Each run has an unknown gain and phase, with variances estimated as well. To first
order in the parameters, with X their columns and those of the runs, and D the errors' covariance,

    P = D^-1 - D^-1 X (X' D^-1 X + S^-1)^-1 X' D^-1,

and the test b, predicted from all others, misses by P_bb^-1 (P y)_b, of covariance P_bb^-1
(Dubrule, Mathematical Geology 15 (1983) 687). A test is all rows of one level in one run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.diagnostics.estimate import tests_of
from dahl_ident.diagnostics.mixed_model import MixedModel, MixedState
from dahl_ident.diagnostics.record_sources import blocks_of
from dahl_ident.diagnostics.residual_space import orthonormal
from dahl_ident.errors import FitError
from dahl_ident.fitting import Optimum
from dahl_ident.problem import RecordProblem

_EXACT = 1e-5  # relative errors that count as none
_ROUNDING = 1e-12  # variance of residuals that are rounding errors, over that stated or left
_RANK = 1e-7  # singular value of the derivatives, over the largest, that counts as none
_LEAST_LEFT = 1e-9  # of a row's weight, that the others do not determine
_LEAST_SHARED = 1e-6  # of a direction of the parameters outside a block, the same
_HEAVY = 4.0  # degrees of freedom of the density with a robust loss


@dataclass(frozen=True)
class PredictiveDensity:
    """Log densities of tests left out."""

    tests: FloatArray  # (T,): log density of each test
    run: NDArray[np.intp]  # (T,): the run of each
    # root mean square that the model leaves of the fundamentals, and of all harmonics over the
    # fundamental; NaN where there are none
    misfit: float
    harmonic_misfit: float
    # of an average over all fundamentals; NaN of records
    noise: float = float("nan")

    @property
    def total(self) -> float:
        """The sum over the tests."""
        return float(self.tests.sum())

    def gain_over(self, other: PredictiveDensity) -> tuple[float, float]:
        """Return how much higher the density is than another's, and its standard error.

        The error is the larger of those from the scatter of tests and of runs.
        """
        each = self.tests - other.tests
        sums = np.bincount(self.run, each)
        errors = [
            np.sqrt(part.size) * float(part.std(ddof=1)) if part.size > 1 else 0.0
            for part in (each, sums)
        ]
        return float(each.sum()), max(errors)


def predictive_density(optimum: Optimum, fitted: Optimum | None = None) -> PredictiveDensity:
    """Return the log density of every test, predicted by the model fitted to the others.

    The optimum it is compared with weighs the residuals of records for both.
    """
    if optimum.problem.response is None:
        return _of_records(optimum, (fitted or optimum).problem)
    problem, data = optimum.problem, optimum.problem.data
    test, owner = tests_of(data)
    run = np.unique(np.zeros(data.n) if data.run is None else data.run, return_inverse=True)[1]
    size = np.abs(data.response)[owner]
    size = np.where(size > 0.0, size, size.max())  # a row of nothing counts as the largest
    predicted = problem.predict(optimum.theta)
    missed = (data.response - predicted) / size
    if not np.isfinite(missed).all():
        raise FitError("the search ended where the model has no finite response")
    fundamental = owner == np.arange(data.n)
    y = _parts(missed)
    J = problem.prediction_jacobian(optimum.theta) / size[:, None]
    known = np.isfinite(J).all(axis=0) & (np.abs(J) > 0.0).any(axis=0)
    X = orthonormal(_parts(J[:, known].T).T, _RANK)
    scatter: list[FloatArray] = []
    if run.max() > 0:
        relative = predicted / size
        members = run == np.arange(run.max() + 1)[:, None]
        scatter = [_parts(members * x).T for x in (relative, 1j * data.harmonic * relative)]
    stated, group = _stated(optimum, size), np.repeat(~fundamental, 2).astype(np.intp)
    real = np.repeat(data.harmonic == 0, 2) & (np.arange(y.size) % 2 == 1)
    keep = np.flatnonzero(~real)
    _, group = np.unique(group[keep], return_inverse=True)
    groups, y, stated = int(group.max()) + 1, y[keep], stated[keep]
    beyond = np.maximum(np.bincount(group, y**2 - stated) / np.bincount(group), 0.0)
    unit = np.sqrt(stated + beyond[group] + _EXACT**2)
    Z = [one[keep] / unit[:, None] for one in scatter]
    model = MixedModel(
        y / unit, orthonormal(X[keep] / unit[:, None]), Z, group, np.full(groups, _ROUNDING),
        groups, np.full(len(Z), np.inf),
    )  # fmt: skip
    state = model.reml(np.ones(len(Z)))
    tests = _densities(state, np.repeat(test, 2)[keep], unit, robust=optimum.loss != "linear")
    first = np.unique(test, return_index=True)[1]
    square, count = np.abs(missed) ** 2, int(fundamental.sum()) or 1
    misfit = float(np.sqrt(square[fundamental].sum() / count)) if fundamental.any() else np.nan
    of_harmonics = float(np.sqrt(square[~fundamental].sum() / count))
    noise = misfit / float(np.sqrt(np.count_nonzero(data.harmonic == 1) or np.nan))
    return PredictiveDensity(
        tests, run[first], misfit, of_harmonics if not fundamental.all() else np.nan, noise
    )


def _of_records(optimum: Optimum, weighed: RecordProblem) -> PredictiveDensity:
    """Return the log density of blocks of records, residuals weighed as another problem does.

    Noise is white then. A direction of the parameters that one block alone determines, such as a
    first state, costs a sample.
    """
    problem: RecordProblem = optimum.problem
    robust = optimum.loss != "linear"
    predicted = [problem.predict(optimum.values, i) for i in range(len(problem.records))]
    pairs = list(zip(problem.measured, predicted, strict=True))
    left = [weighed.filtered((y - p.output) / problem.sizes[0]) for y, p in pairs]
    y, blocks = np.concatenate(left), blocks_of(left)
    Q = orthonormal(np.concatenate([weighed.filtered(p.by) for p in predicted]), _RANK)
    variance = float(y @ y) / max(y.size - Q.shape[1], 1) + _EXACT**2
    first = np.cumsum([0, *(len(e) for e in left)])
    tests = np.empty(len(blocks))
    for number, (record, rows) in enumerate(blocks):
        Q_block, e = Q[first[record] + rows], y[first[record] + rows]
        values, vectors = np.linalg.eigh(np.eye(Q.shape[1]) - Q_block.T @ Q_block)
        shared = values > _LEAST_SHARED
        part = vectors.T[shared] @ (Q_block.T @ e)
        squares = float(e @ e + np.sum(part**2 / values[shared])) / variance
        n = e.size - np.count_nonzero(~shared)
        volume = np.log(values[shared]).sum() - n * np.log(2.0 * np.pi * variance)
        tests[number] = _log_density(squares, float(volume), e.size, robust=robust)
    missed = np.concatenate([y - p.output for y, p in pairs])
    share = float(np.sqrt(np.mean(missed**2))) / problem.sizes[0]
    run = np.array([problem.runs[record] for record, _ in blocks])
    return PredictiveDensity(tests, np.unique(run, return_inverse=True)[1], share, float("nan"))


def _log_density(squares: float, volume: float, size: int, *, robust: bool) -> float:
    """Return a normal log density, or Student's where it is robust, up to a constant."""
    if robust:
        squares = (_HEAVY + size) * float(np.log1p(squares / _HEAVY))
    return 0.5 * (volume - squares)


def _parts(values: ComplexArray) -> FloatArray:
    return np.ascontiguousarray(values, dtype=np.complex128).view(np.float64)


def _stated(optimum: Optimum, size: FloatArray) -> FloatArray:
    """Return the stated variances of both parts, relative, or zero."""
    problem = optimum.problem
    covariance = problem.data.covariance
    if not problem.scale_known or covariance is None:
        return np.zeros(2 * problem.data.n)
    both = np.diagonal(covariance, axis1=1, axis2=2) / size[:, None] ** 2
    return np.asarray(both.ravel())


def _densities(
    state: MixedState, test: NDArray[np.intp], unit: FloatArray, *, robust: bool
) -> FloatArray:
    """Return the log density of each test, given all others."""
    densities = np.empty(int(test.max()) + 1)
    for number in range(len(densities)):
        rows = np.flatnonzero(test == number)
        values, vectors = np.linalg.eigh(state.block(rows))
        values = np.maximum(values, _LEAST_LEFT * state.weights[state.model.group[rows]].max())
        squares = float(np.sum((vectors.T @ state.weighted[rows]) ** 2 / values))
        volume = float(np.log(values).sum() - len(rows) * np.log(2.0 * np.pi))
        density = _log_density(squares, volume, len(rows), robust=robust)
        densities[number] = density - float(np.log(unit[rows]).sum())
    return densities
