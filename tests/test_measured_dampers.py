"""Measured dampers: what laws beyond Dahl find in whole records, from no guess."""

from dataclasses import replace

import numpy as np
import pytest

from dahl_ident import (
    Backlash,
    Dahl,
    Damper,
    FrequencyResponse,
    Mass,
    PowerDamper,
    Spring,
    extract,
    fit,
)
from tests.measured import assert_still, cranks, dampers, needs_measured

pytestmark = needs_measured


def estimated(records, model):
    """Return the estimates, and the share of the force's rms that is left."""
    found = fit(records, model, output="force", throw=False).optimum
    left = np.concatenate(found.problem.split_residuals(found.values))
    share = np.sqrt(np.mean(left**2) / np.mean(np.concatenate(found.problem.measured) ** 2))
    return dict(zip(found.problem.names, found.values.tolist(), strict=True)), float(share)


def test_a_friction_damper_with_a_gap():
    """Three whole tests at 0.5 Hz: stiffness as others found it; the gap exceeds 3 mm."""
    records = dampers("0.5Hz_*")
    values, share = estimated(records, Backlash(Dahl(asymmetry=None)) + Mass() + Damper())
    assert share < 0.18
    assert values["sigma"] == pytest.approx(4.6e6, rel=0.1)
    assert 3.0e-3 < values["gap"] < 4.5e-3


@pytest.mark.parametrize(
    ("pattern", "most"),
    [
        pytest.param("[0-9]*.1", 0.14, marks=pytest.mark.long),
        pytest.param(".A.*", 0.12, marks=pytest.mark.long),
        (".vali.*", 0.07),
    ],
)
def test_magneto_rheological_dampers_ask_for_a_power_law(pattern, most):
    model = Dahl() + PowerDamper() + Spring() + Mass()
    values, share = estimated(cranks(pattern)[::2], model)
    assert share < most
    assert 0.1 < values["exponent"] < 1.2


@pytest.mark.parametrize(
    ("pattern", "labelled", "names"),
    [
        # two minima of the exponent, 1.1 and 2.5: the likelier counts, its distance is in u
        ("[0-9]*.1", False, ("f_max", "sigma", "alpha", "damping")),
        pytest.param(".A.*", False, ("f_max", "sigma", "alpha", "damping"), marks=pytest.mark.long),
        # the test of two rows holds most of what tells friction from damping
        pytest.param(".vali.*", True, ("f_max", "sigma", "damping"), marks=pytest.mark.long),
    ],
)
def test_no_test_left_out_lets_an_estimate_jump(pattern, labelled, names):
    tests = [extract(record, harmonics=[1]) for record in cranks(pattern)]
    if labelled:
        tests = [replace(t, level=np.full(t.n, f"test {i}")) for i, t in enumerate(tests)]

    def estimate(some):
        data = FrequencyResponse.concatenate(some)
        return fit(data, Dahl() + Damper(), throw=False)

    assert_still(tests, estimate, names)


def test_a_runaway_start_does_not_win():
    """Without its sixth test, one start of this series runs to a stiffness of 7e17 N/m."""
    records = [r for i, r in enumerate(cranks("[0-9]*.1")) if i != 6]
    tests = FrequencyResponse.concatenate([extract(r, harmonics=[1]) for r in records])
    params = fit(tests, Dahl() + Spring(), throw=False).params
    assert params["f_max"].value == pytest.approx(89.3, rel=0.02)
    assert abs(params["stiffness"].value) < 2000.0
