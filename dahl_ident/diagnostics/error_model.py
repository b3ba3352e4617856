r"""The estimate, and its covariance by source of error.

Write each row's log response as

    ln R_i = ln R(A_i, omega_i; theta) + run_i + level_i + d(ln A_i, ln omega_i) + e_i

with noise e, scatter between runs and between repeats of a level, and a smooth model error d
(:mod:`dahl_ident.diagnostics.error_sources`). Exponents that were assumed, not given, and
calibrations with a stated uncertainty are parameters with a prior. The estimate is weighted least
squares with one misfit for all rows (:mod:`dahl_ident.diagnostics.misfit_share`), W its weights.
Variances follow from restricted maximum likelihood at the estimate
(:mod:`dahl_ident.diagnostics.variance_components`). With V_k the covariance of source k, priors
included as rows of unit variance, and

    G = (J' W J)^-1 J' W,

the covariance of the estimate is the sum of G V_k G' over the sources: the rows of an uncertainty
budget (JCGM 100:2008). Sources widen the estimate and never move it. From five tests on no
parameter's uncertainty is below that of leaving out each test in turn (the jackknife), and what it
adds is one more row.

Source: Searle, Casella and McCulloch, *Variance Components*, 1992; Huber, *Robust Statistics*,
1981, section 7.6 (the sandwich); Rasmussen and Williams, *Gaussian Processes*, 2006, section 2.7.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.diagnostics.determined_directions import Basis, chart_of_limit
from dahl_ident.diagnostics.error_sources import (
    HARMONICS,
    MODEL_ERROR,
    NOISE,
    TESTS,
    Source,
    StructuredSources,
    noise_of,
    own_errors,
    rows_of_tests,
    run_deviations,
)
from dahl_ident.diagnostics.misfit_explanations import at_an_end, neighbourhood
from dahl_ident.diagnostics.misfit_share import WeightedEstimate, weighted_estimate
from dahl_ident.diagnostics.outliers import suspicious_points
from dahl_ident.diagnostics.residual_space import ResidualSpace
from dahl_ident.diagnostics.run_deviations import (
    Linearization,
    RunDeviations,
    alike,
    linearization,
)
from dahl_ident.diagnostics.variance_components import (
    Likelihood,
    LinearModel,
    Projection,
    RowProjection,
    VarianceComponents,
    block_diagonal,
    variance_components,
)
from dahl_ident.fitting import Optimum
from dahl_ident.problem import Problem

EXPONENT = "exponent"
DRIVE = "drive factor"
_GAIN = "force_gain"
_STEPS = 6  # expansions about the runs at most; the last counts, settled or not
_TRIED = 2  # sources of which one may leave, at a time
_FEWEST_TESTS = 5  # of which each is left out in turn
_TESTS_THAT_LIMIT = 8  # fewer may agree by chance although the model errs
_BY_CHANCE = 2.0  # standard deviations
_SHARED_BY = 4.0  # tests at most that a smooth model error moves alike, of its length
_LEAST_DOF = 4  # residuals beyond the parameters, below which there is noise alone
_FEW_ROWS = 100  # with more, rows are compressed to directions that the sources affect
_CALIBRATIONS = {
    "force_gain": "force calibration",
    "displacement_gain": "displacement calibration",
    "delay": "delay",
}


class Assumption(NamedTuple):
    """A parameter held at a value that has an uncertainty: its source, and that of its log."""

    source: str
    std: float


@dataclass(frozen=True)
class ErrorModel:
    """The estimate, and its covariance by every source of error.

    Attributes
    ----------
    optimum : Optimum
        The least-squares fit that it started from.
    problem : Problem
        The same with the assumed exponents free; its `names` order every array here.
    theta : ndarray, shape (Q,)
        Weighted least squares, search coordinates.
    estimate : WeightedEstimate
        The same with its weights.
    sources : tuple of Source
        Random errors of the rows, K of them.
    variances : ndarray, shape (K,)
        Of the sources.
    contributions : mapping of str to ndarray, shape (Q, Q)
        Covariance of theta by source, type A first.
    tests : int
        Number of tests, of which each may have been left out.
    assumed : tuple of str
        Names of parameters that were assumed: exponents, the force gain for a drive factor.
    """

    optimum: Optimum
    problem: Problem
    theta: FloatArray
    estimate: WeightedEstimate
    sources: tuple[Source, ...]
    components: VarianceComponents
    contributions: Mapping[str, FloatArray]
    tests: int
    assumed: tuple[str, ...]
    linear: LinearModel
    projection: Projection
    given: FloatArray
    """G where the assumed exponents are taken as given, shape (Q, m)."""
    jacobian: FloatArray
    """Derivatives of the residuals of data and priors by theta, shape (M, Q)."""
    near: Linearization
    """Residuals at the estimate, each run's at its own parameters."""
    runs: RunDeviations | None = None
    """How runs deviate from the estimate; None where they are alike."""
    basis: Basis | None = None
    """Changes of theta that the data determine at all; None where that is every one."""

    @property
    def variances(self) -> FloatArray:
        """Variance of each source."""
        return self.components.variances

    @property
    def names(self) -> tuple[str, ...]:
        """Free parameters and assumed exponents."""
        return self.problem.names

    @property
    def distinguishes_noise(self) -> bool:
        """Whether there are enough residuals to tell a model error from noise."""
        return _tells(self.problem, self.assumed)

    @cached_property
    def covariance(self) -> FloatArray:
        """Combined covariance of theta, shape (Q, Q)."""
        return np.asarray(sum(self.contributions.values()))

    @cached_property
    def inverse(self) -> FloatArray:
        """G, shape (Q, m)."""
        assert self.linear.lever is not None
        return self._of_theta(self.linear.lever)

    @cached_property
    def generalised(self) -> FloatArray:
        """The same of generalised least squares, which predicts what the device departs by."""
        return self._of_theta(self.projection.generalised_inverse())

    def _of_theta(self, changes: FloatArray) -> FloatArray:
        return changes if self.basis is None else self.basis.matrix @ changes

    @cached_property
    def values(self) -> Mapping[str, float]:
        """The estimates by name."""
        return dict(zip(self.names, self.problem.to_values(self.theta).tolist(), strict=True))

    @cached_property
    def stderr(self) -> Mapping[str, float]:
        """Combined standard uncertainty of each value, by name."""
        size = np.abs(self.problem.value_slopes(self.theta))
        errors = size * np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))
        return dict(zip(self.names, errors.tolist(), strict=True))

    def std(self, directions: FloatArray) -> FloatArray:
        """Return the combined standard uncertainty of directions . theta, for (..., Q)."""
        variance = np.einsum("...i,ij,...j->...", directions, self.covariance, directions)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def holds(self, name: str) -> bool:
        """Return whether a parameter is determined, where the data leave some directions open."""
        if self.basis is None:
            return True
        if not np.isfinite(self.optimum.stderr.get(name, 0.0)):
            return False  # at the limit at which the optimum lies
        direction = np.eye(len(self.names))[self.names.index(name)]
        return bool(self.basis.holds(direction))

    def dof(self, direction: FloatArray, sources: Sequence[str] | None = None) -> float:
        """Return the effective degrees of freedom of the uncertainty of direction . theta.

        Satterthwaite's: 2 u^4 over the variance of u^2 that the variances' own errors make, no
        less than 1. `sources` leaves only these; infinite where all variances are known.
        """
        lever = direction @ (self.inverse if sources is None else self.given)
        length = float(np.abs(lever).max()) or 1.0  # any length of the direction will do
        direction, lever = direction / length, lever / length
        shares = np.zeros(len(self.sources))
        for k, (source, part) in enumerate(zip(self.sources, self.linear.Z, strict=True)):
            if sources is None or source.name in sources:
                moved = lever * part if part.ndim == 1 else lever @ part
                shares[k] = moved @ moved
        spread = float(shares @ self.components.covariance @ shares)
        counted = self.contributions if sources is None else sources
        parts = {n: float(direction @ self.contributions[n] @ direction) for n in counted}
        if TESTS in parts:
            spread += 2.0 * parts[TESTS] ** 2 / (self.tests - 1)
        if not spread > 0.0:
            return np.inf
        return max(1.0, 2.0 * sum(parts.values()) ** 2 / spread)

    @cached_property
    def at_estimate(self) -> Optimum:
        """The estimate as an optimum: its residuals have the stated weights."""
        problem, theta, optimum = self.problem, self.theta, self.optimum
        known = dict(zip(optimum.names, optimum.values.tolist(), strict=True))
        values = [
            value if self.holds(name) else known.get(name, value)
            for name, value in self.values.items()
        ]
        C = self.covariance.copy()
        open_ = [i for i, name in enumerate(self.names) if not self.holds(name)]
        C[open_] = C[:, open_] = 0.0
        C[open_, open_] = np.inf
        y, _ = problem.residuals_and_jacobian(theta)
        m = problem.n_residuals
        data, priors = float(y[:m] @ y[:m]), float(y[m:] @ y[m:])
        scale = 1.0
        if not problem.scale_known:
            free = max(optimum.dof - priors, 1.0)
            scale = max(float(np.sqrt(data / free)), float(problem.rounding))
        cost = 0.5 * (data + scale**2 * priors)
        return replace(
            optimum, problem=problem, theta=theta, values=np.array(values), covariance=C,
            scale=scale, cost=cost,
        )  # fmt: skip

    @cached_property
    def parallel_to_the_law(self) -> ComplexArray:
        """Responses (n,) by generalised least squares, parallel forces and rates included.

        Without the smooth departure from the law itself, which its parameters do not describe.
        """
        moved = self.near.J @ (self.generalised @ self.linear.y)
        for source, effect in zip(self.sources, self.projection.effects(), strict=True):
            parallel = source.shapes is None or source.shapes.parallel
            if source.name == MODEL_ERROR and parallel:
                moved += source.columns @ effect
        relative = np.einsum("nij,nj->ni", self.relative_units(), moved.reshape(-1, 2))
        return np.asarray(self.near.fitted * np.exp(relative @ np.array([1.0, 1.0j])))

    @cached_property
    def rows(self) -> RowProjection:
        """P and what the variances do to it, for the residuals of the data."""
        y = self.near.y * row_weights(self.problem)
        return RowProjection(self.linear, self.projection, self.variances, y)

    def relative_units(self) -> FloatArray:
        """Return what takes each row's residuals to ln gain and phase, shape (n, 2, 2)."""
        return relative_units(self.problem, self.theta)


def relative_units(problem: Problem, theta: FloatArray) -> FloatArray:
    """Return what takes each row's residuals to ln gain and phase, shape (n, 2, 2)."""
    predicted = problem.predict(theta)
    parts = [-problem.residual_change(theta, f * predicted) for f in (1.0, 1j)]
    return np.linalg.pinv(np.stack([part.reshape(-1, 2) for part in parts], axis=-1))


def error_model(optimum: Optimum, *, of_combinations: bool = False) -> ErrorModel | None:
    """Return the model of an optimum's errors; None where there is nothing to estimate it from.

    Parameters
    ----------
    optimum : Optimum
        From :func:`dahl_ident.fitting.solve`.
    of_combinations : bool, default False
        Also where parameters are undetermined, or their optimum lies at infinity: then
        the covariance holds for combinations that the data determine, and for these alone.

    Returns
    -------
    ErrorModel or None
        None where no finite optimum was found, a parameter is undetermined, the loss is robust,
        residuals are rounding errors, or none is left beyond the parameters.
    """
    if optimum.loss != "linear":
        return None  # its errors are those of the robust estimate, noise alone
    if optimum.is_exact or not np.isfinite(optimum.theta).all():
        return None
    determined = optimum.success and bool(np.isfinite(optimum.covariance).all())
    if not (determined or of_combinations):
        return None
    problem, assumed = with_assumed(optimum.problem)
    if problem.n_numbers - len(optimum.names) <= 0:
        return None
    try:
        return _estimated(optimum, problem, assumed, determined)
    except np.linalg.LinAlgError:
        return None


def with_assumed(given: Problem) -> tuple[Problem, dict[str, Assumption]]:
    """Return the problem with what was assumed free: exponents, and the factor of the drive."""
    assumed = {
        p.name: Assumption(EXPONENT, float(np.log(p.prior[1] / p.prior[0]) / np.sqrt(12.0)))
        for p in given.model.parameters
        if p.assumed and not p.free and p.prior is not None
    }
    u = given.data.drive_factor_uncertainty
    gain = next(p for p in given.sensors.parameters if p.name == _GAIN)
    if u and not gain.free:
        assumed[gain.name] = Assumption(DRIVE, float(u))
    if not assumed:
        return given, {}
    return given.assuming({name: one.std for name, one in assumed.items()}), assumed


class _Rows:
    """Residuals and Jacobian at a point, counted as the optimum counts them."""

    def __init__(self, optimum: Optimum, problem: Problem) -> None:
        self._problem = problem
        known = dict(zip(optimum.names, optimum.theta, strict=True))
        self.start = np.array(
            [known.get(p.name, np.log(p.value or 1.0)) for p in problem.parameters]
        )
        self.m = problem.n_residuals

    def at(self, theta: FloatArray, near: Linearization) -> tuple[FloatArray, FloatArray]:
        """Return residuals and Jacobian: data, then priors."""
        y, J = near.y, near.J
        if self._problem.n_priors:
            own, by = self._problem.residuals_and_jacobian(theta, tails=False)
            y, J = np.concatenate([y, own[self.m :]]), np.vstack([J, by[self.m :]])
        weight = np.concatenate([row_weights(self._problem), np.ones(len(y) - self.m)])
        return y * weight, J * weight[:, None]


def row_weights(problem: Problem) -> FloatArray:
    """Return the root of what an estimated covariance counts each residual for, (m,)."""
    weight, dof = np.ones(problem.n_residuals), problem.data.dof
    if not problem.gaussian and dof is not None:
        nu = np.minimum(dof, 1e12)  # a covariance of few dof: the variance of Student's t
        weight = np.repeat(np.sqrt((nu - 2.0) / nu), 2)
    return weight


def _estimated(
    optimum: Optimum, problem: Problem, assumed: Mapping[str, Assumption], determined: bool
) -> ErrorModel:
    rows = _Rows(optimum, problem)
    m = rows.m
    basis = None
    if not determined:
        chart = chart_of_limit(optimum, problem)
        first = rows.at(rows.start, linearization(problem, rows.start))
        basis = Basis.of(first[1], rows.start, chart)
    dof = problem.n_numbers - len(problem.names)
    estimate = weighted_estimate(
        problem,
        lambda theta: rows.at(theta, linearization(problem, theta)),
        rows.start,
        dof + problem.n_priors * problem.scale_known,
        basis,
    )
    theta = estimate.theta
    if basis is not None:
        basis = basis.at(theta)
    shared = StructuredSources(problem, theta) if _tells(problem, assumed) else None
    apart = own_errors(problem, _standing_apart(optimum))
    runs: RunDeviations | None = None
    found: VarianceComponents | None = None
    for _ in range(_STEPS):
        near = linearization(problem, theta, runs)
        y, whole = rows.at(theta, near)
        if not np.isfinite(y).all():
            raise np.linalg.LinAlgError("a drive beyond the force limit has no steady response")
        J = whole if basis is None else whole @ basis.matrix
        noise = noise_of(problem, theta, few=m <= 2 * _FEW_ROWS and shared is not None)
        sources = noise if shared is None else (*noise, *apart, *shared.at(theta, near))
        linear, contrasts = linear_model(problem, y, J, sources, estimate.lever(J))
        level = 0.0 if problem.scale_known else float(y[:m] @ y[:m]) / max(dof, 1)
        floor = np.array([level * (s.columns.ndim == 1) for s in sources])
        if found is None:
            found = _asked_for(contrasts, sources, floor)
        else:  # about other runs: what was not asked for before is not asked for again
            found = variance_components(contrasts, found.variances, found.largest)
        projection = Projection(linear, found.variances)
        before, runs = runs, run_deviations(problem, sources, projection.effects())
        if runs is not None:  # these are about the estimate that V weighs
            move = projection.generalised_inverse() @ linear.y
            move = move if basis is None else basis.matrix @ move
            runs = runs.about(move, range(len(theta)))
        if alike(before, runs):
            break
    assert found is not None
    always = [s.name == NOISE and not s.price for s in sources]
    kept = np.flatnonzero((found.variances > 0.0) | always).tolist()
    sources = tuple(sources[k] for k in kept)
    linear = replace(linear, Z=[linear.Z[k] for k in kept])
    found = found.only(kept)
    projection = Projection(linear, found.variances)
    assert linear.lever is not None
    G = given = linear.lever if basis is None else basis.matrix @ linear.lever
    contributions = _by_source(problem, assumed, sources, linear, found, G)
    tests = rows_of_tests(problem.data)
    if basis is None:
        by_tests = estimate.jackknife(whole, y, tests, problem.bounds())
        wide = np.ones(len(theta))
        if len(tests) >= _TESTS_THAT_LIMIT and MODEL_ERROR in contributions:
            wide = _at_most(contributions[MODEL_ERROR], _SHARED_BY * by_tests)
            contributions[MODEL_ERROR] *= np.outer(wide, wide)
        ranged = [i for i, n in enumerate(problem.names) if n in assumed and n != _GAIN]
        if ranged:
            kept = [i for i in range(len(theta)) if i not in ranged]
            given = np.zeros(G.shape)
            given[kept] = linear.turned(estimate.lever(whole[:, kept]))
            others = _by_source(problem, assumed, sources, linear, found, given)
            if MODEL_ERROR in others:
                others[MODEL_ERROR] *= np.outer(wide, wide)
            contributions = _with_exponents(contributions, others)
        moved = _by_harmonics(problem, estimate, y, whole)
        if moved.any():
            contributions[HARMONICS] = np.outer(moved, moved)
        if len(tests) >= _FEWEST_TESTS:
            by_chance = 1.0 - 1.0 / np.sqrt(2.0 * (len(tests) - 1))  # the jackknife's own error
            contributions = _at_least(contributions, by_chance**2 * by_tests)
    return ErrorModel(
        optimum, problem, theta, estimate, sources, found, contributions, len(tests),
        tuple(assumed), linear, projection, given, whole, near, runs, basis,
    )  # fmt: skip


def _with_exponents(
    contributions: dict[str, FloatArray], given: dict[str, FloatArray]
) -> dict[str, FloatArray]:
    """Return what each source does at given exponents, and what they do that are not given."""
    whole, others = (np.asarray(sum(parts.values())) for parts in (contributions, given))
    return {**given, EXPONENT: given.get(EXPONENT, 0.0) + _positive(whole - others)}


def _positive(C: FloatArray) -> FloatArray:
    """Return the part of a symmetric matrix that is a covariance."""
    values, vectors = np.linalg.eigh(C)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _at_most(C: FloatArray, most: FloatArray) -> FloatArray:
    """Return the factors of parameters' uncertainties that bring C to `most` where it is more."""
    own, most = np.diagonal(C), np.diagonal(most)
    return np.sqrt(np.divide(most, own, out=np.ones(len(own)), where=own > most))


def _by_harmonics(
    problem: Problem, estimate: WeightedEstimate, y: FloatArray, J: FloatArray
) -> FloatArray:
    """Return how far harmonics move theta from the fundamentals' estimate, beyond chance, (Q,)."""
    m = problem.n_residuals
    kept = np.concatenate([np.repeat(problem.data.harmonic == 1, 2), np.ones(len(y) - m, bool)])
    if kept.all() or 2 * (problem.data.harmonic == 1).sum() <= len(problem.names):
        return np.zeros(J.shape[1])
    own = estimate.lever(J, kept)
    lever = own - estimate.lever(J)
    noise = np.ones(len(y))
    if not problem.scale_known:
        noise[:m] /= estimate.factors[0, 0, 0]
    moved, chance = own @ y, np.linalg.norm(lever * noise, axis=1)
    return np.where(np.abs(moved) > _BY_CHANCE * chance, moved, 0.0)


def _at_least(contributions: dict[str, FloatArray], least: FloatArray) -> dict[str, FloatArray]:
    """Return the contributions with one more where they are below the `least` covariance."""
    C = np.asarray(sum(contributions.values()))
    with np.errstate(divide="ignore", invalid="ignore"):
        wider = np.sqrt(np.maximum(np.diagonal(least) / np.diagonal(C), 1.0))
    wider = np.where(np.isfinite(wider), wider, 1.0)
    if not (wider > 1.0).any():
        return contributions
    return {**contributions, TESTS: _positive(C * np.outer(wider, wider) - C)}


def _standing_apart(optimum: Optimum) -> list[int]:
    """Return the rows that stand apart.

    Neighbours, or a row at an end of the table, may be where the model fails.
    """
    rows = sorted(p.row for p in suspicious_points(optimum, ResidualSpace(optimum)))
    return [] if at_an_end(optimum, rows) or neighbourhood(optimum, rows) else rows


def _tells(problem: Problem, assumed: Collection[str]) -> bool:
    return problem.n_numbers - len(problem.names) + len(assumed) >= _LEAST_DOF


def _asked_for(
    contrasts: Likelihood, sources: Sequence[Source], floor: FloatArray
) -> VarianceComponents:
    """Return the variances; sources that raise the likelihood by less than their price have none.

    A source that has none once all others are in is never missed; of the rest, that which costs
    the likelihood least leaves first, of a few that cost least by the information on their
    variances. `floor` has variances at which the covariance is not singular.
    """
    most = np.array([s.largest for s in sources])
    price = np.array([s.price for s in sources])
    found = variance_components(contrasts, np.minimum(floor, most), most)
    while True:
        most = np.where((price > 0.0) & (found.variances == 0.0), 0.0, most)
        open_ = np.flatnonzero((price > 0.0) & (most > 0.0))
        about = 0.5 * found.variances[open_] ** 2 / np.diagonal(found.covariance)[open_]
        for k in open_[np.argsort(about - price[open_])[:_TRIED]].tolist():
            fewer = most.copy()
            fewer[k] = 0.0
            begin = np.where(found.variances > 0.0, found.variances, floor)
            trial = variance_components(contrasts, np.minimum(begin, fewer), fewer)
            if found.log_likelihood - trial.log_likelihood < price[k]:
                found = trial
                break
        else:
            return found


def linear_model(
    problem: Problem,
    y: FloatArray,
    J: FloatArray,
    sources: tuple[Source, ...],
    lever: FloatArray | None = None,
) -> tuple[LinearModel, Likelihood]:
    """Return residuals of data and priors with the sources' columns, compressed if many.

    Also their likelihood.
    """
    m, extra = problem.n_residuals, len(y) - problem.n_residuals
    known = np.concatenate([np.full(m, float(problem.scale_known)), np.ones(extra)])
    weight = row_weights(problem)
    Z = [s.columns if s.columns.ndim < 3 else block_diagonal(s.columns) for s in sources]
    # an error of the response is one of its weighted residual; noise of one scale is that of these
    Z = [z if z.ndim == 1 else weight[:, None] * z for z in Z]
    Z = [np.concatenate([z, np.zeros((extra, *z.shape[1:]))]) for z in Z]
    linear = LinearModel(y, J, known, Z, lever)
    fewer = linear.compressed(m) if m > 2 * _FEW_ROWS else linear
    return fewer, Likelihood(fewer)


def _by_source(
    problem: Problem,
    assumed: Mapping[str, Assumption],
    sources: tuple[Source, ...],
    linear: LinearModel,
    found: VarianceComponents,
    lever: FloatArray,
) -> dict[str, FloatArray]:
    """Return the covariance of theta that each source makes by the lever (Q, m) of residuals."""
    result = {}
    priors = [_CALIBRATIONS.get(name, name) for name in problem.priors]
    known = [*priors, *(one.source for one in assumed.values())]
    m = len(linear.y) - len(known)
    if problem.scale_known:
        result[NOISE] = _squared(lever[:, :m])
    for source, part, variance in zip(sources, linear.Z, found.variances.tolist(), strict=True):
        own = variance * _squared(lever * part if part.ndim == 1 else lever @ part)
        result[source.name] = result[source.name] + own if source.name in result else own
    for row, name in enumerate(known, start=m):
        own = _squared(lever[:, row : row + 1])
        result[name] = result[name] + own if name in result else own
    return result


def _squared(lever: FloatArray) -> FloatArray:
    return np.asarray(lever @ lever.T)
