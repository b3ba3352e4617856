"""The command in a report repeats its result: it is run, and the numbers are compared."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import dahl_ident as di

SETS = Path(__file__).parents[1] / "datasets" / "synthetic"
A = np.geomspace(3e-4, 3e-2, 12)
NOISE = 0.01 * np.random.default_rng(3).standard_normal((2, 12))


def table(friction):
    response = friction.describing_function(A) * np.exp(NOISE[0] + 1j * NOISE[1])
    return di.FrequencyResponse(np.full(12, 2.0), response, A)


def shipped(name):
    return di.load_dataset(name)


def command_of(result):
    """Return the command that a report prints."""
    place = di.report(result, "command.json", overwrite=True)
    command: str | None = json.loads(place.read_text(encoding="utf-8"))["command"]
    return command


def check_repeated(run, fit):
    command = command_of(fit)
    told: dict[str, Any] = json.loads(run.line(command, "--json").out)["params"]
    assert set(told) == set(fit.params)
    for name, estimate in fit.params.items():
        assert told[name]["vary"] == estimate.vary
        assert told[name]["value"] == pytest.approx(estimate.value, rel=1e-7)
        if estimate.stderr is not None:
            assert told[name]["stderr"] == pytest.approx(estimate.stderr, rel=1e-5)
    return command


def test_of_files_with_options(run):
    text = "frequency_hz,gain [N/m],phase_deg\n"
    for level in ("my 1.csv", "2.csv"):
        rows = table(di.Dahl(0.1, 30.0))
        half = rows.select(rows=(np.arange(12) < 6) == (level == "2.csv"))
        text_rows = [
            f"{f},{g},{p}" for f, g, p in zip(half.frequency_hz, half.gain, np.degrees(half.phase),
                                              strict=True)
        ]  # fmt: skip
        Path(level).write_text(text + "\n".join(text_rows) + "\n", encoding="utf-8")
    data = di.read_frequency_response(["my 1.csv", "2.csv"], amplitude="2 mm rms")
    fit = di.fit(data, di.Dahl() + di.Spring(0.5), noise="absolute", throw=False)
    command = check_repeated(run, fit)
    assert "'my 1.csv' 2.csv --amplitude '2 mm rms'" in command


def test_of_sensors_priors_and_solver(run):
    table(di.Dahl(0.1, 30.0, 1.3)).save("t.csv")
    sensors = di.Sensors(force_gain=stats.norm(1.0, scale=0.02), delay=-1e-3)
    fit = di.fit(
        di.read_frequency_response("t.csv"), di.Dahl(), free=["alpha"], sensors=sensors,
        loss="huber", throw=False,
    )  # fmt: skip
    command = check_repeated(run, fit)
    assert "--force-gain 'norm(1.0, scale=0.02)'" in command
    fit = di.fit(di.read_frequency_response("t.csv"), di.Dahl(alpha=1.3), method="ipopt")
    assert "--alpha 1.3 --noise relative --method ipopt" in check_repeated(run, fit)


def test_of_a_shipped_table(run):
    command = check_repeated(run, di.fit(shipped("noisy"), di.Dahl()))
    assert command.startswith("dahl-ident datasets noisy -o - | dahl-ident fit - ")


@pytest.mark.parametrize(
    ("model", "told"),
    [
        (di.Dahl(name="pivot"), "--element 'dahl(name=pivot)'"),
        (di.BoucWen(q=300.0), "--element 'bouc_wen(q=300.0)'"),
        (di.Dahl(alpha=None, asymmetry=0.1) + di.Mass(), "'dahl(alpha=free, asymmetry=0.1)'"),
    ],
)
def test_of_any_law(run, model, told):
    fit = di.fit(shipped("noisy"), model, throw=False)
    assert told in check_repeated(run, fit)


def test_of_waveforms(run):
    record = di.read_record(SETS / "plant_recording.csv.gz")
    data = di.extract(record, controlled="force", harmonics=[1], num_periods=8)
    data = data.select(rows=data.quality["verdict"] == "good")
    plant = di.Dahl() + di.Mass() + di.Damper() + di.Spring()
    command = check_repeated(run, di.fit(data, plant, throw=False))
    assert "--num-periods 8" in command


def test_of_a_posterior(run):
    table(di.Dahl(0.1, 30.0)).save("t.csv")
    data = di.read_frequency_response("t.csv")
    priors: dict[str, Any] = {"f_max": stats.lognorm(s=0.5, scale=0.1), "sigma": (1.0, 100.0)}
    posterior = di.posterior(data, di.Dahl(alpha=1.0), priors=priors, seed=4, steps=80)
    command = command_of(posterior)
    told = json.loads(run.line(command, "--json").out)
    assert told["summary"]["sigma"]["mean"] == posterior.summary().loc["sigma", "mean"]


def test_of_what_the_command_line_wrote(run):
    table(di.Dahl(0.1, 30.0)).save("t.csv")
    run("report", "t.csv", "--stiffness", "free", "-o", "r.html", "-o", "one.json")
    page = Path("r.html").read_text(encoding="utf-8")
    found = re.search(r"<pre tabindex=\"0\">(dahl-ident [^<]*)</pre>", page)
    first = Path("one.json").read_bytes()
    run.line(found[1], "--overwrite")
    one, two = (json.loads(text)["fits"] for text in (first, Path("one.json").read_bytes()))
    assert one == two


def test_what_no_command_describes_is_said_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = table(di.Dahl(0.1, 30.0))
    fit = di.fit(data, di.Dahl())
    assert command_of(fit) is None, "these data come from no file"
    gap = di.fit(shipped("noisy"), di.Backlash(di.Dahl()), throw=False)
    assert command_of(gap) is None, "--element takes no element within another"
    text = di.report(fit, tmp_path / "r.md").read_text(encoding="utf-8")
    assert "in Python; no command describes this model and these data" in text


def test_of_an_exponent_that_was_given(run):
    table(di.Dahl(0.1, 30.0)).save("t.csv")
    data = di.read_frequency_response("t.csv")
    for model, option in ((di.Dahl(), False), (di.Dahl(alpha=1.0), True)):
        found = command_of(di.fit(data, model))
        assert ("--alpha 1.0" in found) is option
    alone = di.posterior(data, di.Dahl(), seed=4, steps=60, uncertainty="noise")
    assert "--uncertainty noise" in (command_of(alone) or "")
