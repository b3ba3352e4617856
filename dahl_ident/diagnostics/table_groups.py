"""Groups of a table's rows: repeats of one level, rows of one drive level, tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse

_SAME_LEVEL = 0.02  # of ln A and ln f, beyond which the response is another
_MOST_LEVELS = 50  # with an error each: the cost is cubic in their number
_EQUAL = 1e-9  # of the same: one number, stored twice
_BY_CHANCE = 0.01  # tables without repeats in which some seem to be
FEWEST_TESTS = 3  # runs, or labelled levels, that count as tests


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


def repeats(level: NDArray[np.intp], fundamental: NDArray[np.bool_]) -> FloatArray:
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
            if FEWEST_TESTS <= len(names) < data.n:
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
