r"""Exact posteriors of up to three parameters: adaptive quadrature over the whole prior.

Each parameter in turn is the outer one. At each of its values the others are integrated on a
lattice around their conditional mode (:mod:`dahl_ident.bayes.lattice`), so that even narrow and
curved ridges are followed without a search. The result is the marginal density of the outer
parameter, which is integrated over the range of its prior in panels: around the centre of the
posterior they are as wide as its spread, and further out they grow until the prior ends or the
density is negligible. A panel has the 9 nodes of Clenshaw and Curtis; its error is estimated from
the last two coefficients of the Chebyshev series through them, which cannot vanish by chance,
unlike a difference of two integrals. The panels with the largest errors are halved until the errors
add up to less than the tolerance.

The evidence is obtained once for each parameter, from disjoint sets of points. Their disagreement
counts as error as well. If they contradict each other while there are still few panels, the
lattices miss part of the posterior, and refinement stops. What lies apart from the ridges that
start at the least-squares optimum, a second mode behind a valley e^-40 deep, is not looked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.special import logsumexp

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.lattice import Box, Lattice, LogDensity, Slicer
from dahl_ident.bayes.noise_scale import BISECTIONS

POINTS = 9  # of a panel: smooth densities take few panels, narrow ones not many useless nodes
_FIRST = 2.0  # standard deviations from the centre to the first wall
_GROWTH = 2.5  # from wall to wall outwards: few panels, and none far wider than the density within
_FARTHEST = 40.0  # below the peak's logarithm, where panels end
_STEP = {0: 1.0, 1: 0.5, 2: 0.75}  # of the lattice, by its axes
_FINER, _REFINEMENTS = 0.6, 5  # by which an axis is refined until its error is small enough
_LATTICE_SHARE = 0.3  # of the tolerance
_ROUGH = 1e-3  # error at which the parameters' evidences are compared
_CONTRADICTION = 10.0  # times the estimated errors, by which evidences may differ
_PART = 0.125  # of the last two Chebyshev coefficients that the integral of what follows is


class Rule(NamedTuple):
    """Nodes on [-1, 1], weights, and matrices from values at the nodes to Chebyshev series."""

    nodes: FloatArray
    weights: FloatArray
    series: FloatArray
    """Of the function, (POINTS, POINTS)."""
    primitive: FloatArray
    """Of its integral from -1, (POINTS + 1, POINTS)."""


@lru_cache(maxsize=1)
def rule() -> Rule:
    """Return Clenshaw and Curtis's rule of 9 points."""
    nodes = -np.cos(np.pi * np.arange(POINTS) / (POINTS - 1))
    series = np.linalg.inv(chebyshev.chebvander(nodes, POINTS - 1)).astype(np.float64)
    primitive = chebyshev.chebint(series, lbnd=-1).astype(np.float64)
    return Rule(nodes, primitive.sum(axis=0), series, primitive)


@dataclass(frozen=True)
class Panels:
    """Pieces of the outer axis: walls, (C,), and at the nodes, (C, POINTS), the inner integrals.

    `errors` are those of the inner integrals, (2, d, C, POINTS); `ids` tell whose points are whose.
    """

    low: FloatArray
    high: FloatArray
    log_value: FloatArray
    errors: FloatArray
    ids: NDArray[np.intp]

    def __add__(self, other: Panels) -> Panels:
        return Panels(
            np.concatenate([self.low, other.low]),
            np.concatenate([self.high, other.high]),
            np.concatenate([self.log_value, other.log_value]),
            np.concatenate([self.errors, other.errors], axis=2),
            np.concatenate([self.ids, other.ids]),
        )

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Panels:
        return Panels(
            self.low[chosen],
            self.high[chosen],
            self.log_value[chosen],
            self.errors[:, :, chosen],
            self.ids[chosen],
        )

    @property
    def half(self) -> FloatArray:
        """Half widths, (C,)."""
        return 0.5 * (self.high - self.low)


@dataclass(frozen=True)
class Marginal:
    """The marginal density of one theta in panels, and the weighted points behind it.

    Attributes
    ----------
    low, high : ndarray, shape (C,)
        Walls of the panels, rising.
    density : ndarray, shape (C, POINTS)
        At their nodes, normalised.
    theta, weights : ndarray, shapes (N, D) and (N,)
        Points and their probabilities, which sum to 1.
    log_evidence, error : float
        ln of the integral, and its relative error.
    evaluations : int
        Points at which the density was computed.
    """

    low: FloatArray
    high: FloatArray
    density: FloatArray
    theta: FloatArray
    weights: FloatArray
    log_evidence: float
    error: float
    evaluations: int

    def quantiles(self, probabilities: FloatArray) -> FloatArray:
        """Return the theta below which there is a given part of the probability."""
        panel = np.searchsorted(self._below[1:-1], probabilities)
        rest = probabilities - self._below[panel]
        low, high = self.low[panel], self.high[panel]
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            under = self._within(panel, middle) < rest
            low, high = np.where(under, middle, low), np.where(under, high, middle)
        return np.asarray(0.5 * (low + high))

    def _within(self, panel: NDArray[np.intp], points: FloatArray) -> FloatArray:
        """Return the probability from the lower wall of a panel to a point in it, (Q,)."""
        angle = np.arccos(self._place(panel, points))
        terms = np.cos(angle[:, None] * np.arange(POINTS + 1))
        return np.asarray(np.einsum("qk,qk->q", terms, self._primitive[panel]))

    def _place(self, panel: NDArray[np.intp], points: FloatArray) -> FloatArray:
        """Return where points are in their panels, from -1 to 1."""
        low, high = self.low[panel], self.high[panel]
        return np.clip((2.0 * points - low - high) / (high - low), -1.0, 1.0)

    def at(self, points: FloatArray) -> FloatArray:
        """Return the density at each of Q points."""
        panel = np.clip(np.searchsorted(self.low, points) - 1, 0, len(self.low) - 1)
        angle = np.arccos(self._place(panel, points))
        terms = np.cos(angle[:, None] * np.arange(POINTS))
        density = np.einsum("qk,qk->q", terms, self.density[panel] @ rule().series.T)
        outside = (points < self.low[0]) | (points > self.high[-1])
        return np.where(outside, 0.0, np.maximum(density, 0.0))

    @cached_property
    def _primitive(self) -> FloatArray:
        half = 0.5 * (self.high - self.low)
        return half[:, None] * (self.density @ rule().primitive.T)

    @cached_property
    def _below(self) -> FloatArray:
        """The probability below each wall, (C + 1,); a Chebyshev series at 1 is its sum."""
        return np.concatenate([[0.0], np.cumsum(self._primitive.sum(axis=1))])


@dataclass(frozen=True)
class Grid:
    """A posterior as the marginals of all its parameters."""

    marginals: tuple[Marginal, ...]

    @cached_property
    def best(self) -> Marginal:
        """The marginal with the smallest error, whose points represent the posterior."""
        return min(self.marginals, key=lambda m: np.inf if np.isnan(m.error) else m.error)

    @property
    def dims(self) -> int:
        """The number D of parameters."""
        return len(self.marginals)

    @property
    def theta(self) -> FloatArray:
        """The points, shape (N, D)."""
        return self.best.theta

    @property
    def weights(self) -> FloatArray:
        """Their probabilities, which sum to 1."""
        return self.best.weights

    @property
    def log_evidence(self) -> float:
        """Logarithm of the integral."""
        return self.best.log_evidence

    @property
    def error(self) -> float:
        """The largest error of a marginal, or disagreement between two of them, relative."""
        each = [m.log_evidence for m in self.marginals]
        return float(np.max([*(m.error for m in self.marginals), np.expm1(np.ptp(each))]))

    @property
    def evaluations(self) -> int:
        """Points at which the density was computed."""
        return sum(m.evaluations for m in self.marginals)

    def quantiles(self, axis: int, probabilities: FloatArray) -> FloatArray:
        """Return quantiles of one theta."""
        return self.marginals[axis].quantiles(probabilities)


def integrate(
    log_density: LogDensity,
    box: Box,
    slicers: Sequence[Slicer],
    centre: FloatArray,
    spread: FloatArray,
    *,
    tolerance: float = 1e-4,
    most: int = 200_000,
) -> Grid:
    """Return the density's integral over a box, once for each parameter.

    Parameters
    ----------
    log_density : callable
        theta (S, D) -> (S,); -inf outside the prior.
    box : tuple of ndarray, shape (D,)
        Lower and upper ends of theta.
    slicers : sequence of Slicer
        One for each parameter as the outer one, in their order.
    centre, spread : ndarray, shape (D,)
        Where the density is large, and about its standard deviations.
    tolerance : float
        Relative error to be reached.
    most : int
        Evaluations for one parameter at which refinement ends in any case.
    """
    # a badly placed lattice overflows; its error is then reported as infinite
    with np.errstate(over="ignore", invalid="ignore"):
        works = [_Work(log_density, box, slicer, centre, spread, most) for slicer in slicers]
        rough = max(_ROUGH, tolerance)
        for work in works:
            work.halve_panels(rough)
        if not _contradict(works, rough):
            for work in works:
                work.complete(tolerance)
        return Grid(tuple(work.marginal() for work in works))


class _Work:
    """One marginal under construction: panels, and the lattice that fills them."""

    def __init__(
        self,
        log_density: LogDensity,
        box: Box,
        slicer: Slicer,
        centre: FloatArray,
        spread: FloatArray,
        most: int,
    ) -> None:
        self._log_density, self._box, self._slicer = log_density, box, slicer
        self._centre, self._spread = float(centre[slicer.outer]), float(spread[slicer.outer])
        self._most, self._spent = most, 0
        self._inner = len(slicer.inner)
        self._lay(np.full(self._inner, _STEP[self._inner]))

    def _lay(self, step: FloatArray) -> None:
        """Start with a lattice of a given step."""
        axis = self._slicer.outer
        ends = float(self._box[0][axis]), float(self._box[1][axis])
        self._step = step
        self._lattice = Lattice(self._log_density, self._box, self._slicer, step)
        self._panels = _outwards(self._lattice, self._centre, self._spread, ends)
        self._errors = _errors(self._panels)

    @property
    def evaluations(self) -> int:
        """Points at which the density was computed."""
        return self._spent + self._lattice.evaluations

    @property
    def error(self) -> float:
        """Relative error of the integral."""
        return float(self._errors.outer.sum() + self._errors.inner.sum())

    @property
    def log_evidence(self) -> float:
        """Logarithm of the integral."""
        return float(logsumexp(self._panels.log_value + _log_weights(self._panels)))

    def halve_panels(self, tolerance: float) -> None:
        """Halve the worst panels until the error along the outer axis is small enough."""
        while self._errors.outer.sum() > (1.0 - _LATTICE_SHARE) * tolerance:
            if self.evaluations > self._most:
                break
            chosen = _largest(self._errors.outer, 0.3 * tolerance)
            panels = self._panels
            self._panels = panels[~chosen] + _at(self._lattice, *_halves(panels[chosen]))
            self._errors = _errors(self._panels)

    def complete(self, tolerance: float) -> None:
        """Refine panels and lattice until the tolerance or the limit of evaluations is reached."""
        self.halve_panels(tolerance)
        for _ in range(_REFINEMENTS - 1):
            coarse = self._errors.inner > _LATTICE_SHARE * tolerance / max(1, self._inner)
            denser = self._lattice.evaluations * _FINER ** -coarse.sum()
            if not coarse.any() or self.evaluations + denser > self._most:
                break
            self._spent = self.evaluations
            self._lay(np.where(coarse, _FINER * self._step, self._step))
            self.halve_panels(tolerance)

    def marginal(self) -> Marginal:
        """Return the marginal in its present state."""
        return _finished(self._panels, self._lattice, self.error, self.evaluations)


def _contradict(works: Sequence[_Work], rough: float) -> bool:
    """Return whether evidences differ by far more than the estimated errors explain."""
    each = [work.log_evidence for work in works]
    stated = max(rough, *(work.error for work in works))
    return bool(np.expm1(np.ptp(each)) > _CONTRADICTION * stated)


def _log_weights(panels: Panels) -> FloatArray:
    """Return ln of the weights of all nodes, (C, POINTS)."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(rule().weights * panels.half[:, None]))


class _Errors(NamedTuple):
    """Of every panel, (C,), and of the inner integrals by axis, (d,); relative to the whole."""

    outer: FloatArray
    inner: FloatArray


def _at(lattice: Lattice, low: FloatArray, high: FloatArray) -> Panels:
    """Return panels with the inner integrals at all their nodes."""
    nodes = 0.5 * ((low + high)[:, None] + (high - low)[:, None] * rule().nodes)
    sums = lattice(nodes.ravel())
    shape = nodes.shape
    errors = sums.errors.reshape(*sums.errors.shape[:2], *shape)
    return Panels(low, high, sums.log_value.reshape(shape), errors, sums.ids.reshape(shape))


def _outwards(lattice: Lattice, centre: float, spread: float, box: tuple[float, float]) -> Panels:
    """Return panels from the centre to where the box or the density ends."""
    centre = min(max(centre, box[0]), box[1])
    reach = _FIRST * spread
    walls = [max(box[0], centre - reach), min(box[1], centre + reach)]
    first = np.array([walls[0], centre]), np.array([centre, walls[1]])
    solid = first[1] > first[0]
    panels = _at(lattice, first[0][solid], first[1][solid])
    open_ = [walls[0] > box[0], walls[1] < box[1]]
    while any(open_):
        reach *= _GROWTH
        next_ = [max(box[0], centre - reach), min(box[1], centre + reach)]
        low = np.array([next_[0], walls[1]])[open_]
        high = np.array([walls[0], next_[1]])[open_]
        more = _at(lattice, low, high)
        panels = panels + more
        something = more.log_value.max(axis=1) > panels.log_value.max() - _FARTHEST
        left = iter(something)
        for side in (0, 1):
            if open_[side]:
                walls[side] = next_[side]
                open_[side] = bool(next(left)) and walls[side] != box[side]
    return panels


def _errors(panels: Panels) -> _Errors:
    value = np.exp(panels.log_value - panels.log_value.max())
    fine = value @ rule().weights * panels.half
    total = fine.sum()
    series = np.abs(value @ rule().series.T)
    outer = _PART * series[:, -2:].sum(axis=1) * panels.half
    with np.errstate(divide="ignore", invalid="ignore"):
        second, fourth = (value * panels.errors) @ rule().weights @ panels.half / total
        inner = second * np.nan_to_num(np.minimum(1.0, second / fourth))
    return _Errors(outer / total, inner)


def _largest(errors: FloatArray, rest: float) -> NDArray[np.bool_]:
    """Return the smallest set of panels without which the errors add up to less than `rest`."""
    order = np.argsort(errors)
    chosen = np.zeros(len(errors), dtype=bool)
    chosen[order[np.cumsum(errors[order]) > rest]] = True
    return chosen


def _halves(panels: Panels) -> tuple[FloatArray, FloatArray]:
    middle = 0.5 * (panels.low + panels.high)
    return np.concatenate([panels.low, middle]), np.concatenate([middle, panels.high])


def _finished(panels: Panels, lattice: Lattice, error: float, evaluations: int) -> Marginal:
    """Return the marginal with its points, those of panels that were halved left out."""
    log_weights = _log_weights(panels)
    of_id = np.full(lattice.values, -np.inf)
    of_id[panels.ids.ravel()] = log_weights.ravel()
    log_evidence = float(logsumexp(panels.log_value + log_weights))
    theta, log_mass, ids = lattice.points.joined()
    weights = np.exp(log_mass + of_id[ids] - log_evidence)
    some = weights > 0.0
    rising = np.argsort(panels.low)
    return Marginal(
        panels.low[rising],
        panels.high[rising],
        np.exp(panels.log_value[rising] - log_evidence),
        theta[some],
        weights[some] / weights.sum(),
        log_evidence,
        error,
        evaluations,
    )
