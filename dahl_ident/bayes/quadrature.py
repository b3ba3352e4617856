r"""Exact posteriors of up to three parameters: adaptive quadrature over the whole prior.

The box of the prior is cut into cells. Around the centre of the posterior they are as small as
its spread; outwards they grow sixfold from shell to shell until the box is full, so that tails
count as far as the prior reaches. A cell is integrated by a product of Clenshaw and Curtis's
rules of 9 points. Their 5 inner points are a rule of their own; what changes when they take its
place along one axis is the error of the cell along that axis. The cells of largest error are
halved along their worst axes until all errors add up to less than the tolerance. For the integral
this is generous, that of 9 points being far better than that of 5; for quantiles, which cut through
cells, it is about right.

Ridges are straightened first: theta = centre + L phi, L unit lower triangular from the covariance
of the parameters. L turns walls of the box oblique, which matters only where there is probability,
so parameters that reach a wall come first and keep their axes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray

POINTS = 9
_INNER = 3.0  # standard deviations from the centre to the first wall
_SHELLS = 6.0
_NEAR = 5.0  # standard deviations within which a wall is near
_NOTHING = 60.0  # below the peak's logarithm
_WORST = 0.3  # of the worst axis' error at which another axis is halved as well
_BISECTIONS = 50
_STEP = 1e-3  # of the range, for a slope
_FINE = {2: 64, 3: 20}  # lines along an axis of a cell, by dimension

LogDensity = Callable[[FloatArray], FloatArray]


class Rule(NamedTuple):
    """Nodes on [-1, 1], weights, weights of every second node, and node values to integrals."""

    nodes: FloatArray
    weights: FloatArray
    coarse: FloatArray
    primitive: FloatArray
    """Values at the nodes -> Chebyshev coefficients of the integral from -1."""


@lru_cache(maxsize=1)
def rule() -> Rule:
    """Return Clenshaw and Curtis's rule of 9 points with that of 5 inside it."""
    nodes = -np.cos(np.pi * np.arange(POINTS) / (POINTS - 1))
    primitive = _primitive(nodes)
    coarse = np.zeros(POINTS)
    coarse[::2] = _primitive(nodes[::2]).sum(axis=0)
    return Rule(nodes, primitive.sum(axis=0), coarse, primitive)


def _primitive(nodes: FloatArray) -> FloatArray:
    coefficients = np.linalg.inv(chebyshev.chebvander(nodes, len(nodes) - 1))
    return np.asarray(chebyshev.chebint(coefficients, lbnd=-1))


@dataclass(frozen=True)
class Cells:
    """Cells and the log-density at their nodes.

    Attributes
    ----------
    low, high : ndarray, shape (C, D)
        Their walls in phi.
    log_density : ndarray, shape (C, POINTS, ..., POINTS)
        One axis a dimension.
    """

    low: FloatArray
    high: FloatArray
    log_density: FloatArray

    def __add__(self, other: Cells) -> Cells:
        return Cells(
            np.concatenate([self.low, other.low]),
            np.concatenate([self.high, other.high]),
            np.concatenate([self.log_density, other.log_density]),
        )

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Cells:
        return Cells(self.low[chosen], self.high[chosen], self.log_density[chosen])

    @property
    def volume(self) -> FloatArray:
        """Half widths multiplied, which is what weights on [-1, 1] need."""
        return np.asarray(np.prod(0.5 * (self.high - self.low), axis=1))


@dataclass(frozen=True)
class Grid:
    """A posterior as weighted points, cell by cell.

    Attributes
    ----------
    cells : Cells
        Without the empty ones.
    centre : ndarray, shape (D,)
        Where phi = 0.
    shear : ndarray, shape (D, D)
        theta = centre + shear phi.
    order : ndarray of int, shape (D,)
        Which theta each phi moves first, with slope 1.
    log_evidence : float
        ln of the integral.
    error : float
        Estimated error of the integral, relative.
    evaluations : int
        Points at which the density was computed.
    """

    cells: Cells
    centre: FloatArray
    shear: FloatArray
    order: NDArray[np.intp]
    log_evidence: float
    error: float
    evaluations: int

    @cached_property
    def theta(self) -> FloatArray:
        """The points, shape (C * POINTS^D, D)."""
        return self.centre + _nodes(self.cells.low, self.cells.high) @ self.shear.T

    @cached_property
    def weights(self) -> FloatArray:
        """Their probabilities, which sum to 1."""
        weights = self._density * self.cells.volume[:, None] * _product(rule().weights, self.dims)
        return np.asarray((weights / weights.sum()).ravel())

    @property
    def dims(self) -> int:
        """The number D of parameters."""
        return len(self.centre)

    @cached_property
    def _density(self) -> FloatArray:
        """The normalised density at the nodes, (C, POINTS^D)."""
        flat = self.cells.log_density.reshape(len(self.cells.low), -1)
        return np.exp(flat - self.log_evidence)

    def quantiles(self, axis: int, probabilities: FloatArray) -> FloatArray:
        """Return quantiles of one theta."""
        lines = self._lines(axis)
        found = lines.quantiles(probabilities)
        if len(lines.low) == len(self.cells.low):
            return found
        # oblique lines end one after the other, which takes more of them to count
        step = _STEP * (self.theta[:, axis].max() - self.theta[:, axis].min())
        density = (lines.below(found + step) - lines.below(found - step)) / (2.0 * step)
        excess = self._lines(axis, _FINE[self.dims]).below(found) - probabilities
        return np.asarray(found - excess / density)

    def _lines(self, axis: int, finer: int = POINTS) -> Lines:
        """Return the density along one theta, cell by cell where its axis is straight.

        Elsewhere line by line, `finer` of them along each other axis of a cell.
        """
        cells, D = self.cells, self.dims
        position = int(np.argmax(self.order == axis))
        others = np.delete(np.arange(D), position)
        slopes = self.shear[axis, others]
        density = np.moveaxis(self._density.reshape(cells.log_density.shape), position + 1, -1)
        half = 0.5 * (cells.high - cells.low)
        volume = np.prod(half[:, others], axis=1)[:, None]
        low = self.centre[axis] + cells.low[:, position]
        high = self.centre[axis] + cells.high[:, position]
        if not np.any(slopes):
            weights = volume * _product(rule().weights, D - 1)
            return Lines(low, high, np.einsum("cl,cln->cn", weights, _flat(density)))
        nodes, weights_1 = rule().nodes, rule().weights
        if finer != POINTS:
            nodes, weights_1 = np.polynomial.legendre.leggauss(finer)
            for k in range(1, D):
                density = np.moveaxis(np.moveaxis(density, k, -1) @ _between(nodes).T, -1, k)
        shift = _nodes(cells.low[:, others], cells.high[:, others], nodes) @ slopes
        shift = shift.reshape(len(half), -1)
        values = (volume * _product(weights_1, D - 1))[..., None] * _flat(density)
        walls = [(shift + wall[:, None]).ravel() for wall in (low, high)]
        return Lines(walls[0], walls[1], values.reshape(-1, POINTS))


def _flat(density: FloatArray) -> FloatArray:
    """Join all axes but the first and the last."""
    return density.reshape(len(density), -1, density.shape[-1])


def _between(points: FloatArray) -> FloatArray:
    """Return the matrix from values at the nodes to those at other points of [-1, 1]."""
    coefficients = np.linalg.inv(chebyshev.chebvander(rule().nodes, POINTS - 1))
    return np.asarray(chebyshev.chebvander(points, POINTS - 1) @ coefficients)


@dataclass(frozen=True)
class Lines:
    """Pieces of a one-dimensional density, (L,) walls and (L, POINTS) values; they add up."""

    low: FloatArray
    high: FloatArray
    values: FloatArray

    @cached_property
    def _primitive(self) -> FloatArray:
        return 0.5 * (self.high - self.low)[:, None] * (self.values @ rule().primitive.T)

    def quantiles(self, probabilities: FloatArray) -> FloatArray:
        """Return the points below which there is a given part of the probability."""
        low = np.full(len(probabilities), self.low.min())
        high = np.full(len(probabilities), self.high.max())
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            under = self.below(middle) < probabilities
            low, high = np.where(under, middle, low), np.where(under, high, middle)
        return np.asarray(0.5 * (low + high))

    def below(self, points: FloatArray) -> FloatArray:
        """Return the probability below each of Q points."""
        x = (2.0 * points[:, None] - self.low - self.high) / (self.high - self.low)
        angle = np.arccos(np.clip(x, -1.0, 1.0))
        terms = np.cos(angle[..., None] * np.arange(POINTS + 1))
        return np.asarray(np.einsum("qlk,lk->q", terms, self._primitive))


def integrate(
    log_density: LogDensity,
    box: tuple[FloatArray, FloatArray],
    centre: FloatArray,
    covariance: FloatArray,
    *,
    tolerance: float = 1e-4,
    most: int = 2_000_000,
) -> Grid:
    """Return the density's integral over a box as weighted points.

    Parameters
    ----------
    log_density : callable
        theta (S, D) -> (S,); -inf outside the prior.
    box : tuple of ndarray, shape (D,)
        Lower and upper ends of theta.
    centre, covariance : ndarray, shape (D,) and (D, D)
        Where the density is large, and about how wide.
    tolerance : float
        Relative error to be reached.
    most : int
        Evaluations at which refinement ends all the same.
    """
    shear, spread, order = _straightened(covariance, box, centre)
    low, high = _bounding(box, centre, shear, order)
    at = _Evaluator(log_density, centre, shear)
    cells = at.cells(*at.promising(*_shells(low, high, spread)))
    while True:
        integral, errors, peak = _integrals(cells)
        total, worst = integral.sum(), errors.max(axis=1)
        error = worst.sum() / total
        if error <= tolerance or at.evaluations >= most:
            break
        chosen = _largest(worst, 0.5 * tolerance * total)
        cells = cells[~chosen] + at.cells(*_halved(cells[chosen], errors[chosen]))
    kept = integral > 1e-16 * total
    log_evidence = float(peak + np.log(total))
    return Grid(cells[kept], centre, shear, order, log_evidence, float(error), at.evaluations)


class _Evaluator:
    """Computes densities at the nodes of cells, and counts."""

    def __init__(self, log_density: LogDensity, centre: FloatArray, shear: FloatArray) -> None:
        self._log_density, self._centre, self._shear = log_density, centre, shear
        self.evaluations = 0

    def cells(self, low: FloatArray, high: FloatArray) -> Cells:
        """Return cells with the density at all their nodes."""
        values = self._at(_nodes(low, high))
        return Cells(low, high, values.reshape(len(low), *[POINTS] * low.shape[1]))

    def promising(self, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the walls of those cells whose inner nodes find any density at all."""
        values = self._at(_nodes(low, high, rule().nodes[::2])).reshape(len(low), -1).max(axis=1)
        some = values > values.max() - _NOTHING
        return low[some], high[some]

    def _at(self, phi: FloatArray) -> FloatArray:
        self.evaluations += len(phi)
        return self._log_density(self._centre + phi @ self._shear.T)


def _straightened(
    covariance: FloatArray, box: tuple[FloatArray, FloatArray], centre: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
    """Return the shear, phi's standard deviations, and which theta each phi moves first.

    Axes along which the posterior reaches a wall come first, and are not sheared by each other.
    """
    std = np.sqrt(np.diagonal(covariance))
    reaches = (centre - _NEAR * std < box[0]) | (centre + _NEAR * std > box[1])
    order = np.lexsort((-std / (box[1] - box[0]), ~reaches))
    ordered = covariance[np.ix_(order, order)] / np.outer(std[order], std[order])
    root = np.linalg.cholesky(ordered)
    slopes = root / np.diagonal(root)
    walls = reaches[order]
    slopes[np.outer(walls, walls) & ~np.eye(len(std), dtype=bool)] = 0.0
    alone = np.linalg.inv(slopes)
    spread = np.sqrt(np.diagonal(alone @ ordered @ alone.T)) * std[order]
    shear = np.empty_like(slopes)
    shear[order] = slopes * std[order][:, None] / std[order]
    return shear, spread, order


def _bounding(
    box: tuple[FloatArray, FloatArray],
    centre: FloatArray,
    shear: FloatArray,
    order: NDArray[np.intp],
) -> tuple[FloatArray, FloatArray]:
    """Return the ranges of phi that hold the box."""
    D = len(centre)
    low, high = np.empty(D), np.empty(D)
    for k, axis in enumerate(order):
        slopes = shear[axis, :k]
        reach = np.stack([slopes * low[:k], slopes * high[:k]])
        low[k] = box[0][axis] - centre[axis] - reach.max(axis=0).sum()
        high[k] = box[1][axis] - centre[axis] - reach.min(axis=0).sum()
    return low, high


def _shells(low: FloatArray, high: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return walls of cells around phi = 0 that grow outwards until the box is full."""
    D = len(low)
    inner = np.stack([np.maximum(low, -_INNER * spread), np.minimum(high, _INNER * spread)])
    middle = np.clip(0.0, inner[0], inner[1])
    cells = [
        (np.where(upper, middle, inner[0]), np.where(upper, inner[1], middle))
        for upper in _corners(D)
    ]
    reach = _INNER
    while np.any(inner[0] > low) or np.any(inner[1] < high):
        reach *= _SHELLS
        for axis in range(D):
            for side, limit, sign in ((0, low, -1.0), (1, high, 1.0)):
                wall = limit[axis], sign * reach * spread[axis]
                new = max(wall) if side == 0 else min(wall)
                if new != inner[side, axis]:
                    slab = inner.copy()
                    slab[1 - side, axis], slab[side, axis] = inner[side, axis], new
                    cells.append((slab[0].copy(), slab[1].copy()))
                    inner[side, axis] = new
    lows, highs = (np.array(walls) for walls in zip(*cells, strict=True))
    solid = (highs > lows).all(axis=1)
    return lows[solid], highs[solid]


def _corners(dims: int) -> NDArray[np.bool_]:
    return np.array(np.meshgrid(*[[False, True]] * dims)).reshape(dims, -1).T


def _nodes(low: FloatArray, high: FloatArray, x: FloatArray | None = None) -> FloatArray:
    """Return points of cells, x along each axis or the rule's nodes, (C * len(x)^D, D)."""
    D = low.shape[1]
    x = rule().nodes if x is None else x
    unit = np.stack(np.meshgrid(*[x] * D, indexing="ij"), axis=-1).reshape(1, -1, D)
    nodes = 0.5 * ((low + high)[:, None] + (high - low)[:, None] * unit)
    return np.asarray(nodes.reshape(-1, D))


def _product(weights: FloatArray, dims: int) -> FloatArray:
    result = np.ones(1)
    for _ in range(dims):
        result = np.multiply.outer(result, weights).ravel()
    return result


def _integrals(cells: Cells) -> tuple[FloatArray, FloatArray, float]:
    """Return each cell's integral, its error along each axis, and the log taken out."""
    peak = float(cells.log_density.max())
    density = np.exp(cells.log_density - peak)
    weights, coarse = rule().weights, rule().coarse
    D = cells.low.shape[1]
    fine = _contracted(density, [weights] * D)
    by_axis = [
        np.abs(fine - _contracted(density, [coarse if i == axis else weights for i in range(D)]))
        for axis in range(D)
    ]
    return fine * cells.volume, np.stack(by_axis, axis=1) * cells.volume[:, None], peak


def _contracted(density: FloatArray, weights: list[FloatArray]) -> FloatArray:
    for w in reversed(weights):
        density = density @ w
    return density


def _largest(errors: FloatArray, rest: float) -> NDArray[np.bool_]:
    """Return the fewest cells without which the errors add up to less than `rest`."""
    order = np.argsort(errors)
    chosen = np.zeros(len(errors), dtype=bool)
    chosen[order[np.cumsum(errors[order]) > rest]] = True
    return chosen


def _halved(cells: Cells, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the walls of the cells' halves, cut along their worst axes."""
    low, high = cells.low, cells.high
    cut = errors >= _WORST * errors.max(axis=1, keepdims=True)
    for axis in range(low.shape[1]):
        yes = cut[:, axis]
        middle = 0.5 * (low[yes, axis] + high[yes, axis])
        left, right = high[yes].copy(), low[yes].copy()
        left[:, axis] = right[:, axis] = middle
        low, high, cut = (
            np.concatenate([low[~yes], low[yes], right]),
            np.concatenate([high[~yes], left, high[yes]]),
            np.concatenate([cut[~yes], cut[yes], cut[yes]]),
        )
    return low, high
