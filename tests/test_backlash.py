"""A gap in the link to a friction element."""

import json

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident import fit
from dahl_ident.elements import describe_model
from dahl_ident.elements.facts import Path
from dahl_ident.errors import ModelError
from tests.derivatives import central_differences
from tests.test_generic_friction import Jenkins

AT_REST = np.zeros(())


@pytest.mark.parametrize(
    ("law", "A", "first", "third"),
    [
        (di.Backlash(di.Dahl(1.0, 3.0), 0.8), 2.0, 0.3901538 + 0.4032069j, 0.0288864 - 0.0183396j),
        (di.Backlash(di.Dahl(1.0, 1.0), 0.6), 1.0, 0.5368324 + 0.1217627j, 0.0781530 + 0.0417040j),
    ],
)
def test_the_check_values(law, A, first, third):
    assert complex(law.dynamic_stiffness(A)) == pytest.approx(first, abs=1e-7)
    assert complex(law.dynamic_stiffness(A, harmonic=3)) == pytest.approx(third, abs=1e-7)


def test_a_closed_gap_is_none_and_a_wide_one_carries_no_force():
    A = np.geomspace(0.01, 10.0, 20)
    tight = di.Backlash(di.Dahl(1.0, 3.0, 2.0), 1e-12).describing_function(A)
    np.testing.assert_allclose(tight, di.Dahl(1.0, 3.0, 2.0).describing_function(A), rtol=1e-6)
    wide = di.Backlash(di.Dahl(1.0, 3.0), 2.0)
    assert wide.describing_function([0.0, 0.5, 1.0]).tolist() == [0.0, 0.0, 0.0]
    assert wide.force([0.0, 0.9, -0.9, 0.9]).tolist() == [0.0, 0.0, 0.0, 0.0]


def test_the_force_steps_through_the_gap():
    law = di.Backlash(Jenkins(2.0, 0.5), 0.4)
    x = [0.0, 0.2, 0.5, 1.0, 0.9, 0.5, 0.2, 0.1, 0.0, 0.1, 0.4]
    # contact at 0.2; slip at 1 N; zero force at 0.5; the gap is crossed to 0.1
    expected = [0.0, 0.0, 0.6, 1.0, 0.8, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0]
    np.testing.assert_allclose(law.force(x), expected, atol=1e-9)


def test_refusals():
    wrong: list[di.Element] = [
        di.Spring(1.0),
        di.PowerDamper(1.0, 0.5),
        di.Backlash(di.Dahl(), 0.1),
    ]
    for element in wrong:
        with pytest.raises(ModelError, match="Backlash got"):
            di.Backlash(element, 0.1)
    assert isinstance(di.Backlash(di.Dahl()).element, di.Friction)


def test_two_limits_behind_a_gap_are_those_of_the_general_loop():
    """Closed forms against the quadrature that every law takes, and against differences."""
    rng = np.random.default_rng(3)
    for i in range(30):
        f_max, sigma = 10.0 ** rng.uniform(-2.0, 2.0, 2)
        asymmetry, gap = rng.uniform(-0.7, 0.7), f_max / sigma * 10.0 ** rng.uniform(-2.0, 1.0)
        A = 0.5 * gap + f_max / sigma * 10.0 ** rng.uniform(-1.0, 1.2, 2)
        law = di.Backlash(di.Dahl(f_max, sigma, asymmetry=asymmetry), gap)
        free = di.Model(law).with_free(["f_max", "sigma", "asymmetry", "gap"])
        values, k = law.known_values(), i % 8
        found = free.stiffness_gradient(values, A, AT_REST, k)
        # an exponent of 1 to rounding has no closed form
        other = di.Backlash(di.Dahl(f_max, sigma, 1.0 + 1e-12, asymmetry=asymmetry), gap)
        general = other.stiffness(other.known_values(), A, AT_REST, k)
        size = np.abs(law.stiffness(values, A, AT_REST))
        assert np.all(np.abs(found.value - general) < 1e-8 * size)
        others = np.delete(np.array(values), 2)  # alpha stays 1

        def stiffness(at, law=law, A=A, k=k):
            return law.stiffness(list(np.insert(at, 2, 1.0)), A, AT_REST, k)

        exact = [d for j, d in enumerate(found.by_parameter) if j != 2]
        slopes = central_differences(stiffness, others, 1e-6 * np.abs(others))
        errors = np.abs(np.array(exact) - slopes) * np.abs(others)[:, None]
        assert np.all(errors < 1e-6 * size * A / (A - 0.5 * gap))


@pytest.mark.parametrize("start", [0.55, -0.55])
def test_a_history_that_starts_in_contact_changes_with_the_gap(start):
    """The engine's derivative, for a law without a closed form."""
    x = 2.0 * np.sin(0.05 * np.arange(300.0))
    law = di.Backlash(di.Dahl(1.0, 3.0, 1.5))
    values = [1.0, 3.0, 1.5, 0.8]
    by_gap = law.history(values, Path(x), start, slopes=True).by_parameter[-1]
    (slope,) = central_differences(
        lambda gap: law.force_history([*values[:3], *gap], x, state=start), values[3:], 1e-4
    )
    assert np.max(np.abs(slope)) > 0.1
    np.testing.assert_allclose(by_gap, slope, atol=1e-6)


@pytest.mark.parametrize("asymmetry", [0.0, 0.3])
@pytest.mark.parametrize("start", [0.0, 0.3, 0.5])
def test_a_history_behind_a_gap_is_exact(asymmetry, start):
    """Against the tables that every law takes, and its derivatives against differences."""
    rng = np.random.default_rng(5)
    x = 0.3 * np.cumsum(rng.standard_normal(300)) + 2.0 * np.sin(0.05 * np.arange(300.0))
    inner = di.Dahl(1.0, 3.0, asymmetry=asymmetry) if asymmetry else di.Dahl(1.0, 3.0)
    law = di.Backlash(inner, 0.8)
    values = [float(v) for v in law.known_values()]
    law = law.copy_with(tuple(p if p.name == "alpha" else p.freed() for p in law.parameters))
    found = law.history(values, Path(x), start, slopes=True)
    moved = [v + 1e-12 * (label == "alpha") for label, v in zip(law.labels, values, strict=True)]
    np.testing.assert_allclose(found.value, law.force_history(moved, x, state=start), atol=1e-7)
    slopes = central_differences(
        lambda moved: law.force_history(list(moved), x, state=start), values, 1e-5 * np.abs(values)
    )
    for label, exact, slope in zip(law.labels, found.by_parameter, slopes, strict=True):
        if label != "alpha":
            np.testing.assert_allclose(exact, slope, atol=1e-7)
    if start:
        (slope,) = central_differences(
            lambda moved: law.force_history(values, x, state=float(moved[0])), [start], 1e-5
        )
        np.testing.assert_allclose(found.by_state, slope, atol=1e-7)


def test_the_element_behind_a_gap_is_given_on_the_command_line(run):
    for text, missing in (
        ("backlash", "f_max, sigma, gap"),
        ("backlash(gap=0.1)", "f_max, sigma"),
        ("backlash(bouc_wen, gap=free)", "sigma, q, p, gap"),
    ):
        assert f"has no value for {missing};" in run("simulate", "--element", text).err
    text = "backlash(dahl(f_max=2, sigma=3, asymmetry=0.1), 0.1)"
    description = json.loads(run("simulate", "--element", text, "--json").out)
    expected = di.Backlash(di.Dahl(2.0, 3.0, asymmetry=0.1), 0.1)
    assert description["plant"] == describe_model(expected)


def test_amplitudes_within_the_gap_are_not_a_misfit():
    """Rows of noise alone, within the gap, do not hide that the model describes the others."""
    A = np.concatenate([np.geomspace(1e-4, 4e-4, 5), np.geomspace(6e-4, 5e-2, 20)])
    noise = np.random.default_rng(1).standard_normal((2, A.size))
    law = di.Backlash(di.Dahl(0.1, 30.0), gap=1e-3)
    N = law.dynamic_stiffness(A) + 0.02 * (noise[0] + 1j * noise[1])
    data = di.FrequencyResponse(np.ones(A.size), N, A, quantity="dynamic_stiffness")
    found = fit(data, di.Backlash(di.Dahl(alpha=1.0)), noise="absolute")
    assert found.status == "trusted"
    assert found.params["gap"].value == pytest.approx(1e-3, rel=2e-3)
    assert found.goodness.rms_misfit < 0.02


def test_a_plant_that_moves_within_the_gap_is_linear():
    f_max, sigma, gap = 6.468504e-05, 7.829406e-03, 4.0916780e-02
    linear = di.Mass(1.3699373e-09) + di.Damper(2.9454746e-08) + di.Spring(3.6530052e-03)
    plant = di.Backlash(di.Dahl(f_max, sigma), gap=gap) + linear
    f, drive = np.array([80.0, 130.0, 400.0]), 0.06 * f_max
    X = drive / linear.dynamic_stiffness(1.0, 2.0 * np.pi * f)
    assert (np.abs(X) < 0.5 * gap).all()
    found = di.response(plant, f, drive)
    assert found.steady == "exact"
    np.testing.assert_allclose(found.displacement, X, rtol=1e-8)
