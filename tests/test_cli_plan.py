"""``dahl-ident plan``: the same numbers as in Python, and files that can be used."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import dahl_ident as di

BENCH = ("--frequency", "5Hz", "--displacement", "0.3:30mm", "--noise", "0.02")
RANGES = ("--ranges", "f_max=90:110mN", "--ranges", "sigma=27:33")


def test_a_plan_from_ranges_is_that_of_python(run):
    outcome = run("plan", *BENCH, *RANGES, "--target", "f_max=0.01", "--alpha", "1", "--json")
    assert outcome.status == 0, outcome.err
    plan = di.plan(
        di.Dahl(alpha=1.0),
        ranges={"f_max": (0.09, 0.11), "sigma": (27.0, 33.0)},
        limits={"frequency_hz": 5.0, "displacement": (3e-4, 3e-2)},
        noise=0.02,
        target={"f_max": 0.01},
    )
    told = json.loads(outcome.out)
    assert told["seconds"] == plan.seconds
    assert told["steps"][0]["level"] == plan.steps[0].level


def test_a_saved_fit_is_continued_and_files_are_written(run):
    table = run("datasets", "noisy", "-o", "-").out
    assert run("fit", "-", "--alpha", "1", "--save", "fit.json", stdin=table).status == 0
    outcome = run(
        "plan", "fit.json", "--frequency", "5", "--displacement", "3e-4:3e-2", "--time", "20",
        "--table", "levels.csv", "--waveform", "exciter.csv", "--sample-rate", "100",
    )  # fmt: skip
    assert outcome.status == 0, outcome.err
    assert outcome.out.startswith("2 levels in 20 s.")
    assert np.loadtxt("exciter.csv", delimiter=",", skiprows=1).shape == (2001, 4)
    assert len(Path("levels.csv").read_text().splitlines()) == 3


def test_motions_in_time_continue_a_fit_of_records(run):
    time = np.arange(800) / 100.0
    x = 5e-3 * np.sin(2.0 * time)
    noise = 2e-3 * np.random.default_rng(0).standard_normal(800)
    record = di.Record(time, displacement=x, force=di.Dahl(0.1, 30.0).force(x) + noise)
    di.fit(record, di.Dahl(alpha=1.0)).save("fit.json")
    outcome = run(
        "plan", "fit.json", "--motion", "trapezoid", "--displacement", "1e-3:2e-2", "--speed",
        "0.05", "--acceleration", "1", "--time", "20", "--sample-rate", "100",
        "--waveform", "exciter.csv",
        "--table", "motions.csv",
    )  # fmt: skip
    assert outcome.status == 0, outcome.err
    assert "motion" in outcome.out.splitlines()[0]
    assert np.loadtxt("exciter.csv", delimiter=",", skiprows=1).shape[1] == 4
    assert (
        Path("motions.csv").read_text().startswith("motion,stroke,speed,acceleration,dwell,period,")
    )


def test_a_target_out_of_reach_ends_with_3(run):
    outcome = run("plan", *BENCH, *RANGES, "--target", "f_max=1e-5", "--time", "20")
    assert outcome.status == 3
    assert "does NOT meet the target" in outcome.out
    assert "the limit of time prevents it" in outcome.err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((*RANGES, "--target", "fmax=0.1"), "f_max, sigma, alpha; did you mean 'f_max'?"),
        (
            ("--ranges", "fmax=0.05:0.2N"),
            "ranges of fmax is '0.05N', but no parameter is called fmax",
        ),
        ((*RANGES, "--force", "1:2:3"), "force is '1:2:3'; expected a number, or low:high"),
        (
            (*RANGES, "--displacement", "10mm:0.1mm"),
            "displacement is '10mm:0.1mm'; expected low:high, the low end below the high",
        ),
        (("--time", "9s"), "nothing is known about f_max, sigma; give --ranges f_max=low:high"),
        ((*RANGES, "--target", "f_max=a"), "f_max is 'a'; expected a number"),
        ((*RANGES, "--target", "f_max=1", "--target", "sigma"), "with and without a number"),
        ((*RANGES, "--waveform", "w.csv"), "--waveform and --motion need --sample-rate"),
        ((*RANGES, "--seed", "-1"), "seed is -1; expected a whole number >= 0"),
        (("nothing.json", "--mass", "1"), "a saved fit has its model and sensors"),
    ],
)
def test_bad_input_says_what_was_expected(run, options, message):
    assert message in run.refused("plan", *BENCH, *options)


def test_time_to_spare_is_for_repeats(run):
    outcome = run("plan", *BENCH, *RANGES, "--alpha", "1", "--target", "f_max=0.01", "--time", "1h")
    first = outcome.out.splitlines()[0]
    seconds = float(first.split()[3])
    assert "meets the target" in first
    left = re.search(r"(\d+) s are left; the whole time would give f_max (\S+) %", outcome.out)
    assert float(left[1]) == pytest.approx(3600.0 - seconds, rel=1e-3)
    assert float(left[2]) < 0.2, "an hour instead of seconds"
    assert "Repeat the plan in 5 runs, each a new mounting" in outcome.out
    short = run("plan", *BENCH, *RANGES, "--alpha", "1", "--target", "f_max=0.01", "--time",
                f"{1.2 * seconds}s")  # fmt: skip
    assert "are left" not in short.out
