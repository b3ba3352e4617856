"""Harmonics that alias, against exact forces sampled too seldom."""

import numpy as np
import pytest

from benchmarks.extraction_validation import FRICTION, covers, steady
from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.extraction import extract


def sampled(per_cycle, beta, noise, cycles=20, phase=0.4):
    rng = np.random.default_rng(5)
    n = int(cycles * per_cycle)
    time: FloatArray = np.arange(n, dtype=np.float64) / per_cycle
    x, force = steady(beta, phase + 2.0 * np.pi * time)
    force = force + noise * rng.standard_normal(n)
    return extract(
        Record(time, displacement=x + beta * noise * rng.standard_normal(n), force=force),
        harmonics=(1,),
        frequency=1.0,
    )


def error_and_std(data, beta):
    exact = FRICTION.describing_function(beta)
    return abs(data.response[0] - exact), float(np.sqrt(np.trace(data.covariance[0])))


@pytest.mark.parametrize("per_cycle", [8, 16, 32, 64])
@pytest.mark.parametrize("beta", [0.3, 3.0, 10.0, 30.0])
def test_the_error_that_repeats_is_stated(per_cycle, beta):
    """Without noise nothing but aliases are left, more or less with the sampling's phase."""
    phases = 0.4 + np.arange(5) * 2.0 * np.pi / per_cycle / 5.0
    both = [error_and_std(sampled(per_cycle, beta, 1e-9, phase=p), beta) for p in phases.tolist()]
    error, std = np.sqrt(np.mean(np.square(both), axis=0))
    assert 0.9 * error < std < 5.0 * error


@pytest.mark.parametrize(("per_cycle", "beta"), [(200.0, 3.0), (31.5, 3.0)])
def test_nothing_is_added_where_nothing_aliases(per_cycle, beta):
    """The bound for white noise, with two channels, is hardly exceeded."""
    noise, cycles = 1e-3, 20
    data = sampled(per_cycle, beta, noise, cycles)
    _, std = error_and_std(data, beta)
    N = abs(FRICTION.describing_function(beta))
    bound = np.sqrt(4.0 / (cycles * per_cycle)) * noise * np.hypot(1.0 / beta, N)
    assert std == pytest.approx(bound, rel=0.35)
    assert covers(data, 0, complex(FRICTION.describing_function(beta)), 0.999)


def test_few_samples_are_reported():
    assert sampled(8, 10.0, 1e-4).quality["verdict"].tolist() == [
        "harmonics alias at 8 samples a cycle"
    ]
    assert sampled(64, 10.0, 1e-4).quality["verdict"].tolist() == ["good"]


@pytest.mark.parametrize(("per_cycle", "reported"), [(2.994, True), (4.0, True), (4.3, False)])
def test_harmonics_that_alias_unseen_are_reported(per_cycle, reported):
    verdict = "harmonics alias at" if reported else "good"
    assert str(sampled(per_cycle, 1.0, 1e-4).quality["verdict"][0]).startswith(verdict)
