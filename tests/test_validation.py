"""The validations of the manual on few data sets: the code that writes their pages."""

import numpy as np
import pytest

from benchmarks import uncertainty
from benchmarks.calibration import RANKS, critical, extremity, friction, plant, ranks, report
from benchmarks.coverage import (
    SMALL,
    Row,
    as_markdown,
    closed_by_exact_data,
    cramer_rao,
    run,
    scenarios,
)

# The small version of the coverage validation: the same code, fewer data sets.


@pytest.mark.parametrize(
    "index", [0, 2, *(pytest.param(i, marks=pytest.mark.long) for i in (1, 3, 4, 5))]
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


# The validation of stated uncertainties on few tables: the code that writes the long page.


def of(name):
    (cell,) = (c for c in uncertainty.cells() if c.name == name)
    return cell


def test_a_cell_holds():
    found = uncertainty.judge(of("three days, gain scatters by 5 %"), tables=8)
    assert found.failures == []
    assert "1 of 1 cells hold" in uncertainty.as_markdown([found])
    assert found.plain[0] < 0.8


def test_the_right_model_is_trusted():
    found = uncertainty.judge(of("the model is right"), tables=8)
    assert found.trusted >= 0.9
    assert min(found.covered) >= 0.75


def test_an_exponent_that_nobody_stated_is_no_error():
    found = uncertainty.judge(of("exponent 0.8, beta 0.1 to 10.0"), tables=8)
    assert found.covered[0] > 0.7


def test_a_gap_is_not_taken_for_noise_of_the_amplitudes():
    assert uncertainty.judge(of("backlash of 0.05 x_c"), tables=8).failures == []


def test_harmonics_do_not_hide_another_law():
    """Two Jenkins elements: what their fundamentals show, harmonics may not cover."""
    found = uncertainty.judge(of("harmonics: two Jenkins elements"), tables=4)
    assert found.usable == 0.0


def test_every_cell_draws_its_truth():
    cells = uncertainty.cells()
    assert len({cell.name for cell in cells}) == len(cells)
    for cell in cells:
        data, truth = cell.draw(np.random.default_rng(1))
        assert truth == (uncertainty.F_MAX, uncertainty.SIGMA)
        assert data.n >= uncertainty.ROWS


def test_small_tables_are_calibrated():
    found = uncertainty.calibrated(tables=10)
    assert found.usable > 0.9
    assert "holds" in str(found)


# Simulation-based calibration in small; ``python -m benchmarks.calibration`` is the large one.


def test_the_band_holds_uniform_ranks_and_sees_narrow_posteriors():
    limit = critical(300, 2)
    random = np.random.default_rng(1)
    uniform = random.integers(RANKS, size=300).astype(float)
    assert extremity(uniform) > limit
    # posteriors too narrow by a third
    truth = 1.5 * random.normal(size=300)
    draws = random.normal(size=(RANKS - 1, 300))
    assert extremity(np.sum(draws < truth, axis=0).astype(float)) < limit


@pytest.mark.parametrize(
    ("scenario", "tables"), [(friction(), 5), pytest.param(plant(), 5, marks=pytest.mark.long)]
)
def test_ranks_of_the_truth_are_uniform(scenario, tables):
    found, failed = ranks(scenario, tables, seed=2)
    assert failed == 0
    limit = critical(tables, found.shape[1])
    assert all(extremity(column) >= limit for column in found.T)


def test_the_report_says_whether_ranks_stay_inside(tmp_path):
    random = np.random.default_rng(1)
    results = {"friction": (random.integers(RANKS, size=(100, 2)).astype(float), 0)}
    text = report(results, tmp_path)
    assert "| friction | 100 | 0 | f_max |" in text
    assert "NO" not in text


def test_nuts_gives_the_same_posterior():
    """An independent sampler; ``make nuts`` is the long version."""
    pytest.importorskip("numpyro", reason="the extra nuts is not installed")
    from benchmarks.nuts import compare

    for what, ours, theirs, apart in compare(draws=1000, ess=2000.0):
        assert abs(apart) < 4.0, (what, ours, theirs)
