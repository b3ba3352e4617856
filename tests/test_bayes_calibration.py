"""Simulation-based calibration in small; ``python -m benchmarks.calibration`` is the large one."""

import numpy as np
import pytest

from benchmarks.calibration import RANKS, critical, extremity, friction, plant, ranks, report


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
