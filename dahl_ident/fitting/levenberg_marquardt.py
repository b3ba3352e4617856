"""Levenberg and Marquardt's method for many least-squares problems at once.

Each step solves (H + lambda D) delta = -g with g the gradient of the cost, H its Gauss-Newton
Hessian and D = diag H, so it does not depend on the parameters' units. lambda starts almost at
zero, with a Gauss-Newton step; it falls if the cost falls as H predicts, and rises if the cost does
not fall. All problems take their steps together, until they end.

A problem has converged if the step after the next one, extrapolated from the steps' ratio, would
change the residuals by less than 1e-8 of their standard deviation, or by less than rounding or the
accuracy of predictions; it ends with the next step, which needs no further evaluation. It has also
converged if the cost does not fall although a Gauss-Newton step would change the residuals by less
than 1e-2 of their standard deviation: derivatives are less accurate than costs.
`scipy.optimize.least_squares` is the other method, with the same residuals and Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import EPS, BoolArray, FloatArray, IntArray
from dahl_ident.fitting.losses import Loss
from dahl_ident.noise import bend
from dahl_ident.problem import EXPLICIT, Problem, Quadratic

if TYPE_CHECKING:
    from dahl_ident.fitting.asymptotes import Limit

Evaluate = Callable[[FloatArray, IntArray], Quadratic]
"""Cost, gradient and Hessian at theta, (S, P), given the searches' indices, (S,)."""
Bounds = tuple[FloatArray, FloatArray]
"""Least and largest coordinates, (P,) each, of steps."""
Fall = Callable[[FloatArray], FloatArray | float]
"""Negligible falls of costs (S,)."""

_FIRST_DAMPING = 1e-9  # lambda at first, almost zero for a Gauss-Newton step
_GAUSS_NEWTON = 1e-3  # lambda above which a short step does not show convergence
_MOST_DAMPING = 1e12  # lambda above which the search has failed
_ROUNDING = 1e-12  # rounding errors of a scaled Hessian, some thousand times EPS
_EASING = 0.2  # factor on lambda, at least, after a step that lowers the cost as predicted
_LONGEST_STEP = 2.0  # of a logarithm: a factor of 7, up to which the cost may be quadratic
# length of a step, over the residuals' standard deviation, at which a search has converged
_NOISE_TOLERANCE = 1e-8
# the same, and longest such step of a logarithm, at a point from which the cost does not fall
_STALLED = 1e-2
# longest last step of a logarithm, as the Hessian returned is that before this step
_LAST_STEP = 1e-6
_GEOMETRIC = 0.9  # squared cosine between two steps of a geometric series
_SLOWEST = 0.99  # largest ratio of the series: a hundred steps at once
# change of the residuals, over their size, by a coordinate from bound to bound, below which it has
# no effect and is kept fixed
_FLAT = 1e-3
_NEARLY_STILL = 0.01  # longest last step over the distance between the bounds
_UNSEEN = 4.0 * EPS  # relative change of a cost that may be rounding
_OF_ACCURACY = 0.3  # the same over the accuracy of predictions, if these are inaccurate
_OVERTIME = 2.0  # a higher search ends after this multiple of a converged search's steps
# relative changes of cost, step and slope at which scipy's searches end: a few hundred times EPS
_OF_COST, _OF_STEP, _OF_SLOPE = 1e-13, 1e-10, 1e-14
_EVALUATIONS = 300  # most evaluations of scipy's search, which needs about thirty
NEARLY = 1e-4  # relative difference of costs within which a search that has converged is preferred


@dataclass(frozen=True)
class _Searches:
    """Arrays with a leading axis S, for each search."""

    def take(self, which: BoolArray | IntArray) -> Self:
        """Return some of the searches."""
        return type(self)(*(getattr(self, f.name)[which] for f in fields(self)))

    def assign(self, which: IntArray, other: Self) -> None:
        """Replace some of the searches."""
        for f in fields(self):
            getattr(self, f.name)[which] = getattr(other, f.name)

    def where(self, wins: BoolArray, other: Self) -> Self:
        """Return these searches, replaced by `other` where it `wins`."""
        pairs = [(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)]
        return type(self)(
            *(np.where(wins.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in pairs)
        )


class AtLimit(NamedTuple):
    """A limit at which a search ended, in the limit's own coordinates phi."""

    limit: Limit
    phi: FloatArray
    hessian: FloatArray


@dataclass(frozen=True)
class Minima(_Searches):
    """The ends of S searches."""

    theta: FloatArray
    """Search coordinates, (S, P); for a limit so far out that the model agrees with its limit."""
    cost: FloatArray
    hessian: FloatArray
    converged: BoolArray
    evaluations: IntArray
    limit: NDArray[np.object_] = field(default_factory=lambda: np.empty(0, dtype=object))
    """The :class:`AtLimit` of each search, or None."""

    def __post_init__(self) -> None:
        if len(self.limit) != len(self.theta):
            object.__setattr__(self, "limit", np.full(len(self.theta), None))

    @property
    def determined(self) -> IntArray:
        """The number of determined parameters of each optimum: fewer than P at a limit."""
        P = self.theta.shape[1]
        return np.array([P if at is None else len(at.phi) for at in self.limit])

    def put(self, which: IntArray, other: Minima) -> None:
        """Replace the ends of some searches by those of `other`, which continued them."""
        before = self.evaluations[which]
        self.assign(which, other)
        self.evaluations[which] += before

    @classmethod
    def stacked(cls, parts: Sequence[Minima]) -> Minima:
        """Return the searches of all parts, one after the other."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def best(self, owner: IntArray, S: int) -> Minima:
        """Return the best search of each of S owners: a converged one if nearly as low."""
        lowest, most = np.full(S, np.inf), np.zeros(S, dtype=np.intp)
        np.minimum.at(lowest, owner, self.cost)
        np.maximum.at(most, owner, self.evaluations)
        good = self.converged & (self.cost <= lowest[owner] * (1.0 + NEARLY))
        any_good = np.zeros(S, dtype=np.bool_)
        any_good[owner[good]] = True
        cost = np.where(good | ~any_good[owner], self.cost, np.inf)
        order = np.lexsort((~good, cost, owner))
        first = order[np.searchsorted(owner[order], np.arange(S))]
        return replace(self.take(first), evaluations=most)

    def better(self, other: Minima) -> Minima:
        """Return these searches, replaced by `other` where it is lower or alone has converged."""
        wins = (other.cost < self.cost) & ~(self.converged & ~other.converged)
        wins |= other.converged & ~self.converged
        evaluations = self.evaluations + other.evaluations
        return replace(self.where(wins, other), evaluations=evaluations)


@dataclass(frozen=True)
class _State(_Searches):
    """Point, cost and derivatives of each search."""

    theta: FloatArray
    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray

    def moved(self, which: BoolArray, step: FloatArray, fall: FloatArray) -> _State:
        """Return the state after a last step of some searches, which is not evaluated."""
        return replace(
            self,
            theta=self.theta + np.where(which[:, None], step, 0.0),
            cost=np.where(which, np.maximum(self.cost - fall, 0.0), self.cost),
        )


@np.errstate(all="ignore")
def minimise(
    evaluate: Evaluate,
    theta: FloatArray,
    logarithmic: BoolArray,
    n_residuals: int,
    *,
    inside: Callable[[FloatArray, IntArray], BoolArray] | None = None,
    owner: IntArray | None = None,
    tolerance_factor: float = 1.0,
    enough: Fall | None = None,
    steps: int = 80,
    accuracy: float = EXPLICIT,
    bounds: Bounds | None = None,
    restrained: bool = False,
) -> Minima:
    """Return the minima of the costs that searches from `theta`, (S, P), reach.

    `logarithmic` marks the coordinates that are logarithms, whose steps are limited in length.
    Searches that leave the region `inside`, which is called like `evaluate`, end without
    convergence; so do those that are still higher after twice the steps in which another search of
    the same `owner` has converged. `tolerance_factor` multiplies the length of the step at which a
    search has converged; `enough` gives the fall of a cost that is negligible, whatever the length
    of the step: the search ends before it. `accuracy` is that of predictions, relative to the data.
    Steps end at the `bounds` of theta. In `restrained` searches a logarithmic step of 1 is
    penalised like residuals of one standard deviation, so that coordinates with hardly any effect
    do not move until the others have converged; the last step, which is not evaluated, is short.
    """
    owner = np.arange(len(theta)) if owner is None else owner
    S, P = theta.shape
    unseen_change = _UNSEEN if accuracy <= EXPLICIT else _OF_ACCURACY * accuracy
    active = np.arange(S)
    at = _State(theta, *evaluate(theta, active))
    ends = at.take(active)
    converged, evaluations = np.full(S, P == 0), np.ones(S, dtype=np.intp)
    damping, growth = np.full(S, _FIRST_DAMPING), np.full(S, 2.0)
    last_moves, last_step = np.full(S, 1e-300), np.zeros((S, P))
    close = np.zeros(S, dtype=np.bool_)
    # fewest steps and lowest cost of each owner's converged searches
    fewest, lowest = np.full((2, owner.max(initial=0) + 1), np.inf)
    for count in range(steps if P else 0):
        noise = 2.0 * at.cost / max(n_residuals - P, 1)
        restraint = restrained * noise[:, None] * logarithmic
        step, moves, predicted, longest = _step(at, damping, logarithmic, bounds, restraint)
        shortest = tolerance_factor**2 * _tolerance(at, logarithmic, noise, accuracy)
        settled = moves * np.minimum(1.0, moves / last_moves) <= shortest
        settled |= predicted <= tolerance_factor**2 * EPS * at.cost
        settled &= longest <= tolerance_factor * _LAST_STEP
        settled &= predicted <= at.cost  # a larger fall is rounding
        short = settled
        if bounds is not None:  # coordinates with hardly any effect may take long steps
            short = short & (np.abs(step) <= _NEARLY_STILL * (bounds[1] - bounds[0])).all(axis=1)
        settled = settled | (enough is not None and predicted < enough(at.cost))
        undamped = damping < _GAUSS_NEWTON
        near = (moves <= _STALLED**2 * noise) & (longest <= _STALLED)
        close = np.where(undamped, near, close)
        stalled = close & ~undamped
        settled = (settled & undamped) | stalled
        lost = ~np.isfinite(at.cost) | (damping > _MOST_DAMPING)
        if inside is not None:
            lost |= ~inside(at.theta, active)
        owners = owner[active]
        lost |= (count > _OVERTIME * fewest[owners]) & (at.cost > lowest[owners])
        ended = settled | lost
        if ended.any():
            settled &= ~lost
            converged[active] = settled
            np.minimum.at(fewest, owners[settled], count)
            np.minimum.at(lowest, owners[settled], at.cost[settled])
            moved = settled & ~stalled & (short | (not restrained))
            ends.assign(active, at.moved(moved, step, predicted))
            kept = ~ended
            active, at = active[kept], at.take(kept)
            if not active.size:
                break
            step, moves, predicted = step[kept], moves[kept], predicted[kept]
            damping, growth, close = damping[kept], growth[kept], close[kept]
            last_moves, last_step = last_moves[kept], last_step[kept]
        factor = _extrapolation(at.hessian, step, last_step)
        longest = np.abs(step * logarithmic).max(axis=1)
        factor = np.clip(_LONGEST_STEP / np.maximum(longest, 1e-300), 1.0, factor)
        step = factor[:, None] * step
        trial = at.theta + step if bounds is None else np.clip(at.theta + step, *bounds)
        new = _State(trial, *evaluate(trial, active))
        evaluations[active] += 1
        # a fall that is lost in the rounding of the cost is assumed to be as predicted
        tiny = predicted <= unseen_change * at.cost
        better = (new.cost < at.cost) | (tiny & (new.cost <= (1.0 + unseen_change) * at.cost))
        gain = np.where(tiny, 1.0, at.cost - new.cost) / np.where(tiny, 1.0, predicted)
        lower = np.maximum(damping * np.maximum(_EASING, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-15)
        damping = np.where(better, lower, np.maximum(damping * growth, 1e-6))
        growth = np.where(better, 2.0, 4.0 * growth)
        last_moves = np.where(better, moves, 1e-300)
        last_step = np.where((better & (factor == 1.0))[:, None], step, 0.0)
        at = new if better.all() else at.where(better, new)
    ends.assign(active, at)
    return Minima(ends.theta, ends.cost, ends.hessian, converged, evaluations)


def _step(
    at: _State,
    damping: FloatArray,
    logarithmic: BoolArray,
    bounds: Bounds | None,
    restraint: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the next step, its squared length, the predicted fall of cost, the longest log step.

    The length is that of the change of the residuals.
    """
    P = at.theta.shape[1]
    size = np.sqrt(at.hessian[:, range(P), range(P)])
    size = np.where((size > 0.0) & np.isfinite(size), size, 1.0)
    H = at.hessian / (size[:, :, None] * size[:, None, :])
    g = at.gradient / size
    if bounds is not None:
        low, high = bounds
        fixed = ((at.theta <= low) & (g > 0.0)) | ((at.theta >= high) & (g < 0.0))
        fixed |= size * (high - low) <= _FLAT * np.sqrt(at.cost)[:, None]
        g = np.where(fixed, 0.0, g)
        H = np.where(fixed[:, :, None] | fixed[:, None, :], np.eye(P), H)
    damped = H + (damping[:, None] + restraint / size**2)[:, None] * np.eye(P)
    if not np.isfinite(damped).all():
        bad = ~np.isfinite(damped).all(axis=(1, 2))
        damped[bad], g[bad] = np.eye(P), 0.0
    try:
        delta = -np.linalg.solve(damped, g[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:  # two columns are equal to rounding
        delta = -np.linalg.solve(damped + _ROUNDING * np.eye(P), g[:, :, None])[:, :, 0]
    longest = np.abs(delta / size * logarithmic).max(axis=1)
    if longest.max() > _LONGEST_STEP:
        delta *= np.minimum(1.0, _LONGEST_STEP / np.maximum(longest, 1e-300))[:, None]
    if bounds is not None:
        end = at.theta + delta / size
        cut = (end < low) | (end > high)
        if cut.any():  # solve for the other coordinates, given those at bounds
            at_bounds = np.where(cut, (np.clip(end, low, high) - at.theta) * size, 0.0)
            g_inner = np.where(cut, 0.0, g + (damped @ at_bounds[:, :, None])[:, :, 0])
            H_inner = np.where(cut[:, :, None] | cut[:, None, :], np.eye(P), damped)
            inner = -np.linalg.solve(H_inner + _ROUNDING * np.eye(P), g_inner[:, :, None])[:, :, 0]
            longest_inner = np.abs(inner / size * logarithmic).max(axis=1)
            inner *= np.minimum(1.0, _LONGEST_STEP / np.maximum(longest_inner, 1e-300))[:, None]
            delta = (np.clip(at.theta + (at_bounds + inner) / size, low, high) - at.theta) * size
            longest = np.maximum(longest, longest_inner)
    moves = (delta[:, None, :] @ H @ delta[:, :, None])[:, 0, 0]
    predicted = -(delta * g).sum(axis=1) - 0.5 * moves
    return delta / size, moves, predicted, longest


def _extrapolation(hessian: FloatArray, step: FloatArray, last_step: FloatArray) -> FloatArray:
    """Return the factor that extends a step of a geometric series to the limit of the series.

    If a model is curved and its misfit large, the ratio of each Gauss-Newton step to the last one
    is constant.
    """
    along, past = ((hessian @ delta[:, :, None])[:, :, 0] for delta in (step, last_step))
    product, squares = (step * past).sum(axis=1), (last_step * past).sum(axis=1)
    ratio = product / np.maximum(squares, 1e-300)
    alike = product**2 > _GEOMETRIC * squares * (step * along).sum(axis=1)
    return np.where(alike & (ratio > 0.0), 1.0 / (1.0 - np.minimum(ratio, _SLOWEST)), 1.0)


def _tolerance(
    at: _State, logarithmic: BoolArray, noise: FloatArray, accuracy: float
) -> FloatArray:
    """Return the squared length of a negligible step."""
    P = at.theta.shape[1]
    lever = np.where(logarithmic, 1.0, at.theta)
    signal = (at.hessian[:, range(P), range(P)] * lever**2).max(axis=1)
    return np.asarray(np.maximum(_NOISE_TOLERANCE**2 * noise, accuracy**2 * signal))


def minimise_by_scipy(
    problem: Problem, start: FloatArray, scale: float, loss: Loss | None
) -> Minima:
    """Return the minimum of one table's cost by scipy's trust-region reflective algorithm.

    The search begins at `start`, (P,), and keeps within the problem's bounds.
    """
    from scipy import optimize

    @lru_cache(maxsize=1)  # scipy calls for residuals, and then for their Jacobian
    def rows(key: bytes) -> FloatArray:
        theta = np.frombuffer(key)
        m, values = problem.n_residuals, problem.to_values(theta)
        if not np.isfinite(values).all() or (values[problem.space.positive] == 0.0).any():
            return np.full((1 + theta.size, m + problem.n_priors), np.nan)
        at = problem.rows(theta, scale, tails=loss is None)
        if loss is not None:
            at = bend(at, m, loss, problem.residuals_per_row)
        if not np.isfinite(at).all():
            at[0] = np.nan  # scipy then rejects the step
        return at

    def residuals(at: FloatArray) -> FloatArray:
        return np.asarray(rows(at.tobytes())[0])

    def jacobian(at: FloatArray) -> FloatArray:
        return rows(at.tobytes())[1:].T

    theta, converged, nfev = start, False, 1
    if np.isfinite(rows(start.tobytes())[0]).all():
        with np.errstate(all="ignore"):
            end = optimize.least_squares(
                residuals,
                start,
                jacobian,
                bounds=problem.bounds(),
                x_scale="jac",
                ftol=_OF_COST,
                xtol=_OF_STEP,
                gtol=_OF_SLOPE,
                max_nfev=_EVALUATIONS,
            )
        theta, converged, nfev = np.asarray(end.x), end.status > 0, int(end.nfev)
    minimum = problem.quadratic(theta, scale, loss)
    cost = float(minimum.cost) if nfev > 1 or converged else np.inf
    return Minima(
        theta[None],
        np.array([cost]),
        minimum.hessian[None],
        np.array([converged]),
        np.array([nfev]),
    )
