"""Sweeps of driven plants that scipy integrated: trusted, and the truth inside the intervals.

``python -m benchmarks.driven_plants`` does the same for ten plants, with more tables and rows.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.driven_plants import PLANTS, scored, simulated, table


@pytest.mark.parametrize("number", [0, 2])
def test_a_sweep_of_another_integrator_is_trusted(number: int) -> None:
    plant = PLANTS[number]
    frequency, drive, receptance, closure = simulated(plant, 4, 6)
    assert closure < 1e-6
    tables = [table(plant, frequency, drive, receptance, seed) for seed in (1, 2)]
    score = scored(plant, tables, "exact")
    assert score.trusted == 2
    assert score.inside >= score.intervals - 1
    assert abs(np.mean(score.errors)) < 1.0
    assert max(score.spreads) < 0.1
