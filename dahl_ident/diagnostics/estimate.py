r"""The estimate: weighted least squares, with one misfit in addition to the stated covariance.

A row of the covariance C and the fundamental force F_1 of its test counts as one of the covariance

    C + s^2 |F_1|^2,

the misfit s the same for all fundamentals, and such that chi-square equals its degrees of freedom:
zero where the model describes the data. That of harmonics is the larger of it and their own, and
they count less the farther their estimate lies from that of the fundamentals, so that they cannot
pull it away. Where no covariance is stated, the noise's scale takes its place.
With a robust loss the residuals are its scores, and chi-square and scale are those of
:mod:`dahl_ident.fitting.losses`; to first order all else is as in least squares.
Priors of sensors and ranges of assumed exponents are further rows. Where the optimum lies at
infinity, the coordinates are those of its limit (:mod:`dahl_ident.fitting.asymptotes`), such as
sigma^2/f_max in microslip. Source: Paule and Mandel,
Journal of Research of the National Bureau of Standards 87 (1982) 377.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from dahl_ident.arrays import TINY, ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.contributions import DRIVE_FACTOR, EXPONENT
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.asymptotes import Chart, limits
from dahl_ident.fitting.losses import Loss, loss_named
from dahl_ident.fitting.optimum import agreed_scale
from dahl_ident.noise import squares_of
from dahl_ident.problem import TableProblem
from dahl_ident.problem.stiffness import StiffnessData

_NOTICED = 1e-5  # change of residuals over the largest, below which a direction is undetermined
_OUTSIDE = 1e-3  # share of a direction that the data may leave open, from rounding
GAIN = "force_gain"
_STEPS = 60  # Gauss-Newton steps; five are the rule
_LITTLE_SAID = 0.25  # of the variance of a range: the data say little more of an exponent
_APART = 0.1  # standard deviations between two minima
_NEAR_ENOUGH = 0.03  # the same for the estimates of a jackknife
_LINEAR = 0.3  # change of a logarithm, with which the model changes in proportion
_SETTLED = 1e-3  # of a standard deviation that a step still moves the estimate
_LONGEST_STEP = 0.7  # of a logarithm, in one step: the model is linearised
_FIRST_DAMPING, _DAMPED = 1e-3, 10.0  # of a step after which the sum of squares does not fall
_TRIALS = 8  # of one step, each damped more
_ROOT_STEPS = 200  # Newton's, from below, for the misfit: it doubles where it is far off
_LEAST_LEFT = 1e-3  # of a test, that the others do not determine
_MOST_DISAGREEMENT = 1e6  # of harmonics with fundamentals, as a factor of their variance
_SAME_FACTOR = 1e-8  # of its logarithm
_SAME = 1e-9  # relative change of the misfit's square that no longer counts


@dataclass(frozen=True)
class Basis:
    """Orthonormal directions, (C, r), of the scaled coordinates that the data determine."""

    size: FloatArray
    directions: FloatArray
    slopes: FloatArray  # (Q, C): derivatives of theta with respect to the coordinates
    chart: Chart  # gives theta at the coordinates

    @classmethod
    def every(cls, count: int) -> Basis:
        """Return all directions of theta."""
        unit = np.eye(count)
        return cls(np.ones(count), unit, unit, Chart(unit, np.zeros(count), unit))

    @classmethod
    def of(cls, J: FloatArray, theta: FloatArray, chart: Chart) -> Basis:
        """Return the directions that residuals with the Jacobian J determine."""
        slopes = chart.derivative(theta)
        by_coordinates = J @ slopes
        size = 1.0 / np.maximum(np.linalg.norm(by_coordinates, axis=0), np.finfo(float).tiny)
        _, singular, directions = np.linalg.svd(by_coordinates * size, full_matrices=False)
        return cls(size, directions[singular > _NOTICED * singular[0]].T, slopes, chart)

    @property
    def matrix(self) -> FloatArray:
        """Changes of theta, shape (Q, r)."""
        return np.asarray(self.slopes @ (self.size[:, None] * self.directions))

    def at(self, theta: FloatArray) -> Basis:
        """Return the same changes of the coordinates at another theta."""
        return replace(self, slopes=self.chart.derivative(theta))

    def holds(self, slopes: FloatArray) -> NDArray[np.bool_]:
        """Return whether quantities with the derivatives (..., Q) are determined, shape (...).

        One that no coordinate changes is infinite in the limit, unless nothing changes it at all.
        """
        # directions alone count, and slopes may be as large as numbers can be
        largest = np.abs(slopes).max(axis=-1, keepdims=True, initial=np.finfo(np.float64).tiny)
        scaled = (slopes / largest) @ self.slopes * self.size
        left = scaled - (scaled @ self.directions) @ self.directions.T
        whole = np.linalg.norm(scaled, axis=-1)
        known = np.linalg.norm(left, axis=-1) <= _OUTSIDE * whole
        return np.asarray(known & ((whole > 0.0) | ~slopes.any(axis=-1)))


def chart_of_limit(optimum: Optimum, problem: TableProblem) -> Chart:
    """Return the coordinates of the limit at which an optimum lies; theta where it is finite.

    `problem` may have more free parameters, coordinates in addition to those of the limit.
    """
    gone = {
        p.name: value
        for p, value in zip(optimum.problem.parameters, optimum.values.tolist(), strict=True)
        if np.isinf(value) or (value == 0.0 and p.positive)
    }
    reached = [one for one in limits(optimum.problem) if one.extremes == gone] if gone else []
    if not reached:
        return Basis.every(len(problem.names)).chart
    chart = min(
        (one.chart.of(0) for one in reached),
        key=lambda c: float(np.abs(c.theta(c.phi(optimum.theta)) - optimum.theta).max()),
    )
    of_optimum = [problem.names.index(name) for name in optimum.names]
    others = [i for i in range(len(problem.names)) if i not in of_optimum]
    place, unit = np.argsort([*of_optimum, *others]), np.eye(len(others))
    tied = None if chart.tied is None else (of_optimum[chart.tied[0]], of_optimum[chart.tied[1]])
    offset = np.append(chart.offset, np.zeros(len(others)))[place]
    matrix, back = block_diag(chart.matrix, unit)[place], block_diag(chart.back, unit)[:, place]
    return Chart(matrix, offset, back, tied)


class Assumption(NamedTuple):
    """A parameter held at a value that has an uncertainty: its source, and that of its log."""

    source: str
    std: float


def with_assumed(problem: TableProblem) -> tuple[TableProblem, dict[str, Assumption]]:
    """Return the problem with what was assumed free: exponents, and the factor of the drive."""
    assumed = {
        p.name: Assumption(EXPONENT, float(np.log(p.prior[1] / p.prior[0]) / np.sqrt(12.0)))
        for p in problem.model.parameters
        if p.assumed and not p.free and p.prior is not None
    }
    u = problem.data.drive_factor_uncertainty
    gain = next(p for p in problem.sensors.parameters if p.name == GAIN)
    if u and not gain.free:
        assumed[gain.name] = Assumption(DRIVE_FACTOR, float(u))
    if not assumed:
        return problem, {}
    return problem.assuming({name: one.std for name, one in assumed.items()}), assumed


@dataclass(frozen=True)
class WeightedEstimate:
    """Weighted least squares: the optimum of a problem whose covariances hold the misfit."""

    problem: TableProblem  # the assumed exponents free, its covariances with the misfit
    theta: FloatArray  # (Q,): the estimate, search coordinates
    misfit_variance: FloatArray  # (n,): what the misfit adds to the stated covariances
    scale: float  # of the residuals; 1 where the data state it
    residuals: FloatArray  # (M,): those of data, then of priors, of unit variance
    jacobian: FloatArray  # (M, Q): their derivatives
    loss: Loss | None
    regular: bool  # whether the data determine every parameter
    basis: Basis  # what they determine
    # (Q,): how far a second minimum is, times the root of its probability; None where there is none
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
    def y(self) -> FloatArray:
        """Residuals that are least squares at the estimate, (M,): scores where there is a loss."""
        return scores_of(self.residuals, self.problem.n_residuals, self.loss)

    @property
    def columns(self) -> FloatArray:
        """Derivatives with respect to what the data determine, (M, r)."""
        return self.jacobian @ self.basis.matrix

    def changed(self, changes: ComplexArray) -> FloatArray:
        """Return the changes of `y`, (M, k), by changes (k, n) of the measured responses."""
        columns = -self.problem.residual_change(self.theta, changes).T / self.scale
        return np.pad(columns, ((0, self.problem.n_priors), (0, 0)))

    def factors(self, problem: TableProblem) -> FloatArray:
        """Return the matrices from each row's residuals in `problem` to those of `y`, (n, 2, 2)."""
        ones = np.ones(self.problem.data.n)
        ours = by_row(self.problem, self.theta, ones) / self.scale
        return np.asarray(ours @ np.linalg.pinv(by_row(problem, self.theta, ones)))

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
        """Return G = (J'J)^-1 J', d theta/d y (Q, M), some parameters left out: exact."""
        kept = self.basis.matrix
        if left_out:
            kept = kept[:, [name not in left_out for name in self.problem.names]]
        Q, R = np.linalg.qr(self.jacobian @ kept)
        return np.asarray(kept @ np.linalg.solve(R, Q.T))

    def without(self, left_out: NDArray[np.intp]) -> WeightedEstimate:
        """Return the estimate without some residuals: a Gauss-Newton step, which is short."""
        kept = np.ones(len(self.y), dtype=bool)
        kept[left_out] = False
        step = np.linalg.lstsq(self.columns[kept], -self.y[kept], rcond=1e-13)[0]
        theta = _moved(self.problem, self.theta, np.asarray(step), self.basis)
        r, J = self.problem.residuals_and_jacobian(theta, self.scale, tails=self.loss is None)
        if not (np.isfinite(r).all() and np.isfinite(J).all()):
            return self
        return replace(self, theta=theta, residuals=r, jacobian=J, basis=self.basis.at(theta))

    def jackknife(self, tests: Sequence[NDArray[np.intp]]) -> FloatArray:
        """Return the covariance of theta by leaving out each test, (Q, Q), to first order.

        Each counts with the root of its leverage, so that the sum is without bias where the
        weights are right. Source: Wu, Annals of Statistics 14 (1986) 1261.
        """
        Q, R = np.linalg.qr(self.jacobian)
        moves = []
        for rows in tests:
            of_test = (2 * rows[:, None] + np.arange(2)).ravel()
            left, turn = np.linalg.eigh(np.eye(len(R)) - Q[of_test].T @ Q[of_test])
            along = turn.T @ (Q[of_test].T @ self.y[of_test])
            moves.append(turn @ (along / np.sqrt(np.maximum(left, _LEAST_LEFT))))
        each = np.linalg.solve(R, np.array(moves).T).T
        each = np.clip(each, *(bound - self.theta for bound in self.problem.bounds()))
        return np.asarray(each.T @ each)


def by_row(problem: TableProblem, theta: FloatArray, size: FloatArray | ComplexArray) -> FloatArray:
    """Return the changes of each row's residuals by `size` and by i times it, (n, 2, 2)."""
    both = problem.residual_change(theta, np.array([[1.0], [1.0j]]) * size)
    return both.reshape(2, -1, 2).transpose(1, 2, 0)


def relative_units(problem: TableProblem, theta: FloatArray, predicted: ComplexArray) -> FloatArray:
    """Return the matrices from each row's residuals to ln gain and phase, (n, 2, 2)."""
    return np.asarray(np.linalg.pinv(-by_row(problem, theta, predicted)), dtype=np.float64)


def weighted_estimate(
    optimum: Optimum, problem: TableProblem, *, determined: bool
) -> WeightedEstimate:
    """Return the estimate, searched from an optimum.

    Where the data say little more of an assumed exponent than its range does, there may be a second
    minimum: it is searched from the ends of the range as well, and the likelier one is taken.
    """
    known = dict(zip(optimum.names, optimum.theta, strict=True))
    theta = np.array(
        [known[p.name] if p.name in known else np.log(p.value or 1.0) for p in problem.parameters]
    )
    best = _descended(optimum, problem, theta, determined=determined)
    if not determined:
        return best
    covariance = np.linalg.pinv(best.jacobian.T @ best.jacobian, hermitian=True)
    minima = [best]
    for name, (centre, std) in problem.ranges.items():
        place = problem.names.index(name)
        along, variance = covariance[:, place], float(covariance[place, place])
        if name == GAIN or not variance > _LITTLE_SAID * std**2:
            continue
        for end in (centre - 3.0**0.5 * std, centre + 3.0**0.5 * std):
            change = along / variance * (end - best.theta[place])
            begin = np.clip(best.theta + change, *problem.bounds())
            with suppress(np.linalg.LinAlgError), np.errstate(all="ignore"):  # far off
                there = _descended(optimum, problem, begin, determined=True)
                minima += [there] if np.isfinite(there.deviance) else []
    if len(minima) == 1:
        return best
    best = min(minima, key=lambda minimum: minimum.deviance)
    apart = [m for m in minima if np.linalg.norm(best.columns @ (m.theta - best.theta)) > _APART]
    if not apart:
        return best
    second = min(apart, key=lambda minimum: minimum.deviance)
    chance = 1.0 / (1.0 + np.exp(0.5 * (second.deviance - best.deviance)))
    return replace(best, second=np.sqrt(chance) * (second.theta - best.theta))


def jackknife_with_weights(
    estimate: WeightedEstimate, optimum: Optimum, tests: Sequence[NDArray[np.intp]]
) -> FloatArray:
    """Return the covariance of theta (Q, Q) by estimating again without each test, weights too.

    The model is linearised at the estimate, and refitted where a test moves it far.
    """
    theta, loss = estimate.theta, estimate.loss
    problem = estimate.problem.widened(np.zeros(estimate.problem.data.n))
    every, basis, bounds = LinearRows.at(problem, theta), Basis.every(len(theta)), problem.bounds()
    moves = []
    for rows in tests:
        kept = np.ones(problem.data.n, dtype=bool)
        kept[rows] = False
        others, there = every.take(kept), theta.copy()
        with suppress(np.linalg.LinAlgError):  # the others do not determine it
            for _ in range(_STEPS):
                at = others.moved(there - theta)
                r, columns = at.weighted(at.squares(loss))
                y = scores_of(r, 2 * len(at.z), loss)
                step = _step(columns, y, there, basis, bounds)
                there = there + step
                if np.linalg.norm(columns @ step) < _NEAR_ENOUGH:
                    break
            if np.abs(there - theta)[problem.space.positive].max(initial=0.0) > _LINEAR:
                part = problem.part(kept, problem.data.response[kept])
                there = _descended(optimum, part, theta, determined=True).theta
            moves.append(there - theta)
    each = np.array(moves).reshape(-1, len(theta))
    return np.asarray((1.0 - 1.0 / len(tests)) * each.T @ each)


@dataclass(frozen=True)
class LinearRows:
    """Residuals by the stated covariances, each row's turned so that a misfit weighs both parts.

    A misfit of the square x makes the variances of the two parts 1 + growth x.
    """

    z: FloatArray  # (n, 2)
    slopes: FloatArray  # (n, 2, Q): derivatives with respect to theta
    growth: FloatArray  # (n, 2)
    of_priors: tuple[FloatArray, FloatArray]  # (p,) and (p, Q): residuals and derivatives
    first: NDArray[np.bool_]  # (n,): fundamentals
    numbers: FloatArray  # (n,): of each row

    @classmethod
    def at(cls, stated: TableProblem, theta: FloatArray) -> LinearRows:
        """Return the rows of a problem whose misfit is zero."""
        m = stated.n_residuals
        y, J = stated.residuals_and_jacobian(theta)
        D = by_row(stated, theta, fundamental_sizes(stated.data))
        growth, turn = np.linalg.eigh(D @ D.swapaxes(1, 2))
        return cls(
            np.einsum("nji,nj->ni", turn, y[:m].reshape(-1, 2)),
            np.einsum("nji,njq->niq", turn, J[:m].reshape(-1, 2, len(theta))),
            np.maximum(growth, 0.0),
            (y[m:], J[m:]),
            stated.data.harmonic == 1,
            np.where(stated.data.harmonic == 0, 1.0, 2.0),
        )

    def take(self, rows: NDArray[np.bool_]) -> LinearRows:
        """Return some of the rows, and all priors."""
        named = ("z", "slopes", "growth", "first", "numbers")
        return replace(self, **{name: getattr(self, name)[rows] for name in named})

    def moved(self, step: FloatArray) -> LinearRows:
        """Return the rows after a step of theta."""
        y, J = self.of_priors
        return replace(self, z=self.z + self.slopes @ step, of_priors=(y + J @ step, J))

    def weighted(self, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals of unit variance, and derivatives, for misfits of the squares (n,)."""
        weight = 1.0 / np.sqrt(1.0 + self.growth * square[:, None])
        y, J = self.of_priors
        slopes = (weight[:, :, None] * self.slopes).reshape(-1, J.shape[1])
        return np.concatenate([(weight * self.z).ravel(), y]), np.concatenate([slopes, J])

    def squares(self, loss: Loss | None) -> FloatArray:
        """Return the square of each row's misfit, (n,), with which chi-square is as expected."""
        y, J = self.of_priors
        first, square = self.first, np.zeros(len(self.z))
        apart = bool(first.any() and not first.all() and 2 * first.sum() > J.shape[1])
        first = first | (not apart)
        free = J.shape[1] - len(y) + float(y @ y)
        targets = [(first, self.numbers[first].sum() - free), (~first, self.numbers[~first].sum())]
        if targets[0][1] <= 0.0:
            return square
        for rows, target in targets:
            square[rows] = _square(self.z[rows] ** 2, self.growth[rows], float(target), loss)
        if apart and square.any():
            square[~first] = np.maximum(square[~first], square[first].max())
            r, slopes = self.weighted(square)
            factor = _disagreement(scores_of(r, 2 * len(first), loss), slopes, ~first)
            square = np.where(first, 1.0, factor) * square
        return square


def _descended(
    optimum: Optimum, problem: TableProblem, theta: FloatArray, *, determined: bool
) -> WeightedEstimate:
    """Return the minimum at which a search from theta ends."""
    stated, basis = problem.widened(np.zeros(problem.data.n)), Basis.every(len(theta))
    loss, m = loss_named(optimum.loss, problem.parts), problem.n_residuals
    if not determined:
        _, J = stated.residuals_and_jacobian(theta)
        basis = Basis.of(J, theta, chart_of_limit(optimum, problem))
    last: FloatArray | None = None
    damping, bounds = 0.0, problem.bounds()
    for _ in range(_STEPS):
        variance, scale = _weights(stated, theta, loss)
        weighted = stated.widened(variance)
        r, J = weighted.residuals_and_jacobian(theta, scale, tails=loss is None)
        y = scores_of(r, m, loss)
        basis = basis.at(theta)
        columns = J @ basis.matrix
        if not (np.isfinite(y).all() and np.isfinite(columns).all()):
            raise np.linalg.LinAlgError("no finite step from the estimate")
        step = _step(columns, y, theta, basis, bounds)
        size = np.linalg.norm(columns @ step)
        if size < _SETTLED:
            break
        moved = columns @ step
        further = _further(moved, last)
        step, last = further * step, moved if further == 1.0 else None
        mean = 1.0 if loss is None else loss.mean_slope(squares_of(r[:m]))
        cost = _cost(r, m, loss, mean)
        for _ in range(_TRIALS):
            if damping:
                rows = np.diag(np.sqrt(damping) * np.linalg.norm(columns, axis=0))
                both, last = np.vstack([columns, rows]), None
                step = _step(both, np.append(y, np.zeros(len(rows))), theta, basis, bounds)
            trial = _moved(problem, theta, step, basis)
            value = weighted.residuals_and_jacobian(trial, scale, tails=loss is None)[0]
            if np.isfinite(value).all() and _cost(value, m, loss, mean) < cost:
                damping = damping / _DAMPED if damping > _FIRST_DAMPING else 0.0
                break
            damping = max(_DAMPED * damping, _FIRST_DAMPING)
        else:
            break
        theta = trial
    if not np.isfinite(y).all():
        raise np.linalg.LinAlgError("a drive beyond the force limit has no steady response")
    return WeightedEstimate(weighted, theta, variance, scale, r, J, loss, determined, basis)


def scores_of(r: FloatArray, m: int, loss: Loss | None) -> FloatArray:
    """Return residuals whose sum of squares the estimate makes least, the first m of data."""
    return r if loss is None else np.concatenate([loss.scores(r[:m]), r[m:]])


def _cost(r: FloatArray, m: int, loss: Loss | None, mean: float) -> float:
    """Return the sum of squares, or of losses over their mean slope, which has those scores."""
    z = squares_of(r[:m])
    return float(np.sum(z if loss is None else loss.rho(z) / mean) + r[m:] @ r[m:])


def _step(
    columns: FloatArray,
    y: FloatArray,
    theta: FloatArray,
    basis: Basis,
    bounds: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Return Gauss and Newton's step; parameters that it would take out of bounds go to them."""
    to_bounds, inside = np.zeros(columns.shape[1]), np.ones(columns.shape[1], dtype=bool)
    matrix = basis.matrix
    alone = (matrix != 0.0).sum(axis=1) == 1
    step = to_bounds
    for _ in range(len(theta)):
        rest = np.linalg.lstsq(columns * inside, -y - columns @ to_bounds, rcond=1e-13)[0]
        step = to_bounds + inside * rest
        there = theta + matrix @ step
        within = np.clip(there, *bounds)
        beyond = np.flatnonzero(alone & (there != within))
        places = np.abs(matrix[beyond]).argmax(axis=1)
        if inside[places].sum() == 0:
            break
        inside[places] = False
        to_bounds[places] = (within - theta)[beyond] / matrix[beyond, places]
    return np.asarray(step)


def _further(moved: FloatArray, last: FloatArray | None) -> float:
    """Return the factor that lengthens a step to the sum of the geometric series it continues."""
    ratio = 0.0 if last is None else float(moved @ last) / max(float(last @ last), TINY)
    return 1.0 / (1.0 - ratio) if 0.0 < ratio <= 0.5 else 1.0


@lru_cache(maxsize=64)  # asked for at every step of a search
def tests_of(data: FrequencyResponse) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the number of each row's test, and the row of its fundamental, (n,) each.

    A test is all rows of one level in one run; a row without a fundamental has itself.
    """
    runs = np.zeros(data.n) if data.run is None else np.unique(data.run, return_inverse=True)[1]
    levels = (v for v in (data.amplitude, data.drive) if v is not None)
    places = (runs, data.frequency_hz, *levels)
    test = np.unique(np.column_stack(places), axis=0, return_inverse=True)[1].ravel()
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
    """Return what the misfit adds to each row's variance, and the scale of the residuals."""
    if stated.scale_known:
        square = LinearRows.at(stated, theta).squares(loss)
        return square * fundamental_sizes(stated.data) ** 2, 1.0
    m, dof = stated.n_residuals, stated.n_numbers - len(stated.names)
    # with the derivatives, which the weighted ones will need
    y = stated.residuals_and_jacobian(theta, tails=loss is None)[0]
    scale = max(float(np.sqrt(y[:m] @ y[:m] / max(dof, 1))), float(stated.rounding), 1e-300)
    scale = agreed_scale(stated, loss, lambda _: (theta, dof), scale)
    return np.zeros(stated.data.n), scale


def _disagreement(y: FloatArray, J: FloatArray, harmonics: NDArray[np.bool_]) -> float:
    """Return the factor of the harmonics' variance by which they agree with the fundamentals.

    Both are estimates of the parameters, and the factor is that of Paule and Mandel: the square of
    their distance, over its variance, is the number of directions that harmonics determine.
    """
    of_harmonics = np.pad(np.repeat(harmonics, 2), (0, len(y) - 2 * len(harmonics)))

    def normal_equations(rows: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        return J[rows].T @ J[rows], J[rows].T @ y[rows]

    A, b = normal_equations(~of_harmonics)
    A_h, b_h = normal_equations(of_harmonics)
    size = np.sqrt(np.maximum(np.diagonal(A + A_h), TINY))
    A, b = A / np.outer(size, size), b / size
    A_h, b_h = A_h / np.outer(size, size), b_h / size
    directions = int(np.linalg.matrix_rank(A_h, tol=_NOTICED, hermitian=True))

    def explained(M: FloatArray, v: FloatArray) -> float:
        return float(v @ np.linalg.pinv(M, rcond=_NOTICED**2, hermitian=True) @ v)

    def distance(factor: float) -> float:
        apart = explained(A, b) + explained(A_h, b_h) / factor
        return apart - explained(A + A_h / factor, b + b_h / factor)

    def excess(ln_factor: float) -> float:
        return distance(np.exp(ln_factor)) - directions

    most = np.log(_MOST_DISAGREEMENT)
    if excess(0.0) <= 0.0:
        return 1.0
    if excess(most) >= 0.0:
        return _MOST_DISAGREEMENT
    from scipy.optimize import brentq  # slow to import, and for harmonics that disagree alone

    return float(np.exp(brentq(excess, 0.0, most, xtol=_SAME_FACTOR)))


def _square(z: FloatArray, b: FloatArray, target: float, loss: Loss | None) -> float:
    """Return the square x of a misfit with which chi-square of rows (n, 2) meets its target."""
    x = _root(z, b, target)
    if loss is None or not len(z):
        return x
    for _ in range(_ROOT_STEPS):
        counts = loss.counts(np.sum(z / (1.0 + b * x), axis=1), target)
        last, x = x, _root(counts[:, None] * z, b, target)
        if abs(x - last) <= _SAME * x:
            break
    return x


def _root(z: FloatArray, b: FloatArray, target: float) -> float:
    """Return x >= 0 with sum z/(1 + b x) = target, or below; the sum falls and is convex."""
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
        if step <= _SAME * x:
            break
    return x


def _moved(problem: TableProblem, theta: FloatArray, step: FloatArray, basis: Basis) -> FloatArray:
    """Return theta after a step, or the part of it that changes no logarithm by much."""
    basis = basis.at(theta)
    logarithmic = (basis.slopes[problem.space.positive] != 0.0).any(axis=0)
    move = basis.size * (basis.directions @ step)
    longest = max(float(np.abs(move[logarithmic]).max(initial=0.0)), TINY)
    part = min(1.0, _LONGEST_STEP / longest)
    return np.clip(basis.chart.theta(basis.chart.phi(theta) + part * move), *problem.bounds())
