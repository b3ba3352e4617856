"""Directions in which a law is nonlinear, and its curves at nodes along them.

The force of most laws is proportional to some parameters. The others are **directions**, in which
it is nonlinear: ratios of parameters that scale the force together, such as x_c = f_max/sigma,
lengths, speeds and pure numbers. The dimension of a direction gives its scale: the amplitudes of
the data for a length, amplitude times angular frequency for a speed.

A length has four nodes a decade from a hundredth of the smallest amplitude to a hundred times the
largest, and one a decade beyond, down to 1e-8 and up to 1e6 times. Farther out the curve agrees
with its limit to well below any noise; :mod:`dahl_ident.fitting.asymptotes` decides whether the
optimum lies at infinity. A pure number takes the values that its law declares.

If lengths scale the curve of a rate-independent law, the curve is read from tables over
ln(A/length) whose steps divide those of the grid. If there are several lengths, they are tried as
multiples of the shortest.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from dahl_ident.elements import Element, Friction, Parameter
from dahl_ident.elements.held_motion import form_of
from dahl_ident.elements.parameter import STIFFNESS, Dimension
from dahl_ident.errors import FitError, argument
from dahl_ident.problem import TableProblem
from dahl_ident.problem.stiffness import StiffnessData

_LOG_STEP = 0.01  # of ln(A/length) in a table, which is read at the nearest step
_LOWEST, _NODES = -3200, 6400  # first step and number of steps of a table: 14 decades either way
_DECADE = np.log(10.0) / _LOG_STEP  # steps in a decade
# steps between nodes of the grid: four a decade near the data, one a decade farther out
_FINE, _COARSE = 58, 230
_COMPUTED = 10  # steps of a table between computed values, which are interpolated
_AROUND_KNEE = 1e3  # ratio to the knee beyond which a curve is a power law
# values tried for a number whose law declares none, by its transform
_START_NUMBERS = {"log": (0.25, 0.5, 1.0, 2.0, 4.0), "linear": (-1.0, -0.5, 0.0, 0.5, 1.0)}
LARGEST_STIFFNESS = 1e150  # weighted stiffness whose square is still a number
_MULTIPLES = (1.0, 2.5, 10.0, 100.0)  # several lengths are tried at these times the shortest one
_MOST_TABLES = 64  # tables kept: 6 MB for each harmonic, and some seconds to compute
_LEAST_AMPLITUDES = 4  # amplitudes of a table, for cubic interpolation
_AMPLITUDES_AT_ONCE = 20  # amplitudes computed in one call, until the law overflows
_MOST_NODES = 1000  # nodes of an element whose curves are computed node by node
_MOST_LOOPS = 10_000  # loops integrated for a rate-dependent law: a second or two


@dataclass(frozen=True)
class Direction:
    """A free parameter, or its ratio to another one of the element."""

    parameter: Parameter
    over: Parameter | None
    dimension: Dimension
    """Powers of force, displacement and time."""

    @classmethod
    def of(cls, parameter: Parameter, over: Parameter | None) -> Direction:
        """Return a parameter, or its ratio to another one, with its dimension."""
        divisor = (0, 0, 0) if over is None else over.dimension
        force, displacement, time = (
            a - b for a, b in zip(parameter.dimension, divisor, strict=True)
        )
        return cls(parameter, over, (force, displacement, time))

    @property
    def is_number(self) -> bool:
        """Whether it has no unit."""
        return not any(self.dimension)

    def row(self, problem: TableProblem) -> tuple[FloatArray, float]:
        """Return the row and offset such that its logarithm is row @ theta + offset."""
        row = np.zeros(len(problem.parameters))
        offset = 0.0
        for parameter, sign in ((self.parameter, 1.0), (self.over, -1.0)):
            if parameter is None:
                continue
            if parameter.free:
                row[problem.names.index(parameter.name)] = sign
            elif parameter.value is not None:
                offset += sign * float(np.log(parameter.value))
        return row, offset

    def sizes(self, view: StiffnessData) -> FloatArray:
        """Return the logarithm of its scale at each row of the data, (n,) or (S, n)."""
        force, displacement, time = self.dimension
        ln_size = displacement * np.log(view.amplitude)
        if time:
            ln_size = ln_size - time * np.log(np.maximum(view.omega, 1e-300))
        if force:
            stiffness = np.log(view.typical_stiffness)[..., None]
            ln_size = ln_size + force * (stiffness + np.log(view.amplitude))
        return np.asarray(ln_size)


@dataclass(frozen=True)
class Directions:
    """How an element depends on its free parameters."""

    element: Element
    linear: tuple[Parameter, ...]
    """Free parameters in which the force is linear."""
    scale: tuple[Parameter, ...]
    """Parameters that scale the remaining force together."""
    reference: Parameter | None
    """The parameter in `scale` by which the others are divided."""
    nonlinear: tuple[Direction, ...]

    @property
    def is_free(self) -> bool:
        """Whether the common scale of the force is free, so that it can be solved for."""
        return bool(self.scale) and all(p.free for p in self.scale)

    @cached_property
    def lengths(self) -> tuple[Direction, ...]:
        """The directions with a unit, if all are powers of a length, so that they scale the curve.

        N over the reference then depends only on the amplitude over one of these lengths, their
        ratios, and numbers.
        """
        with_unit = tuple(d for d in self.nonlinear if not d.is_number)
        fixed = [
            p
            for p in self.element.parameters
            if not p.free and p not in self.scale and any(p.dimension)
        ]
        scales = self.element.rate_independent and self.is_free and not fixed and not self.linear
        of_length = all(not d.dimension[0] and not d.dimension[2] for d in with_unit)
        return with_unit if scales and of_length else ()


@lru_cache(maxsize=256)
def directions(element: Element) -> Directions:
    """Return how an element depends on its free parameters."""
    parameters = dict(zip(element.labels, element.parameters, strict=True))
    linear = tuple(p for label, p in parameters.items() if label in element.linear_parameters)
    scale = tuple(
        p
        for label, p in parameters.items()
        if label in element.scale_parameters and p not in linear
    )
    # the divisor of the other scale parameters: a known one, or a stiffness
    known = [p for p in scale if not p.free]
    stiff = [p for p in scale if p.dimension == STIFFNESS]
    reference = next(iter((*known, *stiff, *scale)), None)
    searched = []
    for parameter in element.parameters:
        if not parameter.free or parameter in linear or parameter is reference:
            continue
        if element.is_linear:  # its dependence on the parameter is unknown
            continue
        searched.append(Direction.of(parameter, reference if parameter in scale else None))
    return Directions(
        element, tuple(p for p in linear if p.free), scale, reference, tuple(searched)
    )


def is_positive(parameter: Parameter) -> bool:
    """Return whether a parameter takes values above zero only."""
    return parameter.positive or parameter.lower >= 0.0


def free_springs(problem: TableProblem) -> list[Parameter]:
    """Return the free stiffnesses of linear springs without a lower bound."""
    return [
        p
        for element in problem.model.elements
        if element.is_linear and element.rate_independent
        for p in directions(element).linear
        if p.dimension == STIFFNESS and np.isinf(p.lower)
    ]


@dataclass(frozen=True)
class LinearPart:
    """A linear coefficient of an element: the parameters that it multiplies, and its curve."""

    parameters: tuple[Parameter, ...]
    curve: ComplexArray  # at every row, (..., K, n)

    @property
    def is_positive(self) -> bool:
        """Whether the coefficient is positive."""
        return any(is_positive(p) for p in self.parameters)

    @property
    def may_vanish(self) -> bool:
        """Whether the coefficient may be zero."""
        return not any(p.positive for p in self.parameters)


@dataclass(frozen=True)
class NodeCurves:
    """One element at the K nodes of its grid."""

    values: dict[str, FloatArray]
    """Nonlinear parameters, (K,) or (S, K), and 1 for those that a column multiplies."""
    columns: list[LinearPart]
    known: ComplexArray | None
    """Part that does not depend on a coefficient, (..., K, n)."""
    edges: list[BoolArray]
    """Nodes at either end of each direction, (K,)."""

    @property
    def count(self) -> int:
        """The number of nodes: one for an element without directions."""
        return next((v.shape[-1] for v in self.values.values()), 1)


def needs_loops(d: Directions) -> bool:
    """Return whether a loop has to be integrated for every node and row."""
    law = type(d.element)
    return not d.lengths and not law.rate_independent and law.settled is Friction.settled


def columns_of(
    d: Directions, values: dict[str, FloatArray], view: StiffnessData
) -> tuple[ComplexArray | None, list[LinearPart]]:
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
            columns.append(LinearPart(scaled, base))
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
            columns.append(LinearPart((p,), curve))
        else:
            known = known + (p.value or 0.0) * curve
    return (known if np.any(known) else None), columns


def curves_at_nodes(d: Directions, view: StiffnessData, most: float) -> NodeCurves:
    """Return an element at the nodes of its grid, about `most` at most."""
    if not d.nonlinear:
        fixed, columns = columns_of(d, {}, view)
        columns = [replace(c, curve=_at_one_node(c.curve, view)) for c in columns]
        return NodeCurves({}, columns, None if fixed is None else _at_one_node(fixed, view), [])
    if d.lengths:
        return _tabulated_curves(d, view, most)
    most = min(most, _MOST_NODES)
    if needs_loops(d):
        most = min(most, _MOST_LOOPS / view.harmonic.size)
    lengths = [x for x in d.nonlinear if not x.is_number]
    numbers = [x for x in d.nonlinear if x.is_number]
    ordered = lengths + numbers
    nodes_of_numbers = [_numbers(x) for x in numbers]
    combinations = float(np.prod([nodes.size for nodes in nodes_of_numbers]))
    per_length = max(12.0, (most / combinations) ** (1.0 / max(1, len(lengths))))
    axes = [_axis(x, view, per_length) for x in lengths]
    axes += [nodes[None] for nodes in nodes_of_numbers]
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
    known_part, columns = columns_of(d, values, view)
    if d.is_free and d.reference is not None:
        values[d.reference.name] = np.ones(index.shape[1])
    edges = [i == end for i, n in zip(index, counts, strict=True) if n > 1 for end in (0, n - 1)]
    return NodeCurves(values, columns, known_part, edges[: 2 * len(lengths)])


def _at_one_node(curve: ComplexArray, view: StiffnessData) -> ComplexArray:
    return np.broadcast_to(curve, view.stiffness.shape)[..., None, :]


def _possible(
    d: Directions, ordered: list[Direction], axes: list[FloatArray], index: IntArray
) -> BoolArray:
    """Return the nodes where an element is physically possible; all nodes if there are none."""
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
    """Return the nodes of a pure number."""
    p = direction.parameter
    values = np.array(p.scan or _START_NUMBERS[p.transform])
    if not p.scan and np.isfinite([p.lower, p.upper]).all() and not p.positive:
        values = p.lower + (p.upper - p.lower) * np.linspace(0.1, 0.9, 5)
    inside = values[(values >= p.lower) & (values <= p.upper)]
    return np.asarray(inside if inside.size else np.clip(values[:1], p.lower, p.upper))


def _axis(direction: Direction, view: StiffnessData, most: float) -> FloatArray:
    """Return the nodes of a direction with a unit, (..., K)."""
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


def _tabulated_curves(d: Directions, view: StiffnessData, most: float) -> NodeCurves:
    """Return an element whose curve is scaled by lengths, from tables over ln(A/length).

    There is a table for each combination of numbers and of multiples of the shortest length. The
    nodes are those of the shortest length in the first combination, then in the second, and so on.
    """
    numbers = [x for x in d.nonlinear if x.is_number]
    ordered = [*d.lengths, *numbers]
    multiples = np.array(_MULTIPLES if len(d.lengths) > 1 else (1.0,))
    axes = [_powers(x, multiples) for x in d.lengths] + [_numbers(x) for x in numbers]
    counts = [a.size for a in axes]
    index = np.indices(counts).reshape(len(counts), -1)
    multiple = index[: len(d.lengths)] % multiples.size  # negative values follow the positive ones
    index = index[:, (multiple == 0).any(axis=0)]
    index = index[:, _possible(d, ordered, axes, index)]
    allowed = max(2, int(min(_MOST_TABLES, most / 6.0)))
    if index.shape[1] > allowed:
        chosen = np.random.default_rng(1).choice(index.shape[1], allowed, replace=False)
        index = index[:, np.sort(chosen)]
    # values of the directions at a shortest length of 1, a row for each combination
    unit_values = np.array([a[i] for a, i in zip(axes, index, strict=True)]).T

    amplitude = np.rint(np.log(view.amplitude) / _LOG_STEP).astype(np.intp)  # ln A in steps
    smallest = amplitude.min(axis=-1)
    span = int((amplitude.max(axis=-1) - smallest).max())
    offsets = _offsets(span, max(6.0, most / len(unit_values)))
    length = smallest[..., None] + offsets  # ln of the shortest length in steps
    in_table = np.clip(amplitude[..., None, :] - length[..., None] - _LOWEST, 0, _NODES)
    order = np.searchsorted(view.orders, view.harmonic)
    tables = (_table(d, ordered, tuple(row), view.orders) for row in unit_values.tolist())
    curve = np.concatenate([table[order, in_table] for table in tables], axis=-2)

    ln_length = np.tile(length, len(unit_values)) * _LOG_STEP
    assert d.reference is not None
    values = {d.reference.name: np.ones(ln_length.shape[-1])}
    for direction, column in zip(ordered, unit_values.T, strict=True):
        at_unit, power = np.repeat(column, offsets.size), direction.dimension[1]
        scaled = at_unit * np.exp(ln_length * power) if power else at_unit
        values[direction.parameter.name] = scaled
    # the curve at unit length is that of a reference of 1, whatever its dimension
    shift = d.reference.dimension[1] + 1
    if shift:
        curve = curve / np.exp(ln_length[..., None] * shift)
    node = np.tile(np.arange(offsets.size), len(unit_values))
    edges = [node == 0, node == offsets.size - 1]
    if len(d.lengths) > 1:
        at_longest = index[: len(d.lengths)] % multiples.size == multiples.size - 1
        edges += [np.repeat(at_end, offsets.size) for at_end in at_longest]
    return NodeCurves(values, [LinearPart(d.scale, curve)], None, [e for e in edges if e.any()])


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
        if not (np.abs(parts[-1]) < LARGEST_STIFFNESS).all():
            break
    Z = np.concatenate(parts, axis=1)
    fine = np.arange(_LOWEST, _LOWEST + _NODES + 1) * _LOG_STEP
    usable = (np.abs(Z) < LARGEST_STIFFNESS).all(axis=0)
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

    The splines of scipy are not used: importing them takes longer than a small fit.
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
