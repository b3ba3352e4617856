r"""The covariance of the estimate by source of error.

Write each row's log response as

    ln R_i = ln R(A_i, omega_i; theta) + run_i + level_i + d(ln A_i, ln omega_i) + e_i

with noise e, scatter between runs and between repeats of a level, and a smooth model error d
(:mod:`dahl_ident.diagnostics.error_sources`). The estimate is weighted least squares
(:mod:`dahl_ident.diagnostics.estimate`), residuals y of unit variance, and exponents that were
assumed and calibrations with a stated uncertainty are parameters with a prior, one more residual
each. Variances follow from restricted maximum likelihood
(:mod:`dahl_ident.diagnostics.mixed_model`). With V_k the covariance of source k and

    G = (J'J)^-1 J',

the covariance of the estimate is the sum of G V_k G' over the sources: the rows of an uncertainty
budget (JCGM 100:2008). Sources widen the estimate and never move it. From five tests on no
parameter's uncertainty is below that of leaving out each test in turn (the jackknife), and what it
adds is one more row. The changes by each test are weighted with its leverage, unless chi-square
shows that the weights are wrong.

Source: Searle, Casella and McCulloch, *Variance Components*, 1992; Huber, *Robust Statistics*,
1981, section 7.6 (the sandwich); Rasmussen and Williams, *Gaussian Processes*, 2006, section 2.7.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from dahl_ident.arrays import TINY, ComplexArray, FloatArray
from dahl_ident.bayes.row_errors import RowErrors
from dahl_ident.diagnostics.confidence_levels import CONFIDENCE
from dahl_ident.diagnostics.contributions import (
    CHANNELS,
    EXPONENT,
    LEVELS,
    MODEL_ERROR,
    NOISE,
    RUNS,
    TESTS,
    ErrorContributions,
    positive_part,
    satterthwaite,
)
from dahl_ident.diagnostics.error_sources import (
    Source,
    error_sources,
    errors_of_suspicious,
    grouped_rows,
    passes,
    rows_of_tests,
)
from dahl_ident.diagnostics.estimate import (
    WeightedEstimate,
    jackknife_with_weights,
    weighted_estimate,
    with_assumed,
)
from dahl_ident.diagnostics.held_out import HeldOut, held_out
from dahl_ident.diagnostics.misfit_explanations import is_at_end, neighbourhood, suspicious_points
from dahl_ident.diagnostics.mixed_model import MixedModel, MixedState
from dahl_ident.diagnostics.residual_space import (
    Linearization,
    ResidualSpace,
    RunDeviations,
    run_deviations,
)
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.optimum import (
    agreed_scale,
    blanked,
    information_of,
    inverse,
    propagated,
)
from dahl_ident.problem import TableProblem

_FEWEST_TESTS = 5  # of which each is left out in turn
_MOST_REFITS = 20  # tests; if there are more, none changes the weights much by being left out
_FALSE_ALARM = 0.01  # share of sound tables whose stated noise is doubted
_TESTS_THAT_LIMIT = 8  # fewer may agree by chance although the model errs
_SHARED_BY = 4.0  # most tests that a smooth model error changes alike: its correlation length
_UPPER = 0.5 * (1.0 + CONFIDENCE)
_KINDS = 2  # kinds of model error that are tried; the likelier one counts
_LEAST_DOF = 4  # residuals beyond the parameters, below which there is noise alone
_DETERMINED = 1e-10  # least singular value of derivatives, of the largest, that is not rounding
_AS_STATED = 1e-6  # relative rise of the noise's variance up to which it is as stated


@dataclass(frozen=True)
class ErrorModel(ErrorContributions):
    """The estimate, and its covariance by every source of error."""

    optimum: Optimum  # the least-squares fit that it started from
    problem: TableProblem  # the assumed exponents free, covariances as stated
    estimate: WeightedEstimate  # weighted least squares
    sources: tuple[Source, ...]  # random errors that rows share, those that the residuals show
    state: MixedState  # the mixed model of the residuals at the variances of noise and sources
    contributions: Mapping[str, FloatArray]  # (Q, Q): covariance of theta by source, type A first
    tests: int  # number of tests, of which each may have been left out
    assumed: tuple[str, ...]
    # (2, count, Q, Q): covariance of theta by each variance at unit size, with the exponents
    # estimated, and with exact ones
    units: FloatArray
    # (Q, Q): covariance of theta from leaving out each run; None with a single run
    by_runs: FloatArray | None

    @property
    def theta(self) -> FloatArray:
        """The estimate, search coordinates, (Q,)."""
        return self.estimate.theta

    def of_values(self, covariance: FloatArray) -> FloatArray:
        """Return a covariance of theta as one of the values, (Q, Q)."""
        return propagated(covariance, self.problem.value_slopes(self.theta))

    @property
    def variances(self) -> FloatArray:
        """Variance of each source."""
        return self.state.variances[self.state.model.noises :]

    @property
    def noises(self) -> FloatArray:
        """Variance of the noise over that of the weights: of fundamentals, then of harmonics."""
        return self.state.sizes[: self.state.model.noises]

    @property
    def distinguishes_noise(self) -> bool:
        """Whether there are enough residuals to distinguish a model error from noise."""
        return self.problem.n_nonzero - len(self.names) + len(self.assumed) >= _LEAST_DOF

    @cached_property
    def values(self) -> Mapping[str, float]:
        """The estimates by name."""
        values = self.problem.to_values(self.theta)
        known = zip(self.problem.parameters, values.tolist(), strict=True)
        return {p.name: p.nearest(value) for p, value in known}

    @cached_property
    def estimates(self) -> Mapping[str, float]:
        """The estimates by name; zero or infinite if the optimum lies at such a limit."""
        at_optimum = zip(self.optimum.names, self.optimum.values.tolist(), strict=True)
        return {**self.values, **{n: v for n, v in at_optimum if v == 0.0 or np.isinf(v)}}

    @cached_property
    def stderr(self) -> Mapping[str, float]:
        """Combined standard uncertainty of each value, by name."""
        variances = np.diagonal(self.of_values(self.covariance))
        return dict(zip(self.names, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True))

    def holds(self, name: str) -> bool:
        """Return whether the data determine a parameter."""
        if not np.isfinite(self.optimum.stderr.get(name, 0.0)):
            return False  # at the limit at which the optimum lies
        return bool(self.estimate.basis.holds(np.eye(len(self.names))[self.names.index(name)]))

    @np.errstate(over="ignore")  # a variance that nothing bounds has one degree of freedom
    def dof(self, direction: FloatArray, source: str | None = None) -> float:
        """Return the effective degrees of freedom of the uncertainty of direction . theta.

        Satterthwaite's: 2 u^4 over the variance of u^2 due to the errors of the variances, at
        least 1; fewer if the interval would be narrower than that of the runs alone. Infinite if
        all variances are known. With `source`, the uncertainty is from this source alone. What an
        assumed exponent adds depends on the variances as well.
        """
        direction = direction / (float(np.abs(direction).max()) or 1.0)  # any length will do
        slopes, exact = np.einsum("i,ekij,j->ek", direction, self.units, direction)
        counted = self.contributions if source is None else (source,)
        sizes = {name: float(direction @ self.contributions[name] @ direction) for name in counted}
        if source == EXPONENT:
            slopes = slopes - exact
        elif source is not None:
            labels = [NOISE] * self.state.model.noises + [source.name for source in self.sources]
            slopes = exact * [name == source for name in labels]
        spread = float(slopes @ self.state.variances_covariance @ slopes)
        if TESTS in sizes:
            spread += 2.0 * sizes[TESTS] ** 2 / (self.tests - 1)
        total = sum(sizes.values())
        dof = float(satterthwaite(np.asarray(total), np.asarray(spread)))
        if self.by_runs is None or source is not None:
            return dof
        of_runs = float(direction @ self.by_runs @ direction)
        return float(no_narrower(dof, total, of_runs, len(self.problem.data.runs)))

    @cached_property
    def at_estimate(self) -> Optimum:
        """The estimate as an optimum: its residuals have the stated weights."""
        problem, theta, optimum = self.problem, self.theta, self.optimum
        holds = np.array([self.holds(name) for name in self.names])
        y, m = problem.residuals(theta), problem.n_residuals
        scale = 1.0
        if not problem.scale_known:
            free = max(optimum.dof - float(y[m:] @ y[m:]), 1.0)
            loss = self.estimate.loss
            scale = agreed_scale(problem, loss, lambda _: (theta, free), self.estimate.scale)
        at = replace(optimum, theta=theta, covariance=blanked(self.covariance, ~holds), scale=scale)
        return self._of_problem(at, problem, np.array(list(self.estimates.values())))

    @cached_property
    def by_noise(self) -> Optimum:
        """The estimate as an optimum of the weighted problem; its covariance is from noise alone.

        What was assumed is held at its estimate.
        """
        fixed = {name: self.values[name] for name in self.assumed}
        problem = self.problem.like(fixed=fixed) if fixed else self.problem
        problem, stated = problem.widened(self.estimate.misfit_variance), self.at_estimate
        kept = [self.names.index(name) for name in problem.names]
        theta, lost = self.theta[kept], ~np.isfinite(np.diagonal(stated.covariance)[kept])
        of_noise = information_of(problem, theta, stated.scale, self.estimate.loss, stated.dof)
        at = replace(stated, theta=theta, covariance=blanked(inverse(of_noise)[0], lost))
        return self._of_problem(at, problem, stated.values[kept])

    def _of_problem(self, optimum: Optimum, problem: TableProblem, values: FloatArray) -> Optimum:
        """Return an optimum of another problem with the cost there."""
        scale = optimum.scale
        cost = float(problem.quadratic(optimum.theta, scale, self.estimate.loss).cost)
        return replace(optimum, source=problem, values=values, cost=scale**2 * cost)

    @cached_property
    def runs(self) -> RunDeviations | None:
        """How runs deviate from the generalised estimate; None if they do not scatter."""
        shown = [k for k, source in enumerate(self.sources) if source.name == RUNS]
        if not shown:
            return None
        labels, Q = np.unique(np.asarray(self.problem.data.run)), len(self.names)
        effects, spread = np.zeros((len(labels), Q + 2)), np.zeros(Q + 2)
        predicted, places = self.state.predicted, [*self.names, "gain", "phase"]
        for k in shown:
            place = places.index(self.sources[k].per_test)
            effects[:, place] = predicted[self.state.model.columns(k)]
            spread[place] = self.variances[k] ** 0.5
        mean = -self.estimate.basis.matrix @ predicted[: self.state.model.parameters]
        noise = float(self.noises[0] ** 0.5) * self.estimate.scale
        return run_deviations(self.estimate, mean, effects, spread, noise)

    @cached_property
    def within_runs(self) -> ComplexArray:
        """Predicted responses, (n,), with the parameters, gain and phase of each run."""
        if self.runs is None:
            return self.estimate.predicted
        return Linearization(self.problem, self.theta, self.runs).fitted

    @cached_property
    def parallel_to_the_law(self) -> ComplexArray:
        """Predicted responses, (n,), with errors of levels and model errors in parallel to the law.

        They are predicted by generalised least squares, without the smooth departure from the law
        itself, which its parameters do not describe.
        """
        model, effects = self.state.model, self.state.predicted.copy()
        for k, source in enumerate(self.sources):
            counted = source.name == MODEL_ERROR and (source.shapes is None or source.parallel)
            effects[model.columns(k)] *= counted or source.name == LEVELS
        moved = (model.U @ effects)[: self.problem.n_residuals].reshape(-1, 2)
        relative = np.einsum("nij,nj->ni", self.estimate.relative_units, moved)
        return np.asarray(self.estimate.predicted * np.exp(relative @ np.array([1.0, 1.0j])))

    @cached_property
    def left_out(self) -> HeldOut | None:
        """Tests left out in turn and predicted; None with fewer than three."""
        return held_out(self.estimate, self.state)

    @property
    def structure(self) -> float:
        """Rms of the smooth model error over that of the fundamentals' noise."""
        noise = float(np.sqrt(self.noises[0] * self.noise_square))
        return self.rms(MODEL_ERROR) / max(noise, TINY)

    @cached_property
    def structure_by_chance(self) -> float:
        """Probability that noise and errors of groups of rows alone make `structure` as large."""
        of_model = [k for k, source in enumerate(self.sources) if source.name == MODEL_ERROR]
        if not of_model:
            return 1.0
        model = self.state.model
        shared = [k for k, source in enumerate(self.sources) if source.per_test]
        null = model.with_sources(shared)
        variances = np.zeros(model.count)
        kept = [*range(model.noises), *(model.noises + k for k in shared)]
        variances[kept] = null.reml(np.ones(len(shared))).variances
        alone, known = model.at(variances), self.problem.scale_known
        return min(1.0, _KINDS * min(alone.chance_of(k, known=known) for k in of_model))

    def rms(self, name: str) -> float:
        """Return the rms of ln gain and phase due to a source, or to noise in excess of the stated.

        Of the differences between runs, those of gain and phase count.
        """
        named = [s.name == name and s.per_test not in self.names for s in self.sources]
        squares = np.array([source.mean_square for source in self.sources])
        total = float(self.variances[named] @ squares[named])
        if name == NOISE:
            total += float(self.state.variances[0]) * self.noise_square
        return float(np.sqrt(total))

    @cached_property
    def noise_square(self) -> float:
        """Mean square of the fundamentals' ln gain and phase for residuals of unit variance."""
        first = self.problem.data.harmonic == 1
        units = self.estimate.relative_units[first if first.any() else slice(None)]
        return 0.5 * float(np.mean(np.sum(units**2, axis=(1, 2))))


def error_model(optimum: Optimum, *, of_combinations: bool = False) -> ErrorModel | None:
    """Return the model of an optimum's errors, or None.

    None if the residuals are rounding errors or too few, or a parameter is undetermined. With
    `of_combinations` parameters may be undetermined; the covariance then only holds for what the
    data determine.
    """
    if optimum.is_exact or not np.isfinite(optimum.theta).all():
        return None
    determined = optimum.success and bool(np.isfinite(optimum.covariance).all())
    if not (determined or of_combinations):
        return None
    problem = optimum.problem
    if problem.n_nonzero - len(optimum.names) <= 0:
        return None
    try:
        errors = _with_sources(optimum, problem, determined=determined)
        if problem.data.run is None and any(source.name == RUNS for source in errors.sources):
            runs = problem.like(data=replace(problem.data, run=passes(problem.data)))
            errors = _with_sources(optimum, runs, determined=determined)
    except np.linalg.LinAlgError:
        return None
    return errors


def _with_sources(optimum: Optimum, problem: TableProblem, *, determined: bool) -> ErrorModel:
    """Return the error model of an optimum, with the sources that the residuals show."""
    problem, assumed = with_assumed(problem)
    estimate = weighted_estimate(optimum, problem, determined=determined)
    few = problem.n_nonzero - len(problem.names) + len(assumed) < _LEAST_DOF
    sources: tuple[Source, ...] = ()
    if not few:
        sources = (
            *error_sources(estimate),
            *errors_of_suspicious(estimate, _standing_apart(optimum)),
        )
    state = _mixed(estimate, sources).reml(np.array([source.chance for source in sources]))
    if few and problem.scale_known and not estimate.problem.has_misfit:
        # too few to doubt the noise
        state = state.model.at(np.zeros(state.model.count))
    noises = state.model.noises
    shown = np.flatnonzero(state.variances[noises:] > 0.0)
    sources = tuple(sources[k] for k in shown)
    state = state.model.with_sources(shown).at(state.variances[[*range(noises), *(noises + shown)]])
    exponents = set[str]()
    if estimate.regular:
        exponents = {name for name, p in assumed.items() if p.source == EXPONENT}
    tests = rows_of_tests(problem.data)
    by_tests = estimate.jackknife(tests) if estimate.regular else None
    labels = [NOISE] * noises + [source.name for source in sources]
    labels += [CHANNELS.get(name, name) for name in problem.priors]
    labels += [p.source for p in assumed.values()]
    # with the exponents estimated, and with exact ones
    units = np.array(
        [_unit_covariances(estimate.lever(known), state) for known in (set[str](), exponents)]
    )
    sizes = np.append(state.sizes, np.ones(problem.n_priors))
    if by_tests is not None and len(tests) >= _TESTS_THAT_LIMIT:
        of_model = np.array(labels) == MODEL_ERROR
        u2 = np.einsum("kii,k->i", units[0, of_model], sizes[of_model])
        largest = _SHARED_BY * np.diagonal(by_tests)
        factor = np.sqrt(np.divide(largest, u2, out=np.ones(len(u2)), where=u2 > largest))
        units[:, of_model] *= np.outer(factor, factor)
    contributions, at_exact = (_by_source(labels, sizes[:, None, None] * each) for each in units)
    if exponents:
        added = np.asarray(sum(contributions.values())) - np.asarray(sum(at_exact.values()))
        contributions = {**at_exact, EXPONENT: positive_part(added)}
    if estimate.second is not None:
        contributions[EXPONENT] = contributions[EXPONENT] + np.outer(
            estimate.second, estimate.second
        )
    if by_tests is not None and len(tests) >= _FEWEST_TESTS:
        if estimate.chance < _FALSE_ALARM and len(tests) <= _MOST_REFITS:
            by_tests = jackknife_with_weights(estimate, optimum, tests)
        calibrations = {CHANNELS.get(name, name) for name in problem.priors}
        parts = [part for name, part in contributions.items() if name not in calibrations]
        C, jackknife_error = np.asarray(sum(parts)), 1.0 / np.sqrt(2.0 * (len(tests) - 1))
        u2, least = np.diagonal(C), (1.0 - jackknife_error) ** 2 * np.diagonal(by_tests)
        factor = np.sqrt(np.divide(least, u2, out=np.ones(len(C)), where=(least > u2) & (u2 > 0.0)))
        if (factor > 1.0).any():
            contributions[TESTS] = positive_part(C * np.outer(factor, factor) - C)
    by_runs = None
    if estimate.regular and len(problem.data.runs or ()) > 1:
        runs = grouped_rows(np.unique(np.asarray(problem.data.run), return_inverse=True)[1])
        by_runs = estimate.jackknife(runs)
    return ErrorModel(
        optimum,
        problem,
        estimate,
        sources,
        state,
        contributions,
        len(tests),
        tuple(assumed),
        units[:, : state.model.count],
        by_runs,
    )


def _standing_apart(optimum: Optimum) -> list[int]:
    """Return the suspicious rows; none if they are neighbours, or one at an end of a range.

    There the model may be wrong, and not the rows.
    """
    rows = sorted(p.row for p in suspicious_points(optimum, ResidualSpace(optimum)))
    return [] if is_at_end(optimum, rows) or neighbourhood(optimum, rows) else rows


def _mixed(estimate: WeightedEstimate, sources: Sequence[Source]) -> MixedModel:
    """Return the mixed model of the estimate's residuals.

    Fundamentals have at least the stated noise. Harmonics have it in addition to their misfit,
    which is not an error of the fundamental.
    """
    problem, m = estimate.problem, estimate.problem.n_residuals
    harmonics = np.repeat(problem.data.harmonic != 1, 2) & problem.scale_known
    both = bool(harmonics.any() and not harmonics.all())
    group = np.concatenate([harmonics & both, np.full(problem.n_priors, 1 + both)]).astype(np.intp)
    stated = estimate.factors(problem.widened(np.zeros(problem.data.n)))
    part = 0.5 * np.sum(stated**2, axis=(1, 2)) * problem.scale_known
    known = [float(part[group[:m:2] == g].mean()) for g in range(1 + both)]
    known += [1.0] * bool(problem.n_priors)
    Z, most = [s.columns for s in sources], np.array([s.largest for s in sources])
    return MixedModel(estimate.y, estimate.columns, Z, group, np.array(known), 1 + both, most)


def _unit_covariances(lever: FloatArray, state: MixedState) -> FloatArray:
    """Return the estimate's covariances from unit noises, sources and priors, (k, Q, Q)."""
    model, G = state.model, state.model.noises
    moved = lever @ model.U
    columns = [lever[:, model.group == g] for g in range(G)]
    columns += [moved[:, model.columns(k)] for k in range(model.count - G)]
    columns += list(lever.T[model.group >= G, :, None])
    return np.array([each @ each.T for each in columns])


def _by_source(labels: Sequence[str], parts: FloatArray) -> dict[str, FloatArray]:
    """Return the sum of the parts (k, Q, Q) of each source."""
    by_source = dict[str, FloatArray]()
    for name, part in zip(labels, parts, strict=True):
        by_source[name] = by_source.get(name, 0.0) + part
    return by_source


def no_narrower(
    dof: FloatArray | float, variance: FloatArray | float, of_runs: FloatArray | float, runs: int
) -> FloatArray:
    """Return degrees of freedom that make an interval at least as wide as that of runs alone.

    The mean of n runs has Student's t with n - 1 degrees of freedom, whatever their scatter;
    `of_runs` is its variance. Satterthwaite's formula gives too many degrees of freedom where the
    scatter of few runs happens to be small.

    Examples
    --------
    >>> no_narrower(np.inf, 1.0, np.array([0.1, 1.0]), 2).round(2).tolist()
    [2.05, 1.0]
    """
    least = special.stdtrit(runs - 1.0, _UPPER) * np.sqrt(np.divide(of_runs, variance))
    narrow = least > np.where(np.isinf(dof), special.ndtri(_UPPER), special.stdtrit(dof, _UPPER))
    fewer = special.stdtridf(_UPPER, np.where(narrow, least, 3.0))  # 3: any above 2
    return np.where(narrow, np.maximum(fewer, 1.0), dof)


def row_errors(errors: ErrorModel) -> RowErrors | None:
    """Return errors that rows share, for a posterior's likelihood; None if rows are independent."""
    problem, estimate, m = errors.problem, errors.estimate, errors.problem.n_residuals
    as_stated = not estimate.problem.has_misfit and (errors.noises < 1.0 + _AS_STATED).all()
    by_tests = errors.contributions.get(TESTS)
    if not errors.sources and by_tests is None and (as_stated or not problem.scale_known):
        return None
    names = [NOISE, *(s.name for s in errors.sources), *[TESTS] * (by_tests is not None)]
    counted = tuple(dict.fromkeys(names))
    U, sizes, _ = np.linalg.svd(estimate.columns[:m], full_matrices=False)
    basis = U[:, sizes > _DETERMINED * sizes[0]]
    noise = basis.T @ (basis / errors.state.weights[errors.state.model.group[:m], None])
    shared = np.zeros_like(noise)
    for variance, source in zip(errors.variances.tolist(), errors.sources, strict=True):
        part = basis.T @ source.columns[:m]
        target = noise if source.name == NOISE else shared
        target += variance * part @ part.T
    z, y, moved = basis.T @ estimate.y[:m], estimate.y[:m], basis.T @ estimate.jacobian[:m]
    if by_tests is not None:
        shared += moved @ by_tests @ moved.T
    L = np.linalg.cholesky(noise)
    # shared over noise is diagonal in the coordinates W z; see RowErrors
    ratios, vectors = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, shared).T))
    W = vectors.T @ np.linalg.inv(L)
    values, axes = np.linalg.eigh(noise + shared)
    root = axes / np.sqrt(values) @ axes.T  # of the inverse
    factors = estimate.factors(problem)
    volume = float(np.log(np.abs(np.linalg.det(factors))).sum() - np.log(np.diagonal(L)).sum())
    return RowErrors(
        counted,
        factors,
        estimate.scale,
        errors.theta,
        float(y @ y),
        np.eye(len(errors.theta)) + np.linalg.pinv(moved) @ (root - np.eye(len(root))) @ moved,
        W @ moved,
        np.maximum(ratios, 0.0),
        W @ z,
        np.linalg.solve(W.T, root @ z),
        float(y @ y - z @ z),
        volume,
        np.vstack([W @ moved @ estimate.basis.matrix, estimate.columns[m:]]),
        np.append(W @ z, estimate.y[m:]),
        *_dof_and_share(errors),
        np.inf if problem.scale_known else float(m - len(problem.names)),
    )


def _dof_and_share(errors: ErrorModel) -> tuple[float, float]:
    """Return effective degrees of freedom, and the fraction of variance due to shared errors.

    Both are those of the parameter for which that fraction is largest.
    """
    names = {TESTS, *(s.name for s in errors.sources)} & set(errors.contributions) - {NOISE}
    shared = sum((np.diagonal(errors.contributions[n]) for n in names), np.zeros(len(errors.names)))
    shares = shared / np.maximum(np.diagonal(errors.covariance), TINY)
    shares[[errors.names.index(name) for name in errors.assumed]] = 0.0
    largest = int(np.argmax(shares))
    return errors.dof(np.eye(len(shares))[largest]), float(shares[largest])
