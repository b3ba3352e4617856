r"""Where a search starts: variable projection, so that no user has to guess.

A describing function is linear in sigma once x_c = f_max/sigma and alpha are given,

    N = sigma h_alpha(A / x_c),

and springs, dampers and masses are linear anyway. Least squares in dynamic stiffness, with
amplitudes as measured and weights that the noise model has at the data, is therefore a search
over x_c (and alpha, where free) of each Dahl element alone: at each node of a grid of those, the
linear parameters are solved exactly. Every local minimum over the grid is a start.

The grid has four nodes a decade from a hundredth of the smallest amplitude to a hundred times
the largest, and one a decade beyond, down to 1e-8 and up to 1e6 times. Farther out the curve is
its own limit to well below any noise; whether the optimum lies out there, at infinity, is for
:mod:`dahl_ident.fitting.limits` to decide.

h is read from a table over ln beta whose steps divide those of the grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import SMALLEST, ComplexArray, FloatArray
from dahl_ident.elements import Dahl, Damper, Mass, Parameter, Spring
from dahl_ident.errors import FitError
from dahl_ident.problem import Problem
from dahl_ident.problem.stiffness import StiffnessData

IntArray = NDArray[np.intp]

_STEP = 0.01
_LOWEST, _NODES = -3200, 6400  # of ln beta in the table, in steps
_FINE, _COARSE = 58, 230  # steps between nodes of the grid: four a decade, one a decade
_FINE_ENDS = (6, 4)  # coarse nodes at either end
_DECADE = np.log(10.0) / _STEP
_ALPHAS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
_DEPENDENT = 1e-12  # of a column's length that others leave
_MOST_COMBINATIONS = 4000
_MOST_STARTS = 4
_AROUND = np.array([-1, 0, 1])
_LINEAR = (Mass, Damper, Spring)


def starts(problem: Problem) -> FloatArray:
    """Return the search coordinates of the best starts, best first, shape (starts, P).

    Values that the user gave to free parameters make one more start, the last.
    """
    return _starts(problem, problem.stiffness_data)


def resistant_starts(problem: Problem) -> FloatArray:
    """Return starts of which an outlier rules some, but not all: by other weights as well.

    A response far too large has no say where errors count relative to it, one far too small has
    none where all count alike.
    """
    view = problem.stiffness_data
    size = np.maximum(np.abs(view.stiffness), SMALLEST)
    views = (view, replace(view, weights=1.0 / size), replace(view, weights=np.ones(size.shape)))
    return np.vstack([_starts(problem, each) for each in views])


def _starts(problem: Problem, view: StiffnessData) -> FloatArray:
    grid = _grid(problem, view)
    cost, coefficients = grid.solved()
    places = _local_minima(cost.reshape(grid.shape))[:_MOST_STARTS]
    first = places[0]
    if grid.shape == cost.shape and first in (0, len(cost) - 1):
        nearer = _FINE_ENDS[0] if first == 0 else len(cost) - 1 - _FINE_ENDS[1]
        places = np.append(places, nearer)  # an optimum far out may be kept from there by bounds
    best = grid.theta(coefficients, places)
    if grid.shape == cost.shape and 0 < first < len(cost) - 1:
        around = first + _AROUND
        best[0] = _vertex(cost[around], grid.theta(coefficients, around))
    if all(p.value is None for p in problem.parameters):
        return best
    values = problem.to_values(best[0])
    given = [
        v if p.value is None else p.value for p, v in zip(problem.parameters, values, strict=True)
    ]
    extra = problem.to_search(given)
    return best if np.allclose(extra, best[0], rtol=1e-12) else np.vstack([best, extra])


def best_starts(problem: Problem) -> FloatArray:
    """Return the best start of each table of a batch, shape (S, P)."""
    grid = _grid(problem, problem.stiffness_data)
    cost, coefficients = grid.solved()
    best = cost.argmin(axis=-1)[:, None]
    nodes = cost.shape[-1]
    if grid.shape != (nodes,) or nodes < 3:
        return grid.theta(coefficients, best)[:, 0]
    around = np.clip(best, 1, nodes - 2) + _AROUND
    theta = grid.theta(coefficients, around)
    vertex = _vertex(np.take_along_axis(cost, around, axis=-1), theta)
    vertex = np.where(best == 0, theta[:, 0], vertex)
    return np.where(best == nodes - 1, theta[:, 2], vertex)


def grid_size(problem: Problem) -> int:
    """Return the number of nodes of the grid where starts are searched."""
    return len(_grid(problem, problem.stiffness_data).nodes)


def edge_starts(problem: Problem) -> list[FloatArray]:
    """Return the best nodes at both ends of each Dahl element's grid, each (P,) or (S, P).

    They are where searches for limits start.
    """
    grid = _grid(problem, problem.stiffness_data)
    cost, coefficients = grid.solved()
    found = []
    for index, count in enumerate(grid.shape):
        for edge in {0, count - 1}:
            there = np.where(grid.nodes[:, index] == edge, cost, np.inf)
            found.append(grid.theta(coefficients, there.argmin(axis=-1)[..., None])[..., 0, :])
    return found


def _vertex(cost: FloatArray, theta: FloatArray) -> FloatArray:
    """Return theta at the vertex of the parabola through three nodes, (..., 3) and (..., 3, P)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        left, middle, right = cost[..., 0], cost[..., 1], cost[..., 2]
        u = 0.5 * (left - right) / (left - 2.0 * middle + right)
    u = np.where(np.abs(u) <= 1.0, u, 0.0)[..., None]
    left, middle, right = theta[..., 0, :], theta[..., 1, :], theta[..., 2, :]
    return np.asarray(middle + 0.5 * u * (right - left + u * (right - 2.0 * middle + left)))


@dataclass(frozen=True)
class _Friction:
    """A Dahl element whose x_c or alpha is searched for; arrays have the grid's nodes first."""

    f_max: Parameter
    sigma: Parameter
    alpha: Parameter
    ln_x_c: FloatArray  # (..., K)
    ln_alpha: FloatArray  # (K,)
    curve: ComplexArray  # h at every row, (..., K, n)

    @property
    def is_linear(self) -> bool:
        """Whether sigma is to be solved for, or known at each node."""
        return bool(self.f_max.free and self.sigma.free)

    def known_sigma(self) -> FloatArray:
        """Return sigma at each node where f_max or sigma is given, (..., K)."""
        if not self.sigma.free:
            return np.full(self.ln_x_c.shape, self.sigma.value)
        assert self.f_max.value is not None
        return self.f_max.value * np.exp(-self.ln_x_c)


@dataclass(frozen=True)
class _Grid:
    """Linear least squares at every combination of the friction elements' nodes."""

    problem: Problem
    friction: list[_Friction]
    nodes: IntArray  # (C, friction elements)
    shape: tuple[int, ...]
    target: ComplexArray  # weighted, (..., n)
    weights: FloatArray  # (..., n)
    columns: dict[str, ComplexArray]  # of linear parameters, weighted, (..., n)

    def solved(self) -> tuple[FloatArray, FloatArray]:
        """Return the sum of squares, (..., C), and the linear parameters, (..., C, Q)."""
        if len(self.friction) == 1 and self.friction[0].is_linear and not self.columns:
            cost, coefficients = _solve_one(self.target, self.friction[0].curve, self.weights)
        else:
            cost, coefficients = _solve_linear(*self._system())
        friction = coefficients[..., len(self.columns) :]
        return np.where((friction > 0.0).all(axis=-1), cost, np.inf), coefficients

    def _system(self) -> tuple[FloatArray, list[FloatArray], list[FloatArray]]:
        """Return what is to be fitted, (..., C, 2 n), columns of every node, and of each."""
        target = self.target[..., None, :]
        columns = []
        for index, element in enumerate(self.friction):
            chosen = self.nodes[:, index]
            column = element.curve[..., chosen, :] * self.weights[..., None, :]
            if element.is_linear:
                columns.append(_parts(column))
            else:
                target = target - element.known_sigma()[..., chosen, None] * column
        shape = np.broadcast_shapes(target.shape, (len(self.nodes), 1))
        common = [_parts(np.broadcast_to(c, self.target.shape)) for c in self.columns.values()]
        return _parts(np.broadcast_to(target, shape)), common, columns

    def theta(self, coefficients: FloatArray, places: IntArray) -> FloatArray:
        """Return the search coordinates at some combinations of nodes, (..., k) -> (..., k, P)."""
        chosen = np.take_along_axis(coefficients, places[..., None], axis=-2)
        known = {name: chosen[..., i] for i, name in enumerate(self.columns)}
        used = len(known)
        for index, element in enumerate(self.friction):
            node = self.nodes[places, index]
            ln_x_c = _taken(element.ln_x_c, node)
            if element.is_linear:
                sigma = np.abs(chosen[..., used])
                used += 1
            else:
                sigma = _taken(element.known_sigma(), node)
            known[element.sigma.name] = sigma
            known[element.f_max.name] = sigma * np.exp(ln_x_c)
            known[element.alpha.name] = np.exp(element.ln_alpha[node])
        theta = np.empty((*places.shape, len(self.problem.parameters)))
        for index, parameter in enumerate(self.problem.parameters):
            value = known.get(parameter.name, parameter.value)
            assert value is not None
            if parameter.transform == "log":
                value = np.log(np.maximum(np.abs(value), 1e-300))
            theta[..., index] = value
        return theta


def _grid(problem: Problem, view: StiffnessData) -> _Grid:
    searched = [e for e in problem.model.elements if isinstance(e, Dahl) and _is_free(e.parameters)]
    each = _MOST_COMBINATIONS ** (1.0 / max(1, len(searched)))
    friction = [_nodes(element, view, each) for element in searched]
    counts = [element.curve.shape[-2] for element in friction]
    nodes = np.indices(counts).reshape(len(counts), int(np.prod(counts))).T
    rest = np.zeros(view.stiffness.shape, dtype=np.complex128)
    columns = {}
    for element in problem.model.elements:
        if isinstance(element, Dahl) and _is_free(element.parameters):
            continue
        if isinstance(element, _LINEAR) and element.parameters[0].free:
            column = view.of(element, [np.ones(())])
            columns[element.parameters[0].name] = column * view.weights
        else:
            _require_values(element.parameters)
            rest = rest + view.of(element, _start_values(element.parameters))
    return _Grid(
        problem,
        friction,
        nodes,
        tuple(counts),
        (view.stiffness - rest) * view.weights,
        view.weights,
        columns,
    )


def _nodes(element: Dahl, view: StiffnessData, most: float) -> _Friction:
    """Return the grid of one element, of at most `most` nodes."""
    f_max, sigma, alpha = element.parameters
    position = np.rint(np.log(view.amplitude) / _STEP).astype(np.intp)
    alphas = _ALPHAS if alpha.free else (float(_start_values((alpha,))[0]),)
    if f_max.free or sigma.free:
        low = position.min(axis=-1)
        span = int((position.max(axis=-1) - low).max())
        offsets = _offsets(span, max(6.0, most / len(alphas)))
    else:
        x_c = _start_values((f_max,))[0] / _start_values((sigma,))[0]
        low = np.rint(np.log(x_c) / _STEP).astype(np.intp)
        offsets = np.zeros(1, dtype=np.intp)
    ln_x_c = low[..., None] + offsets
    at = position[..., None, :] - (ln_x_c[..., None] + _LOWEST)
    curves = [_curve(a, view, at) for a in alphas]
    return _Friction(
        f_max,
        sigma,
        alpha,
        np.concatenate([ln_x_c] * len(alphas), axis=-1) * _STEP,
        np.repeat(np.log(alphas), offsets.size),
        curves[0] if len(curves) == 1 else np.concatenate(curves, axis=-2),
    )


@lru_cache(maxsize=256)
def _offsets(span: int, most: float) -> IntArray:
    """Return the nodes of ln x_c in steps above the smallest amplitude's."""
    decade = round(_DECADE)
    fine = max(_FINE, int(np.ceil((span + 4 * decade) / (0.7 * most))))
    below = np.arange(-8 * decade, -2 * decade, _COARSE)
    inner = np.arange(-2 * decade, span + 2 * decade + fine, fine)
    above = np.arange(inner[-1] + _COARSE, span + 6 * decade + 1, _COARSE)
    return np.concatenate([below, inner, above])


def _curve(alpha: float, view: StiffnessData, at: IntArray) -> ComplexArray:
    """Return h at places `at` of the table, row by row's harmonic."""
    if len(view.orders) == 1:
        return _table(alpha, view.orders[0]).take(at, mode="clip")
    curve = np.empty(at.shape, dtype=np.complex128)
    for k in view.orders:
        curve[..., view.harmonic == k] = _table(alpha, k).take(
            at[..., view.harmonic == k], mode="clip"
        )
    return curve


@lru_cache(maxsize=64)
def _table(alpha: float, harmonic: int) -> ComplexArray:
    """Return F_k/X_1 over sigma at ln beta = -32, -31.99, ..., 32."""
    beta = np.exp(_STEP * np.arange(_LOWEST, _LOWEST + _NODES + 1))
    one = np.ones(())
    return Dahl().stiffness((one, one, np.asarray(alpha)), beta, one, harmonic)


def _solve_one(
    target: ComplexArray, curve: ComplexArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what `_solve_linear` does for the one column curve times weights, (..., K, n)."""
    parts = curve.view(np.float64)
    power = curve.real**2 + curve.imag**2
    pulled = (target * weights).view(np.float64)
    size = (target.real**2 + target.imag**2).sum(axis=-1)[..., None]
    overlap = (parts @ pulled[..., None])[..., 0]
    norm = (power @ (weights**2)[..., None])[..., 0]
    coefficient = overlap / np.maximum(norm, 1e-300)
    return size - coefficient * overlap, coefficient[..., None]


def _solve_linear(
    target: FloatArray, common: list[FloatArray], own: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the least sum of squares of target - coefficients times columns, and those.

    Columns in `common`, (..., 2 n), are the same at every node; they are projected out first,
    because those in `own`, (..., C, 2 n), can be hard to tell from them.
    """
    Q, R = _factors(common, target)
    rest = _projected(target, Q)
    columns = (
        np.stack(np.broadcast_arrays(*own), axis=-2) if own else rest[..., None, :][..., :0, :]
    )
    left = _projected(columns, Q[..., None, :, :])
    norm = np.sqrt((left * left).sum(axis=-1))
    left = left / np.where(norm > 0.0, norm, 1.0)[..., None]
    gram = left @ left.swapaxes(-1, -2) + 1e-13 * np.eye(left.shape[-2])
    scaled = np.linalg.solve(gram, left @ rest[..., None])
    rest = rest - (scaled.swapaxes(-1, -2) @ left)[..., 0, :]
    coefficients = scaled[..., 0] / np.where(norm > 0.0, norm, np.inf)
    explained = target - (coefficients[..., None, :] @ columns)[..., 0, :]
    base = np.linalg.solve(R[..., None, :, :], (explained @ Q)[..., None])[..., 0]
    return (rest * rest).sum(axis=-1), np.concatenate([base, coefficients], axis=-1)


def _factors(common: list[FloatArray], target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Q, (..., 2 n, L), and R of the common columns; dependent ones get no part."""
    lead, m = target.shape[:-2], target.shape[-1]
    X = np.zeros((*lead, m, len(common)))
    for index, column in enumerate(common):
        X[..., index] = column
    size = np.sqrt((X * X).sum(axis=-2))
    size = np.where(size > 0.0, size, 1.0)
    Q, R = np.linalg.qr(X / size[..., None, :])
    diagonal = np.abs(np.diagonal(R, axis1=-2, axis2=-1))
    dependent = diagonal < _DEPENDENT
    R = R * size[..., None, :] + np.where(dependent, size, 0.0)[..., None, :] * np.eye(len(common))
    return np.where(dependent[..., None, :], 0.0, Q), R


def _projected(rows: FloatArray, Q: FloatArray) -> FloatArray:
    """Return rows, (..., C, 2 n), less their part in the span of Q; twice, for the last digits."""
    for _ in range(2):
        rows = rows - (rows @ Q) @ Q.swapaxes(-1, -2)
    return rows


def _parts(values: ComplexArray) -> FloatArray:
    """Return real and imaginary parts side by side in the last axis."""
    return np.ascontiguousarray(values).view(np.float64)


def _local_minima(cost: FloatArray) -> IntArray:
    """Return the flat indices of a grid's local minima, the lowest first."""
    lowest = cost < np.inf
    if not lowest.any():
        return np.zeros(1, dtype=np.intp)
    for axis in range(cost.ndim):
        rows, mask = cost.swapaxes(axis, 0), lowest.swapaxes(axis, 0)
        mask[1:] &= rows[1:] <= rows[:-1]
        mask[:-1] &= rows[:-1] < rows[1:]
    places = np.flatnonzero(lowest)
    return places[cost.ravel()[places].argsort()]


def _taken(values: FloatArray, node: IntArray) -> FloatArray:
    """Return values, (K,) or (S, K), at nodes, (k,) or (S, k)."""
    return values[node] if values.ndim == 1 else np.take_along_axis(values, node, axis=-1)


def _is_free(parameters: tuple[Parameter, ...]) -> bool:
    return any(p.free for p in parameters)


def _require_values(parameters: tuple[Parameter, ...]) -> None:
    missing = [p.name for p in parameters if p.value is None]
    if missing:
        raise FitError(
            f"{', '.join(missing)} has no value to start from, and only parameters of Dahl, Mass, "
            "Damper and Spring can be found without one; give it a value and name it in free="
        )


def _start_values(parameters: tuple[Parameter, ...]) -> list[FloatArray]:
    return [np.asarray(np.nan if p.value is None else p.value) for p in parameters]
