r"""How well a model predicts tests that it was not fitted to: their log densities.

Deviations are relative to the fundamental of the same test. Their covariance is the stated one plus
a variance for fundamentals and one for harmonics, estimated from the residuals of the model; so
harmonics with a tiny covariance cannot dominate, and a larger misfit lowers the density. Each run
has an unknown gain and phase, whose variances are estimated as well. To first order in the
parameters, with X their columns and those of the runs, and D the errors' covariance,

    P = D^-1 - D^-1 X (X' D^-1 X + S^-1)^-1 X' D^-1,

and the test b deviates from its prediction by all others by P_bb^-1 (P y)_b, of covariance P_bb^-1
(Dubrule, Mathematical Geology 15 (1983) 687). A test is all rows of one level in one run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray, IntArray, interleaved
from dahl_ident.diagnostics.estimate import tests_of
from dahl_ident.diagnostics.mixed_model import MixedModel, MixedState
from dahl_ident.diagnostics.record_sources import blocks_of
from dahl_ident.diagnostics.residual_space import orthonormal
from dahl_ident.errors import FitError
from dahl_ident.fitting import Optimum
from dahl_ident.problem import RecordProblem

_RELATIVE_ROUNDING = 1e-5  # relative error that is rounding
_NO_RESIDUALS = 1e-12  # variance of residuals, over that expected, that is rounding
_RANK = 1e-7  # singular value of the derivatives, over the largest, that is rounding
_LEAST_LEFT = 1e-9  # least weight of a row that the others predict exactly
_LEAST_SHARED = 1e-6  # information on a direction outside a block, over all, that is negligible
_HEAVY = 4.0  # degrees of freedom of the density with a robust loss


@dataclass(frozen=True)
class PredictiveDensity:
    """Log densities of tests left out."""

    tests: FloatArray  # (T,): log density of each test
    run: IntArray  # (T,): the run of each
    # root mean square misfit of the fundamentals, and of all harmonics over the fundamental; NaN
    # without any
    misfit: float
    harmonic_misfit: float
    # of an average over all fundamentals; NaN for records
    noise: float = float("nan")

    @property
    def total(self) -> float:
        """The sum over the tests."""
        return float(self.tests.sum())

    def gain_over(self, other: PredictiveDensity) -> tuple[float, float]:
        """Return how much higher the density is than another's, and its standard error.

        The error is the larger of those from the scatter of tests and of runs.
        """
        gains = self.tests - other.tests
        of_runs = np.bincount(self.run, gains)
        errors = [
            np.sqrt(part.size) * float(part.std(ddof=1)) if part.size > 1 else 0.0
            for part in (gains, of_runs)
        ]
        return float(gains.sum()), max(errors)


def predictive_density(optimum: Optimum, fitted: Optimum | None = None) -> PredictiveDensity:
    """Return the log density of every test, predicted by the model fitted to the others.

    Residuals of records are weighted as in the optimum `fitted`, with which it is compared.
    """
    if optimum.problem.response is None:
        return _of_records(optimum, (fitted or optimum).problem)
    problem, data = optimum.problem, optimum.problem.data
    test, reference = tests_of(data)
    run = np.unique(np.zeros(data.n) if data.run is None else data.run, return_inverse=True)[1]
    size = np.abs(data.response)[reference]
    size = np.where(size > 0.0, size, size.max())
    predicted = problem.predict(optimum.theta)
    deviation = (data.response - predicted) / size
    if not np.isfinite(deviation).all():
        raise FitError("the search ended where the model has no finite response")
    fundamental = reference == np.arange(data.n)
    y = interleaved(deviation)
    J = problem.prediction_jacobian(optimum.theta) / size[:, None]
    known = np.isfinite(J).all(axis=0) & (np.abs(J) > 0.0).any(axis=0)
    X = orthonormal(interleaved(J[:, known].T).T, _RANK)
    scatter: list[FloatArray] = []
    if run.max() > 0:
        relative = predicted / size
        members = run == np.arange(run.max() + 1)[:, None]
        scatter = [interleaved(members * x).T for x in (relative, 1j * data.harmonic * relative)]
    stated, group = _stated_variances(optimum, size), np.repeat(~fundamental, 2).astype(np.intp)
    zero = np.repeat(data.harmonic == 0, 2) & (np.arange(y.size) % 2 == 1)  # of a mean
    kept = np.flatnonzero(~zero)
    _, group = np.unique(group[kept], return_inverse=True)
    groups, y, stated = int(group.max()) + 1, y[kept], stated[kept]
    excess = np.maximum(np.bincount(group, y**2 - stated) / np.bincount(group), 0.0)
    unit = np.sqrt(stated + excess[group] + _RELATIVE_ROUNDING**2)
    Z = [columns[kept] / unit[:, None] for columns in scatter]
    model = MixedModel(
        y / unit,
        orthonormal(X[kept] / unit[:, None]),
        Z,
        group,
        np.full(groups, _NO_RESIDUALS),
        groups,
        np.full(len(Z), np.inf),
    )
    state = model.reml(np.ones(len(Z)))
    tests = _densities(state, np.repeat(test, 2)[kept], unit, robust=optimum.loss != "linear")
    first = np.unique(test, return_index=True)[1]
    square, count = np.abs(deviation) ** 2, int(fundamental.sum()) or 1
    misfit = float(np.sqrt(square[fundamental].sum() / count)) if fundamental.any() else np.nan
    of_harmonics = float(np.sqrt(square[~fundamental].sum() / count))
    noise = misfit / float(np.sqrt(np.count_nonzero(data.harmonic == 1) or np.nan))
    return PredictiveDensity(
        tests, run[first], misfit, of_harmonics if not fundamental.all() else np.nan, noise
    )


def _of_records(optimum: Optimum, weighed: RecordProblem) -> PredictiveDensity:
    """Return the log density of blocks of records, with the weights of another problem.

    With these weights noise is white. A direction of the parameters that one block alone
    determines, such as a first state, costs one sample.
    """
    problem: RecordProblem = optimum.problem
    robust = optimum.loss != "linear"
    predicted = [problem.predict(optimum.values, i) for i in range(len(problem.records))]
    pairs = list(zip(problem.measured, predicted, strict=True))
    residuals = [weighed.filtered((y - p.output) / problem.output_std) for y, p in pairs]
    y, blocks = np.concatenate(residuals), blocks_of(residuals)
    Q = orthonormal(np.concatenate([weighed.filtered(p.by) for p in predicted]), _RANK)
    variance = float(y @ y) / max(y.size - Q.shape[1], 1) + _RELATIVE_ROUNDING**2
    first = np.cumsum([0, *(len(e) for e in residuals)])
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
    deviation = np.concatenate([y - p.output for y, p in pairs])
    share = float(np.sqrt(np.mean(deviation**2))) / problem.output_std
    run = np.array([problem.runs[record] for record, _ in blocks])
    return PredictiveDensity(tests, np.unique(run, return_inverse=True)[1], share, float("nan"))


def _log_density(squares: float, volume: float, size: int, *, robust: bool) -> float:
    """Return a normal log density, or Student's if `robust`, up to a constant."""
    if robust:
        squares = (_HEAVY + size) * float(np.log1p(squares / _HEAVY))
    return 0.5 * (volume - squares)


def _stated_variances(optimum: Optimum, size: FloatArray) -> FloatArray:
    """Return the stated relative variances of both parts, or zeros."""
    problem = optimum.problem
    covariance = problem.data.covariance
    if not problem.scale_known or covariance is None:
        return np.zeros(2 * problem.data.n)
    both = np.diagonal(covariance, axis1=1, axis2=2) / size[:, None] ** 2
    return np.asarray(both.ravel())


def _densities(state: MixedState, test: IntArray, unit: FloatArray, *, robust: bool) -> FloatArray:
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
