"""One contract over every law, from response to report; `tests/test_every_law.py` names the laws.

The stiffness, its derivatives and the description of every law are judged there; here a law is
estimated from data of its own, by every method, and what follows from a fit is made of it.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident import Model
from dahl_ident.elements import Element
from tests.command_line import Runner
from tests.test_every_law import LAWS
from tests.test_response_of_any_law import all_amplitudes

KINDS = sorted(LAWS)
every_kind = pytest.mark.parametrize("kind", KINDS)
_FREE = 2  # of a law's parameters: those that its declaration begins with
_ROWS = {"lugre": 4, "jenkins": 6}  # their loops are integrated, for every row of every step
_NOISE = 0.005


def known(kind: str) -> Element:
    return LAWS[kind][0]


def asked(kind: str) -> Model:
    """Return the law with its first parameters unknown and the others known."""
    law = known(kind)
    changes = {p.name: p.described("free") for p in law.parameters[:_FREE]}
    changes |= {p.name: p.fixed(p.value) for p in law.parameters[_FREE:] if p.value is not None}
    return Model(law).with_parameters(changes)


def data(kind: str) -> di.FrequencyResponse:
    rng = np.random.default_rng(11)
    A = np.geomspace(0.4, 5.0, _ROWS.get(kind, 12))
    e = rng.standard_normal((2, A.size)) * _NOISE
    Z = known(kind).dynamic_stiffness(A, 2.0 * np.pi) * np.exp(e[0] + 1j * e[1])
    return di.FrequencyResponse(np.ones(A.size), Z, A, quantity="dynamic_stiffness")


def best(fit: di.FitResult) -> dict[str, float]:
    """Return the least-squares optimum, by name."""
    return dict(zip(fit.var_names, fit.optimum.values.tolist(), strict=True))


@cache
def fitted(kind: str) -> di.FitResult:
    return di.fit(data(kind), asked(kind))


@every_kind
def test_response_is_what_a_root_search_finds(kind: str) -> None:
    plant = known(kind) + di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3, name="base")
    found = di.response(plant, 0.4, 1.1, all_roots=True, steady="describing function")
    expected = all_amplitudes(plant, 0.4, 1.1)
    np.testing.assert_allclose(np.ravel(found.amplitude), expected, rtol=1e-7)


@every_kind
def test_least_squares_finds_the_truth_and_knows_it(kind: str) -> None:
    fit = fitted(kind)
    assert fit.success
    for parameter in known(kind).parameters[:_FREE]:
        error = fit.stderr_noise[parameter.name]
        assert parameter.value is not None
        assert abs(best(fit)[parameter.name] - parameter.value) < 4.5 * error
        assert error < 0.2 * parameter.value
    assert fit.identifiability.complete
    assert set(fit.budget()) == set(fit.var_names)


@every_kind
def test_ipopt_and_grid_agree_with_it(kind: str) -> None:
    fit = fitted(kind)
    other = di.fit(fit.data, asked(kind), method="ipopt")
    assert other.optimum.values == pytest.approx(fit.optimum.values, rel=1e-4)
    grid = di.posterior(fit.data, asked(kind), method="grid", tolerance=1e-2, uncertainty="noise")
    for name in fit.var_names:
        assert abs(grid.params[name].value - best(fit)[name]) < 1.5 * fit.stderr_noise[name]


@every_kind
def test_file_report_and_command_line_know_it(kind: str, tmp_path: Path, run: Runner) -> None:
    fit, file = fitted(kind), tmp_path / "fit.json"
    file.write_text(fit.to_json())
    assert di.FitResult.load(file).optimum.values == pytest.approx(fit.optimum.values)
    facts = json.loads(di.report(fit, tmp_path / "page.json").read_text())
    assert facts["trusted"] == fit.trusted
    run("report", str(file), "-o", str(tmp_path / "page.md"))
    text = (tmp_path / "page.md").read_text().replace("\\", "")
    assert all(name in text for name in fit.var_names)
