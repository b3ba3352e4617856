"""Measured hysteresis loops of a rotary friction damper; three steady cycles in each file."""

import numpy as np
import pytest

from dahl_ident.extraction import extract
from dahl_ident.extraction.sine_fit import sine_fit, steady_segment
from tests.measured import cranks, dampers, needs_measured

pytestmark = needs_measured
STEADY_MM = {"0.5in": 12.8, "1in": 25.5, "1.5in": 38.3}
DISTORTED = "1Hz_1.5in"
FILES = [*(f"{f}Hz_{a}in" for f in ("0.25", "0.5", "1") for a in ("0.5", "1", "1.5")), "2Hz_0.5in"]


def level(samples, per_cycle):
    """Return samples without the straight line through the means of their cycles."""
    means = [c.mean() for c in np.split(samples, np.arange(per_cycle, samples.size, per_cycle))]
    slope = np.polyfit(np.arange(len(means) - 1), means[:-1], 1)[0] / per_cycle
    return np.asarray(samples - slope * np.arange(samples.size))


def cycle_by_cycle(record, data, row):
    """Return amplitude and F_k/X_1, k = 0 ... 3, of each cycle, by a least-squares fit for each."""
    start, stop = (data.quality[name][row] for name in ("start_time", "end_time"))
    used = (record.time > start - 1e-9) & (record.time < stop + 1e-9)
    time = record.time[used] - start
    period = 1.0 / data.frequency_hz[row]
    per_cycle = round(period / float(np.diff(time).mean()))
    both = [level(s[used], per_cycle) for s in (record.motion_samples, record.force_samples)]
    amplitude, response = [], []
    for i in range(round(time[-1] / period)):
        cycle = (time >= i * period) & (time < (i + 1) * period)
        theta = 2.0 * np.pi * time[cycle] / period * np.arange(1, 8)[:, None]
        columns = np.vstack([np.ones(theta.shape[1]), np.cos(theta), np.sin(theta)])
        c = np.linalg.lstsq(columns.T, np.array(both)[:, cycle].T, rcond=None)[0]
        X, F = np.vstack([c[:1], c[1:8] - 1j * c[8:]]).T
        amplitude.append(abs(X[1]))
        response.append([F[k] * (abs(X[1]) / X[1]) ** k / abs(X[1]) for k in range(4)])
    return np.array(amplitude), np.array(response)


def loop_area(x, force):
    """Return the area inside closed loops, by the shoelace formula."""
    return float(0.5 * np.sum(force * (np.roll(x, -1) - np.roll(x, 1))))


@pytest.mark.parametrize("name", FILES)
def test_every_file_gives_its_amplitude_and_loop_area(name):
    (record,) = dampers(name)
    every = extract(record, harmonics=range(10))
    assert every.harmonic.tolist() == list(range(10))
    data = every.select(harmonic=1)
    quality = data.quality
    nominal_hz, level = name.split("Hz_")
    assert data.frequency_hz[0] == pytest.approx(float(nominal_hz), rel=2e-3)
    steady_mm = 31.5 if name == DISTORTED else STEADY_MM[level]
    assert 1e3 * data.amplitude[0] == pytest.approx(steady_mm, rel=0.01)
    assert quality["num_periods"][0] == 3

    used = slice(
        *np.searchsorted(
            record.time, [quality["start_time"][0] - 1e-9, quality["end_time"][0] + 1e-9]
        )
    )
    both = np.stack([record.motion_samples[used], record.force_samples[used]])
    segment = steady_segment(record.time[used], both, float(data.omega[0]))
    fit = sine_fit(segment)
    by_harmonics = sum(
        np.pi * k * (fit.phasors(k)[1] * fit.phasors(k)[0].conj()).imag for k in range(1, 10)
    )
    area = loop_area(*both) / (quality["num_periods"][0] - quality["settling_periods"][0])
    assert by_harmonics == pytest.approx(area, rel=0.01)

    fundamental = np.pi * data.amplitude[0] ** 2 * data.response[0].imag
    distortion = quality["displacement_distortion"][0]
    if name == DISTORTED:
        assert distortion == pytest.approx(0.11, abs=0.01)
        assert set(quality["verdict"]) == {"displacement distorted 11 %"}
    else:
        assert distortion < 0.02
        assert fundamental == pytest.approx(area, rel=0.02)


def test_covariance_is_said_to_be_spectral_and_is_small():
    data = extract(*dampers("0.25Hz_1in"), harmonics=[1, 3, 5])
    assert set(data.quality["covariance_from"]) == {"spectrum"}
    std = np.sqrt(0.5 * np.trace(data.covariance[0]))
    assert 1e-4 < std / abs(data.response[0]) < 0.02
    assert (data.quality["displacement_steps"] > 1000).all()


def test_asymmetry_beyond_noise_adds_rows_and_is_said():
    with pytest.warns(UserWarning, match=r"the force is asymmetric in 1 of 1 points: even har"):
        data = extract(*dampers("1Hz_1in"))
    assert data.harmonic.tolist() == list(range(10))
    assert 0.05 < data.quality["asymmetry"][0] < 0.15


@pytest.mark.parametrize(
    ("names", "points"), [(("2.1", "8.1"), 5), (("1.1", "10.1"), 3), ((".A.1", ".A.2", ".A.6"), 4)]
)
def test_an_unsteady_crank_gives_points_with_the_scatter_of_its_cycles(names, points):
    """The first two files have no plateau within 2 %; all agree with a fit of every cycle.

    Other harmonics state in addition what the displacement's own harmonics add.
    """
    ratios, by_distortion, found = [], [], 0
    for name in names:
        (record,) = cranks(name)
        data = extract(record, harmonics=range(4))
        for row in np.flatnonzero(data.harmonic == 1).tolist():
            found += 1
            amplitude, response = cycle_by_cycle(record, data, row)
            assert amplitude.mean() == pytest.approx(data.amplitude[row], rel=3e-3)
            scatter = response - response.mean(axis=0)
            for k in (1, 2, 3):
                at = row - 1 + k
                stated = np.sqrt(np.trace(data.covariance[at]))
                assert abs(response[:, k].mean() - data.response[at]) < stated
                by_cycles = np.sum(np.abs(scatter[:, k]) ** 2) / scatter[:, k].size
                if k == 1:
                    ratios.append(np.sqrt(by_cycles / (scatter[:, k].size - 1)) / stated)
                else:
                    added = data.quality["displacement_distortion"][row] * data.gain[row]
                    by_distortion.append(stated / added)
    assert found == points
    assert 0.6 < np.median(ratios) < 1.5
    np.testing.assert_allclose(by_distortion, 1.0, atol=0.1)


def test_every_file_of_the_crank_gives_points_that_cover_most_of_its_motion():
    records = [record for series in ("[0-9]*.1", ".A.*", ".vali.*") for record in cranks(series)]
    assert len(records) == 29
    for record in records:
        data = extract(record, harmonics=[1])
        assert np.sum(data.quality["num_periods"] / data.frequency_hz) > 0.5 * 12.0
