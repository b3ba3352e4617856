r"""Starts of a search by variable projection, so that no initial values are needed.

The force of a friction law is proportional to some of its parameters, or to one factor on all of
them; a describing function, for instance, is linear in sigma once x_c = f_max/sigma and alpha are
given,

    N = sigma h_alpha(A / x_c),

and springs, dampers and masses are linear anyway. Least squares in dynamic stiffness, with
measured amplitudes and the weights of the noise model at the data, is therefore a search over the
remaining directions (:mod:`dahl_ident.fitting.directions`): at each node of a grid of those,
the linear parameters are solved exactly. The lowest local minima are the starts.

A length has four nodes a decade from a hundredth of the smallest amplitude to a hundred times the
largest, and one a decade beyond, down to 1e-8 and up to 1e6 times. Farther out the curve agrees
with its limit to well below any noise; :mod:`dahl_ident.fitting.asymptotes` decides whether the
optimum lies at infinity. A pure number takes the values that its law declares. If there are too
many combinations of nodes, a quasi-random selection of them is used.

If lengths scale the curve of a rate-independent law, the curve is read from tables over
ln(A/length) whose steps divide those of the grid. Several lengths are multiples of the shortest.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import SMALLEST, BoolArray, ComplexArray, FloatArray, IntArray, interleaved
from dahl_ident.elements import Element, Friction, Parameter
from dahl_ident.elements.held_motion import form_of
from dahl_ident.errors import FitError, argument
from dahl_ident.fitting.directions import Direction, Directions, directions, is_positive
from dahl_ident.problem import TableProblem
from dahl_ident.problem.stiffness import StiffnessData

_LOG_STEP = 0.01  # of ln(A/length) in a table, which is read at the nearest step
_LOWEST, _NODES = -3200, 6400  # first step and number of steps of a table: 14 decades either way
_DECADE = np.log(10.0) / _LOG_STEP  # steps in a decade
# steps between nodes of the grid: four a decade near the data, one a decade farther out
_FINE, _COARSE = 58, 230
_FINE_ENDS = (6, 4)  # number of coarse nodes below the fine ones, and above
_COMPUTED = 10  # steps of a table between computed values, which are interpolated
_AROUND_KNEE = 1e3  # ratio to the knee beyond which a curve is a power law
# values tried for a number whose law declares none, by its transform
_START_NUMBERS = {"log": (0.25, 0.5, 1.0, 2.0, 4.0), "linear": (-1.0, -0.5, 0.0, 0.5, 1.0)}
_LARGEST_STIFFNESS = 1e150  # weighted stiffness whose square is still a number
_DEPENDENT = 1e-12  # part of a column that others do not explain, below which it is rounding
_MULTIPLES = (1.0, 2.5, 10.0, 100.0)  # several lengths are tried at these times the shortest one
_MOST_TABLES = 64  # tables kept: 6 MB a harmonic in all, and some seconds to compute
_LEAST_AMPLITUDES = 4  # amplitudes of a table, for cubic interpolation
_AMPLITUDES_AT_ONCE = 20  # amplitudes computed in one call, until the law overflows
_HIGHEST = 3  # highest harmonic in a start; more cost time for little information
_MOST_COMBINATIONS = 4000  # nodes of all elements together: a limit on memory and time
_MOST_OF_ONE = 1000  # nodes of one element whose curves are computed node by node
_MOST_LOOPS = 10_000  # loops integrated for a rate-dependent law: a second or two
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
class _LinearPart:
    """A linear coefficient of an element: the parameters that it multiplies, and its curve."""

    parameters: tuple[Parameter, ...]
    curve: ComplexArray  # at every row, (..., K, n)

    @property
    def is_positive(self) -> bool:
        return any(is_positive(p) for p in self.parameters)

    @property
    def may_vanish(self) -> bool:
        return not any(p.positive for p in self.parameters)


@dataclass(frozen=True)
class _Curves:
    """One element at the K nodes of its grid."""

    values: dict[str, FloatArray]
    """Nonlinear parameters, (K,) or (S, K), and 1 for those that a column multiplies."""
    columns: list[_LinearPart]
    known: ComplexArray | None
    """Part that does not depend on a coefficient, (..., K, n)."""
    edges: list[BoolArray]
    """Nodes at either end of each direction, (K,)."""


@dataclass(frozen=True)
class _Grid:
    """Linear least squares at every combination of the elements' nodes."""

    problem: TableProblem
    curves: list[_Curves]
    nodes: IntArray  # (C, elements with more than one node)
    shape: tuple[int, ...]
    target: ComplexArray  # weighted, (..., n)
    weights: FloatArray  # (..., n)
    common: list[_LinearPart]  # the same at every node, curves of shape (..., n)
    mixed: bool  # nodes of several directions are in one axis, so neighbours need not be near

    def solved(self) -> tuple[FloatArray, FloatArray]:
        """Return the sum of squares, (..., C), and the linear coefficients, (..., C, Q).

        A column that may vanish is left out where its coefficient would be negative.
        """
        target, common, columns = self._system()
        parts = [column for curves in self.curves for column in curves.columns]
        positive = np.array([p.is_positive for p in parts], dtype=np.bool_)
        may_vanish = np.array([p.may_vanish for p in parts], dtype=np.bool_)
        while True:
            cost, coefficients = _solve_linear(target, common, columns)
            separate = coefficients[..., len(common) :]
            negative = (separate < 0.0) & positive & may_vanish
            if not negative.any():
                break
            columns = [
                np.where(negative[..., [i]], 0.0, column) for i, column in enumerate(columns)
            ]
        allowed = ((separate > 0.0) | ~positive | may_vanish).all(axis=-1)
        return np.where(allowed, cost, np.inf), coefficients

    def _system(self) -> tuple[FloatArray, list[FloatArray], list[FloatArray]]:
        """Return the target, (..., C, 2 n), the common columns, and those of each node."""
        target = self.target[..., None, :]
        columns = []
        for index, curves in enumerate(self.curves):
            chosen = self.nodes[:, index]
            columns += [
                interleaved(column.curve[..., chosen, :] * self.weights[..., None, :])
                for column in curves.columns
            ]
            if curves.known is not None:
                target = target - curves.known[..., chosen, :] * self.weights[..., None, :]
        shape = np.broadcast_shapes(target.shape, (len(self.nodes), 1))
        common = [
            interleaved(np.broadcast_to(c.curve * self.weights, self.target.shape))
            for c in self.common
        ]
        return interleaved(np.broadcast_to(target, shape)), common, columns

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
        used = 0
        for column in self.common:
            _scaled(by_name, column, chosen[..., used])
            used += 1
        for index, curves in enumerate(self.curves):
            node = self.nodes[combinations, index]
            by_name.update({name: _taken(v, node) for name, v in curves.values.items()})
            for column in curves.columns:
                _scaled(by_name, column, chosen[..., used])
                used += 1
        theta = np.empty((*combinations.shape, len(self.problem.parameters)))
        for index, parameter in enumerate(self.problem.parameters):
            value = by_name.get(parameter.name, parameter.value)
            assert value is not None
            if parameter.positive:
                value = np.log(np.maximum(np.abs(value), 1e-300))
            theta[..., index] = value
        return theta


def _scaled(values: dict[str, FloatArray], column: _LinearPart, coefficient: FloatArray) -> None:
    size = np.abs(coefficient) if column.is_positive else coefficient
    for p in column.parameters:
        values[p.name] = values.get(p.name, np.ones(())) * size


def _grid(problem: TableProblem, view: StiffnessData) -> _Grid:
    elements = [directions(e) for e in problem.model.elements]
    searched = [d for d in elements if d.nonlinear]
    rows = np.flatnonzero(view.harmonic <= _HIGHEST)
    rows = rows if rows.size else np.arange(view.harmonic.size)
    if any(_needs_loops(d) for d in searched) and rows.size > _MOST_ROWS:
        first = view.harmonic[rows] == 1
        rows = rows[first] if first.any() else rows
        amplitude = view.amplitude.reshape(-1, view.harmonic.size)[0]
        order = np.lexsort((amplitude[rows], view.omega[rows]))
        chosen = np.linspace(0, rows.size - 1, min(rows.size, _MOST_ROWS)).round().astype(int)
        rows = np.sort(rows[order[chosen]])
    if rows.size < view.harmonic.size:
        view = view.of_rows(rows)
    most = _MOST_COMBINATIONS ** (1.0 / max(1, len(searched)))
    curves = [_curves(d, view, most) for d in searched]
    counts = [next(iter(c.values.values())).shape[-1] for c in curves]
    nodes = np.indices(counts).reshape(len(counts), math.prod(counts)).T
    fixed = np.zeros(view.stiffness.shape, dtype=np.complex128)
    common: list[_LinearPart] = []
    for d in elements:
        if d.nonlinear:
            continue
        known, columns = _columns(d, {}, view)
        fixed = fixed + (0.0 if known is None else known)
        common += columns
    return _Grid(
        problem,
        curves,
        nodes,
        tuple(counts),
        (view.stiffness - fixed) * view.weights,
        view.weights,
        common,
        any(len(d.nonlinear) > 1 for d in searched),
    )


def _needs_loops(d: Directions) -> bool:
    """Return whether a loop has to be integrated for every node and row."""
    law = type(d.element)
    return not d.lengths and not law.rate_independent and law.settled is Friction.settled


def _columns(
    d: Directions, values: dict[str, FloatArray], view: StiffnessData
) -> tuple[ComplexArray | None, list[_LinearPart]]:
    """Return the known part of an element's stiffness, and a column for each coefficient.

    `values` are those of the directions, each (..., K).
    """
    element = d.element
    linear = [p for p in map(element.parameter, element.linear_parameters) if p.free or p.value]
    scaled = d.scale if d.is_free else ()
    missing = [
        p.name
        for p in element.parameters
        if p.value is None and p.name not in values and p not in linear and p not in scaled
    ]
    if missing:
        raise FitError(
            f"{', '.join(missing)} has no value to start from, and {element!r} does not say how "
            f"its force depends on it; give it a value and name it in {argument('free')}"
        )

    def stiffness_at(unit: Parameter | None, scale: float, size: float = 1.0) -> ComplexArray:
        numbers = []
        for p in element.parameters:
            value: FloatArray | float
            if p.name in values:
                value = values[p.name]
            elif p in linear:
                value = size * (p is unit)
            elif p in scaled:
                value = scale
            else:
                value = float("nan") if p.value is None else p.value
            numbers.append(np.asarray(value, dtype=np.float64))
        with np.errstate(all="ignore"):  # a law may overflow far out, where it is not a start
            return view.stiffness_of(element, numbers, at_nodes=bool(values))

    columns = []
    known = np.zeros((), dtype=np.complex128)
    scales = [element.parameter(label) for label in element.scale_parameters]
    if linear and all(p in linear for p in element.parameters):  # a linear element
        curves = [stiffness_at(p, 0.0) for p in linear]
    elif scales and all(p in linear for p in scales):
        curves = [stiffness_at(p, 1.0) for p in linear]
    else:
        base = stiffness_at(None, 1.0)
        if scaled:
            columns.append(_LinearPart(scaled, base))
        else:
            known = base
        over = d.reference if scaled else None
        # by differences about as large as the base, whose errors they have
        sizes = [float(np.exp(Direction.of(p, over).sizes(view).min())) for p in linear]
        curves = [
            (stiffness_at(p, 1.0, size) - base) / size
            for p, size in zip(linear, sizes, strict=True)
        ]
    for p, curve in zip(linear, curves, strict=True):
        if p.free:
            columns.append(_LinearPart((p,), curve))
        else:
            known = known + (p.value or 0.0) * curve
    return (known if np.any(known) else None), columns


def _curves(d: Directions, view: StiffnessData, most: float) -> _Curves:
    """Return an element at the nodes of its grid, of which there are at most about `most`."""
    if d.lengths:
        return _tabulated_curves(d, view, most)
    most = min(most, _MOST_OF_ONE)
    if _needs_loops(d):
        most = min(most, _MOST_LOOPS / view.harmonic.size)
    lengths = [x for x in d.nonlinear if not x.is_number]
    numbers = [_numbers(x) for x in d.nonlinear if x.is_number]
    combined = float(np.prod([n.size for n in numbers])) if numbers else 1.0
    per_length = max(12.0, (most / combined) ** (1.0 / max(1, len(lengths))))
    axes = [_axis(x, view, per_length) for x in lengths] + [n[None] for n in numbers]
    ordered = lengths + [x for x in d.nonlinear if x.is_number]
    counts = [a.shape[-1] for a in axes]
    if np.prod(counts) <= 2.0 * most:
        index = np.indices(counts).reshape(len(counts), -1)
    else:
        index = _quasi_random(tuple(counts), int(most))
    lead = view.amplitude.shape[:-1]
    index = index[:, _possible(d, ordered, [a.reshape(-1, a.shape[-1])[0] for a in axes], index)]
    # numbers are the same for all tables
    ratios = [
        a[..., i] if lead and not x.is_number else a.reshape(-1)[i]
        for x, a, i in zip(ordered, axes, index, strict=True)
    ]
    values: dict[str, FloatArray] = {}
    for direction, ratio in zip(ordered, ratios, strict=True):
        over = direction.over
        known = 1.0 if over is None or over.free or over.value is None else over.value
        values[direction.parameter.name] = np.asarray(ratio * known)
    known_part, columns = _columns(d, values, view)
    if d.is_free and d.reference is not None:
        values[d.reference.name] = np.ones(index.shape[1])
    edges = [i == end for i, n in zip(index, counts, strict=True) if n > 1 for end in (0, n - 1)]
    return _Curves(values, columns, known_part, edges[: 2 * len(lengths)])


def _possible(
    d: Directions, ordered: list[Direction], axes: list[FloatArray], index: IntArray
) -> BoolArray:
    """Return the nodes where an element is physically possible, or all if it is nowhere."""
    names = [x.parameter.name for x in ordered]
    possible = []
    for node in index.T:
        by_name = {name: float(a[i]) for name, a, i in zip(names, axes, node, strict=True)}
        numbers = [
            by_name.get(p.name, 1.0 if p.value is None else p.value) for p in d.element.parameters
        ]
        possible.append(not d.element.physical_objections(numbers))
    return np.asarray(possible) if any(possible) else np.ones(len(possible), dtype=np.bool_)


def _numbers(direction: Direction) -> FloatArray:
    """Return the values of a pure number that are nodes."""
    p = direction.parameter
    values = np.array(p.scan or _START_NUMBERS[p.transform])
    if not p.scan and np.isfinite([p.lower, p.upper]).all() and not p.positive:
        values = p.lower + (p.upper - p.lower) * np.linspace(0.1, 0.9, 5)
    inside = values[(values >= p.lower) & (values <= p.upper)]
    return np.asarray(inside if inside.size else np.clip(values[:1], p.lower, p.upper))


def _axis(direction: Direction, view: StiffnessData, most: float) -> FloatArray:
    """Return the values of a direction with a unit that are nodes, (..., K)."""
    position = np.rint(direction.sizes(view) / _LOG_STEP).astype(np.intp)
    low = position.min(axis=-1)
    span = int((position.max(axis=-1) - low).max())
    signed = not is_positive(direction.parameter)
    offsets = _offsets(span, max(6.0, most / (2.0 if signed else 1.0)))
    values = np.exp((low[..., None] + offsets) * _LOG_STEP)
    if signed:
        values = np.concatenate([-values[..., ::-1], values], axis=-1)
    return np.asarray(values)


@lru_cache(maxsize=16)
def _quasi_random(counts: tuple[int, ...], most: int) -> IntArray:
    """Return `most` combinations of nodes, spread evenly, (directions, most)."""
    from scipy.stats import qmc

    points = qmc.Sobol(len(counts), scramble=False).random_base2(int(np.log2(most)))
    return np.asarray((points * np.array(counts)).astype(np.intp).T)


@lru_cache(maxsize=256)
def _offsets(span: int, most: float) -> IntArray:
    """Return the nodes of the logarithm of a direction in steps above the smallest size."""
    decade = round(_DECADE)
    fine = max(_FINE, int(np.ceil((span + 4 * decade) / (0.7 * most))))
    below = np.arange(-8 * decade, -2 * decade, _COARSE)
    inner = np.arange(-2 * decade, span + 2 * decade + fine, fine)
    above = np.arange(inner[-1] + _COARSE, span + 6 * decade + 1, _COARSE)
    return np.concatenate([below, inner, above])


def _tabulated_curves(d: Directions, view: StiffnessData, most: float) -> _Curves:
    """Return an element whose curve is scaled by lengths, from tables over ln(A/length).

    Lengths are multiples of the shortest.
    """
    numbers = [x for x in d.nonlinear if x.is_number]
    ordered = [*d.lengths, *numbers]
    multiples = np.array(_MULTIPLES if len(d.lengths) > 1 else (1.0,))
    axes = [_powers(x, multiples) for x in d.lengths] + [_numbers(x) for x in numbers]
    counts = [a.size for a in axes]
    index = np.indices(counts).reshape(len(counts), -1)
    shortest = [index[i] % multiples.size == 0 for i in range(len(d.lengths))]
    index = index[:, np.any(shortest, axis=0)]
    index = index[:, _possible(d, ordered, axes, index)]
    allowed = max(2, int(min(_MOST_TABLES, most / 6.0)))
    if index.shape[1] > allowed:
        chosen = np.random.default_rng(1).choice(index.shape[1], allowed, replace=False)
        index = index[:, np.sort(chosen)]
    combinations = np.array([a[i] for a, i in zip(axes, index, strict=True)]).T
    position = np.rint(np.log(view.amplitude) / _LOG_STEP).astype(np.intp)
    low = position.min(axis=-1)
    span = int((position.max(axis=-1) - low).max())
    offsets = _offsets(span, max(6.0, most / len(combinations)))
    ln_length = low[..., None] + offsets
    at = position[..., None, :] - (ln_length[..., None] + _LOWEST)
    at = np.clip(at, 0, _NODES)
    order = np.searchsorted(view.orders, view.harmonic)
    curve = np.concatenate(
        [_table(d, ordered, tuple(c.tolist()), view.orders)[order, at] for c in combinations],
        axis=-2,
    )
    K = len(combinations)
    ln_lengths = np.concatenate([ln_length] * K, axis=-1) * _LOG_STEP
    values = {}
    for column, direction in enumerate(ordered):
        unit = np.repeat(combinations[:, column], offsets.size)
        power = direction.dimension[1]
        values[direction.parameter.name] = unit * np.exp(ln_lengths * power) if power else unit
    assert d.reference is not None
    values[d.reference.name] = np.ones(K * offsets.size)
    node = np.arange(K * offsets.size) % offsets.size
    edges = [node == 0, node == offsets.size - 1]
    if len(d.lengths) > 1:
        longest = index[: len(d.lengths)] % multiples.size == multiples.size - 1
        edges += [np.repeat(far, offsets.size) for far in longest]
    # the curve at unit length is that of a reference of 1, whatever its dimension
    shift = d.reference.dimension[1] + 1
    if shift:
        curve = curve / np.exp(ln_lengths[..., None] * shift)
    return _Curves(values, [_LinearPart(d.scale, curve)], None, [e for e in edges if e.any()])


def _powers(direction: Direction, multiples: FloatArray) -> FloatArray:
    """Return a power of a length at multiples of unit length, of both signs if allowed."""
    values = multiples ** direction.dimension[1]
    return values if is_positive(direction.parameter) else np.concatenate([values, -values])


_TABLES: dict[Hashable, ComplexArray] = {}


def _table(
    d: Directions, ordered: list[Direction], unit_values: tuple[float, ...], orders: tuple[int, ...]
) -> ComplexArray:
    """Return F_k/X_1 over unit scale at ln(A/length) = -32, -31.99, ..., 32, (orders, n).

    `unit_values` are those of the directions at unit length.
    """
    element = d.element
    at_unit = dict(zip((x.parameter.name for x in ordered), unit_values, strict=True))
    values = [
        np.asarray(at_unit.get(p.name, 1.0 if p.free or p.value is None else p.value), np.float64)
        for p in element.parameters
    ]
    key = (form_of(element), tuple(float(v) for v in values), orders)
    if key not in _TABLES:
        if len(_TABLES) >= _MOST_TABLES:
            _TABLES.clear()
        _TABLES[key] = _computed_table(element, values, np.array(orders))
    return _TABLES[key]


def _computed_table(
    element: Element, values: list[FloatArray], orders: NDArray[np.int64]
) -> ComplexArray:
    """Return the table, computed around the knee and extended by power laws.

    It is NaN beyond the last amplitude at which the law has a loop.
    """
    low, high = (float(np.asarray(v)) for v in element.knee(values))
    if not 0.0 < low <= high < np.inf:
        low = high = 1.0
    first = int(np.log(low / _AROUND_KNEE) / _LOG_STEP) // _COMPUTED * _COMPUTED
    last = int(np.log(high * _AROUND_KNEE) / _LOG_STEP)
    coarse = np.arange(max(first, _LOWEST), min(last, _LOWEST + _NODES) + 1, _COMPUTED)
    x = coarse * _LOG_STEP
    parts = []
    for part in np.array_split(x, max(1, x.size // _AMPLITUDES_AT_ONCE)):
        with np.errstate(all="ignore"):
            parts.append(
                element.stiffness(
                    values,
                    np.tile(np.exp(part), orders.size),
                    np.ones(()),
                    np.repeat(orders, part.size),
                ).reshape(orders.size, -1)
            )
        if not (np.abs(parts[-1]) < _LARGEST_STIFFNESS).all():
            break
    Z = np.concatenate(parts, axis=1)
    fine = np.arange(_LOWEST, _LOWEST + _NODES + 1) * _LOG_STEP
    usable = (np.abs(Z) < _LARGEST_STIFFNESS).all(axis=0)
    count = usable.size if usable.all() else int(usable.argmin())
    if count < _LEAST_AMPLITUDES:
        return np.full((orders.size, fine.size), np.nan, dtype=np.complex128)
    x, Z, is_cut = x[:count], Z[:, :count], count < x.size
    table = _interpolated(Z, (np.clip(fine, x[0], x[-1]) - x[0]) / (_COMPUTED * _LOG_STEP))
    for end, near, side in ((0, 1, fine < x[0]), (-1, -2, fine > x[-1])):
        for extended, Y in ((table.real, Z.real), (table.imag, Z.imag)):
            with np.errstate(divide="ignore", invalid="ignore"):
                slope = np.log(Y[:, end] / Y[:, near]) / (x[end] - x[near])
            slope = np.clip(np.where(np.isfinite(slope), slope, 0.0), -3.0, 3.0)[:, None]
            extended[:, side] = Y[:, [end]] * np.exp(slope * (fine[side] - x[end]))
    if is_cut:
        table[:, fine > x[-1]] = np.nan
    return table


def _interpolated(Z: ComplexArray, position: FloatArray) -> ComplexArray:
    """Return columns of (K, n) at positions from 0 to n - 1, by cubics through the four nearest.

    Splines of scipy take longer to import than a small fit takes.
    """
    first = np.clip(position.astype(np.intp) - 1, 0, Z.shape[1] - 4)
    u = position - first
    weights = (
        (u - 1) * (u - 2) * (3 - u) / 6,
        u * (u - 2) * (u - 3) / 2,
        u * (u - 1) * (3 - u) / 2,
        u * (u - 1) * (u - 2) / 6,
    )
    return np.asarray(sum(Z[:, first + i] * w for i, w in enumerate(weights)))


def _solve_linear(
    target: FloatArray, common: list[FloatArray], separate: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the least sum of squares of target - coefficients times columns, and the coefficients.

    Columns in `common`, (..., 2 n), are the same at every node; they are projected out first,
    because those in `separate`, (..., C, 2 n), can be nearly dependent on them.
    """
    Q, R = _factors(common, target)
    residual = _projected(target, Q)
    columns = (
        np.stack(np.broadcast_arrays(*separate), axis=-2)
        if separate
        else residual[..., None, :][..., :0, :]
    )
    # nodes at which a hardening law overflows are not starts
    usable = np.asarray((np.abs(columns) < _LARGEST_STIFFNESS).all(axis=(-2, -1)))
    if not usable.all():
        columns = np.where(usable[..., None, None], columns, 0.0)
    remaining = _projected(columns, Q[..., None, :, :])
    norm = _lengths(remaining)
    if common:
        norm[norm < _DEPENDENT * _lengths(columns)] = 0.0
    unit = remaining / np.where(norm > 0.0, norm, np.inf)[..., None]
    gram = unit @ unit.swapaxes(-1, -2) + 1e-13 * np.eye(unit.shape[-2])
    scaled = np.linalg.solve(gram, unit @ residual[..., None])
    residual = residual - (scaled.swapaxes(-1, -2) @ unit)[..., 0, :]
    coefficients = scaled[..., 0] / np.where(norm > 0.0, norm, np.inf)
    cost = np.where(usable, np.einsum("...i,...i->...", residual, residual), np.inf)
    if not common:
        return cost, coefficients
    explained = target - (coefficients[..., None, :] @ columns)[..., 0, :]
    base = np.linalg.solve(R[..., None, :, :], (explained @ Q)[..., None])[..., 0]
    return cost, np.concatenate([base, coefficients], axis=-1)


def _lengths(rows: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", rows, rows)))


def _factors(common: list[FloatArray], target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Q, (..., 2 n, L), and R of the common columns; Q is 0 for dependent columns."""
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
    """Return rows, (..., C, 2 n), minus their part in the span of Q; twice, for accuracy."""
    for _ in range(2 if Q.shape[-1] else 0):
        rows = rows - (rows @ Q) @ Q.swapaxes(-1, -2)
    return rows


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
