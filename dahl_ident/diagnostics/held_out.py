r"""Tests that are left out one at a time, and predicted from all others: bands, log densities.

The parameters are estimated again without each test, and with residuals and derivatives at that
estimate the linear mixed model of :mod:`dahl_ident.diagnostics.error_model` predicts the rows b of
the test from all others. Their deviations from the prediction are

    e_b = (P_bb)^-1 (P y)_b,    with the covariance (P_bb)^-1,

P as in :mod:`dahl_ident.diagnostics.mixed_model`. The variances s_k are estimates from all tests,
and with D = (P_bb)^-1 the covariance moves by dD/ds_k = D (P V_k P)_bb D, which gives its degrees
of freedom. Source: Dubrule, *Cross validation of kriging in a unique neighborhood*, Mathematical
Geology 15 (1983) 687.

The deviations of tests from their predictions also predict the deviation of the next one, whatever
the distribution of their errors. With Student's t as the prior, with the weight of c scores, the
distribution of the next score is that of a Dirichlet process,

    P(score > z) = (c P(|t| > z) + number of scores > z)/(c + their number),

which is t with few scores and the observed distribution with many. Source: Ferguson, *A Bayesian
analysis of some nonparametric problems*, Annals of Statistics 1 (1973) 209.

Bands are checked in the same way: the width of each follows from the scores of the other tests, but
the variances are those of all tests.

Models are compared by the log densities of such tests.
Deviations are relative to the fundamental of the same test. Their covariance is the stated one plus
a variance for fundamentals and one for harmonics, estimated from the residuals of the model; so
harmonics with a tiny covariance cannot dominate, and a larger misfit lowers the density. Each run
has an unknown gain and phase, whose variances are estimated as well. The same
equations, to first order in the parameters, predict each test, which is all rows of one level in
one run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from dahl_ident.arrays import FloatArray, IntArray, interleaved
from dahl_ident.diagnostics.confidence_levels import CONFIDENCE
from dahl_ident.diagnostics.contributions import satterthwaite
from dahl_ident.diagnostics.error_sources import FEWEST_TESTS, rows_of_tests
from dahl_ident.diagnostics.estimate import WeightedEstimate, tests_of
from dahl_ident.diagnostics.judgement import Finding, VerdictStatus, described
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
_MOST_TESTS = 100  # tests left out: the share inside is then known to 2 %
_PRIOR_SCORES = 10.0  # weight c of Student's t
_NORMAL = 1e12  # degrees of freedom beyond which Student's t is the normal distribution
_UNPREDICTED = 1e6  # standard deviation of ln gain or phase above which there is no prediction


@dataclass(frozen=True)
class HeldOut:
    """Fundamentals of tests left out, predicted from the others; ln gain and phase, (r, 2)."""

    rows: IntArray  # (r,): indices in the data
    test: IntArray  # (r,): number of each row's test
    # (r, 2): deviations from the predictions, their standard deviations, and the degrees of freedom
    # of these; NaN without a prediction
    deviation: FloatArray
    std: FloatArray
    dof: FloatArray
    available: int  # number of tests; of very many, evenly chosen ones were left out

    @property
    def scores(self) -> FloatArray:
        """Deviations over their standard deviations, shape (r, 2)."""
        return np.asarray(np.abs(self.deviation) / self.std)


def band_factor(scores: FloatArray, dof: FloatArray, level: float) -> FloatArray:
    """Return the half width of a band over the standard deviation of a test.

    It is that of Student's t, or larger if tests that were left out deviate more.

    Examples
    --------
    >>> of_two = np.array([4.0, 5.0, *np.linspace(0.1, 1.9, 16)])
    >>> band_factor(of_two[2:], np.array([30.0]), 0.95).round(2).tolist()
    [2.04]
    >>> band_factor(of_two, np.array([30.0]), 0.95).round(2).tolist()
    [4.0]
    """
    upper, nu = 0.5 * (1.0 + level), np.minimum(dof, _NORMAL)
    least = special.stdtrit(nu, upper)
    falling = np.sort(scores[np.isfinite(scores)])[::-1]
    outside = (1.0 - level) * (_PRIOR_SCORES + falling.size)
    larger = np.arange(min(int(outside), falling.size) + 1)  # number of scores outside
    by_prior = np.minimum((outside - larger) / _PRIOR_SCORES, 1.0)
    t = special.stdtrit(np.expand_dims(nu, -1), 1.0 - 0.5 * by_prior)
    best = np.maximum(t, np.append(falling, 0.0)[larger])[..., by_prior > 0.0].min(axis=-1)
    return np.asarray(np.maximum(least, best))


def held_out(estimate: WeightedEstimate, state: MixedState) -> HeldOut | None:
    """Return the tests left out in turn; None with fewer than three."""
    data = estimate.problem.data
    tests = rows_of_tests(data)
    if len(tests) < FEWEST_TESTS:
        return None
    first = (data.harmonic == 1) | (data.harmonic != 1).all()
    chosen = np.linspace(0, len(tests) - 1, min(len(tests), _MOST_TESTS)).round().astype(int)
    W = state.variances_covariance
    of_tests = []
    for number, rows in enumerate(tests[i] for i in chosen):
        index = (2 * rows[:, None] + np.arange(2)).ravel()
        refit = estimate.without(index)
        try:
            others = state.model.with_residuals(refit.y, refit.columns).at(state.variances)
            D = np.linalg.inv(others.block(index))
        except np.linalg.LinAlgError:
            continue
        to_gain_and_phase, r = estimate.relative_units[rows], np.arange(len(rows))
        blocks = np.concatenate([D[None], D @ others.block_slopes(index) @ D]).reshape(
            -1, len(r), 2, len(r), 2
        )
        by_source = np.einsum(
            "rai,rkij,raj->kra", to_gain_and_phase, blocks[:, r, :, r], to_gain_and_phase
        )
        predicted = refit.y[index] - D @ others.weighted[index]
        deviations = to_gain_and_phase @ (refit.residuals[index] - predicted).reshape(-1, 2, 1)
        variance = np.maximum(by_source[0], 0.0)
        spread = np.einsum("kra,kl,lra->ra", by_source[1:], W, by_source[1:])
        dof = satterthwaite(variance, spread)
        std = np.sqrt(variance)
        std = np.where((std > 0.0) & (std < _UNPREDICTED), std, np.nan)
        kept = first[rows]
        parts = (rows, np.full(len(rows), number), deviations[..., 0], std, dof)
        of_tests.append([part[kept] for part in parts])
    if not of_tests:
        return None
    rows, test, deviation, std, dof = map(np.concatenate, zip(*of_tests, strict=True))
    return HeldOut(rows, test, deviation, std, dof, len(tests))


@dataclass(frozen=True)
class CrossValidation:
    """Held-out gains and phases of fundamentals, compared with their 95.45 % bands."""

    tests: int  # runs, levels or rows left out, one at a time, the parameters estimated again
    gains: int  # held-out gains inside their bands
    phases: int
    rows: int  # fundamentals that were held out: so many gains, and so many phases
    width: float  # root mean square of the bands' half widths, in ln gain and phase (rad)
    misfit: float  # the same of the held-out deviations
    available: int  # number of tests; of very many, evenly chosen ones were left out

    @property
    def inside(self) -> int:
        """Gains and phases inside their bands."""
        return self.gains + self.phases

    @property
    def count(self) -> int:
        """Number of gains and phases."""
        return 2 * self.rows

    def finding(self, severity: VerdictStatus) -> Finding:
        """Return the check as a finding."""
        names = ("tests", "available", "gains", "phases", "rows", "width")
        values = {name: getattr(self, name) for name in names}
        return described("held_out", severity, **values)

    def __str__(self) -> str:
        return str(self.finding(VerdictStatus.TRUSTED))


def cross_validation(left_out: HeldOut | None) -> CrossValidation | None:
    """Return how well bands hold for tests that were left out; None where there are too few.

    Examples
    --------
    >>> import dahl_ident as di
    >>> check = di.fit(di.load_dataset("noisy"), di.Dahl()).cross_validation
    >>> check.gains > 0.8 * check.rows, check.phases > 0.8 * check.rows
    (True, True)
    """
    if left_out is None:
        return None
    width = np.empty(left_out.std.shape)
    for test in np.unique(left_out.test).tolist():
        rows = left_out.test == test
        k = band_factor(left_out.scores[~rows].ravel(), left_out.dof[rows], CONFIDENCE)
        width[rows] = k * left_out.std[rows]
    known = np.isfinite(width).all(axis=1)
    if not known.any():
        return None
    width, deviation = width[known], left_out.deviation[known]
    gains, phases = (np.abs(deviation) <= width).sum(axis=0).tolist()
    return CrossValidation(
        len(np.unique(left_out.test)),
        gains,
        phases,
        len(width),
        float(np.sqrt(np.mean(width**2))),
        float(np.sqrt(np.mean(deviation**2))),
        left_out.available,
    )


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
    stated, group = np.zeros(y.size), np.repeat(~fundamental, 2).astype(np.intp)
    if problem.scale_known and data.covariance is not None:
        stated = (np.diagonal(data.covariance, axis1=1, axis2=2) / size[:, None] ** 2).ravel()
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
