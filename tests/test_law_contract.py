"""One contract over every law, from response to report; `tests/test_every_law.py` names the laws.

The stiffness, its derivatives and the description of every law are judged there; here a law is
estimated from data of its own, by every method, and what follows from a fit is made of it.
"""

import json
from functools import cache

import numpy as np
import pytest
from scipy.optimize import brentq

import dahl_ident as di
from dahl_ident import Model
from tests.test_every_law import LAWS

KINDS = sorted(LAWS)
every_kind = pytest.mark.parametrize("kind", KINDS)
_FREE = 2  # of a law's parameters: those that its declaration begins with
_ROWS = {"lugre": 4, "jenkins": 6}  # their loops are integrated, for every row of every step
_NOISE = 0.005


def known(kind):
    return LAWS[kind][0]


def asked(kind):
    """Return the law with its first parameters unknown and the others known."""
    law = known(kind)
    changes = {p.name: p.described("free") for p in law.parameters[:_FREE]}
    changes |= {p.name: p.fixed(p.value) for p in law.parameters[_FREE:] if p.value is not None}
    return Model(law).with_parameters(changes)


def data(kind):
    rng = np.random.default_rng(11)
    A = np.geomspace(0.4, 5.0, _ROWS.get(kind, 12))
    e = rng.standard_normal((2, A.size)) * _NOISE
    Z = known(kind).dynamic_stiffness(A, 2.0 * np.pi) * np.exp(e[0] + 1j * e[1])
    return di.FrequencyResponse(np.ones(A.size), Z, A, quantity="dynamic_stiffness")


def best(fit):
    """Return the least-squares optimum, by name."""
    return dict(zip(fit.var_names, fit.optimum.values.tolist(), strict=True))


@cache
def fitted(kind):
    return di.fit(data(kind), asked(kind))


def all_amplitudes(plant, frequency_hz, drive):
    """Return every amplitude at which the plant needs the drive, by a bracketing root search."""
    omega = 2.0 * np.pi * frequency_hz
    A = np.geomspace(1e-9, 1e3, 2000)
    excess = np.abs(A * plant.dynamic_stiffness(A, omega)) - drive
    crossings = np.flatnonzero(excess[1:] * excess[:-1] < 0.0)
    return [
        brentq(
            lambda a: abs(a * complex(plant.dynamic_stiffness(a, omega))) - drive,
            A[i], A[i + 1], rtol=1e-13, xtol=1e-300,
        )
        for i in crossings
    ]  # fmt: skip


@pytest.mark.parametrize(("frequency_hz", "drive"), [(0.4, 1.1), (0.0, 0.05), (1.5, 3.0)])
@every_kind
def test_response_is_what_a_root_search_finds(kind, frequency_hz, drive):
    plant = known(kind) + di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3, name="base")
    response = di.response(plant, frequency_hz, drive, all_roots=True, steady="describing function")
    expected = all_amplitudes(plant, frequency_hz, drive)
    assert len(expected) == int(response.number_of_solutions)
    np.testing.assert_allclose(np.ravel(response.amplitude), expected, rtol=1e-7)


@every_kind
def test_least_squares_finds_the_truth_and_knows_it(kind):
    fit = fitted(kind)
    assert fit.success
    for parameter in known(kind).parameters[:_FREE]:
        error = fit.stderr_noise[parameter.name]
        assert abs(best(fit)[parameter.name] - parameter.value) < 4.5 * error
        assert error < 0.2 * parameter.value
    assert fit.identifiability.complete
    assert set(fit.budget()) == set(fit.var_names)
    assert np.isfinite(fit.predict([1.0], amplitude=[1.0]).gain()[1]).all()
    again = di.FitResult.from_json(fit.to_json())
    assert again.optimum.values == pytest.approx(fit.optimum.values)


@pytest.mark.parametrize("kind", ["maxwell_slip", "jenkins"])  # a closed form; integrated
def test_ipopt_and_grid_agree_with_it(kind):
    fit = fitted(kind)
    other = di.fit(fit.data, asked(kind), method="ipopt")
    assert other.optimum.values == pytest.approx(fit.optimum.values, rel=1e-4)
    grid = di.posterior(fit.data, asked(kind), method="grid", tolerance=1e-2, uncertainty="noise")
    for name in fit.var_names:
        assert abs(grid.params[name].value - best(fit)[name]) < 1.5 * fit.stderr_noise[name]


def test_a_chain_agrees_with_the_fit_and_its_energy_with_the_closed_form():
    fit = fitted("jenkins")
    chain = di.posterior(fit, seed=1, steps=60)
    for name in fit.var_names:
        error = fit.params[name].stderr
        assert error is not None
        assert abs(chain.params[name].value - fit.params[name].value) < error
    for result in (fit, chain):
        energy = next(q for q in result.derived([2.0]) if q.name.startswith("energy"))
        assert abs(energy.value - 4.0 * 3.0 * 0.3 * (2.0 - 0.3)) < 4.0 * energy.stderr


def test_file_report_and_command_line_know_it(tmp_path, run):
    fit, file = fitted("jenkins"), tmp_path / "fit.json"
    file.write_text(fit.to_json())
    facts = json.loads(di.report(fit, tmp_path / "page.json").read_text())
    assert facts["trusted"] == fit.trusted
    run("report", str(file), "-o", str(tmp_path / "page.md"))
    text = (tmp_path / "page.md").read_text().replace("\\", "")
    assert all(name in text for name in fit.var_names)
