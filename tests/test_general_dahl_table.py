"""The tables of any exponent, against closed forms, integration to 50 digits and the quadrature."""

from __future__ import annotations

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.density import Density
from dahl_ident.bayes.priors import joint_prior
from dahl_ident.elements import general_dahl, linear_dahl
from dahl_ident.elements.general_dahl_table import stiffness
from dahl_ident.problem import TableProblem
from tests.bayes_cases import friction_table, harmonic_table


def at(value: float) -> FloatArray:
    return np.asarray(value, dtype=np.float64)


def amplitudes(alpha: float) -> FloatArray:
    """Return beta over 12 decades, and many close to the onset of slip."""
    beta = 10.0 ** np.random.default_rng(1).uniform(-6.0, 6.0, 400)
    if alpha >= 1.0:
        return beta
    gaps = np.geomspace(1e-13, 0.9, 100)
    onset = 2.0**-alpha / (1.0 - alpha)
    return np.concatenate([beta, onset * (1.0 - gaps), [onset], onset * (1.0 + gaps)])


@pytest.mark.parametrize(
    "alpha",
    [
        *(1e-9, 0.01, 0.2, 0.36904, 0.5, 0.7, 0.899999, 0.9, 0.95, 1.0 - 1e-9, 1.0 + 1e-9),
        *(1.2, 1.8, 3.5, 10.0, 100.0, 1000.0),
    ],
)
def test_holds_the_quadrature(alpha: float) -> None:
    beta = amplitudes(alpha)
    error = stiffness(beta, at(alpha))[0] - general_dahl.stiffness(beta, at(alpha))
    assert np.max(np.abs(error) * (1.0 + beta)) < 1e-10


@pytest.mark.parametrize("alpha", [0.01, 0.5, 0.899, 0.95, 1.0, 1.8, 100.0, 2000.0])
def test_slope_is_that_of_the_quadrature(alpha: float) -> None:
    beta = 10.0 ** np.random.default_rng(1).uniform(-6.0, 6.0, 400)
    h, slope = stiffness(beta, at(alpha), slope=True)
    by_quadrature = -general_dahl.stiffness_gradient(beta, at(alpha))[1]
    assert np.array_equal(h, stiffness(beta, at(alpha))[0])
    assert np.max(np.abs(slope - by_quadrature) * (1.0 + beta)) < 1e-8


def test_closed_forms_of_one_and_of_one_half() -> None:
    beta = np.geomspace(1e-6, 1e6, 500)
    error = stiffness(beta, at(1.0))[0] - linear_dahl.describing_function(beta)
    assert np.max(np.abs(error) * (1.0 + beta)) < 1e-12
    before_slip = np.geomspace(1e-6, np.sqrt(2.0), 500)
    exact = np.sqrt(1.0 - before_slip**2 / 4.0) + 2j * before_slip / (3.0 * np.pi)
    assert np.max(np.abs(stiffness(before_slip, at(0.5))[0] - exact)) < 1e-10


def test_a_value_does_not_depend_on_what_else_is_asked() -> None:
    random = np.random.default_rng(2)
    alpha = np.exp(random.uniform(-3.0, 3.0, (200, 1)))
    beta = np.exp(random.uniform(-5.0, 5.0, (200, 70)))
    together = stiffness(beta, alpha)[0]
    assert together.shape == (200, 70)
    for row in (0, 50, 199):
        alone = stiffness(beta[row], alpha[row])[0]
        assert np.max(np.abs(alone - together[row]) * (1.0 + beta[row])) < 1e-14
    columns = stiffness(beta, np.broadcast_to(alpha, beta.shape))[0]
    assert np.max(np.abs(columns - together) * (1.0 + beta)) < 1e-14
    assert stiffness(np.zeros((0, 2)), at(2.0))[0].shape == (0, 2)


def test_ends_and_what_is_no_number() -> None:
    with np.errstate(invalid="ignore"):
        found = stiffness(np.array([0.0, 1e-300, np.nan, 1e200]), at(0.5))[0]
    assert np.abs(found[:2] - 1.0).max() < 1e-14
    assert np.isnan(found[2])
    assert found[3] == pytest.approx(4j / np.pi * 1e-200, rel=1e-10)
    with np.errstate(invalid="ignore"):
        assert np.isnan(stiffness(at(1.0), at(np.nan))[0])
    # beyond the tables by quadrature
    far = np.array([1e-4, 1e-3]), at(5e3)
    assert np.array_equal(stiffness(*far)[0], general_dahl.stiffness(*far))


@pytest.mark.parametrize(
    ("data", "model"),
    [
        (friction_table(), di.Dahl(alpha=None)),
        (friction_table(), di.Dahl(alpha=0.6)),
        (harmonic_table(0.0), di.Dahl(alpha=None)),
        (friction_table(), di.Dahl(alpha=None) + di.Spring()),
    ],
    ids=["free", "given", "harmonics", "with a spring"],
)
def test_the_posterior_has_the_density_of_its_problem(
    data: di.FrequencyResponse, model: di.Element
) -> None:
    problem = TableProblem(data, model)
    density = Density(problem, joint_prior(problem))
    assert type(density.tabulated.model.elements[0]).__name__ == "TabulatedDahl"
    theta = density.prior.draw(np.random.default_rng(3), 300)
    expected = density.log_prior(theta) + problem.log_likelihood(theta)
    assert density.highest(theta) == pytest.approx(expected, rel=1e-9, abs=1e-7)


def test_linear_friction_keeps_its_closed_form() -> None:
    problem = TableProblem(friction_table(), di.Dahl())
    assert Density(problem, joint_prior(problem)).tabulated is problem
