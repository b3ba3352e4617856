r"""Starts of a search by variable projection, so that no initial values are needed.

The force of a friction law is proportional to some of its parameters, or to one factor on all of
them; a describing function, for instance, is linear in sigma once x_c = f_max/sigma and alpha are
given,

    N = sigma h_alpha(A / x_c),

and springs, dampers and masses are linear anyway. Least squares in dynamic stiffness, with
amplitudes as measured and weights that the noise model has at the data, is therefore a search over
the remaining directions (:mod:`dahl_ident.fitting.directions`): at each node of a grid of those,
the linear parameters are solved exactly. The lowest local minima are the starts.

A length has four nodes a decade from a hundredth of the smallest amplitude to a hundred times the
largest, and one a decade beyond, down to 1e-8 and up to 1e6 times. Farther out the curve agrees
with its limit to well below any noise; whether the optimum lies out there, at infinity, is for
:mod:`dahl_ident.fitting.asymptotes` to decide. A pure number takes the values that its law
declares. All nodes are combined while they are few; else points of a quasi-random sequence are.

Where lengths scale the curve of a rate-independent law, the curve is read from tables over
ln(A/length) whose steps divide those of the grid; several lengths are one and its multiples.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import SMALLEST, ComplexArray, FloatArray
from dahl_ident.elements import Element, Friction, Parameter
from dahl_ident.elements.held_motion import form_of
from dahl_ident.errors import FitError, argument
from dahl_ident.fitting.directions import Direction, Directions, directions, is_positive
from dahl_ident.problem import TableProblem
from dahl_ident.problem.stiffness import StiffnessData

IntArray = NDArray[np.intp]

_STEP = 0.01  # of ln(A/length) in a table, which is read at the nearest step
_LOWEST, _NODES = -3200, 6400  # first step and number of steps of a table: 14 decades either way
_DECADE = np.log(10.0) / _STEP  # steps in a decade
# steps between nodes of the grid: four a decade near the data, one a decade farther out
_FINE, _COARSE = 58, 230
_FINE_ENDS = (6, 4)  # nodes farther out below the fine ones, and above
# a table is computed at every tenth step, with cubics between; the law is what takes the time
_COMPUTED = 10
_AROUND_KNEE = 1e3  # distance from the knee beyond which a curve is a power law
# values tried of a number whose law names none, by its transform
_NUMBERS = {"log": (0.25, 0.5, 1.0, 2.0, 4.0), "linear": (-1.0, -0.5, 0.0, 0.5, 1.0)}
_LARGEST = 1e150  # weighted stiffness whose square is still a number
_DEPENDENT = 1e-12  # share of a column that others do not explain, below which it is rounding
_MULTIPLES = (1.0, 2.5, 10.0, 100.0)  # several lengths are tried at these times the shortest one
_MOST_TABLES = 64  # tables kept: 6 MB a harmonic in all, and some seconds to compute
_LEAST = 4  # amplitudes that a table needs for its cubics
_TOGETHER = 20  # amplitudes computed together, until the law overflows
_HIGHEST = 3  # highest harmonic in a start; more of them cost time and tell little more
_MOST_COMBINATIONS = 4000  # nodes of all elements together: a limit on memory and time
_MOST_OF_ONE = 1000  # nodes of one element whose curves are computed node by node
_MOST_LOOPS = 10_000  # loops integrated for a law that depends on the rate: a second or two
_MOST_ROWS = 20  # rows for which they are
_MOST_STARTS = 4  # searches of a table, each of which costs as much as the first
# sum of squares, over the lowest, at which a node is no start, however coarse the grid
_HOPELESS = 100.0
_ALIKE = 0.01  # relative difference of the sums of squares of nodes that may be one start


class Starts(NamedTuple):
    """Starts of all tables: the table of each, (M,), and its search coordinates, (M, P)."""

    table: IntArray
    theta: FloatArray

    def joined(self, other: Starts) -> Starts:
        """Return these and others."""
        return Starts(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def of(self, tables: IntArray) -> Starts:
        """Return those of some tables, in rising order, which are numbered anew."""
        chosen = np.isin(self.table, tables)
        return Starts(np.searchsorted(tables, self.table[chosen]), self.theta[chosen])


def global_starts(problem: TableProblem, *, resistant: bool = False) -> Starts:
    """Return the best starts of every table of a problem, best first.

    Values that the user gave to free parameters make one more start, the last. `resistant` starts
    are made with two kinds of weights, so that an outlier dominates only some of them. A response
    far too large has little weight where errors count relative to it, one far too small where all
    count alike.
    """
    view = problem.stiffness_data
    begin = _starts(problem, view)
    if not resistant:
        return begin
    size = np.maximum(np.abs(view.stiffness), SMALLEST)
    for weights in (1.0 / size, np.ones(size.shape)):
        begin = begin.joined(_starts(problem, replace(view, weights=weights)))
    return begin


def _starts(problem: TableProblem, view: StiffnessData) -> Starts:
    grid = _grid(problem, view)
    cost, coefficients = grid.solved()
    S = problem.n_tables
    table, place = _local_minima(cost.reshape(S, *grid.shape), mixed=grid.mixed)
    last = cost.shape[-1] - 1
    if grid.shape == (last + 1,) and last >= sum(_FINE_ENDS):
        first = np.flatnonzero(np.diff(table, prepend=-1))
        for edge, nearer in ((0, _FINE_ENDS[0]), (last, last - _FINE_ENDS[1])):
            there = table[first[place[first] == edge]]  # a bound may keep it far out from there
            table, place = np.append(table, there), np.append(place, np.full(there.size, nearer))
        order = np.argsort(table, kind="stable")
        table, place = table[order], place[order]
    if cost.ndim > 1:
        theta = grid.of_tables(table).theta(coefficients[table], place[:, None])[:, 0]
    else:
        theta = grid.theta(coefficients, place)
    begin = Starts(table, theta)
    if all(p.value is None for p in problem.parameters):
        return begin
    best = theta[np.diff(table, prepend=-1) > 0]
    values = problem.to_values(best)
    for index, parameter in enumerate(problem.parameters):
        if parameter.value is not None:
            values[:, index] = parameter.value
    stated = problem.to_search(values)
    new = ~np.isclose(stated, best, rtol=1e-12).all(axis=1)
    begin = begin.joined(Starts(np.flatnonzero(new), stated[new]))
    order = np.argsort(begin.table, kind="stable")
    return Starts(begin.table[order], begin.theta[order])


def grid_size(problem: TableProblem) -> int:
    """Return the number of nodes of the grid where starts are searched."""
    return len(_grid(problem, problem.stiffness_data).nodes)


def edge_starts(problem: TableProblem) -> list[FloatArray]:
    """Return the best nodes at both ends of each direction's grid, each (P,) or (S, P).

    They are where searches for limits start.
    """
    grid = _grid(problem, problem.stiffness_data)
    cost, coefficients = grid.solved()
    edges = []
    for index, curves in enumerate(grid.curves):
        for at in curves.edges:
            there = np.where(at[grid.nodes[:, index]], cost, np.inf)
            edges.append(grid.theta(coefficients, there.argmin(axis=-1)[..., None])[..., 0, :])
    return edges


@dataclass(frozen=True)
class _LinearPart:
    """A linear coefficient of one element: which parameters it multiplies, and its curve."""

    parameters: tuple[Parameter, ...]
    curve: ComplexArray  # at every row, (..., K, n)

    @property
    def is_positive(self) -> bool:
        return any(is_positive(p) for p in self.parameters)


@dataclass(frozen=True)
class _Curves:
    """One element at the K nodes of its grid."""

    values: dict[str, FloatArray]
    """Nonlinear parameters, and those that a column multiplies at 1: (K,) or (S, K)."""
    columns: list[_LinearPart]
    known: ComplexArray | None
    """The part that does not depend on any coefficient, (..., K, n)."""
    edges: list[NDArray[np.bool_]]
    """The nodes at either end of each direction, (K,)."""


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
    mixed: bool  # nodes of several directions follow each other: neighbours need not be near

    def solved(self) -> tuple[FloatArray, FloatArray]:
        """Return the sum of squares, (..., C), and the linear coefficients, (..., C, Q)."""
        cost, coefficients = _solve_linear(*self._system())
        separate = coefficients[..., len(self.common) :]
        positive = [c.is_positive for curves in self.curves for c in curves.columns]
        allowed = ((separate > 0.0) | ~np.array(positive, dtype=np.bool_)).all(axis=-1)
        return np.where(allowed, cost, np.inf), coefficients

    def _system(self) -> tuple[FloatArray, list[FloatArray], list[FloatArray]]:
        """Return the target, (..., C, 2 n), columns common to all nodes, and those of each."""
        target = self.target[..., None, :]
        columns = []
        for index, curves in enumerate(self.curves):
            chosen = self.nodes[:, index]
            columns += [
                _parts(column.curve[..., chosen, :] * self.weights[..., None, :])
                for column in curves.columns
            ]
            if curves.known is not None:
                target = target - curves.known[..., chosen, :] * self.weights[..., None, :]
        shape = np.broadcast_shapes(target.shape, (len(self.nodes), 1))
        common = [
            _parts(np.broadcast_to(c.curve * self.weights, self.target.shape)) for c in self.common
        ]
        return _parts(np.broadcast_to(target, shape)), common, columns

    def of_tables(self, tables: IntArray) -> _Grid:
        """Return the grid for `theta` alone, of some tables of a batch."""
        return replace(
            self,
            curves=[
                replace(c, values={k: v[tables] if v.ndim > 1 else v for k, v in c.values.items()})
                for c in self.curves
            ],
        )

    def theta(self, coefficients: FloatArray, places: IntArray) -> FloatArray:
        """Return the search coordinates at some combinations of nodes, (..., k) -> (..., k, P)."""
        if coefficients.ndim == 2:
            chosen = coefficients[places]
        else:
            chosen = np.take_along_axis(coefficients, places[..., None], axis=-2)
        by_name: dict[str, FloatArray] = {}
        used = 0
        for column in self.common:
            _scaled(by_name, column, chosen[..., used])
            used += 1
        for index, curves in enumerate(self.curves):
            node = self.nodes[places, index]
            by_name.update({name: _taken(v, node) for name, v in curves.values.items()})
            for column in curves.columns:
                _scaled(by_name, column, chosen[..., used])
                used += 1
        theta = np.empty((*places.shape, len(self.problem.parameters)))
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
    every = [directions(e) for e in problem.model.elements]
    searched = [d for d in every if d.nonlinear]
    rows = np.flatnonzero(view.harmonic <= _HIGHEST)
    rows = rows if rows.size else np.arange(view.harmonic.size)
    if any(_takes_loops(d) for d in searched) and rows.size > _MOST_ROWS:
        first = view.harmonic[rows] == 1
        rows = rows[first] if first.any() else rows
        amplitude = view.amplitude.reshape(-1, view.harmonic.size)[0]
        order = np.lexsort((amplitude[rows], view.omega[rows]))
        chosen = np.linspace(0, rows.size - 1, min(rows.size, _MOST_ROWS)).round().astype(int)
        rows = np.sort(rows[order[chosen]])
    if rows.size < view.harmonic.size:
        view = view.of_rows(rows)
    each = _MOST_COMBINATIONS ** (1.0 / max(1, len(searched)))
    curves = [_curves(d, view, each) for d in searched]
    counts = [_size(c) for c in curves]
    nodes = np.indices(counts).reshape(len(counts), math.prod(counts)).T
    fixed = np.zeros(view.stiffness.shape, dtype=np.complex128)
    common: list[_LinearPart] = []
    for d in every:
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


def _takes_loops(d: Directions) -> bool:
    """Return whether a loop is integrated for every node and row."""
    law = type(d.element)
    return not d.lengths and not law.rate_independent and law.settled is Friction.settled


def _size(curves: _Curves) -> int:
    return int(next(iter(curves.values.values())).shape[-1])


def _columns(
    d: Directions, values: dict[str, FloatArray], view: StiffnessData
) -> tuple[ComplexArray | None, list[_LinearPart]]:
    """Return the known part of an element's stiffness, and a column for each coefficient.

    `values` are those of the directions, each (..., K).
    """
    linear = {p.name for p in d.linear}
    scaled = {p.name for p in d.scale} if d.is_free else set()
    missing = [
        p.name
        for p in d.element.parameters
        if p.value is None and p.name not in {*linear, *scaled, *values}
    ]
    if missing:
        raise FitError(
            f"{', '.join(missing)} has no value to start from, and {d.element!r} does not say how "
            f"its force depends on it; give it a value and name it in {argument('free')}"
        )

    def at(one: Parameter | None, scale: float) -> ComplexArray:
        numbers = []
        for p in d.element.parameters:
            value: FloatArray | float
            if p.name in values:
                value = values[p.name]
            elif p.name in linear:
                value = float(p is one)
            elif p.name in scaled:
                value = scale
            else:
                value = float("nan") if p.value is None else p.value
            numbers.append(np.asarray(value, dtype=np.float64))
        with np.errstate(all="ignore"):  # far out a law may overflow, and is not a start there
            return view.of(d.element, numbers, at_nodes=bool(values))

    columns = []
    if not d.linear:
        return (None, [_LinearPart(d.scale, at(None, 1.0))]) if scaled else (at(None, 1.0), [])
    if all(p in d.linear for p in d.element.parameters):  # a linear element: nothing else acts
        return None, [_LinearPart((p,), at(p, 0.0)) for p in d.linear]
    scales = d.element.scale_parameters
    if scales and {d.element.parameter(label).name for label in scales} <= linear:
        return None, [_LinearPart((p,), at(p, 1.0)) for p in d.linear]
    base = at(None, 1.0)
    if scaled:
        columns.append(_LinearPart(d.scale, base))
    columns += [_LinearPart((p,), at(p, 1.0) - base) for p in d.linear]
    return (None if scaled or not np.any(base) else base), columns


def _curves(d: Directions, view: StiffnessData, most: float) -> _Curves:
    """Return an element at the nodes of its grid, about `most` at most."""
    if d.lengths:
        return _tabulated_curves(d, view, most)
    most = min(most, _MOST_OF_ONE)
    if _takes_loops(d):
        most = min(most, _MOST_LOOPS / view.harmonic.size)
    lengths = [x for x in d.nonlinear if not x.is_number]
    numbers = [_numbers(x) for x in d.nonlinear if x.is_number]
    combined = float(np.prod([n.size for n in numbers])) if numbers else 1.0
    each = max(12.0, (most / combined) ** (1.0 / max(1, len(lengths))))
    axes = [_axis(x, view, each) for x in lengths] + [n[None] for n in numbers]
    ordered = lengths + [x for x in d.nonlinear if x.is_number]
    counts = [a.shape[-1] for a in axes]
    if np.prod(counts) <= 2.0 * most:
        index = np.indices(counts).reshape(len(counts), -1)
    else:
        index = _quasi_random(tuple(counts), int(most))
    lead = view.amplitude.shape[:-1]
    index = index[:, _possible(d, [*ordered], [a.reshape(-1, a.shape[-1])[0] for a in axes], index)]
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
) -> NDArray[np.bool_]:
    """Return the nodes where an element is physically possible, or every node."""
    names = [x.parameter.name for x in ordered]
    possible = []
    for node in index.T:
        by_name = {name: float(a[i]) for name, a, i in zip(names, axes, node, strict=True)}
        numbers = [
            by_name.get(p.name, 1.0 if p.value is None else p.value) for p in d.element.parameters
        ]
        possible.append(not d.element.physics(numbers))
    return np.asarray(possible) if any(possible) else np.ones(len(possible), dtype=np.bool_)


def _numbers(direction: Direction) -> FloatArray:
    """Return the values of a pure number that are tried."""
    p = direction.parameter
    values = np.array(p.scan or _NUMBERS[p.transform])
    if not p.scan and np.isfinite([p.lower, p.upper]).all() and not p.positive:
        values = p.lower + (p.upper - p.lower) * np.linspace(0.1, 0.9, 5)
    inside = values[(values >= p.lower) & (values <= p.upper)]
    return np.asarray(inside if inside.size else np.clip(values[:1], p.lower, p.upper))


def _axis(direction: Direction, view: StiffnessData, most: float) -> FloatArray:
    """Return the values of a direction with a unit that are tried, (..., K)."""
    position = np.rint(direction.sizes(view) / _STEP).astype(np.intp)
    low = position.min(axis=-1)
    span = int((position.max(axis=-1) - low).max())
    signed = not is_positive(direction.parameter)
    offsets = _offsets(span, max(6.0, most / (2.0 if signed else 1.0)))
    values = np.exp((low[..., None] + offsets) * _STEP)
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
    """Return an element whose curve lengths scale: from tables over ln(A/length).

    The length is the shortest; the others are multiples of it.
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
    position = np.rint(np.log(view.amplitude) / _STEP).astype(np.intp)
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
    ln_lengths = np.concatenate([ln_length] * K, axis=-1) * _STEP
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
    # the curve at unit length is that of unit reference, whatever the reference's own dimension
    shift = d.reference.dimension[1] + 1
    if shift:
        curve = curve / np.exp(ln_lengths[..., None] * shift)
    return _Curves(values, [_LinearPart(d.scale, curve)], None, [e for e in edges if e.any()])


def _powers(direction: Direction, multiples: FloatArray) -> FloatArray:
    """Return the values of a power of a length at multiples of unit length, of both signs."""
    values = multiples ** direction.dimension[1]
    return values if is_positive(direction.parameter) else np.concatenate([values, -values])


_TABLES: dict[Hashable, ComplexArray] = {}


def _table(
    d: Directions, ordered: list[Direction], at: tuple[float, ...], orders: tuple[int, ...]
) -> ComplexArray:
    """Return F_k/X_1 over unit scale at ln(A/length) = -32, -31.99, ..., 32, (orders, n).

    `at` are the values of the directions at unit length.
    """
    element = d.element
    at_unit = dict(zip((x.parameter.name for x in ordered), at, strict=True))
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
    """Return the table from amplitudes around the knee; power laws beyond.

    Beyond the last amplitude at which the law has a loop there is none.
    """
    low, high = (float(np.asarray(v)) for v in element.knee(values))
    if not 0.0 < low <= high < np.inf:
        low = high = 1.0
    first = int(np.log(low / _AROUND_KNEE) / _STEP) // _COMPUTED * _COMPUTED
    last = int(np.log(high * _AROUND_KNEE) / _STEP)
    coarse = np.arange(max(first, _LOWEST), min(last, _LOWEST + _NODES) + 1, _COMPUTED)
    x = coarse * _STEP
    parts = []
    for some in np.array_split(x, max(1, x.size // _TOGETHER)):
        with np.errstate(all="ignore"):
            parts.append(
                element.stiffness(
                    values, np.tile(np.exp(some), orders.size), np.ones(()),
                    np.repeat(orders, some.size),
                ).reshape(orders.size, -1)
            )  # fmt: skip
        if not (np.abs(parts[-1]) < _LARGEST).all():
            break
    Z = np.concatenate(parts, axis=1)
    fine = np.arange(_LOWEST, _LOWEST + _NODES + 1) * _STEP
    usable = (np.abs(Z) < _LARGEST).all(axis=0)
    count = usable.size if usable.all() else int(usable.argmin())
    if count < _LEAST:
        return np.full((orders.size, fine.size), np.nan, dtype=np.complex128)
    x, Z, ends = x[:count], Z[:, :count], count < x.size
    table = _between(Z, (np.clip(fine, x[0], x[-1]) - x[0]) / (_COMPUTED * _STEP))
    for end, near, side in ((0, 1, fine < x[0]), (-1, -2, fine > x[-1])):
        for whole, Y in ((table.real, Z.real), (table.imag, Z.imag)):
            with np.errstate(divide="ignore", invalid="ignore"):
                slope = np.log(Y[:, end] / Y[:, near]) / (x[end] - x[near])
            slope = np.clip(np.where(np.isfinite(slope), slope, 0.0), -3.0, 3.0)[:, None]
            whole[:, side] = Y[:, [end]] * np.exp(slope * (fine[side] - x[end]))
    if ends:
        table[:, fine > x[-1]] = np.nan
    return table


def _between(Z: ComplexArray, place: FloatArray) -> ComplexArray:
    """Return columns (K, n) at places from 0 to n - 1, by cubics through the four nearest.

    A spline of scipy takes longer to import than a small fit takes.
    """
    first = np.clip(place.astype(np.intp) - 1, 0, Z.shape[1] - 4)
    u = place - first
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
    """Return the least sum of squares of target - coefficients times columns, and those.

    Columns in `common`, (..., 2 n), are the same at every node; they are projected out first,
    because those in `separate`, (..., C, 2 n), can be hard to tell from them.
    """
    Q, R = _factors(common, target)
    residual = _projected(target, Q)
    columns = (
        np.stack(np.broadcast_arrays(*separate), axis=-2)
        if separate
        else residual[..., None, :][..., :0, :]
    )
    # a hardening law overflows at some nodes: no starts
    usable = np.asarray((np.abs(columns) < _LARGEST).all(axis=(-2, -1)))
    if not usable.all():
        columns = np.where(usable[..., None, None], columns, 0.0)
    left = _projected(columns, Q[..., None, :, :])
    norm = np.sqrt(np.einsum("...i,...i->...", left, left))
    if common:
        whole = np.sqrt(np.einsum("...i,...i->...", columns, columns))
        norm[norm < _DEPENDENT * whole] = 0.0
    left = left / np.where(norm > 0.0, norm, np.inf)[..., None]
    gram = left @ left.swapaxes(-1, -2) + 1e-13 * np.eye(left.shape[-2])
    scaled = np.linalg.solve(gram, left @ residual[..., None])
    residual = residual - (scaled.swapaxes(-1, -2) @ left)[..., 0, :]
    coefficients = scaled[..., 0] / np.where(norm > 0.0, norm, np.inf)
    cost = np.where(usable, np.einsum("...i,...i->...", residual, residual), np.inf)
    if not common:
        return cost, coefficients
    explained = target - (coefficients[..., None, :] @ columns)[..., 0, :]
    base = np.linalg.solve(R[..., None, :, :], (explained @ Q)[..., None])[..., 0]
    return cost, np.concatenate([base, coefficients], axis=-1)


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
    for _ in range(2 if Q.shape[-1] else 0):
        rows = rows - (rows @ Q) @ Q.swapaxes(-1, -2)
    return rows


def _parts(values: ComplexArray) -> FloatArray:
    """Return real and imaginary parts side by side in the last axis."""
    return np.ascontiguousarray(values).view(np.float64)


def _local_minima(cost: FloatArray, *, mixed: bool) -> tuple[IntArray, IntArray]:
    """Return each table's lowest local minima over its grid, (S, ...): table and flat index.

    The lowest of a table comes first; a table without any has its first node. Where nodes are
    `mixed`, minima of nearly the same cost count as one where there are others: a parameter may not
    matter there.
    """
    S = len(cost)
    lowest = cost < np.inf
    for axis in range(1, cost.ndim):
        rows, mask = cost.swapaxes(axis, 0), lowest.swapaxes(axis, 0)
        mask[1:] &= rows[1:] <= rows[:-1]
        mask[:-1] &= rows[:-1] < rows[1:]
    flat, lowest = cost.reshape(S, -1), lowest.reshape(S, -1)
    lowest[~lowest.any(axis=1), 0] = True
    table, place = np.nonzero(lowest)
    if table.size == S:
        return table, place
    order = np.lexsort((flat[table, place], table))
    table, place = table[order], place[order]
    if mixed:
        lows, alike = flat[table, place], np.zeros(table.size, dtype=np.bool_)
        alike[1:] = (np.diff(table) == 0) & (lows[1:] <= (1.0 + _ALIKE) * lows[:-1])
        alike &= (np.bincount(table[~alike], minlength=S) > 1)[table]
        table, place = table[~alike], place[~alike]
    first = np.searchsorted(table, table)
    rank = np.arange(table.size) - first
    lows = flat[table, place]
    good = (rank == 0) | ((rank < _MOST_STARTS) & (lows <= _HOPELESS * lows[first]))
    return table[good], place[good]


def _taken(values: FloatArray, node: IntArray) -> FloatArray:
    """Return values, (K,) or (S, K), at nodes, (k,) or (S, k)."""
    return values[node] if values.ndim == 1 else np.take_along_axis(values, node, axis=-1)
