"""A law written here, the elastoplastic one, in every result: fit, chain, grid, JSON, report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dahl_ident as di


class Elastoplastic(di.Friction):
    kind = "elastoplastic_of_the_test"
    equation = "dF/dx = stiffness until F reaches f_max"
    parameters = (
        di.Parameter("stiffness", "N/m", "elastic stiffness", lower=0.0, transform="log"),
        di.Parameter("f_max", "N", "friction limit", lower=0.0, transform="log"),
    )

    def slope(self, force: Any, direction: Any, velocity: Any, values: Any) -> Any:
        stiffness, f_max = values
        return stiffness * (direction * force < f_max)


TRUTH = {"stiffness": 30.0, "f_max": 0.1}


def closed_form(A: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return N(A) of an elastoplastic element: k (theta - sin theta cos theta + j sin^2)/pi."""
    k, limit = TRUTH["stiffness"], TRUTH["f_max"] / TRUTH["stiffness"]
    theta = np.arccos(np.clip(1.0 - 2.0 * limit / A, -1.0, 1.0))
    real = (theta - 0.5 * np.sin(2.0 * theta)) / np.pi
    return k * (real + 1j * np.sin(theta) ** 2 / np.pi)


@pytest.fixture(scope="module")
def data() -> di.FrequencyResponse:
    A = np.geomspace(1e-3, 5e-2, 14)
    random = np.random.default_rng(3)
    noise = random.normal(scale=0.01, size=A.size) + 1j * random.normal(scale=0.01, size=A.size)
    return di.FrequencyResponse(np.ones(A.size), closed_form(A) * np.exp(noise), A)


@pytest.fixture(scope="module")
def fit(data: di.FrequencyResponse) -> di.FitResult:
    return di.fit(data, Elastoplastic())


def test_fit_and_grid_find_the_truth(fit: di.FitResult, data: di.FrequencyResponse) -> None:
    grid = di.posterior(data, Elastoplastic(), method="grid", tolerance=3e-3)
    for result in (fit, grid):
        for name, truth in TRUTH.items():
            estimate = result.params[name]
            assert estimate.stderr is not None
            assert abs(estimate.value - truth) < 4.0 * estimate.stderr
            assert estimate.stderr < 0.03 * truth
        assert np.isfinite(result.predict([1.0], amplitude=[0.01]).gain()[1]).all()
        energy = next(q for q in result.derived([0.02]) if q.name.startswith("energy"))
        exact = 4.0 * TRUTH["f_max"] * (0.02 - TRUTH["f_max"] / TRUTH["stiffness"])
        assert abs(energy.value - exact) < 4.0 * energy.stderr
        assert set(result.budget()) == set(TRUTH)


def test_a_chain_agrees_with_the_fit(fit: di.FitResult) -> None:
    chain = di.posterior(fit, seed=1, steps=120)
    for name in TRUTH:
        one, other = chain.params[name], fit.params[name]
        assert one.stderr is not None
        assert other.stderr is not None
        assert abs(one.value - other.value) < other.stderr


def test_json_and_report(fit: di.FitResult, tmp_path: Path) -> None:
    again = di.FitResult.from_json(fit.to_json())
    assert again.params["f_max"].value == pytest.approx(fit.params["f_max"].value, rel=1e-12)
    page = di.report(fit, tmp_path / "report.json")
    text = json.dumps(json.loads(page.read_text()))
    assert "elastic stiffness" in text or "stiffness" in text
