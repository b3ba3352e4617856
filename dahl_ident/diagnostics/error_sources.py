r"""Sources of correlated or uneven residuals: noise, scatter and model error.

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

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.quantities import COMPLIANCES
from dahl_ident.diagnostics.run_deviations import Linearization, RunDeviations
from dahl_ident.problem import Problem

NOISE = "noise"
MODEL_ERROR = "model error"
RUNS = "scatter between runs"
LEVELS = "scatter between repeated levels"
APART = "suspicious points"
TESTS = "jackknife over tests"
HARMONICS = "model error of harmonics"

_PRICE = 0.4  # rise of the log-likelihood that a model error, or noise of levels, takes
_PRICE_OF_RATE = 0.1  # the same for a force limit that changes with speed
_PRICE_OF_LEVELS = 3.0  # the same for what a level has in common: 1 % of the tables, by chance
_PRICE_OF_A_ROW = 2.0  # the same for an error of one row, which some row seems to have by chance
_LENGTH = 1.0  # of the model error, in ln A and ln omega
_MOST_PLACES = 200  # of shapes, chosen evenly where rows are more
_MOST_NOISY = 100  # levels with a noise of their own: the cost is cubic in their number
_SMOOTH = 1e-3  # eigenvalue of the correlation, over the largest, that is negligible
_MOST_SHAPES = 24  # of its eigenvectors; a decade of both amplitude and frequency takes 15
_SAME_LEVEL = 0.02  # of ln A and ln f, beyond which the response is another
_MOST_LEVELS = 50  # with an error each: the cost is cubic in their number
_EQUAL = 1e-9  # of the same: one number, stored twice
_BY_CHANCE = 0.01  # tables without repeats in which some seem to be
_MOST_DEPARTURE = 5.0  # rms of a model error over that of the misfit which it leaves
_LEAST_RATE_RANGE = np.log(2.0)  # of frequency, that tells speed from amplitude
_MOST_LEVEL_NOISE = 0.05  # of ln A: sensors scatter less; more of it would hide a wrong model
_MOST_UNDERSTATED = 3.0  # true standard deviation over the stated one
_FEWEST_TESTS = 3  # runs, or labelled levels, that count as tests
_FEWEST = 2  # runs, or repeated levels, that show a scatter


@dataclass(frozen=True)
class Source:
    """One source of random error.

    Attributes
    ----------
    name : str
        As a budget lists it; several sources may share one.
    columns : ndarray, shape (m, q), (m,) or (n, 2, 1)
        Residuals at unit variance; one dimension stands for a diagonal matrix, three for a column
        of each row's own.
    mean_square : float
        Of ln gain and phase over the rows, at unit variance.
    shapes : Shapes or None
        Extension of the source to other amplitudes and frequencies.
    own : str
        What another test has an own draw of: "gain", "phase", "both" or a parameter's name;
        empty for noise and model error.
    largest : float
        Variance.
    absorbed : ndarray, shape (Q, q), or None
        Changes of theta that do the same as each column; taken out of the columns.
    rate_of : (str, float) or None
        Parameter that changes as a power of the peak speed, and ln of the speed where it is its
        estimate.
    """

    name: str
    columns: FloatArray
    mean_square: float
    shapes: Shapes | None = None
    own: str = ""
    largest: float = np.inf
    absorbed: FloatArray | None = None
    rate_of: tuple[str, float] | None = None
    price: float = 0.0


@dataclass(frozen=True)
class Shapes:
    """Eigenvectors of a smooth correlation between rows, continued to other places.

    Attributes
    ----------
    places : ndarray, shape (n, 2)
        ln A and ln omega of the rows.
    parallel : bool
        Whether it is a force in parallel with the model, which depends on frequency alone.
    unit : float
        Stiffness at unit variance of such a force.
    """

    places: FloatArray
    weights: FloatArray
    parallel: bool
    unit: float

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


def noise_of(problem: Problem, theta: FloatArray, *, few: bool) -> tuple[Source, ...]:
    """Return the noise that each row has of its own.

    Of unknown size, or beyond that of the data's covariance: far more than was stated is another
    error, and no larger where a covariance is. Then, of `few` rows, gain and phase have a scatter
    too. Harmonics have noise of their own: a misfit in them is not an error of the fundamental.
    """
    n, unit = problem.n_residuals // 2, unit_noise(problem)
    if not (few and problem.scale_known):
        return (Source(NOISE, np.ones(2 * n), unit),)
    predicted, first = problem.predict(theta), problem.data.harmonic == 1
    parts = [-problem.residual_change(theta, f * predicted).reshape(n, 2) for f in (1.0, 1j)]
    blocks = np.zeros((n, 2, n, 2))
    blocks[np.arange(n), :, np.arange(n), :] = np.stack(parts, axis=-1)
    found = []
    for own in (first, ~first):
        if own.any():
            share, most = float(own.mean()), _MOST_UNDERSTATED**2 - 1.0
            found.append(Source(NOISE, np.repeat(1.0 * own, 2), share * unit, largest=most))
            found.append(Source(NOISE, blocks[:, :, own].reshape(2 * n, -1), share))
    return tuple(found)


def own_errors(problem: Problem, rows: Sequence[int]) -> tuple[Source, ...]:
    """Return an error of each of some rows, in addition to the noise, that no other row shares."""
    found = []
    for row in rows:
        columns = np.zeros((problem.n_residuals, 2))
        columns[2 * row : 2 * row + 2] = np.eye(2)
        share = unit_noise(problem) / problem.data.n
        found.append(Source(APART, columns, share, price=_PRICE_OF_A_ROW))
    return tuple(found)


class StructuredSources:
    """The sources that several rows share, and noise of the amplitudes.

    Their shapes are those of the model at `theta`. In measured ones the noise itself would be a
    shape, and explain itself. `further`, (k, 2), are further places where they are needed.
    """

    def __init__(
        self, problem: Problem, theta: FloatArray, further: FloatArray | None = None
    ) -> None:
        self._problem = problem
        compliance = problem.data.quantity in COMPLIANCES
        self._divided = np.where((problem.data.controlled == "force") == compliance, 1.0, -1.0)
        view, data = problem.predicted_stiffness(theta), problem.data
        self._places = places(view.amplitude, view.omega)
        self._fundamental = view.harmonic == 1
        self._repeats = _repeats(repeated_levels(data), self._fundamental)
        self._runs = (
            np.empty((0, data.n)) if data.run is None else _indicators(np.asarray(data.run))
        )
        unit = float(np.abs(view.stiffness[self._fundamental]).max(initial=0.0)) or 1.0
        every = self._places if further is None else np.vstack([self._places, further])
        self._shapes = (
            Shapes.of(every, parallel=False),
            Shapes.of(every, parallel=True, unit=unit),
        )
        stiffness = np.where(self._fundamental, view.stiffness, np.inf)
        self._changes = [shape.changes(self._places, stiffness) for shape in self._shapes]
        self._speed = self._places.sum(axis=1)
        self._rates = bool(np.ptp(self._places[:, 1]) > _LEAST_RATE_RANGE)
        self._levels = _scattering_levels(problem)
        self._in_common = _rows_of_levels(data)

    def at(self, theta: FloatArray, near: Linearization) -> tuple[Source, ...]:
        """Return the sources at theta, their columns linearised where `near` is."""
        problem, predicted, J = self._problem, near.predicted, near.J
        size = _sizes(problem, predicted)

        def columns(changes: ComplexArray) -> FloatArray:
            """Return residuals for relative changes (k, n), shape (m, k)."""
            return near.change(changes * size).T

        own = self._fundamental & (size != 0.0)  # a gap that is not crossed has no response
        missed = problem.data.response[own] / size[own] - 1.0
        left = float(np.mean(np.abs(missed) ** 2)) if own.any() else 0.0
        found = []
        for shape, changes in zip(self._shapes, self._changes, strict=True):
            square, made, absorbed = _mean_square(changes), columns(changes), None
            if shape.parallel:
                absorbed = _absorbed(problem, J, made)
                made = made + J @ absorbed
            most = 0.5 * _MOST_DEPARTURE**2 * left / square
            found.append(
                Source(
                    MODEL_ERROR, made, square, shape,
                    largest=most, absorbed=absorbed, price=_PRICE,
                )
            )  # fmt: skip
        centre = float(self._speed[self._fundamental].mean()) if self._fundamental.any() else 0.0
        change = np.repeat(self._speed - centre, 2)[:, None]
        found += [
            Source(
                MODEL_ERROR,
                J[:, i : i + 1] * change,
                float(np.mean((J[:, i] * change[:, 0]) ** 2)) * unit_noise(problem),
                rate_of=(problem.names[i], centre),
                price=_PRICE_OF_RATE,
            )
            for i in _scattering_parameters(problem)
            if self._rates
        ]
        if len(self._runs) >= _FEWEST:
            share = self._runs * predicted
            turned = 1j * problem.data.harmonic * share
            found.append(Source(RUNS, near.change(share).T, 0.5, own="gain"))
            found.append(Source(RUNS, near.change(turned).T, 0.5, own="phase"))
            each = np.repeat(self._runs, 2, axis=1).T
            found += [
                Source(RUNS, each * J[:, i : i + 1], 0.0, own=problem.names[i])
                for i in _scattering_parameters(problem)
            ]
        if self._levels:
            found += self._noise_of_levels(theta)
        if len(self._in_common) >= _FEWEST_TESTS:
            found += self._errors_of_levels(theta, near)
        if len(self._repeats) >= _FEWEST:
            shared = np.concatenate([self._repeats, 1j * self._repeats])
            found.append(Source(LEVELS, columns(shared), 1.0, own="both"))
        return tuple(found)

    def _errors_of_levels(self, theta: FloatArray, near: Linearization) -> Iterator[Source]:
        """Yield what all rows of one level share: a gain, and an error of the level itself.

        An amplifier's gain makes both where the responses were divided by the level.
        """
        by_level = self._problem.level_slope(theta)
        for change in (near.predicted, by_level, by_level + self._divided * near.predicted):
            columns = near.change(self._in_common * change).T
            yield Source(LEVELS, columns, 0.5, own="gain", price=_PRICE_OF_LEVELS)

    def _noise_of_levels(self, theta: FloatArray) -> Iterator[Source]:
        """Yield noise of the amplitudes, or drives, at which responses were measured.

        The first counts in slip, where the response changes with amplitude, and not in microslip.
        The second is that of a level which the response was made with: divided by a measured
        amplitude, a stiffness is off by as much in microslip, and right in slip.
        """
        predicted = self._problem.predict(theta)
        by_level = self._problem.level_slope(theta)
        by_both = by_level + self._divided * predicted
        for change, most in ((by_level, np.inf), (by_both, _MOST_LEVEL_NOISE)):
            columns = -self._problem.residual_change(theta, change).reshape(-1, 2, 1)
            share = np.divide(change, predicted, out=np.zeros_like(change), where=predicted != 0.0)
            square = 0.5 * float(np.mean(np.abs(share) ** 2))
            yield Source(NOISE, columns, square, largest=most**2, price=_PRICE)


def run_deviations(
    problem: Problem, sources: Sequence[Source], effects: Sequence[FloatArray]
) -> RunDeviations | None:
    """Return how runs deviate, from the effects of each source; None where none scatters."""
    shared = [(s.own, u) for s, u in zip(sources, effects, strict=True) if s.name == RUNS]
    if not any(u.any() for _, u in shared):
        return None
    found = RunDeviations.none(np.asarray(problem.data.run), len(problem.names))
    for own, u in shared:
        if own in problem.names:
            found.theta[:, problem.names.index(own)] = -u  # columns there are those of J
        else:
            (found.gain if own == "gain" else found.phase)[:] = u
    return found


def _scattering_levels(problem: Problem) -> bool:
    """Return whether levels may be noisy; not where noise is known or rows are many."""
    data = problem.data
    stated = problem.scale_known or problem.noise != "relative"
    return data.n <= _MOST_NOISY and not (stated and (data.controlled != "force").all())


def _sizes(problem: Problem, predicted: ComplexArray) -> ComplexArray:
    """Return what a departure is relative to: the row's response, a harmonic's fundamental."""
    data = problem.data
    first = data.harmonic == 1
    if first.all():
        return predicted.copy()
    held = np.ones(data.n) if data.amplitude is None else data.amplitude
    _, which = np.unique(np.column_stack([data.frequency_hz, held]), axis=0, return_inverse=True)
    which = which.ravel()
    partner = np.full(which.max() + 1, -1)
    partner[which[first][::-1]] = np.flatnonzero(first)[::-1]  # the first of several
    rows = ~first & (partner[which] >= 0)
    own, size = predicted[rows], predicted.copy()
    phase = np.divide(own, np.abs(own), out=np.zeros_like(own), where=own != 0.0)
    size[rows] = np.abs(predicted[partner[which[rows]]]) * phase
    return size


def _absorbed(problem: Problem, J: FloatArray, columns: FloatArray) -> FloatArray:
    """Return what the model's linear parts take of forces in parallel, as changes of theta."""
    names = {p.name for e in problem.model.elements if e.is_linear for p in e.parameters}
    own = [i for i, name in enumerate(problem.names) if name in names]
    found = np.zeros((J.shape[1], columns.shape[1]))
    if own:
        found[own] = -np.linalg.lstsq(J[:, own], columns, rcond=None)[0]
    return found


def _scattering_parameters(problem: Problem) -> list[int]:
    """Return the columns of parameters that may differ from run to run, in addition to the gain."""
    found = []
    for element in problem.model.elements:
        if element.is_linear:
            continue
        for label in element.scale_parameters[:-1]:  # all of them together are a gain
            name = element.parameter(label).name
            if name in problem.names:
                found.append(problem.names.index(name))
    return found


def _rows_of_levels(data: FrequencyResponse) -> FloatArray:
    """Return which rows belong to each drive or amplitude held at several frequencies, (L, n)."""
    held = _agreeing(np.log(_held(data)), (data.controlled == "force").astype(np.intp))
    rows = held == np.arange(held.max() + 1)[:, None]
    count = rows.sum(axis=1)
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


def _repeats(level: NDArray[np.intp], fundamental: NDArray[np.bool_]) -> FloatArray:
    """Return which rows belong to each level that was measured more than once, (levels, n).

    Of very many levels, neighbours share what is then the scatter of their mean.
    """
    repeated = np.flatnonzero(np.bincount(level[fundamental], minlength=level.max() + 1) > 1)
    groups = min(len(repeated), _MOST_LEVELS)
    own = np.full(level.max() + 1, -1)
    own[repeated] = np.arange(len(repeated)) * groups // max(len(repeated), 1)
    return np.asarray((np.arange(groups)[:, None] == own[level]) & fundamental, dtype=np.float64)


def repeated_levels(data: FrequencyResponse) -> NDArray[np.intp]:
    """Return the number of each row's level, shape (n,).

    Rows are of one level where the frequency and what was held, drive or amplitude, agree as
    closely as repeats do; not where a sweep is dense.
    """
    driven = data.controlled == "force"
    frequency = _agreeing(np.log(data.frequency_hz), np.zeros(data.n, dtype=np.intp))
    return _agreeing(np.log(_held(data)), 2 * frequency + driven)


def rows_of_tests(data: FrequencyResponse) -> list[NDArray[np.intp]]:
    """Return the rows of each test: runs, else labelled levels, else repeats of one level."""
    for labels in (data.run, data.level):
        if labels is not None:
            names, which = np.unique(labels, return_inverse=True)
            if _FEWEST_TESTS <= len(names) < data.n:
                return _rows_of(which)
    return _rows_of(repeated_levels(data))


def _rows_of(which: NDArray[np.intp]) -> list[NDArray[np.intp]]:
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
    found = np.empty(len(x), dtype=np.intp)
    found[order] = labelled(breaks | (wide & (apart > _EQUAL)))
    return found


def _indicators(labels: NDArray[np.str_]) -> FloatArray:
    return np.asarray(np.unique(labels)[:, None] == labels, dtype=np.float64)


def _correlation(one: FloatArray, other: FloatArray, parallel: bool) -> FloatArray:
    squares = np.zeros((len(one), len(other)))
    for axis in (1,) if parallel else (0, 1):
        if np.ptp(np.concatenate([one[:, axis], other[:, axis]])) > 0.0:
            squares += ((one[:, axis, None] - other[:, axis]) / _LENGTH) ** 2
    return np.asarray(np.exp(-0.5 * squares))


def _mean_square(changes: ComplexArray) -> float:
    """Return the mean square of ln gain and phase that changes of unit variance make."""
    return 0.5 * float(np.sum(np.abs(changes) ** 2, axis=0).mean())


def unit_noise(problem: Problem) -> float:
    """Return the mean square of ln gain and phase that residuals of unit variance are."""
    weights = problem.stiffness_data.weights * np.abs(problem.stiffness_data.stiffness)
    return float(np.mean(1.0 / np.maximum(weights, 1e-150) ** 2))
