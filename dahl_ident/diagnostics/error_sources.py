r"""Sources of error that several rows share: scatter, model error, errors of the levels.

Each source is a set of columns: its errors are the columns times independent random numbers of one
variance. Departures are relative changes of the response, so that a source applies to every
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

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, IntArray, quotient
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

_SAME_LEVEL = 0.02  # of ln A and ln f: values farther apart are different levels
_MOST_LEVELS = 50  # levels with an error each: the cost is cubic in their number
_EQUAL = 1e-9  # of the same: equal except for rounding
_REPEATS_BY_CHANCE = 0.01  # share of tables without repeats in which some levels seem repeated
FEWEST_TESTS = 3  # runs, or labelled levels, that count as tests

# Share of tables in which noise alone may look like a model error, or like noisy levels: if it is
# lower, a missing spring or a wrong gain is overlooked; if higher, intervals of a correct model are
# too long.
_OFTEN = 0.15
_SHARED_LEVELS = 0.02  # of three kinds together
_SELDOM = 0.01  # of suspicious points
_LENGTH = 1.0  # of the model error, in ln A and ln omega
_MOST_POINTS = 200  # points of shapes, chosen evenly among more rows
_MOST_NOISY = 100  # levels with a noise each: the cost is cubic in their number
_SMOOTH = 1e-3  # eigenvalue of the correlation, over the largest, that is negligible
_MOST_SHAPES = 24  # of its eigenvectors; a decade of both amplitude and frequency takes 15
_MOST_DEPARTURE = 5.0  # largest rms of a model error over that of the misfit
_LEAST_RATE_RANGE = np.log(2.0)  # of ln omega, to distinguish speed from amplitude
_MOST_LEVEL_NOISE = 0.05  # of ln A: sensors scatter less; more would hide a wrong model
_FEWEST = 2  # runs, or repeated levels, that show a scatter


_LEVELS_OF: WeakKeyDictionary[FrequencyResponse, IntArray] = WeakKeyDictionary()
"""Number of each row's level, by table, as several callers need it."""


def rows_of_levels(data: FrequencyResponse) -> FloatArray:
    """Return which rows share a drive or amplitude at several frequencies, (L, n)."""
    level = _agreeing(np.log(_level(data)), (data.controlled == "force").astype(np.intp))
    rows = level == np.arange(level.max() + 1)[:, None]
    count = (rows & (data.harmonic == 1)).sum(axis=1)
    if len(rows) > _MOST_LEVELS or not (count > 1).all():
        return np.empty((0, data.n))
    return np.asarray(rows, dtype=np.float64)


def _level(data: FrequencyResponse) -> FloatArray:
    """Return the drive or amplitude that was controlled in each row, (n,)."""
    driven, level = data.controlled == "force", np.ones(data.n)
    for rows, column in ((driven, data.drive), (~driven, data.amplitude)):
        if column is not None:
            level[rows] = column[rows]
    return level


def is_monotonic(data: FrequencyResponse) -> bool:
    """Return whether the levels of all runs rise, or all fall, from row to row.

    A drift with time then cannot be distinguished from a change with the level.
    """
    runs = np.zeros(data.n) if data.run is None else data.run
    first, level = data.harmonic == 1, _level(data)
    steps = [np.diff(level[first & (runs == run)]) for run in np.unique(runs)]
    signs = np.sign(np.concatenate(steps))
    return bool(np.abs(signs).sum() > 1 and abs(signs.sum()) == np.abs(signs).sum())


def repeats(level: IntArray, fundamental: BoolArray) -> FloatArray:
    """Return which rows belong to each level that was measured more than once, (levels, n).

    Of very many levels, neighbours are combined.
    """
    repeated = np.flatnonzero(np.bincount(level[fundamental], minlength=level.max() + 1) > 1)
    groups = min(len(repeated), _MOST_LEVELS)
    group = np.full(level.max() + 1, -1)
    group[repeated] = np.arange(len(repeated)) * groups // max(len(repeated), 1)
    return np.asarray((np.arange(groups)[:, None] == group[level]) & fundamental, dtype=np.float64)


def repeated_levels(data: FrequencyResponse) -> IntArray:
    """Return the number of each row's level, shape (n,).

    Rows have one level if the frequency and the controlled drive or amplitude agree as closely as
    in repeats, but not merely because a sweep is dense.
    """
    if data not in _LEVELS_OF:
        driven = data.controlled == "force"
        frequency = _agreeing(np.log(data.frequency_hz), np.zeros(data.n, dtype=np.intp))
        _LEVELS_OF[data] = _agreeing(np.log(_level(data)), 2 * frequency + driven)
    return _LEVELS_OF[data]


def passes(data: FrequencyResponse) -> NDArray[np.str_] | None:
    """Return the pass over the levels that each row belongs to, (n,); None for a single pass.

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
    keys = np.column_stack([repeated_levels(data), data.harmonic])
    number = np.empty(data.n, dtype=np.intp)
    for rows in grouped_rows(np.unique(keys, axis=0, return_inverse=True)[1].ravel()):
        number[rows] = np.arange(len(rows))
    if number[-1] == 0 or (np.diff(number) < 0).any() or np.bincount(number).min() < _FEWEST:
        return None
    return np.array([f"pass {k + 1}" for k in number.tolist()])


def rows_of_tests(data: FrequencyResponse) -> list[IntArray]:
    """Return the rows of each test: runs, else labelled levels, else repeats of one level."""
    for labels in (data.run, data.level):
        if labels is not None:
            names, number = np.unique(labels, return_inverse=True)
            if FEWEST_TESTS <= len(names) < data.n:
                return grouped_rows(number)
    return grouped_rows(repeated_levels(data))


def grouped_rows(group: IntArray) -> list[IntArray]:
    """Return the rows of each group, given the number of each row's group."""
    return np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1])


def _agreeing(x: FloatArray, groups: IntArray) -> IntArray:
    """Return a label for each value: the same for values of a group that repeat one another.

    The gaps between values without repeats are assumed to be exponentially distributed, with the
    mean of the larger gaps. This gives the probability that the k smallest are as small as they
    are. If the lowest of these probabilities is below 1 % for the table, the gaps up to that k are
    gaps between repeats.
    """
    order = np.lexsort((x, groups))
    differences = np.diff(x[order])
    joined = np.diff(groups[order]) == 0
    gaps = np.sort(differences[joined & (differences > _EQUAL)])
    small = gaps[gaps < _SAME_LEVEL]
    k = np.arange(1, len(small) + 1)
    larger = np.append(gaps, np.maximum(gaps[-1:], _SAME_LEVEL))  # and one after the last value
    mean = np.maximum(np.cumsum(larger[::-1])[::-1][k] / (len(larger) - k) - small, _EQUAL)
    unlikely = k * np.log(np.expm1(-larger[k] / mean) / np.expm1(-small / mean))
    widest_repeat = _EQUAL
    if unlikely.max(initial=0.0) > np.log(max(len(gaps), 1) / _REPEATS_BY_CHANCE):
        widest_repeat = float(small[np.argmax(unlikely)])

    def labelled(breaks: BoolArray) -> IntArray:
        return np.concatenate([[0], np.cumsum(breaks)])

    breaks = ~(joined & (differences <= widest_repeat))
    label = labelled(breaks)
    starts = np.flatnonzero(np.concatenate([[True], breaks]))
    ends = np.append(starts[1:], len(x)) - 1
    wide = (x[order][ends] - x[order][starts] > _SAME_LEVEL)[label[1:]]
    labels = np.empty(len(x), dtype=np.intp)
    labels[order] = labelled(breaks | (wide & (differences > _EQUAL)))
    return labels


@dataclass(frozen=True)
class Source:
    """One source of random error."""

    name: str  # in a budget; several sources may share one
    columns: FloatArray  # (M, q): whitened residuals that the source makes at unit variance
    mean_square: float  # of ln gain and phase over the rows, at unit variance
    shapes: Shapes | None = None  # extension of the source to other amplitudes and frequencies
    # what varies from test to test: "gain", "phase", "both" or a parameter's name; empty for noise
    # and model error
    per_test: str = ""
    largest: float = np.inf  # variance
    # (Q, q): changes of theta with the same effect as a part of each column, which is removed
    absorbed: FloatArray | None = None
    # parameter that varies as a power of the peak speed, and ln of the speed at which it equals its
    # estimate
    rate_of: tuple[str, float] | None = None
    # share of tables in which noise alone may make the source appear; 1 for one always included
    chance: float = 1.0

    @property
    def parallel(self) -> bool:
        """Whether it is a force in parallel with the model."""
        return self.shapes is not None and self.shapes.parallel

    @property
    def kind(self) -> tuple[bool, str]:
        """Key that distinguishes it from other model errors."""
        return self.parallel, "" if self.rate_of is None else self.rate_of[0]

    def changes(
        self,
        names: Sequence[str],
        slopes: ComplexArray,
        points: FloatArray,
        stiffness: ComplexArray | None,
    ) -> FloatArray | None:
        """Return the changes of ln gain and phase at other points, (n, 2, q), at unit variance.

        `points` are ln A and ln omega, (n, 2), `slopes` (n, Q) the derivatives of ln R with respect
        to theta at them, and `stiffness` the dynamic stiffness; None leaves out forces in parallel
        with the model. None is returned for a source that does not extend to other points.
        """
        if self.rate_of is not None:
            name, centre = self.rate_of
            ln_speed = (points.sum(axis=1) - centre)[:, None, None]
            return np.asarray(parts(slopes[:, [names.index(name)]]) * ln_speed)
        if self.shapes is None or (self.parallel and stiffness is None):
            return None
        ratio = np.ones(len(slopes), dtype=np.complex128) if stiffness is None else stiffness
        changes = parts(self.shapes.changes(points, ratio).T)
        return changes if self.absorbed is None else changes - parts(slopes) @ self.absorbed

    def drawn(
        self, names: Sequence[str], slopes: ComplexArray, near: IntArray, units: FloatArray
    ) -> FloatArray | None:
        """Return the changes (n, 2, q) that vary from test to test, at unit variance; None without.

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
    """Eigenvectors of a smooth correlation between rows, extended to other points."""

    points: FloatArray  # (n, 2): ln A and ln omega of the rows
    weights: FloatArray
    # whether it is a force in parallel with the model, which depends on frequency alone
    parallel: bool
    unit: float  # stiffness at unit variance of such a force

    @classmethod
    def of(cls, points: FloatArray, *, parallel: bool, unit: float = 1.0) -> Shapes:
        """Return the significant eigenvectors; of many rows, for evenly chosen ones."""
        if len(points) > _MOST_POINTS:
            order = np.lexsort(points.T[::-1])
            chosen = np.linspace(0, len(points) - 1, _MOST_POINTS).round().astype(int)
            points = points[order[chosen]]
        values, vectors = np.linalg.eigh(_correlation(points, points, parallel))
        kept = np.flatnonzero(values > _SMOOTH * values[-1])[::-1][:_MOST_SHAPES]
        return cls(points, vectors[:, kept] / np.sqrt(values[kept]), parallel, unit)

    def at(self, points: FloatArray) -> FloatArray:
        """Return the shapes at other points (k, 2), shape (k, q)."""
        return np.asarray(_correlation(points, self.points, self.parallel) @ self.weights)

    def changes(self, points: FloatArray, stiffness: ComplexArray) -> ComplexArray:
        """Return relative changes of the response by each shape in gain and phase, (2 q, k)."""
        shapes = self.at(points).T.astype(np.complex128)
        if self.parallel:
            shapes = shapes * quotient(self.unit, stiffness)
        return np.asarray(np.concatenate([shapes, 1j * shapes]))


def log_points(amplitude: FloatArray, omega: FloatArray) -> FloatArray:
    """Return ln A and ln omega, shape (n, 2)."""
    return np.asarray(np.log(np.column_stack(np.broadcast_arrays(amplitude, omega))))


def error_sources(
    estimate: WeightedEstimate, further: FloatArray | None = None
) -> tuple[Source, ...]:
    """Return the sources that several rows share, and noise of the levels.

    Their columns are relative to the model's responses at the estimate; relative to the measured
    ones, they would contain the noise. `further`, (k, 2), are more points where shapes are needed.
    """
    return tuple(
        source
        for sources in (
            _model_error(estimate, further),
            _changes_with_speed(estimate),
            _runs(estimate),
            _levels(estimate),
        )
        for source in sources
    )


def _model_error(estimate: WeightedEstimate, further: FloatArray | None) -> Iterator[Source]:
    """Yield a smooth departure from the model, a force in parallel, and errors of harmonics."""
    problem = estimate.problem
    view = estimate.view
    first = view.harmonic == 1
    points = log_points(view.amplitude, view.omega)
    all_points = points if further is None else np.vstack([points, further])
    size = _sizes(problem, estimate.predicted)
    responding = first & (size != 0.0)  # within a gap there is no response
    departure = problem.data.response[responding] / size[responding] - 1.0
    misfit = float(np.mean(np.abs(departure) ** 2)) if responding.any() else 0.0
    stiffness = np.where(first, view.stiffness, np.inf)
    for shape in (
        Shapes.of(all_points, parallel=False),
        Shapes.of(all_points, parallel=True, unit=float(view.typical_stiffness)),
    ):
        changes, absorbed = shape.changes(points, stiffness) * first, None
        square = 0.5 * float(np.sum(np.abs(changes) ** 2, axis=0).mean())
        columns = estimate.changed(changes * size)
        if shape.parallel:
            absorbed = _absorbed(problem, estimate.jacobian, columns)
            columns = columns + estimate.jacobian @ absorbed
        largest = 0.5 * _MOST_DEPARTURE**2 * misfit / square
        yield Source(
            MODEL_ERROR, columns, square, shape, largest=largest, absorbed=absorbed, chance=_OFTEN
        )
    orders = np.unique(view.harmonic[~first])
    if len(orders) > 0 and first.any():
        smooth = Shapes.of(points, parallel=False).changes(points, stiffness)
        changes = np.concatenate([smooth * (view.harmonic == k) for k in orders])
        yield Source(HARMONICS, estimate.changed(changes * size), 0.0, chance=_OFTEN)


def _changes_with_speed(estimate: WeightedEstimate) -> Iterator[Source]:
    """Yield a power of the peak speed for each parameter of friction that may scatter."""
    view = estimate.view
    speed, first = log_points(view.amplitude, view.omega).sum(axis=1), view.harmonic == 1
    if not (first.any() and np.ptp(np.log(view.omega)) > _LEAST_RATE_RANGE):
        return
    centre = float(speed[first].mean())
    change = np.pad(np.repeat(speed - centre, 2), (0, estimate.problem.n_priors))
    for i in _scale_parameters(estimate.problem, every=False):
        column = -(estimate.jacobian[:, i] * change)[:, None]
        relative = estimate.relative_units @ column[: 2 * first.size].reshape(-1, 2, 1)
        square = 0.5 * float(np.mean(np.sum(relative[first] ** 2, axis=(1, 2))))
        rate_of = (estimate.problem.names[i], centre)
        yield Source(MODEL_ERROR, column, square, rate_of=rate_of, chance=_OFTEN)


def _runs(estimate: WeightedEstimate) -> Iterator[Source]:
    """Yield what differs from run to run: gain, phase, and parameters of friction.

    Without stated runs, each pass over the levels may be a run.
    """
    problem = estimate.problem
    stated = problem.data.run
    labels, chance = (passes(problem.data), _OFTEN) if stated is None else (stated, 1.0)
    if labels is None:
        return
    runs = (np.unique(labels)[:, None] == labels).astype(np.float64)
    if len(runs) < _FEWEST:
        return
    gain = runs * estimate.predicted
    phase = 1j * problem.data.harmonic * gain
    yield Source(RUNS, estimate.changed(gain), 0.5, per_test="gain", chance=chance)
    yield Source(RUNS, estimate.changed(phase), 0.5, per_test="phase", chance=chance)
    members = np.pad(np.repeat(runs, 2, axis=1).T, ((0, problem.n_priors), (0, 0)))
    every = any(element.is_linear for element in problem.model.elements)
    for i in _scale_parameters(problem, every=every):
        columns = -members * estimate.jacobian[:, i : i + 1]
        yield Source(RUNS, columns, 0.0, per_test=problem.names[i], chance=chance)


def _levels(estimate: WeightedEstimate) -> Iterator[Source]:
    """Yield errors of the levels: of each row, of all rows of a level, of each repeated level.

    The level itself may be wrong, or the level that the response was divided by as well: a
    stiffness then has the same relative error in microslip, and none in slip. All rows of a level
    may share these errors, and a gain.
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
            square = 0.5 * float(np.mean(np.abs(quotient(change, predicted)) ** 2))
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


def errors_of_suspicious(estimate: WeightedEstimate, rows: Sequence[int]) -> Iterator[Source]:
    """Yield the additional error of all suspicious rows."""
    if len(rows) > 0:
        changes = np.zeros((len(rows), estimate.problem.data.n), dtype=np.complex128)
        changes[np.arange(len(rows)), rows] = estimate.predicted[rows]
        columns = estimate.changed(np.concatenate([changes, 1j * changes]))
        yield Source(APART, columns, 0.0, chance=_SELDOM)


def _sizes(problem: TableProblem, predicted: ComplexArray) -> ComplexArray:
    """Return the reference of a relative departure: the fundamental's size, at the row's phase."""
    _, fundamental = tests_of(problem.data)
    size = np.abs(predicted)
    return size[fundamental] * quotient(predicted, size)


def _absorbed(problem: TableProblem, J: FloatArray, columns: FloatArray) -> FloatArray:
    """Return changes of the linear elements' theta that explain part of the columns, (Q, q)."""
    names = {p.name for e in problem.model.elements if e.is_linear for p in e.parameters}
    linear = [i for i, name in enumerate(problem.names) if name in names]
    changes = np.zeros((J.shape[1], columns.shape[1]))
    if linear:
        changes[linear] = -np.linalg.lstsq(J[:, linear], columns, rcond=None)[0]
    return changes


def _scale_parameters(problem: TableProblem, *, every: bool) -> list[int]:
    """Return the columns of friction's scale parameters, all or without the last of each law.

    All of them together are a gain, if friction is all there is.
    """
    indices = []
    for element in problem.model.elements:
        if element.is_linear:
            continue
        for label in element.scale_parameters[: None if every else -1]:
            name = element.parameter(label).name
            if name in problem.names:
                indices.append(problem.names.index(name))
    return indices


def _correlation(first: FloatArray, second: FloatArray, parallel: bool) -> FloatArray:
    squares = np.zeros((len(first), len(second)))
    for axis in (1,) if parallel else (0, 1):
        if np.ptp(np.concatenate([first[:, axis], second[:, axis]])) > 0.0:
            squares += ((first[:, axis, None] - second[:, axis]) / _LENGTH) ** 2
    return np.asarray(np.exp(-0.5 * squares))
