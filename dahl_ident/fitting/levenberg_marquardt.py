"""Levenberg and Marquardt's method for many least-squares problems at once.

Each step solves (H + lambda D) delta = -g with g the gradient of the cost, H its Gauss-Newton
Hessian and D = diag H, so it does not depend on the parameters' units. lambda starts at almost
nothing, a Gauss-Newton step; it falls where a step does what H predicted, and rises where the cost
does not fall. All problems take their steps together; those that have ended drop out.

A problem has converged where the step after the next, as the steps shrink, would move the residuals
by less than 1e-8 of their standard deviation, or by no more than what rounding, or the accuracy of
predictions, leaves of the data; it ends with the next step, which needs no further evaluation.
`scipy.optimize.least_squares` is the other method, on the same residuals and Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.losses import Loss
from dahl_ident.noise import bend
from dahl_ident.problem import EXPLICIT, Problem, Quadratic

if TYPE_CHECKING:
    from dahl_ident.fitting.asymptotes import Limit

IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
Evaluate = Callable[[FloatArray, IntArray], Quadratic]
"""(theta (S, P), which of the searches they belong to (S,)) -> cost, gradient, Hessian."""
Bounds = tuple[FloatArray, FloatArray]
"""Least and largest coordinates, (P,) each, of steps."""
Fall = Callable[[FloatArray], FloatArray | float]
"""Costs (S,) -> their falls that are not worth a step."""

_EPS = float(np.finfo(np.float64).eps)  # distance from 1 to the next number
_FIRST_DAMPING = 1e-9  # lambda at first: almost nothing, so that the step is Gauss and Newton's
_GAUSS_NEWTON = 1e-3  # lambda above which a step is short because of it, not near a minimum
_MOST_DAMPING = 1e12  # lambda at which steps change no digit: the search has failed
_ROUNDING = 1e-12  # rounding errors of a scaled Hessian, some thousand times _EPS
_LONGEST_STEP = 2.0  # of a logarithm: a factor of 7, within which a quadratic may still hold
# length of a step, over the residuals' standard deviation, at which a search has converged
_NOISE_TOLERANCE = 1e-8
# longest step of a logarithm that may be the last: the Hessian returned is that before it
_LAST_STEP = 1e-6
_ALIKE = 0.9  # squared cosine between two steps of a geometric series
_SLOWEST = 0.99  # their ratio at most: a hundred steps at once
# change of the residuals, over their size, that a coordinate makes from bound to bound, below which
# it is held: it has no effect
_FLAT = 1e-3
_NEAR = 0.01  # longest last step, as a share of the way between the bounds
_UNSEEN = 4.0 * _EPS  # relative change of a cost that may be rounding
_OF_ACCURACY = 0.3  # the same over the accuracy of predictions, where that is less than rounding's
# a search that is still higher ends after so many times the steps of one that has converged
_OVERTIME = 2.0
# relative changes of cost, step and slope at which scipy's searches end: a few hundred times _EPS
_OF_COST, _OF_STEP, _OF_SLOPE = 1e-13, 1e-10, 1e-14
_EVALUATIONS = 300  # of scipy's search, which needs about thirty; more mean that it does not end
NEARLY = 1e-4  # relative difference of costs within which a search that has converged is preferred


@dataclass(frozen=True)
class _Searches:
    """Arrays with a leading axis S, one place for each search."""

    def take(self, which: BoolArray | IntArray) -> Self:
        """Return some of the searches."""
        return type(self)(*(getattr(self, f.name)[which] for f in fields(self)))

    def assign(self, which: IntArray, other: Self) -> None:
        """Replace some of the searches."""
        for f in fields(self):
            getattr(self, f.name)[which] = getattr(other, f.name)

    def where(self, wins: BoolArray, other: Self) -> Self:
        """Return, search by search, the other where it `wins`."""
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
    """Search coordinates, (S, P); at a limit so far out that the model is its limit."""
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
        """The number of parameters that each optimum has: fewer than P at a limit."""
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
        """Return the best search of each of S owners: converged ones first if nearly as low."""
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
        """Return, search by search, the other where it is lower or alone has converged."""
        wins = (other.cost < self.cost) & ~(self.converged & ~other.converged)
        wins |= other.converged & ~self.converged
        every = self.evaluations + other.evaluations
        return replace(self.where(wins, other), evaluations=every)


@dataclass(frozen=True)
class _State(_Searches):
    """Where each search stands."""

    theta: FloatArray
    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray

    def moved(self, which: BoolArray, step: FloatArray, fall: FloatArray) -> _State:
        """Return this state with a last short step taken by some."""
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
    unseen: bool = True,
    restrained: bool = False,
) -> Minima:
    """Return the minima of the costs that searches from `theta`, shape (S, P), find.

    `logarithmic` says which coordinates are logarithms: their steps have a longest length.
    Searches that leave the region `inside`, which is called like `evaluate`, end there, not
    converged; so do those that are still higher after twice the steps in which another one of the
    same `owner` has converged. `tolerance_factor` multiplies the length of the step at which a
    search has converged; `enough` gives the fall of a cost that is not worth a step, however long:
    the search ends before it. `accuracy` is that of predictions, relative to the data. No step
    leads beyond the `bounds` of theta; a coordinate at its bound that would go on stays there. In
    `restrained` searches a logarithmic step of 1 counts like residuals of one standard deviation:
    coordinates that hardly have an effect wait where they are until the others have converged.
    """
    owner = np.arange(len(theta)) if owner is None else owner
    S, P = theta.shape
    unseen_change = _UNSEEN if accuracy <= EXPLICIT else _OF_ACCURACY * accuracy
    active = np.arange(S)
    at = _State(theta, *evaluate(theta, active))
    ends = at.take(active)
    converged, evaluations = np.full(S, P == 0), np.ones(S, dtype=np.intp)
    damping, growth = np.full(S, _FIRST_DAMPING), np.full(S, 2.0)
    last, before = np.full(S, 1e-300), np.zeros((S, P))
    # steps of each owner's converged search
    first, lowest = np.full((2, owner.max(initial=0) + 1), np.inf)
    for count in range(steps if P else 0):
        noise = 2.0 * at.cost / max(n_residuals - P, 1)
        restraint = restrained * noise[:, None] * logarithmic
        step, moves, predicted, longest = _step(at, damping, logarithmic, bounds, restraint)
        shortest = tolerance_factor**2 * _tolerance(at, logarithmic, n_residuals, accuracy)
        settled = moves * np.minimum(1.0, moves / last) <= shortest
        settled |= predicted <= tolerance_factor**2 * _EPS * at.cost
        settled &= longest <= tolerance_factor * _LAST_STEP
        settled &= predicted <= at.cost  # a larger fall is rounding
        short = settled
        if bounds is not None:  # far steps of what hardly has an effect may lead anywhere
            short = short & (np.abs(step) <= _NEAR * (bounds[1] - bounds[0])).all(axis=1)
        settled = settled | (enough is not None and predicted < enough(at.cost))
        settled &= damping < _GAUSS_NEWTON
        lost = ~np.isfinite(at.cost) | (damping > _MOST_DAMPING)
        if inside is not None:
            lost |= ~inside(at.theta, active)
        owners = owner[active]
        lost |= (count > _OVERTIME * first[owners]) & (at.cost > lowest[owners])
        ended = settled | lost
        if ended.any():
            settled &= ~lost
            converged[active] = settled
            np.minimum.at(first, owners[settled], count)
            np.minimum.at(lowest, owners[settled], at.cost[settled])
            ends.assign(active, at.moved(settled & (short | unseen), step, predicted))
            keep = ~ended
            active, at = active[keep], at.take(keep)
            if not active.size:
                break
            step, moves, predicted = step[keep], moves[keep], predicted[keep]
            damping, growth, last, before = damping[keep], growth[keep], last[keep], before[keep]
        further = _further(at.hessian, step, before)
        longest = np.abs(step * logarithmic).max(axis=1)
        further = np.clip(_LONGEST_STEP / np.maximum(longest, 1e-300), 1.0, further)
        step = further[:, None] * step
        trial = at.theta + step
        new = _State(trial, *evaluate(trial, active))
        evaluations[active] += 1
        # a fall too small to see next to one enormous row's cost is taken as predicted
        tiny = predicted <= unseen_change * at.cost
        better = (new.cost < at.cost) | (tiny & (new.cost <= (1.0 + unseen_change) * at.cost))
        gain = np.where(tiny, 1.0, at.cost - new.cost) / np.where(tiny, 1.0, predicted)
        # the damping of the last step is still needed
        least = np.where(growth > 2.0, 1.0 / 3.0, 0.05)
        calmer = np.maximum(damping * np.maximum(least, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-15)
        damping = np.where(better, calmer, np.maximum(damping * growth, 1e-6))
        growth = np.where(better, 2.0, 4.0 * growth)
        last = np.where(better, moves, 1e-300)
        before = np.where((better & (further == 1.0))[:, None], step, 0.0)
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
    """Return the next step, its squared length, the fall of cost predicted, the longest log step.

    The length is among residuals.
    """
    P = at.theta.shape[1]
    size = np.sqrt(at.hessian[:, range(P), range(P)])
    size = np.where((size > 0.0) & np.isfinite(size), size, 1.0)
    H = at.hessian / (size[:, :, None] * size[:, None, :])
    g = at.gradient / size
    if bounds is not None:
        low, high = bounds
        held = ((at.theta <= low) & (g > 0.0)) | ((at.theta >= high) & (g < 0.0))
        held |= size * (high - low) <= _FLAT * np.sqrt(at.cost)[:, None]
        g = np.where(held, 0.0, g)
        H = np.where(held[:, :, None] | held[:, None, :], np.eye(P), H)
    damped = H + (damping[:, None] + restraint / size**2)[:, None] * np.eye(P)
    if not np.isfinite(damped).all():
        bad = ~np.isfinite(damped).all(axis=(1, 2))
        damped[bad], g[bad] = np.eye(P), 0.0
    try:
        delta = -np.linalg.solve(damped, g[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:  # somewhere two columns are alike to rounding
        delta = -np.linalg.solve(damped + _ROUNDING * np.eye(P), g[:, :, None])[:, :, 0]
    longest = np.abs(delta / size * logarithmic).max(axis=1)
    if longest.max() > _LONGEST_STEP:
        delta *= np.minimum(1.0, _LONGEST_STEP / np.maximum(longest, 1e-300))[:, None]
    if bounds is not None:
        wide = delta
        delta = (np.clip(at.theta + wide / size, low, high) - at.theta) * size
        cut = delta != wide
        if cut.any():  # the others' steps are best for those that end at a bound
            at_bounds = np.where(cut, delta, 0.0)
            g_there = np.where(cut, 0.0, g + (damped @ at_bounds[:, :, None])[:, :, 0])
            free = np.where(cut[:, :, None] | cut[:, None, :], np.eye(P), damped)
            inner = -np.linalg.solve(free + _ROUNDING * np.eye(P), g_there[:, :, None])[:, :, 0]
            furthest = np.abs(inner / size * logarithmic).max(axis=1)
            inner *= np.minimum(1.0, _LONGEST_STEP / np.maximum(furthest, 1e-300))[:, None]
            delta = (np.clip(at.theta + (at_bounds + inner) / size, low, high) - at.theta) * size
            longest = np.maximum(longest, furthest)
    moves = (delta[:, None, :] @ H @ delta[:, :, None])[:, 0, 0]
    predicted = -(delta * g).sum(axis=1) - 0.5 * moves
    return delta / size, moves, np.maximum(predicted, 1e-300), longest


def _further(hessian: FloatArray, step: FloatArray, before: FloatArray) -> FloatArray:
    """Return the factor that lengthens a step to the sum of the geometric series it continues.

    Where a model is curved and misses the data by much, each step of Gauss and Newton's is the same
    share of the one `before`.
    """
    along, past = ((hessian @ each[:, :, None])[:, :, 0] for each in (step, before))
    product, squares = (step * past).sum(axis=1), (before * past).sum(axis=1)
    ratio = product / np.maximum(squares, 1e-300)
    alike = product**2 > _ALIKE * squares * (step * along).sum(axis=1)
    return np.where(alike & (ratio > 0.0), 1.0 / (1.0 - np.minimum(ratio, _SLOWEST)), 1.0)


def _tolerance(at: _State, logarithmic: BoolArray, n_residuals: int, accuracy: float) -> FloatArray:
    """Return the squared length of a step that no longer matters."""
    P = at.theta.shape[1]
    noise = 2.0 * at.cost / max(n_residuals - P, 1)
    lever = np.where(logarithmic, 1.0, at.theta)
    signal = (at.hessian[:, range(P), range(P)] * lever**2).max(axis=1)
    return np.asarray(np.maximum(_NOISE_TOLERANCE**2 * noise, accuracy**2 * signal))


def minimise_by_scipy(
    problem: Problem, start: FloatArray, scale: float, loss: Loss | None
) -> Minima:
    """Return the minimum of one table's cost between its bounds, from one start, shape (P,).

    The trust-region reflective algorithm.
    """
    from scipy import optimize

    last: dict[bytes, FloatArray] = {}  # scipy asks for residuals, and then for their Jacobian

    def rows(theta: FloatArray) -> FloatArray:
        key = theta.tobytes()
        if key not in last:
            last.clear()
            last[key] = evaluated(theta)
        return last[key]

    def evaluated(theta: FloatArray) -> FloatArray:
        m, values = problem.n_residuals, problem.to_values(theta)
        if not np.isfinite(values).all() or (values[problem.space.positive] == 0.0).any():
            return np.full((1 + theta.size, m + problem.n_priors), np.nan)
        at = problem.rows(theta, scale, tails=loss is None)
        if loss is not None:
            at = bend(at, m, loss, problem.parts)
        if not np.isfinite(at).all():
            at[0] = np.nan  # a step that scipy takes back
        return at

    def residuals(at: FloatArray) -> FloatArray:
        return np.asarray(rows(at)[0])

    def jacobian(at: FloatArray) -> FloatArray:
        return rows(at)[1:].T

    theta, converged, nfev = start, False, 1
    if np.isfinite(rows(start)[0]).all():
        with np.errstate(all="ignore"):
            end = optimize.least_squares(
                residuals, start, jacobian, bounds=problem.bounds(),
                x_scale="jac", ftol=_OF_COST, xtol=_OF_STEP, gtol=_OF_SLOPE, max_nfev=_EVALUATIONS,
            )  # fmt: skip
        theta, converged, nfev = np.asarray(end.x), end.status > 0, int(end.nfev)
    there = problem.quadratic(theta, scale, loss)
    cost = float(there.cost) if nfev > 1 or converged else np.inf
    counts = np.array([converged]), np.array([nfev])
    return Minima(theta[None], np.array([cost]), there.hessian[None], *counts)
