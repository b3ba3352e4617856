"""Campaigns: one row a device whatever happens, resumed without loss, and their population."""

import importlib
import json
import os
import re
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import dahl_ident as di
from dahl_ident import population
from dahl_ident.errors import DataError, ValidationError
from tests.campaign_cases import Changed, as_toml, assert_equal, definition, make_tables, results

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="signals and pipes are POSIX")


def test_each_device_is_a_row_and_a_failure_is_one_too(tmp_path):
    truth = make_tables(tmp_path, 5, runs=2)
    (tmp_path / "d001_r1.csv").write_text("nothing that can be read\n")
    done = di.campaign(definition(tmp_path), jobs=1)
    table = done.table
    assert table["device"].tolist() == truth["device"].tolist()
    assert dict(done.statuses)["failed"] == 1
    bad = table.set_index("device").loc["d001"]
    assert bad["status"] == "failed"
    assert "d001_r1.csv" in bad["error"]
    good = table[table["status"] != "failed"]
    expected = truth.set_index("device").loc[good["device"], "f_max"].to_numpy()
    assert np.all(np.abs(good["f_max"] - expected) < 5.0 * good["u_f_max"])
    temperature = truth.set_index("device").loc[good["device"], "temperature"]
    assert good["temperature"].tolist() == pytest.approx(temperature.tolist())
    assert (table["seconds"] > 0).all()
    assert (good["assumed"] == "alpha").all()
    fit = di.fit(
        di.read_frequency_response([tmp_path / f"d000_r{r}.csv" for r in (0, 1)]), di.Dahl()
    )
    assert good["u_alpha"].iloc[0] == pytest.approx(fit.params["alpha"].stderr)
    assert "alpha" not in population(table).parameters


def test_a_fit_without_an_uncertainty_is_left_out_and_named(tmp_path):
    """Data without noise leave nothing to estimate an uncertainty from, but a trusted fit."""
    make_tables(tmp_path, 4)
    di.load_dataset("clean").save(tmp_path / "d001_r0.csv", overwrite=True)
    content = definition(tmp_path) | {"model": [{"kind": "dahl", "alpha": 1}]}
    done = di.campaign(content, jobs=1)
    assert done.table["status"].tolist() == ["trusted"] * 4
    evaluated = population(done.table)
    assert (evaluated.used, sum(evaluated.left_out.values())) == (3, 1)
    assert evaluated["f_max"].devices.index.tolist() == ["d000", "d002", "d003"]
    text = done.report(tmp_path / "campaign.html").read_text(encoding="utf-8")
    assert "Population: f_max" in text
    assert "d001: trusted without a finite uncertainty" in text
    for device in (0, 2, 3):
        di.load_dataset("clean").save(tmp_path / f"d00{device}_r0.csv", overwrite=True)
    nobody = di.campaign(content, jobs=1).report(tmp_path / "campaign.html", overwrite=True)
    assert "there is no population" in nobody.read_text(encoding="utf-8")


def test_one_fit_a_run(tmp_path):
    make_tables(tmp_path, 2, runs=3)
    table = di.campaign(definition(tmp_path, output__per="run"), jobs=1).table
    assert table["run"].tolist() == ["r0", "r1", "r2"] * 2


def test_a_second_run_does_only_what_is_missing_or_changed(tmp_path):
    make_tables(tmp_path, 4)
    first = di.campaign(definition(tmp_path), jobs=1)
    before = first.table
    again = di.campaign(definition(tmp_path), jobs=1)
    assert (len(again.finished), again.to_do) == (4, ())
    pd.testing.assert_frame_equal(again.table, before)
    other = di.load_dataset("noisy")
    other.save(tmp_path / "d002_r0.csv", overwrite=True)
    planned = di.campaign(definition(tmp_path), jobs=1, dry_run=True)
    assert planned.to_do == ("d002",)
    third = di.campaign(definition(tmp_path), jobs=1)
    assert third.to_do == ("d002",)
    changed = third.table["f_max"] != before["f_max"]
    assert third.table["device"][changed].tolist() == ["d002"]


def test_a_line_cut_off_by_a_crash_is_done_again(tmp_path):
    make_tables(tmp_path, 3)
    before = di.campaign(definition(tmp_path), jobs=1).table
    journal = tmp_path / "results" / "journal.jsonl"
    journal.write_bytes(journal.read_bytes()[:-20])
    again = di.campaign(definition(tmp_path), jobs=1)
    assert len(again.to_do) == 1
    assert_equal(again.table, before)


def test_changed_options_are_named_before_anything_runs(tmp_path):
    make_tables(tmp_path, 2)
    di.campaign(definition(tmp_path), jobs=1)
    with pytest.raises(DataError, match=r'fit was \{\}, now \{"noise": "absolute"\}'):
        di.campaign(definition(tmp_path, fit__noise="absolute"), jobs=1)
    redone = di.campaign(definition(tmp_path, fit__noise="absolute"), jobs=1, redo=True)
    assert len(redone.to_do) == 2


WRONG: Mapping[str, tuple[dict[str, Any], str]] = {
    "no file": ({"files__pattern": "nowhere/{device}.csv"}, "finds no file"),
    "no device": ({"files__pattern": "{name}.csv"}, r"has no \{device\}"),
    "twice": ({"files__pattern": "{device}_{device}.csv"}, "has the same field twice"),
    "kind": ({"files__kind": "sheet"}, "expected one of record, response"),
    "option": ({"fit__nose": "relative"}, r"unknown options in \[fit\]: nose"),
    "table": ({"fitt__noise": "relative"}, "unknown entry 'fitt'; .*did you mean 'fit'"),
    "extract": ({"extract__mode": "steps"}, "are not extracted"),
    "covariates": ({"files__covariates": "none.csv"}, "cannot be read"),
    "covariates' path": ({"files__covariates": 3}, "expected the path of a table"),
    "braces": ({"files__pattern": "{device}_{2}.csv"}, "braces without a name"),
    "no pattern": ({"files": {}}, "files has no pattern; expected text such as 'data/{device}"),
    "laws": ({"laws": 3}, "laws is 3; expected the path of a Python file, or a list"),
    "no path": ({"output__folder": ""}, "output.folder is ''; expected the path of a folder"),
    "per": ({"output__per": "day"}, "expected one of device, run"),
    "folder": ({"output__folder": 3}, "expected the path of a folder"),
    "reports": ({"output__reports": "no"}, "expected true or false"),
    "date": ({"fit__noise": date(2026, 1, 1)}, "fit.noise is .*; expected text in quotes"),
    "role": (
        {"read__columns": {"amplitud": "x"}},
        r"^the campaign: \[read\.columns\]: unknown entry 'amplitud'; .*did you mean 'amplitude'",
    ),
    "column": ({"read__columns": {"gain": {"unti": "N"}}}, r"gain: unknown entry 'unti'; .*'unit'"),
    "unit": ({"read__columns": {"gain": {"unit": "N/mmm"}}}, r"gain: \[N/mmm\] is not a known"),
    "label": ({"read__columns": {"controlled": {"forse": "d*"}}}, "'forse'; .* mean 'force'"),
    "columns": ({"read__columns": 3}, r"^the campaign: \[read\.columns\] is 3; expected its path"),
    "reading": ({"read__controlled": "forse"}, r"^the campaign: \[read\]: controlled is 'forse'"),
    "law": ({"model": [{"kind": "dal"}]}, "^the campaign: .*did you mean 'dahl'"),
    "laws' path": ({"laws": "\0"}, "^the campaign: .*: the file of laws cannot be read: embedded"),
    "folder's path": ({"output__folder": "\0"}, "the folder cannot be made: embedded null"),
    "value": (
        {"model": [{"kind": "mass"}, {"kind": "dahl", "f_max": "abc"}]},
        r"^the campaign: model\[1\]: f_max: expected real .* got 'abc'",
    ),
    "label of a law": ({"model": [{"kind": "dahl", "fmax": 1}]}, r"model\[0\]: .* mean 'f_max'"),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG)
def test_a_wrong_definition_is_named_before_anything_runs(tmp_path, changes, message):
    make_tables(tmp_path, 2)
    with pytest.raises(DataError, match=message):
        di.campaign(definition(tmp_path, **changes), jobs=1)
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("source", [3, None, b"campaign.toml", ["campaign.toml"]])
def test_what_is_not_a_definition_is_refused(source):
    with pytest.raises(ValidationError, match=r"the campaign is .*; expected its path, as text"):
        di.campaign(source)


def test_a_column_map_is_beside_the_campaign_and_its_changes_are_named(tmp_path, monkeypatch):
    f_max = make_tables(tmp_path, 1)["f_max"][0]
    path = as_toml(tmp_path)
    path.write_text(path.read_text() + '[read]\ncolumns = "columns.toml"\n')
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for folder, factor in ((tmp_path, 2), (Path(), 3)):
        (folder / "columns.toml").write_text(f"[amplitude]\nfactor = {factor}\n")
    fit = di.campaign(path, jobs=1).table.iloc[0]
    # the same stiffness, twice as far
    assert abs(fit["f_max"] - 2.0 * f_max) < 5.0 * fit["u_f_max"]
    (tmp_path / "columns.toml").write_text("[amplitude]\nfactor = 4\n")
    with pytest.raises(DataError, match=r'read was .*"factor": 2.*, now .*"factor": 4'):
        di.campaign(path, jobs=1)


def test_duplicates_and_missing_covariates_are_named(tmp_path):
    make_tables(tmp_path, 2)
    for day in ("x", "y"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "d000_r0.csv").write_bytes((tmp_path / "d000_r0.csv").read_bytes())
    both = {"pattern": f"{tmp_path.as_posix()}/{{day}}/{{device}}_{{run}}.csv", "kind": "response"}
    with pytest.raises(DataError, match=r"both device 'd000', run 'r0'"):
        di.campaign({"files": both, "model": [{"kind": "dahl"}]}, jobs=1)
    rows = (tmp_path / "devices.csv").read_text().splitlines()
    (tmp_path / "devices.csv").write_text("\n".join(rows[:2]) + "\n")
    with pytest.raises(DataError, match="no row for device 'd001'"):
        di.campaign(definition(tmp_path), jobs=1)
    (tmp_path / "devices.csv").write_text("\n".join([*rows, rows[1]]) + "\n")
    with pytest.raises(DataError, match="line 4 repeats"):
        di.campaign(definition(tmp_path), jobs=1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("device,t\nd000\n", "line 2 has 1 values; the header has 2"),
        ("device,t,t\nd000,1,2\n", "several columns are called t"),
        ("device,f_max\nd000,1\nd001,1\n", "called 'f_max', like a column of the results"),
        ("device,u_t\nd000,1\nd001,1\n", "called 'u_t', like a column of the results"),
        ("device,t\nd000,nan\n", "line 2 has no value for t"),
        ("", "has the columns none"),
    ],
)
def test_a_wrong_table_of_covariates_is_named(tmp_path, text, message):
    make_tables(tmp_path, 2)
    (tmp_path / "devices.csv").write_text(text)
    with pytest.raises(DataError, match=message):
        di.campaign(definition(tmp_path), dry_run=True)


def test_a_covariate_given_twice_and_fits_of_one_name_are_named(tmp_path):
    for name in ("a_b-c", "a-b_c"):
        (tmp_path / f"{name}.csv").write_text("")
    (tmp_path / "devices.csv").write_text("device,day\na_b,1\na,1\n")
    pattern = f"{tmp_path.as_posix()}/{{device}}-{{day}}.csv"
    with pytest.raises(DataError, match="day is in the pattern and in the table"):
        di.campaign(definition(tmp_path, files__pattern=pattern), dry_run=True)
    for place in ("a_b/c", "a/b_c"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "x.csv").write_text("")
    both = {"pattern": f"{tmp_path.as_posix()}/{{device}}/{{run}}/x.csv", "kind": "response"}
    content = {"files": both, "model": [{"kind": "dahl"}], "output": {"per": "run"}}
    with pytest.raises(DataError, match="are both called a_b_c"):
        di.campaign(content, dry_run=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fit__noise": "pink"}, "the first fits all fail: ValidationError: noise is 'pink'"),
        ({"fit__free": ["mass"]}, "the first fits all fail: ModelError: the model has no"),
    ],
)
def test_options_that_no_fit_can_use_leave_no_result(tmp_path, changes, message):
    make_tables(tmp_path, 2)
    with pytest.raises(DataError, match=message):
        di.campaign(definition(tmp_path, **changes), jobs=1)
    assert di.campaign(definition(tmp_path), jobs=1).statuses == {"trusted": 2}


def test_a_table_that_is_not_of_a_campaign_is_kept(tmp_path):
    make_tables(tmp_path, 1)
    path = tmp_path / "results" / "results.csv"
    path.parent.mkdir()
    path.write_text("mine")
    with pytest.raises(DataError, match=r"results\.csv exists, and is not of a campaign"):
        di.campaign(definition(tmp_path), jobs=1)
    assert path.read_text() == "mine"


def test_one_device_that_the_options_do_not_fit_is_a_row(tmp_path):
    """The first of the fits fails with an error of options; the others can use them."""
    make_tables(tmp_path, 3)
    table = di.read_frequency_response(tmp_path / "d001_r0.csv")
    known = 0.003**2 * np.abs(table.response)[:, None, None] ** 2 * np.eye(2)
    replace(table, covariance=known).save(tmp_path / "d001_r0.csv", overwrite=True)
    rows = di.campaign(definition(tmp_path, fit__noise="measured"), jobs=1).table
    assert rows["status"].tolist() == ["failed", "trusted", "failed"]
    assert rows["error"].iloc[0] == rows["error"].iloc[2] != ""


def test_what_a_report_cannot_use_is_named_before_anything_runs(tmp_path, run):
    make_tables(tmp_path, 2)
    path = as_toml(tmp_path)
    report = str(tmp_path / "r.html")
    for options, message in (
        (["--covariate", "heat", "--report", report], "the fits have the covariates temperature"),
        (["--order", "day", "--report", report], "the fits have the covariates temperature"),
        (["--order", "temperature"], "give --report as well"),
        (["--report", str(tmp_path / "none" / "r.html")], "there is no folder"),
    ):
        assert message in run.refused("campaign", path, *options)
    assert not (tmp_path / "results").exists()


class _Deadly(tuple[Any, ...]):
    """Files that end the process that receives them."""

    def __reduce__(self):
        return os._exit, (9,)


def test_a_job_that_kills_its_process_is_a_row_and_costs_no_other(tmp_path):
    make_tables(tmp_path, 2)
    with Changed("d000", files=_Deadly()) as pool:
        table = di.campaign(definition(tmp_path), executor=pool).table
    assert table["status"].tolist() == ["failed", "trusted"]
    assert "died" in table["error"].iloc[0]


def test_a_fit_of_files_that_it_can_read_makes_no_folder(tmp_path, monkeypatch):
    """A process that was killed would leave it behind."""
    make_tables(tmp_path, 1)
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.syspath_prepend(str(tmp_path))  # no process of another test does the fit
    (tmp_path / "temporary").mkdir()
    before = (tmp_path / "temporary").stat().st_mtime_ns
    assert di.campaign(definition(tmp_path), jobs=1).statuses == {"trusted": 1}
    assert (tmp_path / "temporary").stat().st_mtime_ns == before


# Limits of a fit


class _Hanging(tuple[Any, ...]):
    """Files that take for ever to receive."""

    def __reduce__(self):
        return time.sleep, (3600.0,)


class _Hungry(tuple[Any, ...]):
    """Files that need more memory than there is."""

    def __iter__(self):
        return iter([np.ones(10**9)])


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory")
@pytest.mark.parametrize(
    ("files", "limits", "says"),
    [
        (_Hanging(), {"timeout": 1.0}, "stopped after 1 s, the limit of time for a device; give"),
        (_Hungry(), {"memory": 2.0}, "the limit of memory for a device does not suffice"),
    ],
)
def test_a_device_has_limits_of_time_and_memory(tmp_path, files, limits, says):
    make_tables(tmp_path, 1)
    with Changed("d000", files=files) as pool:
        table = di.campaign(definition(tmp_path), executor=pool, **limits).table
    assert table["error"].iloc[0].startswith(says)
    assert di.campaign(definition(tmp_path), jobs=1).statuses == {"trusted": 1}


def test_fits_that_were_stopped_are_done_with_more_time(tmp_path, run):
    make_tables(tmp_path, 2)
    path = str(as_toml(tmp_path))
    stopped = run("campaign", path, "--jobs", "1", "--timeout", "0.001")
    assert stopped.status == 3
    assert results(tmp_path)["error"].str.startswith("stopped after 0.001 s").all()
    assert run("campaign", path, "--jobs", "1").status == 0
    assert results(tmp_path)["status"].tolist() == ["trusted"] * 2
    assert run("campaign", path, "--timeout", "-1").status == 1


@POSIX
def test_what_is_not_a_file_is_a_row_and_is_not_waited_for(tmp_path, run):
    make_tables(tmp_path, 2)
    (tmp_path / "d001_r0.csv").unlink()
    os.mkfifo(tmp_path / "d001_r0.csv")
    path = str(as_toml(tmp_path))
    assert "to do: d001" in run("campaign", path, "--dry-run").out
    done = run("campaign", path, "--jobs", "1")
    assert (done.status, "1 trusted, 1 failed" in done.out) == (0, True)
    assert "is a pipe; expected a file" in results(tmp_path)["error"][1]
    sent = run("campaign", path, "--jobs", "1", "--send-files", "--redo")
    assert "1 trusted, 1 failed" in sent.out
    covariates = definition(tmp_path, files__covariates=str(tmp_path / "d001_r0.csv"))
    with pytest.raises(DataError, match="is a pipe; expected a file"):
        di.campaign(covariates, dry_run=True)


def test_a_law_of_a_module_is_known_where_it_is_fitted(tmp_path, monkeypatch):
    make_tables(tmp_path, 1)
    (tmp_path / "lab_laws.py").write_text(LAW)
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.import_module("lab_laws")
    gap = {"kind": "backlash", "element": {"kind": "lab_law"}, "gap": 1e-9}
    for name, element in (("gap", gap), ("alone", {"kind": "lab_law"})):
        content = definition(tmp_path, output__folder=str(tmp_path / name))
        assert "failed" not in di.campaign(content | {"model": [element]}, jobs=1).statuses


LAW = """
import dahl_ident as di

class LabLaw(di.Friction):
    \"\"\"dF/dx = sigma (1 - d F / f_max).\"\"\"

    kind = "lab_law"
    parameters = (
        di.Parameter("f_max", "N", "friction limit"),
        di.Parameter("sigma", "N/m", "contact stiffness"),
    )

    def slope(self, force, direction, velocity, values):
        f_max, sigma = values
        return sigma * (1 - direction * force / f_max)
"""


def test_cells_that_spreadsheets_run_are_inert(tmp_path):
    make_tables(tmp_path, 1)
    (tmp_path / "d000_r0.csv").rename(tmp_path / "=1+2_r0.csv")
    (tmp_path / "devices.csv").write_text("device,@lab,t\n=1+2,+x,-3\n")
    done = di.campaign(definition(tmp_path), jobs=1)
    header, row = (tmp_path / "results" / "results.csv").read_text().splitlines()
    assert row.startswith("'=1+2,")
    assert ",'+x," in row
    assert ",'@lab," in header
    assert list(done.table.loc[0, ["device", "@lab", "t"]]) == ["=1+2", "+x", -3]
    data = di.load_dataset("noisy")
    labels = np.array(["=1", "'=1", "-3 dB", "-3", *["d"] * (len(data.response) - 4)])
    named = di.FrequencyResponse(data.frequency_hz, data.response, data.amplitude, level=labels)
    named.save(tmp_path / "table.csv")
    assert not re.search(r"(^|,)[=@+]|,-3 dB", (tmp_path / "table.csv").read_text(), re.MULTILINE)
    back = di.read_frequency_response(tmp_path / "table.csv")
    assert back.level.tolist() == labels.tolist()


@pytest.mark.pictures
def test_command_line(tmp_path, run):
    make_tables(tmp_path, 4)
    path = as_toml(tmp_path)
    plan = run("campaign", str(path), "--dry-run")
    assert "to do: d003" in plan.out
    report = tmp_path / "campaign.html"
    done = run("campaign", str(path), "--jobs", "1", "--report", str(report), "--json")
    assert json.loads(done.out)["to_do"] == ["d000", "d001", "d002", "d003"]
    assert b"Population: f_max" in report.read_bytes()
    shown = re.findall(r">([^<>]+)<", report.read_text())
    table = pd.read_csv(tmp_path / "results" / "results.csv").iloc[0]
    at = len(shown) - 1 - shown[::-1].index("d000")
    value, u = shown[at + 2 : at + 4]  # f_max; u has two digits, and the value as many decimals
    assert float(u) == pytest.approx(table["u_f_max"], rel=0.06)
    assert len(value.partition(".")[2]) == len(u.partition(".")[2])
    assert float(value) == pytest.approx(table["f_max"], abs=table["u_f_max"])
    assert run("campaign", str(path), "--report", "campaign.pdf").status == 0
    assert Path("campaign.pdf").read_bytes().startswith(b"%PDF")
    as_waves = path.read_text().replace("response", "record") + '[output]\nfolder = "waves"\n'
    path.write_text(as_waves)
    waves = run("campaign", str(path))
    assert waves.status == 3
    assert "the table says why, such as DataError: " in waves.err
    assert "d000_r0.csv: no motion found" in waves.err
