r"""Profile likelihood: the deviance as a function of one parameter, with all others optimal.

The deviance of a parameter at a value is the rise of -2 ln L with that parameter held there and
all others optimal,

    D(theta_i) = (min S(theta | theta_i) - min S(theta)) / s^2,

with s the noise's scale. Its square root, negative on the lower side, is nearly a straight line
where the problem is nearly linear, and its slope follows without another search (the envelope
theorem), so Newton's method on that root finds a limit in few steps. The limits of all parameters,
sides and levels are searched together; each step solves all their constrained problems at once,
starting along the tangent of the last solution.

If a profile stays below its threshold until the model no longer changes, the interval is open on
that side.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dahl_ident.arrays import EPS, BoolArray, FloatArray, IntArray, unit_diagonal
from dahl_ident.elements import Parameter
from dahl_ident.elements.parameter import FORCE, STIFFNESS
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.asymptotes import Chart, microslip_charts
from dahl_ident.fitting.global_start import edge_starts
from dahl_ident.fitting.levenberg_marquardt import minimise
from dahl_ident.fitting.losses import loss_named
from dahl_ident.fitting.optimum import Status, inverse
from dahl_ident.fitting.search import DOUBTFUL
from dahl_ident.problem import Quadratic

# Searches for limits
_NEAR = 1e-3  # distance of the root from its target at which one last Newton step is exact enough
_CLOSED_BRACKET = 1e-4  # width of a bracket over its distance, and
_NARROW = 0.01  # in conditional standard errors, at which a limit is known well enough
_MARGIN = 0.02  # distance that a step keeps from the ends of a bracket, over its width
_GROWTH, _SHRINKAGE = 3.0, 0.3  # of a step over the last one, until the target is bracketed
_LONGEST_LOG_STEP = 3.0  # step of a logarithm
_CURVE_STEPS = 60  # most steps of the searches, which are made together
_POINTS_AT_ONCE = 8  # points of a curve computed at once, from the last one on their side
# Constrained searches
_SEARCH_STEPS = 40
_TOLERANCE_FACTOR = 1e5  # the deviance, flat at its minimum, still errs by 1e-6 only
_ENOUGH = 1e-8  # fall of the cost at which a search along a flat valley ends
_SAME_DEVIANCE = 0.1  # relative difference: 5 % of the distance to a limit
# Where a search gives up
_FAR, _FEW_STEPS = float(np.log(100.0)), 3  # distance of a logarithm, and steps of the others
_FARTHEST_LINEAR = 1e6  # conditional standard errors, if the parameter is not a logarithm
_FARTHEST_LOG = 80.0  # distance of a logarithm from the optimum
_FARTHEST_RATIO = 4.0  # the same of a pure number: an exponent or a gain
_LEAST_X_C = 1e-14  # over the smallest amplitude
_MOST_X_C, _MOST_X_C_WITH_SPRING = 1e8, 1e5  # over the largest, alone and in parallel with a spring
_SOFTEST, _STIFFEST = 1e-12, 1e6  # sigma over the median stiffness


class Bracket:
    """S searches outwards from 0, each for the point where its function reaches its target.

    The searches that are `active` need their functions at `position`, (S,). `end`, (S,), is where
    the targets are met, infinite where they are not.
    """

    def __init__(
        self,
        target: FloatArray,
        step: FloatArray,
        furthest: FloatArray,
        logarithmic: BoolArray,
        least_width: FloatArray,
    ) -> None:
        self._target, self._furthest, self._logarithmic = target, furthest, logarithmic
        self._least_width = least_width
        self.position, self._step = np.minimum(step, furthest), step
        self._inner, self._outer = np.zeros(target.shape), np.full(target.shape, np.inf)
        self.end = np.full(target.shape, np.nan)
        self.active: IntArray = np.arange(target.size)

    def narrow(self, value: FloatArray, slope: FloatArray, hopeless: BoolArray) -> BoolArray:
        """Take the functions' values and slopes at the active positions, and choose the next ones.

        A search ends where it meets its target. One below its target ends open if it is `hopeless`,
        and at the furthest position if it has come so far. Returns which active searches were below
        their targets.
        """
        a = self.active
        position, target = self.position[a], self._target[a]
        below = value < target
        self._inner[a[below]] = position[below]
        self._outer[a[~below]] = position[~below]
        with np.errstate(divide="ignore", invalid="ignore"):
            newton = (target - value) / slope
            width = self._outer[a] - self._inner[a]
            met = (np.abs(value - target) < _NEAR) & np.isfinite(newton)
            least_width = np.minimum(_CLOSED_BRACKET * self._outer[a], self._least_width[a])
            met |= np.isfinite(self._outer[a]) & (width <= least_width)
        newton = np.where(np.isfinite(newton), newton, np.inf)
        at_bound = below & (position >= self._furthest[a]) & ~met
        is_open = below & hopeless & ~met & ~at_bound
        polished = position + np.where(np.abs(newton) < self._step[a], newton, 0.0)
        self.end[a[met]] = polished[met]
        self.end[a[at_bound]] = position[at_bound]
        self.end[a[is_open]] = np.inf
        continues = ~(met | at_bound | is_open)
        self.active = a[continues]
        self._move(newton[continues], below[continues])
        return below

    def give_up(self) -> FloatArray:
        """Return the ends; searches without an end take the outer side of their brackets."""
        self.end[self.active] = self._outer[self.active]
        return self.end

    def _move(self, newton: FloatArray, below: BoolArray) -> None:
        """Set the next positions: Newton's, kept within the bracket and the longest step."""
        a = self.active
        position, inner, outer = self.position[a], self._inner[a], self._outer[a]
        bracketed = np.isfinite(outer)
        last = np.where(below, self._step[a], np.inf)
        shortest = np.where(bracketed, 0.0, _SHRINKAGE * last)
        longest = _GROWTH * last
        longest = np.where(self._logarithmic[a], np.minimum(_LONGEST_LOG_STEP, longest), longest)
        forward = np.clip(np.where(newton > 0.0, newton, np.inf), shortest, longest)
        new = position + np.where(below, forward, newton)
        width = np.where(bracketed, outer - inner, 0.0)
        inside = (new > inner + _MARGIN * width) & (new < outer - _MARGIN * width)
        new = np.where(bracketed & ~inside, inner + 0.5 * width, new)
        new = np.minimum(new, self._furthest[a])
        self.position[a], self._step[a] = new, np.maximum(np.abs(new - position), 1e-300)


class Profiler:
    """Profiles of every free parameter of one optimum."""

    def __init__(self, optimum: Optimum) -> None:
        self.optimum, self._problem = optimum, optimum.problem
        self._searched = self._problem.near(optimum.theta)
        self._scale = 1.0 if optimum.scale_known else optimum.scale
        self._loss = loss_named(optimum.loss, self._problem.residuals_per_row)
        self._logarithmic = self._problem.space.positive
        self._low, self._high = self._problem.bounds()
        self._is_slow = False  # whether each step takes exact steady motions
        self._limits: dict[bytes, FloatArray] = {}  # of thresholds

    # Limits

    def limits(
        self, thresholds: FloatArray, asked: BoolArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper limits in search coordinates, each of shape (levels, P).

        `thresholds` are roots of the deviance. Minus and plus infinity where a side is open. If the
        search is slow, limits are NaN for parameters that were not `asked` for, (P,), by default
        all.
        """
        unknown = np.full((2, len(thresholds), self._problem.n_reported), np.nan)
        ends = self._limits.setdefault(thresholds.tobytes(), unknown)
        new = np.isnan(ends[0, 0])
        if self._is_slow and asked is not None:
            new &= asked
        if new.any():
            limits = self._new_limits(thresholds, np.flatnonzero(new))
            if self._searched is not self._problem and not self._agrees(limits):
                self._searched, self._is_slow = self._problem, True
                del self._at_optimum
                return self.limits(thresholds, asked)
            ends[..., new] = limits
        return ends[0], ends[1]

    def _new_limits(self, thresholds: FloatArray, asked: IntArray) -> FloatArray:
        """Return both limits of some parameters, shape (2, levels, asked)."""
        ends = np.full((2, len(thresholds), asked.size), np.inf)
        ends[0] = -np.inf
        side, level, column = (a.ravel() for a in np.indices(ends.shape))
        index = asked[column]
        is_open = self._open[side, index]
        known = bool(np.isfinite(self._scale) and np.isfinite(thresholds).all())
        if known and self._problem.response is None:  # of records
            far = np.zeros(ends.shape, dtype=np.bool_)
            positive = self._logarithmic[asked]
            far_deviance = self.far_deviance(asked[positive])
            far[..., positive] = far_deviance[:, None] < thresholds[:, None] ** 2
            is_open = is_open | far.ravel()
        search = np.flatnonzero(~is_open)
        if known and search.size:
            ends[side[search], level[search], column[search]] = self._ends(
                index[search], 2.0 * side[search] - 1.0, thresholds[level[search]]
            )
        return ends

    def _agrees(self, ends: FloatArray) -> bool:
        """Return whether the exact steady motion has the same deviance at the widest limits.

        Limits are searched with a prediction near the optimum that is far cheaper.
        """
        widest = ends[:, np.argmax(ends[1].max(axis=1))]
        limit, index = widest.ravel(), np.tile(np.arange(widest.shape[1]), 2)
        closed = np.isfinite(limit)
        index, moved = index[closed], (limit - self.optimum.theta[index])[closed]
        if not index.size:
            return True
        theta = self.optimum.theta + moved[:, None] * self._tangents[index]
        near, exact = (
            p.quadratic(theta, self._scale, self._loss).cost
            for p in (self._searched, self._problem)
        )
        with np.errstate(invalid="ignore"):
            differs = np.abs(exact - near) > _SAME_DEVIANCE * np.abs(near - self._least_cost)
        return not (differs | ~np.isfinite(exact)).any()

    def _ends(self, index: IntArray, sign: FloatArray, target: FloatArray) -> FloatArray:
        """Return where the profile of parameter `index` meets `target` on the side of `sign`."""
        theta = np.tile(self.optimum.theta, (len(index), 1))
        tangent, origin = self._tangents[index], self.optimum.theta[index]
        was_reachable = np.zeros(len(index), dtype=np.bool_)
        furthest = np.where(sign > 0.0, self._high[index] - origin, origin - self._low[index])
        step, width = self._first_step[index] * target, _NARROW * self._conditional[index]
        bracket = Bracket(target, step, furthest, self._logarithmic[index], width)
        for _ in range(_CURVE_STEPS):
            a = bracket.active
            moved = sign[a] * bracket.position[a] + origin[a] - theta[a, index[a]]
            at = self._from_best_start(index[a], theta[a], self._along(tangent[a], moved))
            root = np.sqrt(np.maximum(at.deviance, 0.0))
            reachable = self._reachable(at.theta, index[a], bracket.position[a])
            was_reachable[a] |= reachable
            with np.errstate(divide="ignore", invalid="ignore"):
                slope = sign[a] * at.slope / root
            below = bracket.narrow(root, slope, was_reachable[a] & ~reachable)
            theta[a[below]], tangent[a[below]] = at.theta[below], at.tangent[below]
            if not bracket.active.size:
                break
        return np.asarray(origin + sign * bracket.give_up())

    def _from_best_start(
        self, index: IntArray, theta: FloatArray, change: FloatArray
    ) -> _ConstrainedOptima:
        """Return the best constrained optima from starts at theta + change, an edge or a valley."""
        moved, held = theta + change, np.arange(theta.shape[1]) == index[:, None]
        inside = np.clip(moved, self._low, self._high)  # coordinates that would leave it stay
        starts, rows = [np.where((inside == moved) | held, inside, theta)], [np.arange(len(index))]
        for edge in self._edges:
            starts.append(np.where(held, starts[0], edge))
            rows.append(rows[0])
        for chart in self._microslip_charts:
            valley, applies = _along_valley(chart, index, theta, change, self._smallest)
            starts.append(valley[applies])
            rows.append(np.flatnonzero(applies))
        row = np.concatenate(rows)
        return self._constrained(index[row], np.concatenate(starts)).lowest(row)

    @cached_property
    def _edges(self) -> list[FloatArray]:
        """Starts in gross slip, where data with a free spring do not rule out microslip."""
        sd, starts = np.sqrt(np.diagonal(self.optimum.covariance)), []
        for chart in self._microslip_charts:
            f_max, sigma = _friction_of(chart)
            if max(sd[f_max], sd[sigma]) > DOUBTFUL:
                edges = edge_starts(self._problem)
                starts += [e for e in edges if e[f_max] - e[sigma] < self._smallest]
        return starts

    @cached_property
    def _microslip_charts(self) -> list[Chart]:
        return [] if self._problem.response is None else microslip_charts(self._problem)

    def _along(self, tangent: FloatArray, moved: FloatArray) -> FloatArray:
        """Return the change of theta along its tangent; steps of other logarithms are limited."""
        change = moved[:, None] * tangent
        limited = np.clip(change, -_LONGEST_LOG_STEP, _LONGEST_LOG_STEP)
        return np.where(self._logarithmic & (change != moved[:, None]), limited, change)

    def far_deviance(self, index: IntArray) -> FloatArray:
        """Return the deviance at a hundredth and at a hundred times the estimate, shape (2, n).

        `index` are n positive parameters. The others take Gauss-Newton steps without damping, along
        which first states and offsets, which are nearly interchangeable, follow. They are few, so
        the deviance may be too large, but is not too small.
        """
        theta = np.tile(self.optimum.theta, (2, index.size, 1))
        theta[:, np.arange(index.size), index] += np.array([[-_FAR], [_FAR]])
        rows, held = theta.reshape(-1, theta.shape[-1]), np.tile(index, 2)
        least = np.full(len(rows), np.inf)
        for _ in range(_FEW_STEPS):
            at = self._problem.quadratic(rows, self._scale, self._loss)
            least = np.fmin(least, at.cost)
            pairs = zip(*at[1:], held, strict=True)
            step = np.array([_step_of_others(*pair) for pair in pairs])
            rows = rows + np.where(self._logarithmic, np.clip(step, -1.0, 1.0), step)
        deviance = 2.0 * (least - self._least_cost) * self._stretch[held]
        return np.asarray(deviance.reshape(2, -1))

    # Constrained problems

    def curve(self, index: int, coordinate: FloatArray) -> FloatArray:
        """Return the deviance of parameter `index` at each of `coordinate`."""
        distance = coordinate - self.optimum.theta[index]
        order = np.argsort(np.abs(distance))
        deviance, last = np.empty(len(coordinate)), np.tile(self.optimum.theta, (2, 1))
        for block in np.array_split(order, max(1, order.size // _POINTS_AT_ONCE)):
            side = (distance[block] > 0.0).astype(np.intp)
            start = last[side]
            start[:, index] = coordinate[block]
            at = self._constrained(np.full(block.size, index), start)
            deviance[block], last[side] = at.deviance, at.theta  # the farthest on each side
        return np.maximum(deviance, 0.0)

    def _constrained(self, index: IntArray, start: FloatArray) -> _ConstrainedOptima:
        """Return the optima with parameter `index` of each row held at its start."""
        rows = np.arange(len(index))
        held = np.zeros(start.shape, dtype=np.bool_)
        held[rows, index] = True
        theta, at = self._minimised(held, np.clip(start, self._low, self._high))
        stretch = self._stretch[index]
        deviance = 2.0 * (at.cost - self._least_cost) * stretch
        slope = at.gradient[rows, index] * stretch
        return _ConstrainedOptima(theta, deviance, slope, _tangent(at.hessian, index))

    def _minimised(self, held: BoolArray, start: FloatArray) -> tuple[FloatArray, Quadratic]:
        """Return the constrained optima, and the cost there as the last step predicts it."""
        S, P = start.shape
        theta, lowest = start.copy(), Quadratic(*(np.empty((S, *(P,) * k)) for k in range(3)))
        lowest.cost[:] = np.inf

        def evaluate(at: FloatArray, which: IntArray | None) -> Quadratic:
            cost, gradient, hessian = self._searched.quadratic(at, self._scale, self._loss)
            rows = np.arange(S) if which is None else which
            lower = ~(cost > lowest.cost[rows])
            theta[rows[lower]] = at[lower]
            for best, new in zip(lowest, (cost, gradient, hessian), strict=True):
                best[rows[lower]] = new[lower]
            fixed = held if which is None else held[which]
            gradient = np.where(fixed, 0.0, gradient)
            either = fixed[:, :, None] | fixed[:, None, :]
            return Quadratic(cost, gradient, np.where(either, 0.0, hessian))

        ends = minimise(
            evaluate,
            start,
            self._logarithmic,
            self._problem.n_residuals,
            tolerance_factor=_TOLERANCE_FACTOR,
            enough=lambda _: _ENOUGH,
            steps=_SEARCH_STEPS,
            accuracy=self._problem.accuracy,
            bounds=(self._low, self._high),
        ).theta
        step = ends - theta
        moved = np.any(step, axis=1, keepdims=True)[..., None]  # elsewhere infinite derivatives
        bend = np.einsum("sij,sj->si", np.where(moved, lowest.hessian, 0.0), step)
        slope = np.where(moved[:, 0], lowest.gradient, 0.0) + 0.5 * bend
        change = (slope * step).sum(axis=1)
        return ends, Quadratic(lowest.cost + change, lowest.gradient + bend, lowest.hessian)

    @cached_property
    def _least_cost(self) -> float:
        return self.optimum.cost / self._scale**2

    @cached_property
    def _at_optimum(self) -> Quadratic:
        theta = self.optimum.theta[None]
        cost, gradient, hessian = self._searched.quadratic(theta, self._scale, self._loss)
        return Quadratic(cost[0], gradient[0], hessian[0])

    @cached_property
    def _tangents(self) -> FloatArray:
        P = len(self.optimum.theta)
        hessian = np.broadcast_to(self._at_optimum.hessian, (P, P, P))
        return _tangent(hessian, np.arange(P))

    @cached_property
    def _stretch(self) -> FloatArray:
        """Return the factors that scale each deviance to follow chi-square.

        A robust loss has one factor; residuals correlated in time have one for each parameter.
        """
        in_time = self._problem.response is None
        if self._loss is None and not in_time:
            return np.ones(len(self.optimum.theta))
        expected = np.diagonal(inverse(self._at_optimum.hessian)[0])
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = expected / np.diagonal(self.optimum.covariance)
        valid = np.isfinite(ratio) & (ratio > 0.0)
        if in_time:
            return np.where(valid, ratio, 1.0)
        return np.full(ratio.shape, np.median(ratio[valid]) if valid.any() else 1.0)

    # Where a search begins and where it gives up

    @cached_property
    def _conditional(self) -> FloatArray:
        """Standard error of each parameter if all others were known."""
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / np.sqrt(np.diagonal(self._at_optimum.hessian)))

    @cached_property
    def _first_step(self) -> FloatArray:
        """Return the first step for a threshold of 1: a standard error, of logarithms at most 1."""
        error = np.sqrt(np.diagonal(self.optimum.covariance))
        unknown = np.where(self._logarithmic, 1.0, self._conditional)
        step = np.where(np.isfinite(error) & (error > 0.0), error, unknown)
        step = np.where(np.isfinite(step) & (step > 0.0), step, 1.0)
        return np.where(self._logarithmic, np.minimum(step, 1.0), step)

    @cached_property
    def _open(self) -> BoolArray:
        """Return which sides need no search, below and above, shape (2, P).

        These are the sides on which the optimum lies at infinity or zero, and those of parameters
        that can change without any change of the prediction.
        """
        values, status = self.optimum.values, self.optimum.status
        flat = np.isinf(np.diagonal(self.optimum.covariance)) & (status is Status.SINGULAR)
        flat |= status is Status.NOT_CONVERGED
        below = (values == -np.inf) | (self._logarithmic & (values == 0.0))
        return np.array([below | flat, (values == np.inf) | flat])

    def _reachable(self, theta: FloatArray, index: IntArray, position: FloatArray) -> BoolArray:
        """Return whether the model still changes farther out."""
        near = position < self._farthest[index]
        columns = dict(zip(self._problem.names, theta.T, strict=True))
        for f_max, sigma in self._friction:
            of_friction = np.isin(np.array(self._problem.names)[index], (f_max.name, sigma.name))
            ln_f_max, ln_sigma = (np.asarray(columns.get(p.name, _ln(p))) for p in (f_max, sigma))
            ln_x_c = ln_f_max - ln_sigma
            least, most, softest, stiffest = self._reach
            matters = (ln_x_c > least) & (ln_x_c < most) & (ln_sigma > softest)
            cancels = (ln_sigma > stiffest) & (ln_x_c > self._smallest)
            near &= ~of_friction | (matters & ~cancels)
        return near

    @cached_property
    def _friction(self) -> list[tuple[Parameter, Parameter]]:
        """Force limit and stiffness of every law whose scale parameters these two are."""
        pairs: list[tuple[Parameter, Parameter]] = []
        for element in self._problem.model.elements if self._problem.response is not None else ():
            scale = {element.parameter(s).dimension: s for s in element.scale_parameters}
            if element.has_memory and {*scale} == {FORCE, STIFFNESS}:
                force, stiffness = scale[FORCE], scale[STIFFNESS]
                pairs.append((element.parameter(force), element.parameter(stiffness)))
        return pairs

    @cached_property
    def _smallest(self) -> float:
        """Logarithm of the smallest amplitude; an x_c above it is microslip."""
        return float(np.log(self._problem.stiffness_data.amplitude.min()))

    @cached_property
    def _reach(self) -> FloatArray:
        """Ends of ln x_c, then of ln sigma, beyond which friction is at a limit.

        Friction stiffer than the last, in microslip, is almost cancelled by a negative spring.
        """
        view = self._problem.stiffness_data
        stiffness = view.typical_stiffness
        has_spring = any(e.is_linear and e.holds_at_rest for e in self._problem.model.elements)
        low, high = view.amplitude.min(), view.amplitude.max()
        most = _MOST_X_C_WITH_SPRING if has_spring else _MOST_X_C
        return np.log([low * _LEAST_X_C, high * most, stiffness * _SOFTEST, stiffness * _STIFFEST])

    @cached_property
    def _farthest(self) -> FloatArray:
        """Distance from the optimum beyond which a search gives up."""
        pure = np.array([p.unit == "" for p in self._problem.parameters])
        logarithms = np.where(pure, _FARTHEST_RATIO, _FARTHEST_LOG)
        far = _FARTHEST_LINEAR * self._conditional + 2.0 * np.abs(self.optimum.theta)
        return np.where(self._logarithmic, logarithms, far)


@dataclass(frozen=True)
class _ConstrainedOptima:
    """Constrained optima: theta, deviance, half its slope in the held coordinate, and tangent."""

    theta: FloatArray
    deviance: FloatArray
    slope: FloatArray
    tangent: FloatArray

    def lowest(self, row: IntArray) -> _ConstrainedOptima:
        """Return the solution of least deviance among those of each row."""
        order = np.lexsort((self.deviance, row))
        best = order[np.unique(row[order], return_index=True)[1]]
        return _ConstrainedOptima(*(array[best] for array in vars(self).values()))


def _along_valley(
    chart: Chart, index: IntArray, theta: FloatArray, change: FloatArray, least: float
) -> tuple[FloatArray, BoolArray]:
    """Return theta with one coordinate moved at constant sigma^2/f_max and sigma + stiffness.

    Also return to which rows this applies: their coordinate takes part in the valley, and ln x_c
    stays above the `least` of microslip.
    """
    assert chart.tied is not None
    spring, _ = chart.tied
    f_max, sigma = _friction_of(chart)
    target = (theta + change)[np.arange(len(index)), index]
    phi = chart.phi(theta)
    ln_kappa, total = phi[:, sigma], phi[:, spring]
    with np.errstate(invalid="ignore", divide="ignore"):  # beyond the total stiffness
        ln_x_c: dict[int, FloatArray] = {
            f_max: 0.5 * (target - ln_kappa),
            sigma: target - ln_kappa,
            spring: np.log(total - target) - ln_kappa,
        }
        for column, value in ln_x_c.items():
            phi[:, f_max] = np.where(index == column, value, phi[:, f_max])
        moved = chart.theta(phi)
    moved[np.arange(len(index)), index] = target
    applies = np.isin(index, np.array([*ln_x_c])) & (phi[:, f_max] > least)
    return moved, applies & np.isfinite(moved).all(axis=1)


def _friction_of(chart: Chart) -> tuple[int, int]:
    """Return the indices of f_max and sigma of the element to which a chart belongs."""
    assert chart.tied is not None
    sigma = chart.tied[1]
    (f_max,) = (int(i) for i in np.flatnonzero(chart.matrix[sigma]) if i != sigma)
    return f_max, sigma


def _step_of_others(gradient: FloatArray, hessian: FloatArray, held: int) -> FloatArray:
    """Return the Gauss-Newton step, (P,), of all coordinates but one; none where it is infinite."""
    if not np.isfinite(hessian).all():
        return np.zeros(gradient.size)
    others = np.arange(gradient.size) != held
    matrix, size = unit_diagonal(hessian[np.ix_(others, others)])
    step = np.zeros(gradient.size)
    step[others] = (
        -np.linalg.pinv(matrix, rcond=EPS, hermitian=True) @ (gradient[others] / size) / size
    )
    return step


def _tangent(hessian: FloatArray, index: IntArray) -> FloatArray:
    """Return dtheta/dtheta_index along the profile, shape (S, P), 1 at `index` itself."""
    S, P = hessian.shape[:2]
    rows = np.arange(S)
    H = np.where(np.isfinite(hessian), hessian, 0.0).copy()
    b = -H[rows, :, index].copy()
    b[rows, index] = 1.0
    H[rows, index, :] = 0.0
    H[rows, :, index] = 0.0
    H[rows, index, index] = 1.0
    size = np.sqrt(np.maximum(H[:, range(P), range(P)], 0.0))
    size = np.where(size > 0.0, size, 1.0)
    scaled = H / (size[:, :, None] * size[:, None, :]) + 1e-12 * np.eye(P)
    return np.asarray(np.linalg.solve(scaled, (b / size)[:, :, None])[:, :, 0] / size)


def _ln(parameter: Parameter) -> float:
    return float("nan") if parameter.value is None else float(np.log(parameter.value))
