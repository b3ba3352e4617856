r"""The estimate: weighted least squares, with one misfit in addition to the stated covariance.

A row with the stated covariance C, whose test has the fundamental force F_1, is weighted as if its
covariance were

    C + s^2 |F_1|^2.

The misfit s is the same for all fundamentals, and such that chi-square equals its degrees of
freedom: zero where the model describes the data (Paule and Mandel, Journal of Research of the
National Bureau of Standards 87 (1982) 377). The misfit of harmonics is that value or the one from
their own residuals, whichever is larger. If the harmonics alone give another estimate than the
fundamentals, their variance is increased until both agree. Where no covariance is stated, the
estimated scale of the noise replaces s.

With a robust loss the residuals are its scores, and chi-square and scale are those of
:mod:`dahl_ident.fitting.losses`; everything else is as in least squares, to first order.

Priors of sensors and ranges of assumed exponents are additional rows. If the optimum lies at
infinity, the coordinates are those of its limit (:mod:`dahl_ident.fitting.asymptotes`), such as
sigma^2/f_max in microslip.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.linalg import block_diag

from dahl_ident.arrays import TINY, BoolArray, ComplexArray, FloatArray, IntArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.contributions import DRIVE_FACTOR, EXPONENT
from dahl_ident.diagnostics.information import NOTICED, Basis
from dahl_ident.elements import Model
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.asymptotes import Chart, limits
from dahl_ident.fitting.losses import Loss, loss_named
from dahl_ident.fitting.optimum import agreed_scale
from dahl_ident.noise import squares_of
from dahl_ident.problem import TableProblem
from dahl_ident.problem.stiffness import StiffnessData

GAIN = "force_gain"
_GAUSS_NEWTON_STEPS = 60  # most Gauss-Newton steps; five are usual
_BARELY_DETERMINED = 0.25  # variance of an exponent over that of its range: two minima are possible
_TWO_MINIMA = 0.1  # least distance of different minima, in standard deviations
_JACKKNIFE_SETTLED = 0.03  # last step of an estimate of the jackknife, in standard deviations
_LINEAR = 0.3  # change of a logarithm up to which the model is linear
_SETTLED = 1e-3  # last step of a search, in standard deviations
_LONGEST_STEP = 0.7  # change of a logarithm in one step of the linearised model
_FIRST_DAMPING, _DAMPED = 1e-3, 10.0  # damping after a step that fails, and its factor
_STEP_TRIALS = 8  # trials of one step, each with more damping
_ROOT_STEPS = 200  # most Newton steps for the misfit; far from the root, it doubles
_LEAST_REMAINING = 1e-3  # least value of 1 - leverage of a test
_LARGEST_FACTOR = 1e6  # of the harmonics' variance
_SAME_FACTOR = 1e-8  # tolerance of the logarithm of that factor
_SAME_MISFIT = 1e-9  # relative tolerance of the misfit's square


def chart_of_limit(optimum: Optimum, problem: TableProblem) -> Chart:
    """Return the coordinates of the limit at which an optimum lies; theta if it is finite.

    Free parameters of `problem` that the optimum does not have are added as coordinates.
    """
    extremes = {
        p.name: value
        for p, value in zip(optimum.problem.parameters, optimum.values.tolist(), strict=True)
        if np.isinf(value) or (value == 0.0 and p.positive)
    }
    candidates = limits(optimum.problem) if extremes else ()
    matching = [limit for limit in candidates if limit.extremes == extremes]
    if not matching:
        return Basis.every(len(problem.names)).chart
    chart = min(
        (limit.chart.of(0) for limit in matching),
        key=lambda c: float(np.abs(c.theta(c.phi(optimum.theta)) - optimum.theta).max()),
    )
    of_optimum = [problem.names.index(name) for name in optimum.names]
    others = [i for i in range(len(problem.names)) if i not in of_optimum]
    order, unit = np.argsort([*of_optimum, *others]), np.eye(len(others))
    tied = None if chart.tied is None else (of_optimum[chart.tied[0]], of_optimum[chart.tied[1]])
    offset = np.append(chart.offset, np.zeros(len(others)))[order]
    matrix, back = block_diag(chart.matrix, unit)[order], block_diag(chart.back, unit)[:, order]
    return Chart(matrix, offset, back, tied)


class Assumption(NamedTuple):
    """Uncertainty of a parameter that a fit assumes: its name in a budget, and its size."""

    source: str
    std: float  # standard uncertainty of the logarithm


def assumed_exponents(model: Model) -> dict[str, float]:
    """Return the standard uncertainty of the logarithm of each assumed exponent, by name.

    Its range is taken as a uniform distribution of the logarithm.
    """
    return {
        p.name: float(np.log(p.prior[1] / p.prior[0]) / np.sqrt(12.0))
        for p in model.parameters
        if p.assumed and not p.free and p.prior is not None
    }


def with_assumed(problem: TableProblem) -> tuple[TableProblem, dict[str, Assumption]]:
    """Return the problem with free assumed exponents and drive factor, and their uncertainties."""
    exponents = assumed_exponents(problem.model)
    assumed = {name: Assumption(EXPONENT, std) for name, std in exponents.items()}
    u = problem.data.drive_factor_uncertainty
    gain = next(p for p in problem.sensors.parameters if p.name == GAIN)
    if u and not gain.free:
        assumed[gain.name] = Assumption(DRIVE_FACTOR, float(u))
    if not assumed:
        return problem, {}
    return problem.assuming({name: a.std for name, a in assumed.items()}), assumed


@dataclass(frozen=True)
class WeightedEstimate:
    """Weighted least squares: the optimum of a problem whose covariances hold the misfit."""

    problem: TableProblem  # with assumed exponents free, and the misfit in the covariances
    theta: FloatArray  # (Q,): the estimate, search coordinates
    misfit_variance: FloatArray  # (n,): what the misfit adds to the stated covariances
    scale: float  # of the residuals; 1 where the data state it
    residuals: FloatArray  # (M,): of unit variance; those of data, then of priors
    jacobian: FloatArray  # (M, Q): their derivatives
    loss: Loss | None
    regular: bool  # whether the data determine every parameter
    basis: Basis  # directions that the data determine
    # (Q,): difference to a second minimum times the root of its probability; None without one
    second: FloatArray | None = None

    @cached_property
    def deviance(self) -> float:
        """Minus twice the log likelihood, apart from a constant."""
        stated = self.factors(self.problem.widened(np.zeros(self.problem.data.n)))
        r, m = self.residuals, self.problem.n_residuals
        square = squares_of(r[:m])
        lost = np.sum(square if self.loss is None else self.loss.rho(square)) + r[m:] @ r[m:]
        return float(lost - 2.0 * np.linalg.slogdet(stated)[1].sum())

    @cached_property
    def chance(self) -> float:
        """Probability that the stated noise alone makes chi-square this large; 1 without misfit."""
        if not self.problem.has_misfit:
            return 1.0
        r = self.problem.widened(np.zeros(self.problem.data.n)).residuals(self.theta)
        dof = self.problem.n_nonzero + self.problem.n_priors - len(self.problem.names)
        return float(special.chdtrc(max(dof, 1), r @ r))

    @cached_property
    def y(self) -> FloatArray:
        """Residuals in the least-squares sense, (M,): with a robust loss, its scores."""
        return scores_of(self.residuals, self.problem.n_residuals, self.loss)

    @property
    def columns(self) -> FloatArray:
        """Derivatives with respect to what the data determine, (M, r)."""
        return self.jacobian @ self.basis.matrix

    def changed(self, changes: ComplexArray) -> FloatArray:
        """Return the changes of `y`, (M, k), caused by changes (k, n) of the responses."""
        columns = -self.problem.residual_change(self.theta, changes).T / self.scale
        return np.pad(columns, ((0, self.problem.n_priors), (0, 0)))

    def factors(self, problem: TableProblem) -> FloatArray:
        """Return the matrices from each row's residuals in `problem` to those of `y`, (n, 2, 2)."""
        ones = np.ones(self.problem.data.n)
        to_y = row_changes(self.problem, self.theta, ones) / self.scale
        return np.asarray(to_y @ np.linalg.pinv(row_changes(problem, self.theta, ones)))

    @cached_property
    def predicted(self) -> ComplexArray:
        """Predicted responses, (n,)."""
        return self.problem.predict(self.theta)

    @cached_property
    def view(self) -> StiffnessData:
        """Amplitude, frequency and dynamic stiffness of the predicted rows."""
        return self.problem.predicted_stiffness(self.theta)

    @cached_property
    def relative_units(self) -> FloatArray:
        """The matrices from each row of `y` to ln gain and phase, shape (n, 2, 2)."""
        return relative_units(self.problem, self.theta, self.predicted) * self.scale

    def lever(self, left_out: Collection[str] = ()) -> FloatArray:
        """Return G = (J'J)^-1 J', d theta/d y (Q, M), for exact values of `left_out`."""
        kept = self.basis.matrix
        if left_out:
            kept = kept[:, [name not in left_out for name in self.problem.names]]
        Q, R = np.linalg.qr(self.jacobian @ kept)
        return np.asarray(kept @ np.linalg.solve(R, Q.T))

    def without(self, left_out: IntArray) -> WeightedEstimate:
        """Return the estimate without some residuals, by one Gauss-Newton step."""
        kept = np.ones(len(self.y), dtype=bool)
        kept[left_out] = False
        step = np.linalg.lstsq(self.columns[kept], -self.y[kept], rcond=1e-13)[0]
        theta = _moved(self.problem, self.theta, np.asarray(step), self.basis)
        r, J = self.problem.residuals_and_jacobian(theta, self.scale, tails=self.loss is None)
        if not (np.isfinite(r).all() and np.isfinite(J).all()):
            return self
        return replace(self, theta=theta, residuals=r, jacobian=J, basis=self.basis.at(theta))

    def jackknife(self, tests: Sequence[IntArray]) -> FloatArray:
        """Return the covariance of theta by leaving out each test, (Q, Q), to first order.

        The change due to each test is divided by the root of 1 - leverage, so that the covariance
        is unbiased if the weights are right. Source: Wu, Annals of Statistics 14 (1986) 1261.
        """
        Q, R = np.linalg.qr(self.jacobian)
        moves = []
        for rows in tests:
            of_test = (2 * rows[:, None] + np.arange(2)).ravel()
            remaining, vectors = np.linalg.eigh(np.eye(len(R)) - Q[of_test].T @ Q[of_test])
            scores = vectors.T @ (Q[of_test].T @ self.y[of_test])
            moves.append(vectors @ (scores / np.sqrt(np.maximum(remaining, _LEAST_REMAINING))))
        changes = np.linalg.solve(R, np.array(moves).T).T
        changes = np.clip(changes, *(bound - self.theta for bound in self.problem.bounds()))
        return np.asarray(changes.T @ changes)


def row_changes(
    problem: TableProblem, theta: FloatArray, size: FloatArray | ComplexArray
) -> FloatArray:
    """Return the changes of each row's residuals if its response changes by `size` and i `size`."""
    both = problem.residual_change(theta, np.array([[1.0], [1.0j]]) * size)
    return both.reshape(2, -1, 2).transpose(1, 2, 0)


def relative_units(problem: TableProblem, theta: FloatArray, predicted: ComplexArray) -> FloatArray:
    """Return the matrices from each row's residuals to ln gain and phase, (n, 2, 2)."""
    return np.asarray(np.linalg.pinv(-row_changes(problem, theta, predicted)), dtype=np.float64)


def weighted_estimate(
    optimum: Optimum, problem: TableProblem, *, determined: bool
) -> WeightedEstimate:
    """Return the estimate, searched from an optimum.

    If the data determine an assumed exponent barely better than its range does, there may be a
    second minimum. The search is then repeated from the ends of the range, and the likelier minimum
    is taken.
    """
    best = _minimum(optimum, problem, optimum.theta_in(problem), determined=determined)
    if not determined:
        return best
    covariance = np.linalg.pinv(best.jacobian.T @ best.jacobian, hermitian=True)
    minima = [best]
    for name, (centre, std) in problem.ranges.items():
        i = problem.names.index(name)
        column, variance = covariance[:, i], float(covariance[i, i])
        if name == GAIN or not variance > _BARELY_DETERMINED * std**2:
            continue
        for end in (centre - 3.0**0.5 * std, centre + 3.0**0.5 * std):
            change = column / variance * (end - best.theta[i])
            start = np.clip(best.theta + change, *problem.bounds())
            with suppress(np.linalg.LinAlgError), np.errstate(all="ignore"):  # a start far off
                minimum = _minimum(optimum, problem, start, determined=True)
                minima += [minimum] if np.isfinite(minimum.deviance) else []
    best, *others = sorted(minima, key=lambda minimum: minimum.deviance)
    different = [
        m for m in others if np.linalg.norm(best.columns @ (m.theta - best.theta)) > _TWO_MINIMA
    ]
    if not different:
        return best
    second = different[0]
    chance = special.expit(0.5 * (best.deviance - second.deviance))
    return replace(best, second=np.sqrt(chance) * (second.theta - best.theta))


def jackknife_with_weights(
    estimate: WeightedEstimate, optimum: Optimum, tests: Sequence[IntArray]
) -> FloatArray:
    """Return the covariance of theta, (Q, Q), by estimating it and the weights without each test.

    The model is linearised at the estimate, and refitted if a test moves the estimate far. The
    changes are not weighted with the leverage, because the weights may be wrong: a parameter that
    one test alone determines is as uncertain as it is without that test.
    """
    theta, loss = estimate.theta, estimate.loss
    problem = estimate.problem.widened(np.zeros(estimate.problem.data.n))
    rows, basis, bounds = LinearRows.at(problem, theta), Basis.every(len(theta)), problem.bounds()
    moves = []
    for test in tests:
        kept = np.ones(problem.data.n, dtype=bool)
        kept[test] = False
        others, refitted = rows.take(kept), theta.copy()
        with suppress(np.linalg.LinAlgError):  # the other tests do not determine theta
            for _ in range(_GAUSS_NEWTON_STEPS):
                at = others.moved(refitted - theta)
                r, columns = at.weighted(at.squares(loss))
                y = scores_of(r, 2 * len(at.z), loss)
                step = _step(columns, y, refitted, basis, bounds)
                refitted = refitted + step
                if np.linalg.norm(columns @ step) < _JACKKNIFE_SETTLED:
                    break
            if np.abs(refitted - theta)[problem.space.positive].max(initial=0.0) > _LINEAR:
                part = problem.part(kept, problem.data.response[kept])
                refitted = _minimum(optimum, part, theta, determined=True).theta
            moves.append(refitted - theta)
    changes = np.array(moves).reshape(-1, len(theta))
    return np.asarray((1.0 - 1.0 / len(tests)) * changes.T @ changes)


@dataclass(frozen=True)
class LinearRows:
    """Rows whitened by the stated covariances, rotated so that their two parts are independent.

    With a squared misfit x, the variances of the two parts are 1 + growth x.
    """

    z: FloatArray  # (n, 2)
    slopes: FloatArray  # (n, 2, Q): derivatives with respect to theta
    growth: FloatArray  # (n, 2)
    priors: tuple[FloatArray, FloatArray]  # (p,) and (p, Q): residuals and derivatives
    first: BoolArray  # (n,): fundamentals
    numbers: FloatArray  # (n,): real numbers in each row, 1 or 2

    @classmethod
    def at(cls, stated: TableProblem, theta: FloatArray) -> LinearRows:
        """Return the rows of a problem without misfit."""
        m = stated.n_residuals
        y, J = stated.residuals_and_jacobian(theta)
        D = row_changes(stated, theta, fundamental_sizes(stated.data))
        growth, turn = np.linalg.eigh(D @ D.swapaxes(1, 2))
        return cls(
            np.einsum("nji,nj->ni", turn, y[:m].reshape(-1, 2)),
            np.einsum("nji,njq->niq", turn, J[:m].reshape(-1, 2, len(theta))),
            np.maximum(growth, 0.0),
            (y[m:], J[m:]),
            stated.data.harmonic == 1,
            np.where(stated.data.harmonic == 0, 1.0, 2.0),
        )

    def take(self, rows: BoolArray) -> LinearRows:
        """Return some of the rows, and all priors."""
        named = ("z", "slopes", "growth", "first", "numbers")
        return replace(self, **{name: getattr(self, name)[rows] for name in named})

    def moved(self, step: FloatArray) -> LinearRows:
        """Return the rows after a step of theta."""
        y, J = self.priors
        return replace(self, z=self.z + self.slopes @ step, priors=(y + J @ step, J))

    def weighted(self, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals of unit variance and their derivatives, for squared misfits (n,)."""
        weight = 1.0 / np.sqrt(1.0 + self.growth * square[:, None])
        y, J = self.priors
        slopes = (weight[:, :, None] * self.slopes).reshape(-1, J.shape[1])
        return np.concatenate([(weight * self.z).ravel(), y]), np.concatenate([slopes, J])

    def squares(self, loss: Loss | None) -> FloatArray:
        """Return each row's squared misfit, (n,), such that chi-square has its expected value."""
        y, J = self.priors
        first, square = self.first, np.zeros(len(self.z))
        separate = bool(first.any() and not first.all() and 2 * first.sum() > J.shape[1])
        first = first | (not separate)
        free = J.shape[1] - len(y) + float(y @ y)
        targets = [(first, self.numbers[first].sum() - free), (~first, self.numbers[~first].sum())]
        if targets[0][1] <= 0.0:
            return square
        for rows, target in targets:
            square[rows] = _square(self.z[rows] ** 2, self.growth[rows], float(target), loss)
        if separate and square.any():
            square[~first] = np.maximum(square[~first], square[first].max())
            r, slopes = self.weighted(square)
            factor = _disagreement(scores_of(r, 2 * len(first), loss), slopes, ~first)
            square = np.where(first, 1.0, factor) * square
        return square


def _minimum(
    optimum: Optimum, problem: TableProblem, theta: FloatArray, *, determined: bool
) -> WeightedEstimate:
    """Return the minimum that a Gauss-Newton search from theta reaches.

    Each step computes the weights anew. A step that does not lower the cost is repeated with more
    damping.
    """
    stated, basis = problem.widened(np.zeros(problem.data.n)), Basis.every(len(theta))
    loss, m = loss_named(optimum.loss, problem.residuals_per_row), problem.n_residuals
    if not determined:
        _, J = stated.residuals_and_jacobian(theta)
        basis = Basis.of(J, theta, chart_of_limit(optimum, problem))
    damping, bounds = 0.0, problem.bounds()
    for _ in range(_GAUSS_NEWTON_STEPS):
        variance, scale = _weights(stated, theta, loss)
        weighted = stated.widened(variance)
        r, J = weighted.residuals_and_jacobian(theta, scale, tails=loss is None)
        y = scores_of(r, m, loss)
        basis = basis.at(theta)
        columns = J @ basis.matrix
        if not (np.isfinite(y).all() and np.isfinite(columns).all()):
            raise np.linalg.LinAlgError("no finite step from the estimate")
        step = _step(columns, y, theta, basis, bounds)
        if np.linalg.norm(columns @ step) < _SETTLED:
            break
        mean_slope = 1.0 if loss is None else loss.mean_slope(squares_of(r[:m]))
        cost = _cost(r, m, loss, mean_slope)
        for _ in range(_STEP_TRIALS):
            if damping:
                rows = np.diag(np.sqrt(damping) * np.linalg.norm(columns, axis=0))
                damped = np.vstack([columns, rows]), np.append(y, np.zeros(len(rows)))
                step = _step(*damped, theta, basis, bounds)
            trial = _moved(problem, theta, step, basis)
            r_trial = weighted.residuals_and_jacobian(trial, scale, tails=loss is None)[0]
            if np.isfinite(r_trial).all() and _cost(r_trial, m, loss, mean_slope) < cost:
                damping = damping / _DAMPED if damping > _FIRST_DAMPING else 0.0
                break
            damping = max(_DAMPED * damping, _FIRST_DAMPING)
        else:
            break
        theta = trial
    return WeightedEstimate(weighted, theta, variance, scale, r, J, loss, determined, basis)


def scores_of(r: FloatArray, m: int, loss: Loss | None) -> FloatArray:
    """Return residuals for least squares: with a robust loss, scores of the data's m residuals."""
    return r if loss is None else np.concatenate([loss.scores(r[:m]), r[m:]])


def _cost(r: FloatArray, m: int, loss: Loss | None, mean_slope: float) -> float:
    """Return the sum of squares; with a loss, the function whose gradient the scores give."""
    z = squares_of(r[:m])
    return float(np.sum(z if loss is None else loss.rho(z) / mean_slope) + r[m:] @ r[m:])


def _step(
    columns: FloatArray,
    y: FloatArray,
    theta: FloatArray,
    basis: Basis,
    bounds: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Return the Gauss-Newton step within bounds.

    A parameter that the step would take beyond a bound is moved to the bound, and the step of the
    others is computed again. This holds for parameters that one direction of the basis moves.
    """
    matrix = basis.matrix
    uncoupled = (matrix != 0.0).sum(axis=1) == 1
    step, to_bounds = np.zeros((2, columns.shape[1]))
    free = np.ones(columns.shape[1], dtype=bool)
    for _ in range(len(theta)):
        solution = np.linalg.lstsq(columns * free, -y - columns @ to_bounds, rcond=1e-13)[0]
        step = to_bounds + free * solution
        end = theta + matrix @ step
        end_within = np.clip(end, *bounds)
        beyond = np.flatnonzero(uncoupled & (end != end_within))
        directions = np.abs(matrix[beyond]).argmax(axis=1)
        if not free[directions].any():
            break
        free[directions] = False
        to_bounds[directions] = (end_within - theta)[beyond] / matrix[beyond, directions]
    return np.asarray(step)


@lru_cache(maxsize=64)  # used in every step of a search
def tests_of(data: FrequencyResponse) -> tuple[IntArray, IntArray]:
    """Return the number of each row's test, and the row of its fundamental, (n,) each.

    A test is all rows of one level in one run; a row without a fundamental refers to itself.
    """
    runs = np.zeros(data.n) if data.run is None else np.unique(data.run, return_inverse=True)[1]
    levels = (v for v in (data.amplitude, data.drive) if v is not None)
    keys = np.column_stack((runs, data.frequency_hz, *levels))
    test = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    first = np.flatnonzero(data.harmonic == 1)
    fundamental = np.full(test.max() + 1, -1)
    fundamental[test[first][::-1]] = first[::-1]  # the first of several
    others = (data.harmonic != 1) & (fundamental[test] >= 0)
    return test, np.where(others, fundamental[test], np.arange(data.n))


def fundamental_sizes(data: FrequencyResponse) -> FloatArray:
    """Return the size of the response's fundamental in each row's test, (n,)."""
    return np.abs(data.response)[tests_of(data)[1]]


def _weights(
    stated: TableProblem, theta: FloatArray, loss: Loss | None
) -> tuple[FloatArray, float]:
    """Return the variance that the misfit adds to each row, and the scale of the residuals."""
    if stated.scale_known:
        square = LinearRows.at(stated, theta).squares(loss)
        return square * fundamental_sizes(stated.data) ** 2, 1.0
    m, dof = stated.n_residuals, stated.n_nonzero - len(stated.names)
    # derivatives are computed too, as they are needed next
    y = stated.residuals_and_jacobian(theta, tails=loss is None)[0]
    scale = max(float(np.sqrt(y[:m] @ y[:m] / max(dof, 1))), float(stated.rounding), 1e-300)
    scale = agreed_scale(stated, loss, lambda _: (theta, dof), scale)
    return np.zeros(stated.data.n), scale


def _disagreement(y: FloatArray, J: FloatArray, harmonics: BoolArray) -> float:
    """Return the factor of the harmonics' variance with which they agree with the fundamentals.

    Both estimate the parameters. As in Paule and Mandel's method, the squared distance of the two
    estimates over its variance equals the number of directions that the harmonics determine.
    """
    of_harmonics = np.pad(np.repeat(harmonics, 2), (0, len(y) - 2 * len(harmonics)))

    def normal_equations(rows: BoolArray) -> tuple[FloatArray, FloatArray]:
        return J[rows].T @ J[rows], J[rows].T @ y[rows]

    A, b = normal_equations(~of_harmonics)
    A_h, b_h = normal_equations(of_harmonics)
    size = np.sqrt(np.maximum(np.diagonal(A + A_h), TINY))
    A, b = A / np.outer(size, size), b / size
    A_h, b_h = A_h / np.outer(size, size), b_h / size
    directions = int(np.linalg.matrix_rank(A_h, tol=NOTICED, hermitian=True))

    def explained(M: FloatArray, v: FloatArray) -> float:
        return float(v @ np.linalg.pinv(M, rcond=NOTICED**2, hermitian=True) @ v)

    def distance(factor: float) -> float:
        separately = explained(A, b) + explained(A_h, b_h) / factor
        return separately - explained(A + A_h / factor, b + b_h / factor)

    def excess(ln_factor: float) -> float:
        return distance(np.exp(ln_factor)) - directions

    most = np.log(_LARGEST_FACTOR)
    if excess(0.0) <= 0.0:
        return 1.0
    if excess(most) >= 0.0:
        return _LARGEST_FACTOR
    from scipy.optimize import brentq  # slow to import, and rarely needed

    return float(np.exp(brentq(excess, 0.0, most, xtol=_SAME_FACTOR)))


def _square(z: FloatArray, b: FloatArray, target: float, loss: Loss | None) -> float:
    """Return the squared misfit x with which chi-square of rows (n, 2) equals its target."""
    x = _root(z, b, target)
    if loss is None or not len(z):
        return x
    for _ in range(_ROOT_STEPS):
        counts = loss.counts(np.sum(z / (1.0 + b * x), axis=1), target)
        last, x = x, _root(counts[:, None] * z, b, target)
        if abs(x - last) <= _SAME_MISFIT * x:
            break
    return x


def _root(z: FloatArray, b: FloatArray, target: float) -> float:
    """Return x >= 0 at which sum z/(1 + b x), convex and falling, reaches the target."""
    x = 0.0
    if z.sum() <= target:
        return x
    fixed = float(z[b == 0.0].sum())
    if fixed >= target:
        raise np.linalg.LinAlgError("no misfit makes these residuals as small as their covariance")
    for _ in range(_ROOT_STEPS):
        parts = z / (1.0 + b * x)
        excess = float(parts.sum()) - target
        slope = float((parts * b / (1.0 + b * x)).sum())
        step = excess / slope if slope > 0.0 else 0.0
        x += step
        if step <= _SAME_MISFIT * x:
            break
    return x


def _moved(problem: TableProblem, theta: FloatArray, step: FloatArray, basis: Basis) -> FloatArray:
    """Return theta after a step, shortened so that no logarithm changes by much."""
    basis = basis.at(theta)
    logarithmic = (basis.slopes[problem.space.positive] != 0.0).any(axis=0)
    move = basis.size * (basis.directions @ step)
    longest = max(float(np.abs(move[logarithmic]).max(initial=0.0)), TINY)
    part = min(1.0, _LONGEST_STEP / longest)
    return np.clip(basis.chart.theta(basis.chart.phi(theta) + part * move), *problem.bounds())
