r"""Sources of error that several rows share: scatter, model error, errors of the levels.

Each source is a set of columns: its errors are the columns times independent numbers of one
variance. Departures are relative changes of the response, so that the same source serves every
quantity and noise model. The model error is a Gaussian process with the correlation

    exp(-(d ln A)^2/2 - (d ln omega)^2/2),

with a length of one in either logarithm, for both gain and phase. A second part is a force
proportional to displacement that varies smoothly with frequency only, like that of a mass, damper
or spring missing from the model; the part that the model's linear elements can describe is removed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.contributions import (
    APART,
    HARMONICS,
    LEVELS,
    MODEL_ERROR,
    NOISE,
    RUNS,
)
from dahl_ident.diagnostics.estimate import WeightedEstimate, tests_of
from dahl_ident.problem import TableProblem
from dahl_ident.units import COMPLIANCES

_SAME_LEVEL = 0.02  # of ln A and ln f, beyond which the response is another
_MOST_LEVELS = 50  # with an error each: the cost is cubic in their number
_EQUAL = 1e-9  # of the same: one number, stored twice
_BY_CHANCE = 0.01  # tables without repeats in which some seem to be
FEWEST_TESTS = 3  # runs, or labelled levels, that count as tests

# Share of tables in which noise alone may look like a model error, or like noisy levels: with less,
# a spring or an amplifier's gain that is off is overlooked, with more, intervals of a right model
# are too long.
_OFTEN = 0.15
_SHARED_LEVELS = 0.02  # of three kinds together
_SELDOM = 0.01  # of suspicious points
_LENGTH = 1.0  # of the model error, in ln A and ln omega
_MOST_PLACES = 200  # of shapes, chosen evenly where rows are more
_MOST_NOISY = 100  # levels with a noise each: the cost is cubic in their number
_SMOOTH = 1e-3  # eigenvalue of the correlation, over the largest, that is negligible
_MOST_SHAPES = 24  # of its eigenvectors; a decade of both amplitude and frequency takes 15
_MOST_DEPARTURE = 5.0  # rms of a model error over that of the misfit which it leaves
_LEAST_RATE_RANGE = np.log(2.0)  # of frequency, that tells speed from amplitude
_MOST_LEVEL_NOISE = 0.05  # of ln A: sensors scatter less; more of it would hide a wrong model
_FEWEST = 2  # runs, or repeated levels, that show a scatter


_LEVELS_OF: WeakKeyDictionary[FrequencyResponse, NDArray[np.intp]] = WeakKeyDictionary()
"""Number of each row's level, by table: sources, tests and groups ask for it."""


def rows_of_levels(data: FrequencyResponse) -> FloatArray:
    """Return which rows belong to each drive or amplitude held at several frequencies, (L, n)."""
    held = _agreeing(np.log(_held(data)), (data.controlled == "force").astype(np.intp))
    rows = held == np.arange(held.max() + 1)[:, None]
    count = (rows & (data.harmonic == 1)).sum(axis=1)
    if len(rows) > _MOST_LEVELS or not (count > 1).all():
        return np.empty((0, data.n))
    return np.asarray(rows, dtype=np.float64)


def _held(data: FrequencyResponse) -> FloatArray:
    """Return the drive or amplitude that was held in each row, (n,)."""
    driven, held = data.controlled == "force", np.ones(data.n)
    for rows, column in ((driven, data.drive), (~driven, data.amplitude)):
        if column is not None:
            held[rows] = column[rows]
    return held


def in_order_of_level(data: FrequencyResponse) -> bool:
    """Return whether every run goes from level to level in one direction, the same for all.

    A drift along the rows then cannot be distinguished from a change with the level.
    """
    runs = np.zeros(data.n) if data.run is None else data.run
    first, held = data.harmonic == 1, _held(data)
    steps = [np.diff(held[first & (runs == run)]) for run in np.unique(runs)]
    way = np.sign(np.concatenate(steps))
    return bool(np.abs(way).sum() > 1 and abs(way.sum()) == np.abs(way).sum())


def repeats(level: NDArray[np.intp], fundamental: NDArray[np.bool_]) -> FloatArray:
    """Return which rows belong to each level that was measured more than once, (levels, n).

    Of very many levels, neighbours share what is then the scatter of their mean.
    """
    repeated = np.flatnonzero(np.bincount(level[fundamental], minlength=level.max() + 1) > 1)
    groups = min(len(repeated), _MOST_LEVELS)
    group = np.full(level.max() + 1, -1)
    group[repeated] = np.arange(len(repeated)) * groups // max(len(repeated), 1)
    return np.asarray((np.arange(groups)[:, None] == group[level]) & fundamental, dtype=np.float64)


def repeated_levels(data: FrequencyResponse) -> NDArray[np.intp]:
    """Return the number of each row's level, shape (n,).

    Rows are of one level where the frequency and what was held, drive or amplitude, agree as
    closely as repeats do; not where a sweep is dense.
    """
    if data not in _LEVELS_OF:
        driven = data.controlled == "force"
        frequency = _agreeing(np.log(data.frequency_hz), np.zeros(data.n, dtype=np.intp))
        _LEVELS_OF[data] = _agreeing(np.log(_held(data)), 2 * frequency + driven)
    return _LEVELS_OF[data]


def passes(data: FrequencyResponse) -> NDArray[np.str_] | None:
    """Return the pass over the levels that each row belongs to, (n,); None where there is one.

    Levels that are repeated one block after the other may have been measured on several days.

    Examples
    --------
    >>> A, R = np.tile([1e-3, 2e-3, 4e-3], 2), np.ones(6)
    >>> passes(FrequencyResponse(np.ones(6), R, A)).tolist()
    ['pass 1', 'pass 1', 'pass 1', 'pass 2', 'pass 2', 'pass 2']
    >>> passes(FrequencyResponse(np.ones(6), R, np.sort(A))) is None
    True
    """
    if data.run is not None:
        return None
    place = np.column_stack([repeated_levels(data), data.harmonic])
    number = np.empty(data.n, dtype=np.intp)
    for rows in rows_of(np.unique(place, axis=0, return_inverse=True)[1].ravel()):
        number[rows] = np.arange(len(rows))
    if number[-1] == 0 or (np.diff(number) < 0).any() or np.bincount(number).min() < _FEWEST:
        return None
    return np.array([f"pass {k + 1}" for k in number.tolist()])


def rows_of_tests(data: FrequencyResponse) -> list[NDArray[np.intp]]:
    """Return the rows of each test: runs, else labelled levels, else repeats of one level."""
    for labels in (data.run, data.level):
        if labels is not None:
            names, which = np.unique(labels, return_inverse=True)
            if FEWEST_TESTS <= len(names) < data.n:
                return rows_of(which)
    return rows_of(repeated_levels(data))


def rows_of(which: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return the rows of each number."""
    return np.split(np.argsort(which, kind="stable"), np.cumsum(np.bincount(which))[:-1])


def _agreeing(x: FloatArray, groups: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return a label for each value: one for values of a group that repeat one another.

    Gaps between values without repeats are taken as exponential, with the mean that the larger of
    them have; that all of the k smallest are below some size then has a probability. Gaps up to
    the least likely such size are between repeats, if chance made it in one of a hundred tables.
    """
    order = np.lexsort((x, groups))
    apart = np.diff(x[order])
    joined = np.diff(groups[order]) == 0
    gaps = np.sort(apart[joined & (apart > _EQUAL)])
    small = gaps[gaps < _SAME_LEVEL]
    k = np.arange(1, len(small) + 1)
    larger = np.append(gaps, np.maximum(gaps[-1:], _SAME_LEVEL))  # a last one that ends the table
    mean = np.maximum(np.cumsum(larger[::-1])[::-1][k] / (len(larger) - k) - small, _EQUAL)
    unlikely = k * np.log(np.expm1(-larger[k] / mean) / np.expm1(-small / mean))
    apart_at_most = _EQUAL
    if unlikely.max(initial=0.0) > np.log(max(len(gaps), 1) / _BY_CHANCE):
        apart_at_most = float(small[np.argmax(unlikely)])

    def labelled(breaks: NDArray[np.bool_]) -> NDArray[np.intp]:
        return np.concatenate([[0], np.cumsum(breaks)])

    breaks = ~(joined & (apart <= apart_at_most))
    label = labelled(breaks)
    starts = np.flatnonzero(np.concatenate([[True], breaks]))
    ends = np.append(starts[1:], len(x)) - 1
    wide = (x[order][ends] - x[order][starts] > _SAME_LEVEL)[label[1:]]
    labels = np.empty(len(x), dtype=np.intp)
    labels[order] = labelled(breaks | (wide & (apart > _EQUAL)))
    return labels


@dataclass(frozen=True)
class Source:
    """One source of random error."""

    name: str  # as a budget lists it; several sources may share one
    columns: FloatArray  # (M, q): residuals of unit variance that the source makes at unit variance
    mean_square: float  # of ln gain and phase over the rows, at unit variance
    shapes: Shapes | None = None  # extension of the source to other amplitudes and frequencies
    # what differs from test to test: "gain", "phase", "both" or a parameter's name; empty for noise
    # and model error
    per_test: str = ""
    largest: float = np.inf  # variance
    # (Q, q): changes of theta that do the same as each column; taken out of the columns
    absorbed: FloatArray | None = None
    # parameter that changes as a power of the peak speed, and ln of the speed where it is its
    # estimate
    rate_of: tuple[str, float] | None = None
    # share of tables in which noise alone may make the source appear; 1 where it is always counted
    chance: float = 1.0

    @property
    def parallel(self) -> bool:
        """Whether it is a force in parallel with the model."""
        return self.shapes is not None and self.shapes.parallel

    @property
    def kind(self) -> tuple[bool, str]:
        """What distinguishes it from other model errors."""
        return self.parallel, "" if self.rate_of is None else self.rate_of[0]

    def changes(
        self,
        names: Sequence[str],
        slopes: ComplexArray,
        where: FloatArray,
        stiffness: ComplexArray | None,
    ) -> FloatArray | None:
        """Return ln gain and phase that the source makes at other places, (n, 2, q), if it does.

        `slopes` (n, Q) are the derivatives of ln R with respect to theta there, and `stiffness`
        the dynamic stiffness; None leaves out forces in parallel with the model.
        """
        if self.rate_of is not None:
            name, centre = self.rate_of
            away = (where.sum(axis=1) - centre)[:, None, None]
            return np.asarray(parts(slopes[:, [names.index(name)]]) * away)
        if self.shapes is None or (self.parallel and stiffness is None):
            return None
        ratio = np.ones(len(slopes), dtype=np.complex128) if stiffness is None else stiffness
        made = parts(self.shapes.changes(where, ratio).T)
        return made if self.absorbed is None else made - parts(slopes) @ self.absorbed

    def drawn(
        self, names: Sequence[str], slopes: ComplexArray, near: NDArray[np.intp], units: FloatArray
    ) -> FloatArray | None:
        """Return ln gain and phase (n, 2, q) that a new test draws at unit variance, if it does.

        Its noise is that of the rows `near`, where `units` turn residuals into ln gain and phase.
        """
        if self.name == NOISE:
            return np.asarray(units @ self.columns[2 * near[:, None] + np.arange(2)])
        if self.per_test in names:
            return parts(slopes[:, [names.index(self.per_test)]])
        kept = [self.per_test not in ("", "phase"), self.per_test not in ("", "gain")]
        return np.diag(np.array(kept, dtype=np.float64)) if any(kept) else None


def parts(relative: ComplexArray) -> FloatArray:
    """Return ln gain and phase of relative changes (n, q), shape (n, 2, q)."""
    return np.stack([relative.real, relative.imag], axis=1)


@dataclass(frozen=True)
class Shapes:
    """Eigenvectors of a smooth correlation between rows, continued to other places."""

    places: FloatArray  # (n, 2): ln A and ln omega of the rows
    weights: FloatArray
    # whether it is a force in parallel with the model, which depends on frequency alone
    parallel: bool
    unit: float  # stiffness at unit variance of such a force

    @classmethod
    def of(cls, places: FloatArray, *, parallel: bool, unit: float = 1.0) -> Shapes:
        """Return the eigenvectors that rows notice, from evenly chosen ones of many rows."""
        if len(places) > _MOST_PLACES:
            order = np.lexsort(places.T[::-1])
            chosen = np.linspace(0, len(places) - 1, _MOST_PLACES).round().astype(int)
            places = places[order[chosen]]
        values, vectors = np.linalg.eigh(_correlation(places, places, parallel))
        kept = np.flatnonzero(values > _SMOOTH * values[-1])[::-1][:_MOST_SHAPES]
        return cls(places, vectors[:, kept] / np.sqrt(values[kept]), parallel, unit)

    def at(self, places: FloatArray) -> FloatArray:
        """Return the shapes at other places (k, 2), shape (k, q)."""
        return np.asarray(_correlation(places, self.places, self.parallel) @ self.weights)

    def changes(self, places: FloatArray, stiffness: ComplexArray) -> ComplexArray:
        """Return relative changes of the response by each shape, gain and phase, (2 q, k)."""
        shapes = self.at(places).T.astype(np.complex128)
        if self.parallel:
            # a response of zero has no relative change that an element could make
            shapes = shapes * np.divide(
                self.unit, stiffness, out=np.zeros_like(stiffness), where=stiffness != 0.0
            )
        return np.asarray(np.concatenate([shapes, 1j * shapes]))


def places(amplitude: FloatArray, omega: FloatArray) -> FloatArray:
    """Return ln A and ln omega, shape (n, 2)."""
    return np.asarray(np.log(np.column_stack(np.broadcast_arrays(amplitude, omega))))


def error_sources(
    estimate: WeightedEstimate, further: FloatArray | None = None
) -> tuple[Source, ...]:
    """Return the sources that several rows share, and noise of the levels.

    Their shapes are those of the model at the estimate. If they were those of the measured
    responses, noise would explain itself. `further`, (k, 2), are further places where shapes are
    needed.
    """
    return tuple(
        source
        for sources in (
            _model_error(estimate, further), _changes_with_speed(estimate),
            _runs(estimate), _levels(estimate),
        )
        for source in sources
    )  # fmt: skip


def _model_error(estimate: WeightedEstimate, further: FloatArray | None) -> Iterator[Source]:
    """Yield the smooth departure from the model, and a force in parallel with it."""
    problem = estimate.problem
    view = estimate.view
    first = view.harmonic == 1
    there = places(view.amplitude, view.omega)
    unit = float(np.abs(view.stiffness[first]).max(initial=0.0)) or 1.0
    every = there if further is None else np.vstack([there, further])
    size = _sizes(problem, estimate.predicted)
    some = first & (size != 0.0)  # a gap that is not crossed has no response
    missed = problem.data.response[some] / size[some] - 1.0
    left = float(np.mean(np.abs(missed) ** 2)) if some.any() else 0.0
    stiffness = np.where(first, view.stiffness, np.inf)
    for shape in (Shapes.of(every, parallel=False), Shapes.of(every, parallel=True, unit=unit)):
        changes, absorbed = shape.changes(there, stiffness) * first, None
        square, made = _mean_square(changes), estimate.changed(changes * size)
        if shape.parallel:
            absorbed = _absorbed(problem, estimate.jacobian, made)
            made = made + estimate.jacobian @ absorbed
        most = 0.5 * _MOST_DEPARTURE**2 * left / square
        yield Source(
            MODEL_ERROR, made, square, shape, largest=most, absorbed=absorbed, chance=_OFTEN
        )
    orders = np.unique(view.harmonic[~first])
    if len(orders) > 0 and first.any():
        smooth = Shapes.of(there, parallel=False).changes(there, stiffness)
        changes = np.concatenate([smooth * (view.harmonic == k) for k in orders])
        yield Source(HARMONICS, estimate.changed(changes * size), 0.0, chance=_OFTEN)


def _changes_with_speed(estimate: WeightedEstimate) -> Iterator[Source]:
    """Yield a power of the peak speed for each parameter of friction that may scatter."""
    view = estimate.view
    speed, first = places(view.amplitude, view.omega).sum(axis=1), view.harmonic == 1
    if not (first.any() and np.ptp(np.log(view.omega)) > _LEAST_RATE_RANGE):
        return
    centre = float(speed[first].mean())
    change = np.pad(np.repeat(speed - centre, 2), (0, estimate.problem.n_priors))
    for i in _scattering_parameters(estimate.problem):
        column = -(estimate.jacobian[:, i] * change)[:, None]
        rate_of = (estimate.problem.names[i], centre)
        yield Source(MODEL_ERROR, column, 0.0, rate_of=rate_of, chance=_OFTEN)


def _runs(estimate: WeightedEstimate) -> Iterator[Source]:
    """Yield what differs from run to run: gain, phase, and parameters of friction.

    Passes over the levels that differ by more than noise are runs that nobody stated.
    """
    problem = estimate.problem
    stated = problem.data.run
    labels, chance = (passes(problem.data), _OFTEN) if stated is None else (stated, 1.0)
    runs = np.empty((0, problem.data.n)) if labels is None else _indicators(labels)
    if len(runs) < _FEWEST:
        return
    share = runs * estimate.predicted
    turned = 1j * problem.data.harmonic * share
    yield Source(RUNS, estimate.changed(share), 0.5, per_test="gain", chance=chance)
    yield Source(RUNS, estimate.changed(turned), 0.5, per_test="phase", chance=chance)
    each = np.pad(np.repeat(runs, 2, axis=1).T, ((0, problem.n_priors), (0, 0)))
    for i in _scattering_parameters(problem):
        column = -each * estimate.jacobian[:, i : i + 1]
        yield Source(RUNS, column, 0.0, per_test=problem.names[i], chance=chance)


def _levels(estimate: WeightedEstimate) -> Iterator[Source]:
    """Yield errors of the levels: of each row, of a level in common, of each repeated level.

    The level itself may be wrong, and a level that the response was divided by: a stiffness is
    then off by as much in microslip, and right in slip. All rows of a level may share these, and
    a gain.
    """
    problem, data = estimate.problem, estimate.problem.data
    predicted = estimate.predicted
    by_level = problem.level_slope(estimate.theta)
    compliance = data.quantity in COMPLIANCES
    divided = np.where((data.controlled == "force") == compliance, 1.0, -1.0)
    by_both = by_level + divided * predicted
    stated = problem.scale_known or problem.noise != "relative"
    if data.n <= _MOST_NOISY and not (stated and (data.controlled != "force").all()):
        for change, most in ((by_level, np.inf), (by_both, _MOST_LEVEL_NOISE)):
            share = np.divide(change, predicted, out=np.zeros_like(change), where=predicted != 0.0)
            square = 0.5 * float(np.mean(np.abs(share) ** 2))
            columns = estimate.changed(np.diag(change))
            yield Source(NOISE, columns, square, largest=most**2, chance=_OFTEN)
    in_common = rows_of_levels(data)
    if len(in_common) >= FEWEST_TESTS:
        kinds = (predicted, by_level, by_both)
        for change in kinds:
            columns = estimate.changed(in_common * change)
            yield Source(LEVELS, columns, 0.5, per_test="gain", chance=_SHARED_LEVELS / len(kinds))
    repeated = repeats(repeated_levels(data), data.harmonic == 1)
    if len(repeated) >= _FEWEST:
        shared = np.concatenate([repeated, 1j * repeated])
        columns = estimate.changed(shared * _sizes(problem, predicted))
        yield Source(LEVELS, columns, 1.0, per_test="both")


def own_errors(estimate: WeightedEstimate, rows: Sequence[int]) -> Iterator[Source]:
    """Yield one error of all rows that stand apart, beyond those that they share with others."""
    if len(rows) > 0:
        changes = np.zeros((len(rows), estimate.problem.data.n), dtype=np.complex128)
        changes[np.arange(len(rows)), rows] = estimate.predicted[rows]
        columns = estimate.changed(np.concatenate([changes, 1j * changes]))
        yield Source(APART, columns, 0.0, chance=_SELDOM)


def _sizes(problem: TableProblem, predicted: ComplexArray) -> ComplexArray:
    """Return what a departure is relative to: the row's response, a harmonic's fundamental."""
    _, fundamental = tests_of(problem.data)
    size = np.abs(predicted)
    phase = np.divide(predicted, size, out=np.zeros_like(predicted), where=size != 0.0)
    return np.asarray(size[fundamental] * phase)


def _absorbed(problem: TableProblem, J: FloatArray, columns: FloatArray) -> FloatArray:
    """Return what the model's linear parts take of forces in parallel, as changes of theta."""
    names = {p.name for e in problem.model.elements if e.is_linear for p in e.parameters}
    linear = [i for i, name in enumerate(problem.names) if name in names]
    changes = np.zeros((J.shape[1], columns.shape[1]))
    if linear:
        changes[linear] = -np.linalg.lstsq(J[:, linear], columns, rcond=None)[0]
    return changes


def _scattering_parameters(problem: TableProblem) -> list[int]:
    """Return the columns of parameters that may differ from run to run, in addition to the gain."""
    indices = []
    for element in problem.model.elements:
        if element.is_linear:
            continue
        for label in element.scale_parameters[:-1]:  # all of them together are a gain
            name = element.parameter(label).name
            if name in problem.names:
                indices.append(problem.names.index(name))
    return indices


def _indicators(labels: NDArray[np.str_]) -> FloatArray:
    return np.asarray(np.unique(labels)[:, None] == labels, dtype=np.float64)


def _correlation(first: FloatArray, second: FloatArray, parallel: bool) -> FloatArray:
    squares = np.zeros((len(first), len(second)))
    for axis in (1,) if parallel else (0, 1):
        if np.ptp(np.concatenate([first[:, axis], second[:, axis]])) > 0.0:
            squares += ((first[:, axis, None] - second[:, axis]) / _LENGTH) ** 2
    return np.asarray(np.exp(-0.5 * squares))


def _mean_square(changes: ComplexArray) -> float:
    """Return the mean square of ln gain and phase that changes of unit variance make."""
    return 0.5 * float(np.sum(np.abs(changes) ** 2, axis=0).mean())
