"""Records of any motion on the command line: what is read, refused and printed."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import dahl_ident as di
from benchmarks.motion_oracles import DahlByHand, dahl_history
from dahl_ident.errors import DataError
from tests.test_record_fit import DAHL, recorded

MAP = """
[time]
column = "t"
unit = "s"
[displacement]
column = "x"
unit = "mm"
[force]
column = "load"
unit = "kN"
"""


@pytest.fixture
def odd_columns(tmp_path):
    """Return a file that only a column map explains: two motions, units of its own."""
    record = recorded(DAHL, "random", 300, 1e-3)
    x, force = np.asarray(record.displacement), record.force_samples
    rows = np.column_stack([record.time, 1e3 * x, 1e-3 * force, np.gradient(x, record.time)])
    place = tmp_path / "run.csv"
    np.savetxt(place, rows, delimiter=",", header="t,x,load,velocity [m/s]", comments="")
    (tmp_path / "columns.toml").write_text(MAP)
    return place


@pytest.fixture
def mapped(odd_columns):
    """Return the words that read that file."""
    return (odd_columns, "--record", "--columns", odd_columns.with_name("columns.toml"))


def test_a_column_map_is_used(odd_columns, mapped, run):
    assert "Name it with --force ..." in run.refused("fit", odd_columns, "--record")
    done = run("fit", *mapped)
    assert done.status == 0
    assert "f_max" in done.out
    (line,) = (line for line in done.out.splitlines() if line.split()[:1] == ["sigma"])
    assert float(line.split()[1]) == pytest.approx(30.0, rel=0.01)
    assert "Uncertainty budget" not in done.out
    out = run("fit", *mapped, "-v").out
    assert "Uncertainty budget" in out
    assert "offset" in out


def test_waveforms_need_no_option(tmp_path, run):
    for seed in (1, 2):
        recorded(DAHL, "random", 600, 1e-3, seed).save(tmp_path / f"sweep{seed}.csv")
    pattern = tmp_path / "sweep*.csv"
    done = run("fit", pattern)
    assert done.status == 0
    assert "the files hold waveforms: fitted sample by sample, as with --record" in done.err
    assert done.out == run("fit", pattern, "--record").out
    refused = run.refused("fit", "-", stdin=(tmp_path / "sweep1.csv").read_text())
    assert "fitted as a record: dahl-ident fit --record" in refused


def test_a_fast_sweep_is_told_how_to_be_fitted(tmp_path, run):
    t = np.arange(12_000) / 1000.0
    x = 0.02 * np.exp(-t / 6.0) * np.sin(2.0 * np.pi * 5.0 * t)
    path = di.Record(t, displacement=x, force=DAHL.force(x)).save(tmp_path / "a run.csv")
    done = run("extract", path, "--time", "time [s]")
    assert done.status == 3
    assert "biased by about" in " ".join(done.out.split())
    assert f"dahl-ident fit --record '{path}' --time 'time [s]'" in done.err


@pytest.mark.parametrize("command", ["fit", "sample"])
@pytest.mark.parametrize("words", [("--level", "1"), ("--noise", "relative")])
def test_options_of_tables_are_refused(command, words, mapped, run):
    refused = run.refused(command, *mapped, *words)
    assert re.search(rf"{words[0]} (is )?given (together )?with .*record", refused)


def test_a_gain_without_a_prior_about_one_is_refused(mapped, run):
    refused = run.refused("fit", *mapped, "--force-gain", "norm(1.1,0.1)")
    assert "--force-gain is a prior about 1.1;" in refused
    assert "such as 'norm(1, 0.005)', which" in refused


def test_the_force_is_predicted_although_the_model_has_a_mass(odd_columns, mapped, run):
    told = run("fit", *mapped, "--mass", "free", "--predicted", "force").out
    assert "of the measured force" in told
    refused = run("fit", odd_columns, "--predicted", "force")
    assert (refused.status, "--record" in refused.err) == (1, True)


def test_reports_and_posteriors_read_and_predict_as_fits_do(mapped, run):
    mapped = (mapped[0], "--record", "--displacement", "x [mm]", "--force", "load [kN]",
              "--time", "t [s]", "--mass", "free", "--predicted", "force")  # fmt: skip
    fitted = json.loads(run("fit", *mapped, "--json").out)["params"]["sigma"]
    run("report", *mapped, "-o", "page.json")
    (reported,) = json.loads(Path("page.json").read_text("utf-8"))["record_fits"]
    assert reported["parameters"]["sigma"]["value"] == pytest.approx(fitted["value"])
    sampled = json.loads(run("sample", *mapped, "--method", "grid", "--json").out)["summary"]
    assert sampled["sigma"]["mean"] == pytest.approx(fitted["value"], abs=fitted["stderr"])


@pytest.mark.parametrize("words", [("--loss", "huber"), ("--method", "scipy")])
def test_losses_and_methods_are_taken_with_records(words, mapped, run):
    base = ("fit", *mapped, "--json")
    plain, other = (json.loads(run(*base, *more).out)["params"] for more in ((), words))
    for name in ("f_max", "sigma"):
        assert other[name]["value"] == pytest.approx(plain[name]["value"], rel=0.01)


def test_models_of_records_are_compared(mapped, run):
    out = run("fit", *mapped, "--compare").out
    assert "No model compared is better" in out
    assert "of the force left" in out


def test_a_waveform_of_a_plan_is_no_record(tmp_path):
    limits = {"displacement": (1e-4, 3e-2), "frequency_hz": 5.0, "time": 60.0}
    plan = di.plan(
        di.Dahl(alpha=1.0),
        ranges={"f_max": (0.05, 0.2), "sigma": (15.0, 60.0)},
        limits=limits,
        noise=0.02,
    )
    place = plan.write_waveform(tmp_path / "wave.csv", 1000.0)
    with pytest.raises(DataError, match="holds no measured force"):
        di.read_record(place)


def test_two_days_of_waveforms_are_compared(run):
    """Parameters of the device change, not the first force, offset and drift of a record."""
    time = np.arange(600) / 100.0
    x = 5e-3 * np.sin(2.0 * time) * (0.2 + 0.8 * np.sin(0.6 * time) ** 2)
    for day, f_max in (("monday", 0.10), ("friday", 0.12)):
        noise = 5e-4 * np.random.default_rng(int(1000 * f_max)).standard_normal(600)
        table = np.c_[time, x, dahl_history(DahlByHand(f_max, 30.0), x) + noise]
        np.savetxt(f"{day}.csv", table, delimiter=",", comments="",
                   header="time [s],displacement [m],force [N]")  # fmt: skip
        run("fit", f"{day}.csv", "--record", "--alpha", "1", "--save", f"{day}.json")
    told = run("fit", "monday.json", "friday.json", "--report", "r.html")
    assert told.status in (0, 3), told.err
    changes = {
        line.split()[0]: line for line in told.out.splitlines() if " from monday to " in line
    }
    assert set(changes) == {"f_max", "sigma"}
    found = re.search(r": (\S+) ± (\S+) N ", changes["f_max"])
    assert abs(float(found[1]) - 0.02) < 4.0 * float(found[2])
    assert "Changes from each measurement" in Path("r.html").read_text(encoding="utf-8")


def test_waveforms_are_read_alike_by_every_command(tmp_path, run):
    recorded(DAHL, "random", 600, 1e-3).save(tmp_path / "run.csv")
    file, note = tmp_path / "run.csv", "the files hold waveforms: fitted sample by sample"
    page = tmp_path / "page.md"
    for status, words in (
        (0, ("fit", file, "--predicted", "force")),
        (3, ("sample", file, "--steps", 20, "--max-steps", 20)),
        (0, ("report", file, "-o", page)),
    ):
        done = run(*words)
        assert (done.status, note in done.err) == (status, True)
    assert "sigma" in page.read_text()
    refused = run("fit", file, "--levels", 1)
    assert refused.status == 1
    assert "--levels is given together with records of waveforms" in refused.err
