"""Other laws than the one fitted: which is chosen, by what, and what means the same in all."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import dahl_ident as di
from benchmarks.selection import choices
from dahl_ident import compare_models, fit
from dahl_ident.diagnostics.held_out import predictive_density
from dahl_ident.errors import DataError, FitError
from dahl_ident.fitting import Status
from tests.friction_tables import FRICTION, relative_noise, stated, table
from tests.histories import integrated_force


@pytest.mark.parametrize(
    "law", ["linear Dahl", "two limits", pytest.param("gap", marks=pytest.mark.long)]
)
def test_the_law_that_made_the_data_is_chosen(law):
    assert [right for _, right in choices(law, 1, seed=5, amplitudes=6)] == [True]


def with_third(law, factor=1.0, seed=1):
    """Return fundamentals of Dahl's law, and third harmonics of a law, stated to 1e-5."""
    data = table(seed=seed)
    third = factor * law.dynamic_stiffness(data.amplitude, harmonic=3)
    covariance = [stated(data.response, share) for share in (0.01, 1e-5)]
    return di.FrequencyResponse(
        np.ones(60), np.concatenate([data.response, third]), np.tile(data.amplitude, 2),
        harmonic=np.repeat([1, 3], 30), covariance=np.concatenate(covariance),
    )  # fmt: skip


def test_tiny_covariances_of_harmonics_do_not_rule():
    """A third harmonic that is 5 % off, stated to 1e-5: no difference for tests left out."""
    given = fit(with_third(FRICTION, 1.05), di.Dahl(), throw=False)
    plain, spring = compare_models(given, {"spring": di.Dahl() + di.Spring()}).models
    assert spring.density.gain_over(plain.density)[0] < 10.0


def test_what_means_the_same_whatever_the_law():
    found = compare_models(
        fit(table(noise=1e-3), di.Dahl()),
        {"gap": di.Backlash(di.Dahl(), 1e-6), "spring": di.Spring()},
    )
    first, gap, spring = (model.meaning for model in found.models)
    assert first["force limit"] == pytest.approx(0.1, rel=0.01)
    assert gap["stiffness at zero force"] == pytest.approx(30.0, rel=0.01)
    energies = {float(key.split()[-2]): value for key, value in first.items() if "energy" in key}
    for A, energy in energies.items():
        assert energy == pytest.approx(float(FRICTION.dissipated_energy(A)), rel=0.05)
    assert spring["force limit"] == 0.0
    assert "energy a cycle" in str(found)


def test_the_command_prints_the_comparison(run):
    result = run.line("dahl-ident datasets noisy -o - | dahl-ident fit - --compare")
    assert "No model compared is better" in result.out
    assert "force limit" in result.out


@pytest.mark.long
def test_lugre_is_tried_where_the_force_falls_with_the_frequency():
    A = np.tile(np.geomspace(1e-3, 1.0, 14), 2)
    f = np.repeat([0.1, 1.0], 14)
    rng = np.random.default_rng(3)
    noise = 1.0 + 0.005 * rng.standard_normal((28, 2)) @ [1.0, 1.0j]

    def tried(law):
        N = law.dynamic_stiffness(A, 2.0 * np.pi * f)
        data = di.FrequencyResponse(f, N * noise, A)
        return [m.name for m in compare_models(fit(data, di.Dahl(), throw=False)).models]

    assert "LuGre" in tried(di.LuGre(1.0, 100.0, 1.8, 0.5))

    assert "LuGre" not in tried(di.Dahl(1.0, 100.0) + di.Damper(0.5))


def test_lugre_says_where_sines_cannot_distinguish_it_from_dahl():
    A = np.geomspace(1e-3, 1.0, 12)
    rng = np.random.default_rng(4)
    noise = 1.0 + 0.01 * rng.standard_normal((12, 2)) @ [1.0, 1.0j]
    law = di.LuGre(1.0, 100.0, 1.8, 0.5)

    def sentences(frequency):
        N = law.dynamic_stiffness(A, 2.0 * np.pi * frequency) * noise
        given = fit(di.FrequencyResponse(np.full(12, frequency), N, A), di.Dahl(), throw=False)
        asked = di.LuGre(static_ratio=1.8, stribeck_speed=0.5)
        (_, lugre) = compare_models(given, {"LuGre": asked}).models
        return lugre.resemblances

    (text,) = sentences(100.0)
    assert text.startswith("LuGre: at these levels it differs from linear Dahl with a damper by")
    assert not sentences(0.2)


def test_the_model_that_was_fitted_stands_with_what_it_states():
    result = fit(table(noise=1e-3), di.Dahl() + di.Mass(0.01))
    found = compare_models(result, {"spring": di.Dahl() + di.Spring()})
    f_max = result.params["f_max"]
    assert found.models[0].meaning["force limit"] == pytest.approx(f_max.value, rel=1e-12)
    assert [row[0] for row in found.meanings] == ["as fitted", "spring"]
    assert found.models[0].estimates.startswith(str(f_max))
    assert found.models[0].estimates.endswith(
        str(result.params["alpha"]).removesuffix(" (assumed)")
    )


def test_what_runs_away_is_not_determined():
    """Microslip: any limit of the force would do."""
    data = table(beta=(1e-4, 1e-3), n=8, noise=0.01)
    found = compare_models(fit(data, di.Dahl(), throw=False), {"gap": di.Backlash(di.Dahl())})
    assert {row[1] for row in found.meanings} == {"not determined"}
    assert {row[5] for row in found.rows} == {"-"}


def test_a_damper_is_told_from_another_loop_at_one_frequency():
    """Without a damper among the candidates, Bouc-Wen's law took its place."""
    A = np.geomspace(3e-4, 3e-2, 12)
    truth = di.Dahl(0.1, 30.0, alpha=1.0) + di.PowerDamper(0.02, 0.5)
    exact = truth.dynamic_stiffness(A, np.full(A.size, 2.0 * np.pi))
    data = di.FrequencyResponse(np.ones(A.size), exact * relative_noise(A.size, 0.01, 0), A)
    comparison = compare_models(fit(data, di.Dahl(alpha=1.0), throw=False))
    assert comparison.best.name == "power damper added"
    assert comparison.best.meaning["force limit"] == pytest.approx(0.1, rel=0.03)
    assert "of the fundamental, and how much of that is noise is not known" in comparison.headline


def test_models_whose_parameters_are_open_are_not_recommended():
    """In gross slip one of two elements is as stiff as one likes, however well both predict."""
    A = np.geomspace(0.5, 5.0, 12)
    exact = di.Dahl(0.1, 30.0, alpha=1.0).describing_function(A) * (1.0 + 0.05 * np.sin(9.0 * A))
    data = di.FrequencyResponse(np.ones(A.size), exact, A)
    comparison = compare_models(fit(data, di.Dahl(alpha=1.0), throw=False))
    first, *others = comparison.models
    two = next(m for m in others if m.name == "two Dahl elements")
    better = replace(two.density, tests=two.density.tests + 10.0)
    assert not two.is_determined
    assert replace(comparison, models=(first, replace(two, density=better))).best is first
    sprung = next(m for m in others if m.name == "spring added")
    assert sprung.is_determined
    best = replace(comparison, models=(first, replace(sprung, density=better))).best
    assert best.name == "spring added"


def test_two_jenkins_elements_are_maxwell_slip():
    """Not the law of a free exponent that leaves ten times as much."""
    A = np.geomspace(0.1, 10.0, 12) / 300.0
    exact = di.MaxwellSlip([1e-3, 8e-3], [20.0, 10.0]).describing_function(A)
    data = di.FrequencyResponse(np.ones(12), exact * relative_noise(12, 0.01, 0), A)
    comparison = compare_models(fit(data, di.Dahl()))
    assert "Maxwell slip" in comparison.headline
    assert comparison.best.name in ("Maxwell slip", "as fitted")


T = np.arange(1000) / 100.0
X = 1e-3 * np.sin(3.0 * T) + 7e-3 * np.sin(0.9 * T) * np.sin(0.31 * T)


def loop(x):
    """Return the force of a Bouc-Wen law along a displacement."""
    return integrated_force(lambda F, s: 30.0 - 500.0 * s * F + 200.0 * abs(F), x, steps=4)


def test_the_law_of_a_record_is_recognised():
    noise = 2e-4 * np.random.default_rng(0).standard_normal(T.size)
    force = loop(X) + noise
    record = di.Record(T, displacement=X, force=force)
    laws = {"Bouc-Wen": di.BoucWen(), "Maxwell slip": di.MaxwellSlip(2)}
    comparison = compare_models(fit(record, di.Dahl(alpha=1.0), throw=False), laws)
    first, true, slips = comparison.models
    assert comparison.best is true
    assert true.density.misfit == pytest.approx(2e-4 / np.std(force), rel=0.05)
    for other in (first, slips):
        gain, error = true.density.gain_over(other.density)
        assert gain > 5.0 * error > 0.0
    size = float(np.std(X))
    cycle = size * np.sin(np.linspace(0.0, 8.0 * np.pi, 4001))
    closed = loop(cycle)[-1001:]
    (key,) = (key for key in true.meaning if key.startswith("energy"))
    lost = float(np.trapezoid(closed, cycle[-1001:]))
    assert true.meaning[key] == pytest.approx(lost, rel=0.01)
    assert "of the force" in comparison.headline


def test_the_density_of_a_record_is_that_of_blocks_left_out():
    """A spring, an offset and a drift: linear regression, repeated without each block."""
    rng = np.random.default_rng(2)
    force = 3.0 * X + 1e-3 * rng.standard_normal(T.size)
    found = predictive_density(fit(di.Record(T, displacement=X, force=force), di.Spring()).optimum)
    columns = np.column_stack([X, np.ones(T.size), T])
    y = force / np.std(force)
    left = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
    variance = float(left @ left) / (T.size - 3)
    for rows, density in zip(np.array_split(np.arange(T.size), 20), found.tests, strict=True):
        others = np.delete(columns, rows, axis=0)
        estimate = np.linalg.lstsq(others, np.delete(y, rows), rcond=None)[0]
        own = columns[rows]
        spread = np.eye(rows.size) + own @ np.linalg.inv(others.T @ others) @ own.T
        normal = multivariate_normal(own @ estimate, variance * spread)
        assert density == pytest.approx(normal.logpdf(y[rows]), rel=1e-6)


def test_a_damper_is_added_to_a_law_with_an_exponent():
    data = di.load_dataset("alpha_2")
    data = data.select(rows=np.arange(data.n) % 3 == 0)
    given = fit(data, di.BoucWen(30.0, 300.0, exponent=0.6), throw=False)
    comparison = compare_models(given)
    assert not comparison.failed
    assert "power damper added" in [model.name for model in comparison.models]


def test_a_power_damper_is_found_where_dahl_alone_slips_at_once():
    """Friction small against a damper of exponent 0.47, as of magneto-rheological dampers."""
    rng = np.random.default_rng(2)
    A, f = np.geomspace(5.7e-3, 12.6e-3, 20), np.tile([0.84, 1.0, 1.2, 0.9], 5)
    law = di.Dahl(23.0, 1700.0, alpha=1.0) + di.PowerDamper(380.0, 0.47)
    noise = np.exp(0.01 * (rng.standard_normal(20) + 1j * rng.standard_normal(20)))
    data = di.FrequencyResponse(f, law.dynamic_stiffness(A, 2 * np.pi * f) * noise, amplitude=A)
    compared = compare_models(fit(data, di.Dahl(), throw=False))
    assert compared.best.name == "power damper added"
    values = dict(zip(compared.best.optimum.names, compared.best.optimum.values, strict=True))
    assert values["added_exponent"] == pytest.approx(0.47, abs=0.1)
    assert compared.best.density.misfit < 0.02
    rates = [m for m in compared.models if "Bouc-Wen" in m.name]
    assert all(abs(v) < 1e8 for m in rates for v in m.optimum.values)  # not 1e13 per metre
    again = compare_models(fit(data, di.Dahl() + di.PowerDamper(), throw=False))
    assert again.best is again.models[0]
    assert "share the parameter names exponent" in str(again)


def test_a_fit_that_is_not_physical_and_a_search_that_ended_nowhere():
    A = np.geomspace(1e-3, 1e-1, 12)
    exact = di.Dahl(0.1, 30.0, alpha=30.0).describing_function(A)
    data = di.FrequencyResponse(np.ones(A.size), exact * relative_noise(12, 0.003, 1), A)
    alone = compare_models(fit(data, di.Dahl(alpha=None), throw=False), {})
    assert not alone.best.is_physical  # an exponent of 30
    assert alone.best is alone.models[0]
    optimum = fit(data, di.BoucWen(), throw=False).optimum
    wild = replace(optimum, theta=optimum.problem.to_search([30.0, -1e6, 300.0]))
    with pytest.raises(FitError, match="no finite response"):
        predictive_density(wild)


def test_a_search_that_stopped_is_marked_in_the_comparison():
    data = table(beta=(1e-2, 1e1), n=8, noise=0.01)
    found = compare_models(fit(data, di.Dahl()), {"spring": di.Dahl() + di.Spring()})
    first, spring = found.models
    stopped = replace(spring, optimum=replace(spring.optimum, status=Status.NOT_CONVERGED))
    assert "did not converge" not in str(found)
    assert "the search did not converge" in str(replace(found, models=(first, stopped)))


def test_harmonics_of_tiny_covariance_do_not_spoil_the_fundamental():
    """Fundamentals of Dahl's law, third harmonics of tiny covariance that only a gap explains."""
    data, linear = with_third(di.Backlash(FRICTION, 2e-3), seed=23), di.Dahl(alpha=1)
    comparison = compare_models(fit(data, linear, throw=False), {"gap": di.Backlash(linear)})
    plain, gap = comparison.models
    assert gap.density.misfit < 1.1 * plain.density.misfit
    assert comparison.best is plain


def test_harmonics_without_their_fundamentals_are_refused():
    data = with_third(FRICTION)
    third = data.select(rows=data.harmonic == 3)
    with pytest.raises(DataError, match="the table has rows of harmonic 3 alone; expected"):
        fit(third, di.Dahl())


def test_a_force_that_falls_with_the_speed_asks_for_lugre():
    """From no guess, next to harmonics that say nothing."""
    law, n = di.LuGre(0.1, 350.0, 1.94, 0.01), 4
    A = np.tile(np.repeat(0.1 / 350.0 * np.geomspace(0.1, 10.0, n), 2), 3)
    f, rng, parts = np.tile([1.0, 3.0], 3 * n), np.random.default_rng(3), []
    size = 0.01 * np.abs(law.dynamic_stiffness(A, 2.0 * np.pi * f))
    for order in (1, 2):
        N = law.dynamic_stiffness(A, 2.0 * np.pi * f, harmonic=order)
        N = N + size * (rng.standard_normal((len(A), 2)) @ [1.0, 1.0j])
        noise, which = size[:, None, None] ** 2 * np.eye(2), np.full(len(A), order)
        parts.append(di.FrequencyResponse(f, N, A, harmonic=which, covariance=noise))
    given = fit(di.FrequencyResponse.concatenate(parts), di.Dahl(), throw=False)
    best = compare_models(given).best
    assert best.name == "LuGre"
    assert best.optimum.values[:3] == pytest.approx([0.1, 350.0, 1.94], rel=0.05)
