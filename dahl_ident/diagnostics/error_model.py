r"""Linear mixed model of all sources of error of an estimate.

Write each row's log response as

    ln R_i = ln R(A_i, omega_i; theta) + run_i + level_i + d(ln A_i, ln omega_i) + e_i

with noise e, scatter between runs and between repeats of a level, and a smooth model error d
(:mod:`dahl_ident.diagnostics.error_sources`). A point that stands apart from all others may
have one more error, of a variance of its own, and so little weight. Exponents that were assumed,
not given, and calibrations with a stated uncertainty are parameters with a prior. Variances follow
from restricted maximum likelihood (:mod:`dahl_ident.diagnostics.variance_components`). With V the
sum of the covariances, priors included as rows of unit variance,

    G = (J' V^-1 J)^-1 J' V^-1,

the estimate is that of generalised least squares, iterated where the exponent moves, and its
covariance is the sum of G V_k G' over the sources: the rows of an uncertainty budget
(JCGM 100:2008). The variances s that weigh the residuals are estimates too, W their covariance: the
estimate moves by dG/ds_i y = -G V_i P y with each of them, and G V G' is too small by as much,
because these variances suit the residuals (Kackar and Harville; Kenward and Roger). Both together
add

    2 sum_ij W_ij G V_i P V_k P V_j G'

to the row of source k. Source: Searle, Casella and McCulloch, *Variance Components*, 1992; Kenward
and Roger, Biometrics 53 (1997) 983; Rasmussen and Williams, *Gaussian Processes*, 2006, section
2.7.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.diagnostics.determined_directions import Basis, chart_of_limit
from dahl_ident.diagnostics.error_sources import (
    MODEL_ERROR,
    NOISE,
    Source,
    StructuredSources,
    additive,
    gain_and_phase,
    of_one_scale,
    own_errors,
    relative_scatter,
    run_deviations,
)
from dahl_ident.diagnostics.misfit_explanations import at_an_end, neighbourhood
from dahl_ident.diagnostics.outliers import suspicious_points
from dahl_ident.diagnostics.residual_space import ResidualSpace
from dahl_ident.diagnostics.run_deviations import (
    Linearization,
    RunDeviations,
    alike,
    linearization,
)
from dahl_ident.diagnostics.variance_components import (
    CLOSE,
    Likelihood,
    LinearModel,
    Projection,
    RowProjection,
    VarianceComponents,
    block_diagonal,
    likelihood,
    variance_components,
)
from dahl_ident.fitting import Optimum
from dahl_ident.problem import Problem

EXPONENT = "exponent"
DRIVE = "drive factor"
_STEPS = 6  # linearisations at most; the last counts, settled or not
_SETTLED = 0.02  # of a standard deviation that an iteration still moves an estimate
_LONGEST_STEP = 0.7  # of a logarithm, in one iteration: the model is linearised
_ASKED_FOR = {MODEL_ERROR: 0.3, NOISE: 0.5}  # rise of the log-likelihood that a source takes
_RATE = 0.1  # the same for a force limit that changes with speed
_SUPPORTED = 4.0  # the same for another kind of noise: 0.5 % of the tables, by chance
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
    """An estimate that takes every source of error into account, and its covariance by source.

    Attributes
    ----------
    optimum : Optimum
        The least-squares fit that it started from.
    problem : Problem
        The same with the assumed exponents free; its `names` order every array here.
    theta : ndarray, shape (Q,)
        Generalised least squares, search coordinates.
    sources : tuple of Source
        Random errors of the rows, K of them.
    variances : ndarray, shape (K,)
        Of the sources.
    contributions : mapping of str to ndarray, shape (Q, Q)
        Covariance of theta by source, type A first.
    of_weights : mapping of str to ndarray, shape (Q, Q)
        What of these the uncertain variances add.
    assumed : tuple of str
        Names of parameters that were assumed: exponents, the force gain for a drive factor.
    """

    optimum: Optimum
    problem: Problem
    theta: FloatArray
    sources: tuple[Source, ...]
    components: VarianceComponents
    contributions: Mapping[str, FloatArray]
    of_weights: Mapping[str, FloatArray]
    assumed: tuple[str, ...]
    linear: LinearModel
    projection: Projection
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
    def tells_noise_apart(self) -> bool:
        """Whether there are enough residuals to tell a model error from noise."""
        return _tells(self.problem, self.assumed)

    @cached_property
    def covariance(self) -> FloatArray:
        """Combined covariance of theta, shape (Q, Q)."""
        return np.asarray(sum(self.contributions.values()))

    @cached_property
    def inverse(self) -> FloatArray:
        """G, shape (Q, m)."""
        G = self.projection.generalised_inverse()
        return G if self.basis is None else self.basis.matrix @ G

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
        less than 1, u^2 without what these errors add to it. `sources` leaves only these;
        infinite where all variances are known.
        """
        lever = direction @ self.inverse
        length = float(np.abs(lever).max()) or 1.0  # any length of the direction will do
        direction, lever = direction / length, lever / length
        shares = np.zeros(len(self.sources))
        for k, (source, part) in enumerate(zip(self.sources, self.linear.Z, strict=True)):
            if sources is None or source.name in sources:
                moved = lever * part if part.ndim == 1 else lever @ part
                shares[k] = moved @ moved
        spread = float(shares @ self.components.covariance @ shares)
        if not spread > 0.0:
            return np.inf
        counted = self.contributions if sources is None else sources
        total = sum(
            float(direction @ (self.contributions[n] - self.of_weights[n]) @ direction)
            for n in counted
        )
        return max(1.0, 2.0 * total**2 / spread)

    @property
    def runs_about_optimum(self) -> RunDeviations | None:
        """How runs deviate from the optimum, in its parameters."""
        columns = [self.names.index(name) for name in self.optimum.names]
        moved = self.optimum.theta - self.theta[columns]
        return None if self.runs is None else self.runs.about(moved, columns)

    @cached_property
    def beside_the_law(self) -> ComplexArray:
        """Responses (n,) by generalised least squares, with forces beside the model and rates.

        Without the smooth departure from the law itself, which its parameters do not describe.
        """
        moved = self.near.J @ (self.inverse @ self.linear.y)
        for source, effect in zip(self.sources, self.projection.effects(), strict=True):
            beside = source.shapes is None or source.shapes.parallel
            if source.name == MODEL_ERROR and beside:
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
    gain = next(p for p in given.sensors.parameters if p.name == "force_gain")
    if u and not gain.free:
        assumed[gain.name] = Assumption(DRIVE, float(u))
    if not assumed:
        return given, {}
    free = Problem(given.data, given.model, noise=given.noise, sensors=given.sensors, free=assumed)
    return free, assumed


class _Rows:
    """Residuals and Jacobian at a point, counted as the optimum counts them."""

    def __init__(
        self, optimum: Optimum, problem: Problem, assumed: Mapping[str, Assumption]
    ) -> None:
        self._problem = problem
        names, known = problem.names, dict(zip(optimum.names, optimum.theta, strict=True))
        self.start = np.array(
            [known.get(p.name, np.log(p.value or 1.0)) for p in problem.parameters]
        )
        self.m = problem.n_residuals
        self._columns = [names.index(name) for name in assumed]
        self._select = np.eye(len(names))[self._columns]
        self._given = np.array([one.std for one in assumed.values()])
        self._ranges = np.array([one.source == EXPONENT for one in assumed.values()], dtype=bool)
        self.std = self._given.copy()

    def widen(self, covariance: FloatArray) -> None:
        """Let ranges count for less where the data say more; `covariance` is that of theta.

        A range is no best guess: where the data alone know the parameter to u, better than its
        range does to s, an estimate must not be drawn to the middle of the range, so s^2/u takes
        the place of s.
        """
        found = np.diagonal(covariance)[self._columns]
        by_data = np.sqrt(np.maximum(1.0 / found - 1.0 / self.std**2, 1e-12))  # 1/u
        wider = np.maximum(self._given, self._given**2 * by_data)
        self.std = np.where(self._ranges, wider, self._given)

    def at(self, theta: FloatArray, near: Linearization) -> tuple[FloatArray, FloatArray]:
        """Return residuals and Jacobian: data, priors of sensors, ranges of exponents."""
        y, J = near.y, near.J
        if self._problem.priors:
            own, by = self._problem.residuals_and_jacobian(theta, tails=False)
            y, J = np.concatenate([y, own[self.m :]]), np.vstack([J, by[self.m :]])
        weight = np.concatenate([row_weights(self._problem), np.ones(len(y) - self.m)])
        select = self._select / self.std[:, None]
        y = np.concatenate([y * weight, select @ (theta - self.start)])
        return y, np.vstack([J * weight[:, None], select])


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
    rows = _Rows(optimum, problem, assumed)
    theta, m = rows.start, rows.m
    basis = None
    if not determined:
        chart = chart_of_limit(optimum, problem)
        basis = Basis.of(rows.at(theta, linearization(problem, theta))[1], theta, chart)
    noise: tuple[Source, ...] | None = None
    apart = False  # whether gain and phase have errors of their own size
    dof = problem.n_numbers - len(problem.names)
    shared = StructuredSources(problem, theta) if _tells(problem, assumed) else None
    starts: dict[tuple[int, ...] | None, FloatArray] = {}
    runs: RunDeviations | None = None
    for step in range(_STEPS):
        near = linearization(problem, theta, runs)
        y, J = rows.at(theta, near)
        if not np.isfinite(y).all():
            raise np.linalg.LinAlgError("a drive beyond the force limit has no steady response")
        level = float(y[:m] @ y[:m]) / max(dof, 1)
        rest = () if shared is None else shared.at(theta, near, apart=apart)
        whole = J
        if basis is not None:
            basis = basis.at(theta)
            J = J @ basis.matrix
        scatter = relative_scatter(problem, theta) if rest and m <= 2 * _FEW_ROWS else ()
        plain = (*of_one_scale(problem, beside=bool(scatter)), *scatter)
        sources, linear, found = _supported(problem, y, J, noise or plain, rest, level, starts)
        if noise is None and step == 1:
            noise = plain
            if rest and m <= 2 * _FEW_ROWS:
                scales = of_one_scale(problem, beside=True)
                kinds = (
                    (*scales, *relative_scatter(problem, theta, apart=True))
                    if problem.scale_known
                    else gain_and_phase(problem),
                    () if problem.scale_known else additive(problem),
                    _noise_and_own_errors(optimum, plain),
                )
                noise, sources, linear, found = _kind_of_noise(
                    problem, y, J, (sources, linear, found), level, (plain, *kinds)
                )
                apart = noise is kinds[0]
            # far from the optimum all sources may have been led to a lower maximum
            starts = {k: s for k, s in starts.items() if k is not None and noise is plain}
        projection = Projection(linear, found.variances)
        G = inverse = projection.generalised_inverse()
        covariance = projection.covariance()
        if basis is not None:
            G, covariance = basis.matrix @ G, basis.matrix @ covariance @ basis.matrix.T
        move = -G @ linear.y
        std = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))  # below zero by rounding
        before, runs = runs, run_deviations(problem, sources, projection.effects())
        settled = step > 1 and bool(np.all(np.abs(move) < _SETTLED * std))
        if step == _STEPS - 1 or (settled and alike(before, runs)):
            break
        rows.widen(covariance)
        if basis is None:
            theta = theta + move * _shortened(move)
        else:
            theta = basis.moved(theta, -inverse @ linear.y, _shortened)
        theta = np.clip(theta, *problem.bounds())
    parts = [
        _by_source(problem, assumed, sources, linear, found, lever)
        for lever in (G[None], _by_variances(linear, found, projection, G))
    ]
    contributions = {name: own + parts[1][name] for name, own in parts[0].items()}
    return ErrorModel(
        optimum, problem, theta, sources, found, contributions, parts[1], tuple(assumed), linear,
        projection, whole, near, runs, basis,
    )  # fmt: skip


def _shortened(move: FloatArray) -> float:
    """Return the part of a move that an iteration makes."""
    return min(1.0, _LONGEST_STEP / max(float(np.abs(move).max()), 1e-300))


def _noise_and_own_errors(optimum: Optimum, noise: tuple[Source, ...]) -> tuple[Source, ...]:
    """Return noise and an error of each row that stands apart; empty where none does.

    Neighbours, or a row at an end of the table, may be where the model fails.
    """
    rows = sorted(p.row for p in suspicious_points(optimum, ResidualSpace(optimum)))
    if not rows or at_an_end(optimum, rows) or neighbourhood(optimum, rows):
        return ()
    return (*noise, *own_errors(optimum.problem, rows))


def _tells(problem: Problem, assumed: Collection[str]) -> bool:
    return problem.n_numbers - len(problem.names) + len(assumed) >= _LEAST_DOF


_Found = tuple[tuple[Source, ...], LinearModel, VarianceComponents]


def linear_model(
    problem: Problem, y: FloatArray, J: FloatArray, sources: tuple[Source, ...]
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
    linear = LinearModel(y, J, known, Z)
    fewer = linear.compressed(m) if m > 2 * _FEW_ROWS else linear
    return fewer, likelihood(linear if any(s.columns.ndim == 3 for s in sources) else fewer)


def _supported(
    problem: Problem,
    y: FloatArray,
    J: FloatArray,
    noise: tuple[Source, ...],
    rest: tuple[Source, ...],
    level: float,
    starts: dict[tuple[int, ...] | None, FloatArray],
) -> _Found:
    """Return the sources; model errors and noise of the amplitudes where the data ask for them.

    `starts` has the variances with all sources (None) and with those of each subset that were
    estimated last; these ones take their place.
    """
    every = (*noise, *rest)
    linear, contrasts = linear_model(problem, y, J, every)
    upper = np.array([s.largest for s in every])
    scales = np.array([s.columns.ndim == 1 and not problem.scale_known for s in every])
    floor = np.where(scales, level, 0.0)
    whole = variance_components(contrasts, np.minimum(starts.get(None, floor), upper), upper)
    starts[None] = whole.variances
    optional = np.array([i >= len(noise) and s.name in _ASKED_FOR for i, s in enumerate(every)])
    # what has no variance beside all others has none beside fewer that explain as much
    asked = np.flatnonzero(optional & (whole.variances > 0.0)).tolist()
    best, best_value = None, -np.inf
    for k in range(len(asked) + 1):
        for subset in combinations(asked, k):
            price = sum(_asked_for(every[i]) for i in subset)
            # fewer sources explain no more than all of them do
            if best is not None and whole.log_likelihood + CLOSE - price < best_value:
                continue
            kept = ~optional
            kept[list(subset)] = True
            most = np.where(kept, upper, 0.0)
            begin = np.where(whole.variances > 0.0, whole.variances, floor)
            begin = np.minimum(starts.get(subset, begin), most)
            trial = variance_components(contrasts, begin, most)
            starts[subset] = trial.variances
            value = trial.log_likelihood - price
            if value > best_value:
                best, best_value = trial, value
    assert best is not None
    kept = np.flatnonzero(~optional | (best.variances > 0.0))
    return (
        tuple(every[i] for i in kept.tolist()),
        replace(linear, Z=[linear.Z[i] for i in kept.tolist()]),
        replace(
            best,
            variances=best.variances[kept],
            largest=best.largest[kept],
            information=best.information[np.ix_(kept, kept)],
        ),
    )


def _asked_for(source: Source) -> float:
    return _RATE if source.rate_of is not None else _ASKED_FOR[source.name]


def _kind_of_noise(
    problem: Problem,
    y: FloatArray,
    J: FloatArray,
    found: _Found,
    level: float,
    kinds: Sequence[tuple[Source, ...]],
) -> tuple[tuple[Source, ...], tuple[Source, ...], LinearModel, VarianceComponents]:
    """Return the kind of noise that the residuals support, and the sources with it.

    `found` has the first of the `kinds`.
    """
    best, kind = found, kinds[0]
    rest = tuple(s for s in found[0] if not any(s is k for k in kind))
    for trial in kinds[1:]:
        if not trial:
            continue
        sources = (*trial, *rest)
        linear, contrasts = linear_model(problem, y, J, sources)
        own = np.array([s.columns.ndim == 1 for s in sources])
        upper = np.array([s.largest for s in sources])
        other = variance_components(contrasts, np.where(own, level, 0.0), upper)
        if other.log_likelihood > best[2].log_likelihood + _SUPPORTED:
            best, kind = (sources, linear, other), trial
    return (kind, *best)


def _by_source(
    problem: Problem,
    assumed: Mapping[str, Assumption],
    sources: tuple[Source, ...],
    linear: LinearModel,
    found: VarianceComponents,
    levers: FloatArray,
) -> dict[str, FloatArray]:
    """Return the covariance of theta that each source makes by levers (k, Q, m) of residuals."""
    result = {}
    priors = [_CALIBRATIONS.get(name, name) for name in problem.priors]
    known = [*priors, *(one.source for one in assumed.values())]
    m = len(linear.y) - len(known)
    if problem.scale_known:
        result[NOISE] = _squared(levers[..., :m])
    for source, part, variance in zip(sources, linear.Z, found.variances.tolist(), strict=True):
        own = variance * _squared(levers * part if part.ndim == 1 else levers @ part)
        result[source.name] = result[source.name] + own if source.name in result else own
    for row, name in enumerate(known, start=m):
        own = _squared(levers[..., row : row + 1])
        result[name] = result[name] + own if name in result else own
    return result


def _squared(levers: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("kqi,kpi->qp", levers, levers))


def _by_variances(
    linear: LinearModel, found: VarianceComponents, projection: Projection, G: FloatArray
) -> FloatArray:
    """Return what uncertain variances do, as levers (k, Q, m) of independent errors."""
    through = [G * part**2 if part.ndim == 1 else (G @ part) @ part.T for part in linear.Z]
    size = np.sqrt(np.diagonal(found.covariance))
    size = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(found.covariance / np.outer(size, size))
    roots = size[:, None] * vectors * np.sqrt(2.0 * np.maximum(values, 0.0))
    return np.asarray(np.einsum("ik,iqm->kqm", roots, np.array(through)) @ projection.P)
