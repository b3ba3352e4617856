r"""Tests that are left out one at a time, and predicted from all others.

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
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from dahl_ident.arrays import FloatArray, IntArray
from dahl_ident.diagnostics.confidence_levels import CONFIDENCE
from dahl_ident.diagnostics.contributions import satterthwaite
from dahl_ident.diagnostics.error_sources import FEWEST_TESTS, rows_of_tests
from dahl_ident.diagnostics.estimate import WeightedEstimate
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus
from dahl_ident.diagnostics.mixed_model import MixedState

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

    def without(self, test: int) -> FloatArray:
        """Return the scores of all other tests."""
        return np.asarray(self.scores[self.test != test].ravel())


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
            others = state.model.elsewhere(refit.y, refit.columns).at(state.variances)
            D = np.linalg.inv(others.block(index))
        except np.linalg.LinAlgError:
            continue
        to_gain_and_phase, r = estimate.relative_units[rows], np.arange(len(rows))
        blocks = np.concatenate([D[None], D @ others.block_falls(index) @ D]).reshape(
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
    """Held-out gains and phases of fundamentals, compared with their 95.45 % bands.

    Attributes
    ----------
    tests : int
        Runs, levels or rows that were left out, one at a time, the parameters estimated again.
    gains, phases : int
        Held-out gains and phases inside their bands.
    rows : int
        Fundamentals that were held out: so many gains, and so many phases.
    width : float
        Root mean square of the bands' half widths, in ln gain and phase (rad).
    misfit : float
        Root mean square of the held-out deviations, in ln gain and phase (rad).
    available : int
        Number of tests; of very many, evenly chosen ones were left out.
    """

    tests: int
    gains: int
    phases: int
    rows: int
    width: float
    misfit: float
    available: int

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
        return Finding(Question.DESCRIBED, severity, "held_out", values)

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
        k = band_factor(left_out.without(test), left_out.dof[rows], CONFIDENCE)
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
