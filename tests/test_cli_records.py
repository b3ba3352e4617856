"""Records of any motion on the command line: what is read, refused and printed."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import dahl_ident as di
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
def told(run):
    """Return what runs a command, and returns its status and what it printed."""

    def call(*words, stdin=""):
        done = run(*words, stdin=stdin)
        return done.status, done.out, done.err

    return call


def test_a_column_map_is_used(odd_columns, told):
    words = ("fit", odd_columns, "--record")
    code, _, why = told(*words)
    assert code == 1
    assert "Name it with --force ..." in why
    mapped = (*words, "--columns", odd_columns.with_name("columns.toml"))
    code, out, _ = told(*mapped)
    assert code == 0
    assert "f_max" in out
    (line,) = (line for line in out.splitlines() if line.split()[:1] == ["sigma"])
    assert float(line.split()[1]) == pytest.approx(30.0, rel=0.01)
    assert "Uncertainty budget" not in out
    code, out, _ = told(*mapped, "-v")
    assert "Uncertainty budget" in out
    assert "offset" in out


def test_waveforms_need_no_option(tmp_path, told):
    for seed in (1, 2):
        recorded(DAHL, "random", 600, 1e-3, seed).save(tmp_path / f"sweep{seed}.csv")
    pattern = tmp_path / "sweep*.csv"
    code, out, why = told("fit", pattern)
    assert code == 0
    assert "the files hold waveforms: fitted sample by sample, as with --record" in why
    assert out == told("fit", pattern, "--record")[1]
    code, _, why = told("fit", "-", stdin=(tmp_path / "sweep1.csv").read_text())
    assert code == 1
    assert "fitted as a record: dahl-ident fit --record" in why


def test_a_fast_sweep_is_told_how_to_be_fitted(tmp_path, told):
    t = np.arange(12_000) / 1000.0
    x = 0.02 * np.exp(-t / 6.0) * np.sin(2.0 * np.pi * 5.0 * t)
    path = di.Record(t, displacement=x, force=DAHL.force(x)).save(tmp_path / "a run.csv")
    words = ("extract", path, "--time", "time [s]")
    code, out, why = told(*words)
    assert code == 3
    assert "biased by about" in " ".join(out.split())
    assert f"dahl-ident fit --record '{path}' --time 'time [s]'" in why


@pytest.mark.parametrize("command", ["fit", "sample"])
@pytest.mark.parametrize("words", [("--level", "1"), ("--noise", "relative")])
def test_options_of_tables_are_refused(command, words, odd_columns, told):
    place = odd_columns.with_name("columns.toml")
    code, _, why = told(command, odd_columns, "--record", "--columns", place, *words)
    assert code == 1
    assert re.search(rf"{words[0]} (is )?given (together )?with .*record", why)


def test_a_gain_without_a_prior_about_one_is_refused(odd_columns, told):
    place = odd_columns.with_name("columns.toml")
    command = ("fit", odd_columns, "--record", "--columns", place, "--force-gain", "norm(1.1,0.1)")
    code, _, why = told(*command)
    assert code == 1
    assert "--force-gain is a prior about 1.1;" in why
    assert "such as 'norm(1, 0.005)', which" in why


def test_the_force_is_predicted_although_the_model_has_a_mass(odd_columns, told):
    place = odd_columns.with_name("columns.toml")
    words = ("fit", odd_columns, "--record", "--columns", place, "--mass", "free")
    _, out, _ = told(*words, "--predicted", "force")
    assert "of the measured force" in out
    code, _, why = told("fit", odd_columns, "--predicted", "force")
    assert code == 1
    assert "--record" in why


@pytest.mark.parametrize("words", [("--loss", "huber"), ("--method", "scipy")])
def test_losses_and_methods_are_taken_with_records(words, odd_columns, told):
    place = odd_columns.with_name("columns.toml")
    base = ("fit", odd_columns, "--record", "--columns", place, "--json")
    plain, other = (json.loads(told(*base, *more)[1])["params"] for more in ((), words))
    for name in ("f_max", "sigma"):
        assert other[name]["value"] == pytest.approx(plain[name]["value"], rel=0.01)


def test_models_of_records_are_compared(odd_columns, told):
    place = odd_columns.with_name("columns.toml")
    words = ("fit", odd_columns, "--record", "--columns", place, "--compare")
    _, out, _ = told(*words)
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
        force = np.zeros(600)
        for i, dx in enumerate(np.diff(x), 1):  # the exact solution of Dahl's equation
            end = f_max * np.sign(dx)
            force[i] = end + (force[i - 1] - end) * np.exp(-30.0 / f_max * abs(dx))
        table = np.c_[time, x, force + noise]
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


def test_waveforms_are_read_alike_by_every_command(tmp_path, told):
    recorded(DAHL, "random", 600, 1e-3).save(tmp_path / "run.csv")
    file, note = tmp_path / "run.csv", "the files hold waveforms: fitted sample by sample"
    code, _, why = told("fit", file, "--predicted", "force")
    assert (code, note in why) == (0, True)
    code, out, why = told("sample", file, "--steps", 20, "--max-steps", 20)
    assert (code, note in why) == (3, True)
    assert "f_max" in out
    page = tmp_path / "page.md"
    code, _, why = told("report", file, "-o", page)
    assert (code, note in why) == (0, True)
    assert "sigma" in page.read_text()
    code, _, why = told("fit", file, "--levels", 1)
    assert code == 1
    assert "--levels is given together with records of waveforms" in why
