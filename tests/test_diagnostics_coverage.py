"""The small version of the coverage validation: the same code, fewer data sets."""

import numpy as np
import pytest

from benchmarks.coverage import (
    SMALL,
    Row,
    as_markdown,
    closed_by_exact_data,
    cramer_rao,
    run,
    scenarios,
)


@pytest.mark.parametrize(
    "index", [0, 2, 3, *(pytest.param(i, marks=pytest.mark.long) for i in (1, 4, 5))]
)
def test_intervals_cover_and_verdicts_are_right(index):
    count, bootstrapped, replicates = SMALL
    if index in (2, 5):  # long profiles of a hidden spring; five parameters of a plant
        count, bootstrapped = count // 8, 0
    table = run(count, bootstrapped, replicates, [index], processes=1)
    assert not [text for row in table for text in row.failures]


def test_scenarios_are_what_they_are_for():
    bounds = [cramer_rao(s) for s in scenarios()]
    assert all((b < 0.25).all() for i, b in enumerate(bounds) if i not in (1, 2))
    np.testing.assert_allclose(bounds[1], [9.1, 0.002], rtol=0.2)
    np.testing.assert_allclose(bounds[2][:2], [0.31, 8.4], rtol=0.05)  # the table of the theory
    assert sum(bool(closed_by_exact_data(s).all()) for s in scenarios()) == 4


def row(coverage, right, rmse):
    level = np.array([0.6827, 0.9545])
    methods = {"wald": level, "profile": np.array([coverage, 0.9545]), "bootstrap": level}
    tolerance = dict.fromkeys(methods, np.full(2, 0.02))
    return Row(
        "one", "f_max", 100, 10, 0.01, True, rmse * 0.01, 1.05 * 0.01, methods, tolerance, right
    )


def test_what_does_not_hold_is_said():
    assert row(0.68, 1.0, 1.0).failures == []
    bad = row(0.6, 0.98, 1.2)
    assert bad.failures == [
        "verdict right in 0.9800",
        "RMSE 1.200 bounds",
        "profile covers [0.6, 0.9545]",
    ]
    page = as_markdown([bad])
    assert (
        "| one | f_max | 100 (10) | 0.01 | 1.200 | 68.27, 95.45 | 60.00 (!), 95.45 | 68.27, 95.45 |"
        in page
    )
    assert "Requirements that are not met:" in page
    assert "Every ordered cell was judged and meets its requirement." in as_markdown(
        [row(0.68, 1.0, 1.0)]
    )
