"""The whole chain, from waveforms to a report: on the shipped recording, and on measured data."""

import json
from functools import partial
from pathlib import Path

import pytest

import dahl_ident as di
from benchmarks.measured import FOLDER
from dahl_ident.cli import main
from tests.measured import needs_measured


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    code = ended.value.code
    return code if isinstance(code, int) else 0


@pytest.mark.parametrize("steps", [60, pytest.param(None, marks=pytest.mark.long)])
def test_demo_recovers_the_plant_and_tells_machines_its_steps_on_standard_error(
    tmp_path, monkeypatch, capsys, steps
):
    """Sampled to its end by `make validation`, and by who calls `make demo`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dahl_ident.results.posterior", partial(di.posterior, steps=steps))
    Path("lab.toml").write_text("json = true\noutput = 'here'\n", encoding="utf-8")
    status = run("demo", "--config", "lab.toml")
    printed = capsys.readouterr()
    said, told = printed.err, json.loads(printed.out)
    assert status == (3 if steps else 0), said
    headings = [
        "1. inspect",
        "2. extract",
        "3. fit",
        "4. identifiability",
        "5. posterior",
        "6. report",
    ]
    places = [said.index(step) for step in headings]
    assert places == sorted(places)
    lines = said[said.index("Compared with the truth") : places[3]].splitlines()
    off = [float(line.split()[-1]) for line in lines if line.strip().startswith(("f_max", "sigma"))]
    assert len(off) == 2
    assert all(abs(number) < 4.0 for number in off)
    for name, truth in told["truth"].items():
        assert told["fit"]["params"][name]["value"] == pytest.approx(truth, rel=0.3)
    assert told["posterior"]["converged"] is not bool(steps)
    for name, row in told["posterior"]["summary"].items():
        if name in told["truth"] and not steps:  # twice the band: 99.99 %
            low, high = row["2.3%"], row["97.7%"]
            assert 1.5 * low - 0.5 * high < told["truth"][name] < 1.5 * high - 0.5 * low
    page = Path(said.rsplit("report: ", 1)[1].splitlines()[0])
    assert page == Path(told["report"]) == tmp_path / "here" / "report.html"
    assert '<p class="mark">Trusted</p>' in page.read_text(encoding="utf-8") or steps


def test_demo_says_where_no_folder_can_be(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("there").write_text("", encoding="utf-8")
    assert run("demo", "-o", "there") == 1
    assert capsys.readouterr().err == "error: there: the folder cannot be made: File exists\n"


@needs_measured
def test_measured_damper_from_files_to_report(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    tests = ("0.25Hz_0.5in", "0.25Hz_1in", "0.5Hz_0.5in", "0.5Hz_1in", "1Hz_1.5in", "2Hz_0.5in")
    files = [str(FOLDER / "brfd" / f"band30lb_{test}.csv") for test in tests]
    assert run("inspect", files[0]) == 0
    contents = capsys.readouterr().out
    assert "1024 Hz" in contents
    status = run("extract", *files, "-o", "levels.csv", "--harmonics", "1", *_channels(contents))
    assert status in (0, 3), capsys.readouterr().err
    points = capsys.readouterr().out
    assert "points of dynamic stiffness" in points
    run("fit", "levels.csv", "--json", "--noise", "relative")
    params = json.loads(capsys.readouterr().out)["params"]
    assert params["f_max"]["value"] == pytest.approx(1.0e4, rel=0.1)
    assert params["sigma"]["value"] == pytest.approx(2.4e6, rel=0.15)
    status = run("fit", "levels.csv", "--json", "--report", "damper.html")
    told = json.loads(capsys.readouterr().out)
    assert status == 0, "the stated uncertainties include what the model misses"
    assert told["verdict"].startswith("Approximate. ")
    assert "over frequency friction" in told["verdict"]
    page = Path("damper.html").read_text(encoding="utf-8")
    assert '<p class="mark">Approximate</p>' in page
    assert "Models compared" in page
    assert "displacement distorted 11 %" in page


def _channels(contents):
    """Return the options that name displacement and force of these files."""
    lines = [line.removeprefix("#   ") for line in contents.splitlines() if line[:4] == "#   "]
    names = [line.split("  ")[0].strip() for line in lines]
    displacement = next(name for name in names if "isplacement" in name)
    force = next(name for name in names if "orce" in name and "ctuator" not in name)
    return ["--displacement", displacement, "--force", force]
