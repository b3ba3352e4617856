"""Populations of devices: mean, scatter and slope, devices that stand out, control charts."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from dahl_ident import population
from dahl_ident.errors import DahlIdentError, DataError, ValidationError


def simulated(seed, devices, runs, **truth):
    rng = np.random.default_rng(seed)
    t = rng.uniform(-1.0, 1.0, devices)
    level = np.log(0.1) + truth["slope"] * t + rng.normal(0.0, truth["tau"], devices)
    y = np.repeat(level, runs) + rng.normal(0.0, truth["omega"], devices * runs)
    y = y + rng.normal(0.0, truth["u"], y.size)
    names = [f"d{i:03}" for i in range(devices)]
    table = pd.DataFrame(
        {
            "device": np.repeat(names, runs), "status": "trusted", "unit_f_max": "N",
            "f_max": np.exp(y), "u_f_max": truth["u"] * np.exp(y), "t": np.repeat(t, runs),
            "at": np.arange(y.size),
        }
    )  # fmt: skip
    return table, (level, np.log(0.1) + truth["slope"] * t.mean())


def test_population_covers_mean_scatter_and_slope_and_shrinks_errors():
    truth = {"slope": 0.1, "tau": 0.05, "omega": 0.0, "u": 0.04}
    sets, hits, errors = 30, np.zeros(3), np.zeros(2)
    for seed in range(sets):
        table, (level, mean) = simulated(seed, 15, 1, **truth)
        found = population(table, covariates=["t"])["f_max"]
        value, u = found.coefficients["mean"]
        slope, u_slope = found.coefficients["t"]
        _, low, high = found.between_devices
        hits += [abs(value - mean) < 2 * u, abs(slope - 0.1) < 2 * u_slope, low < 0.05 < high]
        errors += [
            np.sum((np.log(found.devices[c].to_numpy()) - level) ** 2) for c in ("shrunken", "own")
        ]
    # 95.45 % of 30: fewer than 25 once in 400
    assert (hits >= 25).all(), hits
    assert errors[0] < 0.85 * errors[1]


def test_scatter_between_runs_is_distinguished_from_that_between_devices():
    table, _ = simulated(3, 40, 4, slope=0.0, tau=0.05, omega=0.02, u=0.005)
    found = population(table)["f_max"]
    assert found.between_devices[1] < 0.05 < found.between_devices[2]
    assert found.between_runs[1] < 0.02 < found.between_runs[2]
    assert found.between_runs[2] < 0.03


def test_outlying_devices_are_found_and_false_alarms_are_rare():
    alarms = 0
    for seed in range(30):
        table, _ = simulated(seed, 12, 1, slope=0.0, tau=0.03, omega=0.0, u=0.01)
        alarms += bool(population(table)["f_max"].outlying)
    assert alarms <= 2  # 1 % of 30: more than 2 once in 300
    table, _ = simulated(7, 30, 1, slope=0.0, tau=0.03, omega=0.0, u=0.01)
    table.loc[[4, 9], "f_max"] *= [1.4, 0.7]
    assert population(table)["f_max"].outlying == ("d004", "d009")
    told = str(population(table)["f_max"])
    assert told.startswith("f_max: mean ")
    assert told.endswith("outside the population: d004, d009, not in these numbers")


def test_control_charts_alarm_at_a_drift_and_seldom_without():
    alarms = caught = 0
    for seed in range(20):
        table, _ = simulated(seed, 60, 1, slope=0.0, tau=0.02, omega=0.0, u=0.005)
        alarms += len(population(table, order="at")["f_max"].out_of_control)
        table.loc[50:, "f_max"] *= 1.05  # for 10 fits, two and a half standard deviations
        caught += any(i >= 50 for i in population(table, order="at")["f_max"].out_of_control)
    # limits from moving ranges of 60 fits and two charts: about 1 alarm in 120
    assert alarms <= 18
    assert caught >= 18


def test_a_moving_range_chart_by_hand():
    table, _ = simulated(1, 3, 1, slope=0.0, tau=0.02, omega=0.0, u=0.005)
    table["f_max"] = np.exp([1.0, 1.2, 0.9])
    fits = population(table, order="at")["f_max"].fits
    sigma = 0.5 * (0.2 + 0.3) / 1.128379
    assert fits["limit"].iloc[0] == pytest.approx(3.0 * sigma, rel=1e-6)
    mean = 3.1 / 3.0
    first = mean + 0.2 * (1.0 - mean)
    assert fits["ewma"].tolist()[:2] == pytest.approx([first, first + 0.2 * (1.2 - first)])
    assert fits["ewma_limit"].iloc[0] == pytest.approx(2.86 * sigma * 0.2)


def test_scatter_between_devices_is_no_alarm_where_devices_have_several_fits():
    alarms = 0
    for seed in range(4):
        table, _ = simulated(seed, 20, 5, slope=0.0, tau=0.05, omega=0.01, u=0.005)
        alarms += len(population(table, order="at")["f_max"].out_of_control)
    assert alarms <= 4  # of 400 fits on two charts; limits of three standard deviations
    table.loc[[37], "f_max"] *= 1.08
    assert 37 in population(table, order="at")["f_max"].out_of_control


def test_a_device_with_one_fit_is_not_compared_with_others_that_have_several():
    table, _ = simulated(1, 8, 3, slope=0.0, tau=0.05, omega=0.01, u=0.005)
    fits = population(table.drop(index=[0, 1]), order="at")["f_max"].fits
    assert np.flatnonzero(fits["value"].isna()).tolist() == [0]
    assert np.isfinite(fits["ewma"][1:]).all()


def test_outlying_devices_take_no_part_in_mean_scatter_and_limits():
    table, _ = simulated(7, 15, 1, slope=0.0, tau=0.03, omega=0.0, u=0.005)
    clean = population(table.drop(index=4), order="at")["f_max"]
    table.loc[[4], "f_max"] *= 1.4
    table.loc[[4], "u_f_max"] *= 1.4
    whole = population(table, order="at")["f_max"]
    assert whole.outlying == ("d004",)
    assert whole.mean == pytest.approx(clean.mean)
    assert whole.between_devices == pytest.approx(clean.between_devices)
    assert whole.devices.loc["d004", "shrunken"] == pytest.approx(table["f_max"][4])
    assert whole.fits["centre"].iloc[0] == pytest.approx(clean.fits["centre"].iloc[0])
    assert 4 in whole.out_of_control


def test_charts_show_time_only_where_an_order_is_stated():
    table, _ = simulated(2, 10, 1, slope=0.0, tau=0.05, omega=0.0, u=0.01)
    assert "ewma" not in population(table)["f_max"].fits
    shuffled = table.sample(frac=1.0, random_state=0)
    pd.testing.assert_frame_equal(
        population(shuffled, order="at")["f_max"].fits, population(table, order="at")["f_max"].fits
    )


def test_few_devices_are_said_to_be_few():
    """The posterior falls as tau^-freedom: tau^2 has a mean from 4 degrees of freedom on."""
    table, _ = simulated(1, 6, 1, slope=0.1, tau=0.05, omega=0.0, u=0.01)
    said = "4 devices are few for a mean, 1 slope and a scatter, whose uncertainties have heavy "
    few = population(table[:4], covariates=["t"])
    assert said in str(few["f_max"])
    assert str(few).count(f"{said}tails: measure at least 6") == 1
    assert "4 devices are few for a mean and a scatter" in str(population(table[:4])["f_max"])
    assert "few" not in str(population(table, covariates=["t"])["f_max"])
    with pytest.raises(DataError, match=r"3 devices .* with 1 covariate needs at least 4"):
        population(table[:3], covariates=["t"])


def test_wrong_tables_are_named():
    table, _ = simulated(0, 5, 1, slope=0.0, tau=0.02, omega=0.0, u=0.01)
    cases: list[tuple[pd.DataFrame, dict[str, Any], type[DahlIdentError], str]] = [
        (table.drop(columns="u_f_max"), {}, DataError, "no parameter with an uncertainty"),
        (table.drop(columns="device"), {}, DataError, "no column device"),
        (table, {"covariates": ["heat"]}, DataError, "no column heat"),
        (table.assign(t=1.0), {"covariates": ["t"]}, ValidationError, "constant"),
        (table.assign(status="failed"), {}, DataError, "0 devices have usable"),
        (table.assign(u_f_max=0.0), {}, DataError, "not above zero"),
        (table.assign(f_max=np.nan), {}, DataError, "expected a number"),
    ]
    for frame, how, error, message in cases:
        with pytest.raises(error, match=message):
            population(frame, **how)
