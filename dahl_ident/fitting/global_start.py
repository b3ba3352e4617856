r"""Starts of a search by variable projection, so that no initial values are needed.

The force of a friction law is proportional to some of its parameters, or to one factor on all of
them; a describing function, for instance, is linear in sigma once x_c = f_max/sigma and alpha are
given,

    N = sigma h_alpha(A / x_c),

and springs, dampers and masses are linear anyway. Least squares in dynamic stiffness, with
measured amplitudes and the weights of the noise model at the data, is therefore a search over the
remaining directions (:mod:`dahl_ident.fitting.directions`): at each node of a grid of those,
the linear parameters are solved exactly. The lowest local minima are the starts.

If there are too many combinations of nodes, a quasi-random selection of them is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import SMALLEST, ComplexArray, FloatArray, IntArray, interleaved
from dahl_ident.fitting.directions import (
    LARGEST_STIFFNESS,
    NodeCurves,
    curves_at_nodes,
    directions,
    needs_loops,
)
from dahl_ident.problem import TableProblem
from dahl_ident.problem.stiffness import StiffnessData

_FINE_ENDS = (6, 4)  # number of coarse nodes below the fine ones, and above
_DEPENDENT = 1e-12  # part of a column that others do not explain, below which it is rounding
_HIGHEST = 3  # highest harmonic in a start; more cost time for little information
_MOST_COMBINATIONS = 4000  # nodes of all elements together: a limit on memory and time
_MOST_ROWS = 20  # rows for which loops are integrated
_MOST_STARTS = 4  # searches of a table, each of which costs as much as the first
_HOPELESS = 100.0  # sum of squares over the lowest, above which a node is not a start
_ONE_START = 0.01  # relative difference of sums of squares within which nodes may be one start


class Starts(NamedTuple):
    """Starts of all tables: the number of each start's table, (M,), and theta, (M, P)."""

    table: IntArray
    theta: FloatArray

    def joined(self, other: Starts) -> Starts:
        """Return these starts and those of `other`."""
        return Starts(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def of(self, tables: IntArray) -> Starts:
        """Return the starts of some tables, in rising order, which are renumbered."""
        chosen = np.isin(self.table, tables)
        return Starts(np.searchsorted(tables, self.table[chosen]), self.theta[chosen])


def global_starts(problem: TableProblem, *, resistant: bool = False) -> Starts:
    """Return the best starts of every table of a problem, best first.

    Values that the user gave to free parameters make one more start, the last. `resistant` adds
    starts from two other kinds of weights, so that an outlier dominates only some of them: one that
    is far too large has little weight with errors relative to the response, one that is far too
    small with equal weights.
    """
    view = problem.stiffness_data
    starts = _starts(problem, view)
    if not resistant:
        return starts
    size = np.maximum(np.abs(view.stiffness), SMALLEST)
    for weights in (1.0 / size, np.ones(size.shape)):
        starts = starts.joined(_starts(problem, replace(view, weights=weights)))
    return starts


def _starts(problem: TableProblem, view: StiffnessData) -> Starts:
    grid = _grid(problem, view)
    cost, coefficients = grid.solved()
    S = problem.n_tables
    table, node = _local_minima(cost.reshape(S, *grid.shape), mixed=grid.mixed)
    last = cost.shape[-1] - 1
    if grid.shape == (last + 1,) and last >= sum(_FINE_ENDS):
        first = np.searchsorted(table, np.arange(S))
        for edge, nearer in ((0, _FINE_ENDS[0]), (last, last - _FINE_ENDS[1])):
            at_edge = table[first[node[first] == edge]]  # a bound may keep a search far out
            table, node = np.append(table, at_edge), np.append(node, np.full(at_edge.size, nearer))
        order = np.argsort(table, kind="stable")
        table, node = table[order], node[order]
    if cost.ndim > 1:
        theta = grid.of_tables(table).theta(coefficients[table], node[:, None])[:, 0]
    else:
        theta = grid.theta(coefficients, node)
    starts = Starts(table, theta)
    if all(p.value is None for p in problem.parameters):
        return starts
    best = theta[np.searchsorted(table, np.arange(S))]
    values = problem.to_values(best)
    for index, parameter in enumerate(problem.parameters):
        if parameter.value is not None:
            values[:, index] = parameter.value
    stated = problem.to_search(values)
    new = ~np.isclose(stated, best, rtol=1e-12).all(axis=1)
    starts = starts.joined(Starts(np.flatnonzero(new), stated[new]))
    order = np.argsort(starts.table, kind="stable")
    return Starts(starts.table[order], starts.theta[order])


def grid_size(problem: TableProblem) -> int:
    """Return the number of nodes of the grid from which starts are chosen."""
    return len(_grid(problem, problem.stiffness_data).nodes)


def edge_starts(problem: TableProblem) -> list[FloatArray]:
    """Return the best nodes at both ends of each direction's grid, each (P,) or (S, P).

    Searches for limits start at them.
    """
    grid = _grid(problem, problem.stiffness_data)
    cost, coefficients = grid.solved()
    edges = []
    for index, curves in enumerate(grid.curves):
        for edge in curves.edges:
            edge_cost = np.where(edge[grid.nodes[:, index]], cost, np.inf)
            edges.append(grid.theta(coefficients, edge_cost.argmin(axis=-1)[..., None])[..., 0, :])
    return edges


@dataclass(frozen=True)
class _Grid:
    """Linear least squares at every combination of the elements' nodes."""

    problem: TableProblem
    curves: list[NodeCurves]
    nodes: IntArray  # (C, elements)
    shape: tuple[int, ...]
    target: ComplexArray  # weighted, (..., 1, n)
    weights: FloatArray  # (..., 1, n)
    mixed: bool  # nodes of several directions are in one axis, so neighbours need not be near

    def solved(self) -> tuple[FloatArray, FloatArray]:
        """Return the sum of squares, (..., C), and the linear coefficients, (..., C, Q).

        A column that may vanish is left out where its coefficient would be negative.
        """
        target, columns, signs = self.target, list[FloatArray](), []
        for index, curves in enumerate(self.curves):
            chosen = self.nodes[:, index] if curves.values else slice(None)
            if curves.known is not None:
                target = target - curves.known[..., chosen, :] * self.weights
            for part in curves.columns:
                columns.append(interleaved(part.curve[..., chosen, :] * self.weights))
                signs.append((bool(curves.values) and part.is_positive, part.may_vanish))
        positive, may_vanish = np.array(signs, dtype=np.bool_).reshape(-1, 2).T
        shape = np.broadcast_shapes(target.shape, (len(self.nodes), 1))
        parts = interleaved(np.broadcast_to(target, shape))
        while True:
            cost, coefficients = _solve_linear(parts, columns)
            negative = (coefficients < 0.0) & positive & may_vanish
            if not negative.any():
                break
            columns = [
                np.where(negative[..., [i]], 0.0, column) for i, column in enumerate(columns)
            ]
        allowed = ((coefficients > 0.0) | ~positive | may_vanish).all(axis=-1)
        return np.where(allowed, cost, np.inf), coefficients

    def of_tables(self, tables: IntArray) -> _Grid:
        """Return the grid of some tables of a batch, for use of `theta` only."""
        return replace(
            self,
            curves=[
                replace(c, values={k: v[tables] if v.ndim > 1 else v for k, v in c.values.items()})
                for c in self.curves
            ],
        )

    def theta(self, coefficients: FloatArray, combinations: IntArray) -> FloatArray:
        """Return the search coordinates at some combinations of nodes, (..., k) -> (..., k, P)."""
        if coefficients.ndim == 2:
            chosen = coefficients[combinations]
        else:
            chosen = np.take_along_axis(coefficients, combinations[..., None], axis=-2)
        by_name: dict[str, FloatArray] = {}
        each = iter(np.moveaxis(chosen, -1, 0))
        for index, curves in enumerate(self.curves):
            node = self.nodes[combinations, index]
            by_name.update({name: _taken(v, node) for name, v in curves.values.items()})
            for column, coefficient in zip(curves.columns, each, strict=False):
                size = np.abs(coefficient) if column.is_positive else coefficient
                for p in column.parameters:
                    by_name[p.name] = by_name.get(p.name, np.ones(())) * size
        theta = np.empty((*combinations.shape, len(self.problem.parameters)))
        for index, parameter in enumerate(self.problem.parameters):
            value = by_name.get(parameter.name, parameter.value)
            assert value is not None
            if parameter.positive:
                value = np.log(np.maximum(np.abs(value), 1e-300))
            theta[..., index] = value
        return theta


def _grid(problem: TableProblem, view: StiffnessData) -> _Grid:
    elements = sorted(map(directions, problem.model.elements), key=lambda d: bool(d.nonlinear))
    searched = [d for d in elements if d.nonlinear]
    rows = np.flatnonzero(view.harmonic <= _HIGHEST)
    rows = rows if rows.size else np.arange(view.harmonic.size)
    if any(needs_loops(d) for d in searched) and rows.size > _MOST_ROWS:
        first = view.harmonic[rows] == 1
        rows = rows[first] if first.any() else rows
        amplitude = view.amplitude.reshape(-1, view.harmonic.size)[0]
        order = np.lexsort((amplitude[rows], view.omega[rows]))
        chosen = np.linspace(0, rows.size - 1, min(rows.size, _MOST_ROWS)).round().astype(int)
        rows = np.sort(rows[order[chosen]])
    if rows.size < view.harmonic.size:
        view = view.of_rows(rows)
    most = _MOST_COMBINATIONS ** (1.0 / max(1, len(searched)))
    curves = [curves_at_nodes(d, view, most) for d in elements]
    counts = [c.count for c in curves]
    return _Grid(
        problem,
        curves,
        np.indices(counts).reshape(len(counts), math.prod(counts)).T,
        tuple(counts[len(counts) - len(searched) :]),
        (view.stiffness * view.weights)[..., None, :],
        view.weights[..., None, :],
        any(len(d.nonlinear) > 1 for d in searched),
    )


def _solve_linear(target: FloatArray, columns: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return the least sum of squares of target - coefficients times columns, and the coefficients.

    By Gram-Schmidt's method, twice for accuracy, because columns can be nearly dependent.
    """
    # nodes at which a hardening law overflows are not starts
    usable = [
        (np.abs(column) < LARGEST_STIFFNESS).all(axis=-1, keepdims=True) for column in columns
    ]
    columns = [np.where(u, c, 0.0) for u, c in zip(usable, columns, strict=True)]
    basis, norms, residual = list[FloatArray](), list[FloatArray](), target
    for column in columns:
        unit = column
        for direction in 2 * basis:
            unit = unit - _product(unit, direction) * direction
        norm, size = (np.sqrt(_product(v, v)) for v in (unit, column))
        norms.append(np.where(norm > _DEPENDENT * size, norm, np.inf))
        basis.append(unit / norms[-1])
        residual = residual - _product(residual, basis[-1]) * basis[-1]
    coefficients, explained = np.empty((*residual.shape[:-1], len(columns))), target
    for i, column in reversed(list(enumerate(columns))):
        each = _product(explained, basis[i]) / norms[i]
        coefficients[..., i] = each[..., 0]
        explained = explained - each * column
    cost = _product(residual, residual)
    for is_usable in usable:
        cost = np.where(is_usable, cost, np.inf)
    return cost[..., 0], coefficients


def _product(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("...i,...i->...", first, second)[..., None])


def _local_minima(cost: FloatArray, *, mixed: bool) -> tuple[IntArray, IntArray]:
    """Return each table's lowest local minima over its grid, (S, ...): table and flat index.

    The lowest of a table comes first; a table without any has its first node. If nodes are `mixed`,
    minima of nearly the same cost count as one as long as others remain, because a parameter may
    have no effect there.
    """
    S = len(cost)
    lowest = cost < np.inf
    for axis in range(1, cost.ndim):
        rows, mask = cost.swapaxes(axis, 0), lowest.swapaxes(axis, 0)
        mask[1:] &= rows[1:] <= rows[:-1]
        mask[:-1] &= rows[:-1] < rows[1:]
    flat, lowest = cost.reshape(S, -1), lowest.reshape(S, -1)
    lowest[~lowest.any(axis=1), 0] = True
    table, node = np.nonzero(lowest)
    if table.size == S:
        return table, node
    order = np.lexsort((flat[table, node], table))
    table, node = table[order], node[order]
    if mixed:
        costs, alike = flat[table, node], np.zeros(table.size, dtype=np.bool_)
        alike[1:] = (np.diff(table) == 0) & (costs[1:] <= (1.0 + _ONE_START) * costs[:-1])
        alike &= (np.bincount(table[~alike], minlength=S) > 1)[table]
        table, node = table[~alike], node[~alike]
    first = np.searchsorted(table, table)
    rank = np.arange(table.size) - first
    costs = flat[table, node]
    good = (rank == 0) | ((rank < _MOST_STARTS) & (costs <= _HOPELESS * costs[first]))
    return table[good], node[good]


def _taken(values: FloatArray, node: IntArray) -> FloatArray:
    """Return values, (K,) or (S, K), at nodes, (k,) or (S, k)."""
    return values[node] if values.ndim == 1 else np.take_along_axis(values, node, axis=-1)
