"""The validation of stated uncertainties on few tables: the code that writes the long page."""

import numpy as np

from benchmarks import uncertainty


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
