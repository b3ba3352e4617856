"""Campaigns: one row a device whatever happens, resumed without loss, and their population."""

import contextlib
import gc
import importlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from datetime import date
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import dahl_ident as di
from dahl_ident import population
from dahl_ident.errors import DahlIdentError, DataError, ValidationError

SECONDS = ["seconds"]
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="signals and pipes are POSIX")


def make_tables(folder, devices, runs=1, seed=1):
    """Write response tables of devices whose f_max grows with temperature; return the truth."""
    rng = np.random.default_rng(seed)
    amplitude = np.geomspace(1e-4, 3e-2, 9)
    truth = []
    for device in range(devices):
        temperature = float(rng.uniform(10.0, 30.0))
        f_max = 0.1 * np.exp(rng.normal(0.01 * (temperature - 20.0), 0.04))
        truth.append({"device": f"d{device:03}", "temperature": temperature, "f_max": f_max})
        for run in range(runs):
            N = di.Dahl(f_max, 30.0).describing_function(amplitude)
            noise = rng.normal(0.0, 0.003, (2, amplitude.size))
            N = N * np.exp(noise[0] + 1j * noise[1])
            table = di.FrequencyResponse(np.ones(amplitude.size), N, amplitude)
            table.save(folder / f"d{device:03}_r{run}.csv")
    frame = pd.DataFrame(truth)
    frame[["device", "temperature"]].to_csv(folder / "devices.csv", index=False)
    return frame


def definition(folder, **changes):
    content: dict[str, Any] = {
        "files": {
            "pattern": f"{folder.as_posix()}/{{device}}_{{run}}.csv",
            "kind": "response",
            "covariates": str(folder / "devices.csv"),
        },
        "model": [{"kind": "dahl"}],
        "output": {"folder": str(folder / "results")},
    }
    for name, value in changes.items():
        table, _, key = name.partition("__")
        content[table] = {**content.get(table, {}), key: value} if key else value
    return content


def as_toml(folder):
    path = folder / "lab.toml"
    path.write_text(
        '[files]\npattern = "{device}_{run}.csv"\nkind = "response"\n'
        'covariates = "devices.csv"\n[[model]]\nkind = "dahl"\n'
    )
    return path


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
    assert good["temperature"].tolist() == pytest.approx(
        truth.set_index("device").loc[good["device"], "temperature"].tolist()
    )
    assert (table["seconds"] > 0).all()


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
    pd.testing.assert_frame_equal(again.table.drop(columns=SECONDS), before.drop(columns=SECONDS))


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
    "table": ({"fitt__noise": "relative"}, "unknown tables: fitt"),
    "extract": ({"extract__mode": "steps"}, "are not extracted"),
    "covariates": ({"files__covariates": "none.csv"}, "cannot be read"),
    "covariates' path": ({"files__covariates": 3}, "expected the path of a table"),
    "braces": ({"files__pattern": "{device}_{2}.csv"}, "braces without a name"),
    "per": ({"output__per": "day"}, "expected one of device, run"),
    "folder": ({"output__folder": 3}, "expected the path of a folder"),
    "reports": ({"output__reports": "no"}, "expected true or false"),
    "date": ({"fit__noise": date(2026, 1, 1)}, "a date or a time"),
    "law": ({"model": [{"kind": "dal"}]}, "^the campaign: .*did you mean 'dahl'"),
    "value": ({"model": [{"kind": "dahl", "f_max": "abc"}]}, "f_max: expected real .* got 'abc'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_definition_is_named_before_anything_runs(tmp_path, case):
    make_tables(tmp_path, 2)
    changes, message = WRONG[case]
    with pytest.raises(DataError, match=message):
        di.campaign(definition(tmp_path, **changes), jobs=1)
    assert not (tmp_path / "results").exists()


def test_duplicates_and_missing_covariates_are_named(tmp_path):
    make_tables(tmp_path, 2)
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "d000_r0.csv").write_bytes((tmp_path / "d000_r0.csv").read_bytes())
    (tmp_path / "y").mkdir()
    (tmp_path / "y" / "d000_r0.csv").write_bytes((tmp_path / "d000_r0.csv").read_bytes())
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


def test_waveforms_with_content_sent_along_and_any_executor(tmp_path):
    record = di.load_dataset("plant_recording")
    record.save(tmp_path / "p1.csv")
    content = {
        "files": {"pattern": f"{tmp_path.as_posix()}/{{device}}.csv"},
        "extract": {"controlled": "force"},
        "model": [{"kind": k} for k in ("dahl", "mass", "damper", "spring")],
        "output": {"folder": str(tmp_path / "results"), "reports": True},
    }
    with ThreadPoolExecutor(1) as pool:
        table = di.campaign(content, jobs=1, executor=pool, send_files=True).table
    assert table["mass"].iloc[0] == pytest.approx(0.3, rel=2e-3)
    assert (tmp_path / "results" / "reports" / table["report"].iloc[0]).stat().st_size > 1000


class _Changed(ThreadPoolExecutor):
    """Workers whose jobs for one device are changed on the way."""

    def __init__(self, device, **changes):
        super().__init__(1)
        self.device, self.changes = device, changes

    def submit(self, function, /, *arguments, **_):
        job, *others = arguments
        job = replace(job, **self.changes) if job.name == self.device else job
        return super().submit(function, job, *others)


class _Deadly(tuple[Any, ...]):
    """Files that end the process that receives them."""

    def __reduce__(self):
        return os._exit, (9,)


def test_a_job_that_kills_its_process_is_a_row_and_costs_no_other(tmp_path):
    make_tables(tmp_path, 2)
    with _Changed("d000", files=_Deadly()) as pool:
        table = di.campaign(definition(tmp_path), executor=pool).table
    assert table["status"].tolist() == ["failed", "trusted"]
    assert "died" in table["error"].iloc[0]


def test_a_killed_driver_and_a_killed_worker_lose_nothing(tmp_path):
    make_tables(tmp_path, 12)
    path = as_toml(tmp_path)
    program = str(Path(sys.executable).with_name("dahl-ident"))
    command = [program, "campaign", str(path), "--jobs", "2"]
    journal = tmp_path / "results" / "journal.jsonl"
    seen = 0
    for victim in (lambda driver: driver, worker_of):
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if victim is worker_of:  # meanwhile
            undisturbed = di.campaign(
                definition(tmp_path, output__folder=str(tmp_path / "a")), jobs=1
            )
        while run.poll() is None:
            now = len(journal.read_bytes().splitlines()) if journal.exists() else 0
            if now > seen:
                os.kill(victim(run.pid), signal.SIGKILL)
                seen = now
                break
            time.sleep(0.01)
        run.wait(timeout=120)
    assert run.returncode == 0
    table = pd.read_csv(tmp_path / "results" / "results.csv", dtype={"device": str})
    expected = undisturbed.table.drop(columns=SECONDS)
    pd.testing.assert_frame_equal(table.drop(columns=SECONDS), expected)
    keys = [json.loads(line)["key"] for line in journal.read_bytes().splitlines()]
    assert len(keys) == len(set(keys)) == 12, "what was finished is not repeated"


def worker_of(driver):
    """Return a process of the driver's pool: the youngest of its descendants."""
    own = {driver}
    for stat in sorted(Path("/proc").glob("[0-9]*/stat"), key=lambda p: int(p.parent.name)):
        with contextlib.suppress(OSError):
            if int(stat.read_text().rpartition(")")[2].split()[1]) in own:
                own.add(int(stat.parent.name))
    return max(own)


CLUSTER = """
import sys
import time

from distributed import LocalCluster

if __name__ == "__main__":
    protocol, port, version = sys.argv[1:]
    if version:
        import dahl_ident.version

        dahl_ident.version.__version__ = version
    with LocalCluster(
        n_workers=1, threads_per_worker=1, protocol=protocol, host="127.0.0.1",
        scheduler_port=int(port), processes=not version, dashboard_address=None,
    ) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


class Cluster:
    """A Dask scheduler with a worker, which can be killed and started again."""

    def __init__(self, folder, protocol="tcp://", version=""):
        self._script = folder / "cluster.py"
        self._script.write_text(CLUSTER)
        self._protocol, self._version = protocol, version
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = str(free.getsockname()[1])
        self.address = f"{protocol}127.0.0.1:{self._port}"

    def start(self):
        self._process = subprocess.Popen(
            [sys.executable, str(self._script), self._protocol, self._port, self._version],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip

    def kill(self):
        """Kill the scheduler and its worker at once, as a machine that loses its power."""
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.communicate()

    def __enter__(self):
        self.start()
        assert self._process.stdout.readline().decode().strip() == self.address
        return self

    def __exit__(self, *_):
        if self._process.poll() is None:
            self.kill()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with Cluster(tmp_path_factory.mktemp("cluster")) as running:
        yield running


@pytest.fixture
def dask_leaks():
    """Drop, with the test, the sockets that a client leaves open where its scheduler was killed."""
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


def serial(folder):
    return di.campaign(definition(folder, output__folder=str(folder / "serial")), jobs=1).table


def equal(table, other):
    pd.testing.assert_frame_equal(table.drop(columns=SECONDS), other.drop(columns=SECONDS))


@POSIX
@pytest.mark.usefixtures("dask_leaks")
@pytest.mark.versions
def test_a_dask_scheduler_gives_the_serial_table(cluster, tmp_path, run):
    make_tables(tmp_path, 3)
    run("campaign", str(as_toml(tmp_path)), "--scheduler", cluster.address, "--send-files")
    table = pd.read_csv(tmp_path / "results" / "results.csv", dtype={"device": str})
    equal(table, serial(tmp_path))


@POSIX
@pytest.mark.usefixtures("dask_leaks")
def test_a_scheduler_that_dies_and_comes_back_loses_nothing(cluster, tmp_path):
    make_tables(tmp_path, 3)

    def restart(done, *_):
        if done == 2:
            cluster.kill()
            cluster.start()

    done = di.campaign(definition(tmp_path), scheduler=cluster.address, progress=restart)
    assert len(done.to_do) == 3
    equal(done.table, serial(tmp_path))


@POSIX
@pytest.mark.usefixtures("dask_leaks")
def test_a_scheduler_that_stays_dead_ends_the_campaign_with_what_is_done(cluster, tmp_path):
    make_tables(tmp_path, 3)

    def lose(done, *_):
        if done == 2:
            cluster.kill()

    with pytest.raises(DataError, match=r"not answered for 2 s; 2 of 3 fits are in .*others"):
        di.campaign(definition(tmp_path), scheduler=cluster.address, patience=2.0, progress=lose)
    table = pd.read_csv(tmp_path / "results" / "results.csv")
    assert table["status"].tolist() == ["trusted"] * 2
    rest = di.campaign(definition(tmp_path), jobs=1)
    assert len(rest.to_do) == 1
    equal(rest.table, serial(tmp_path))


@POSIX
@pytest.mark.usefixtures("dask_leaks")
def test_workers_of_another_version_are_named_before_anything_runs(tmp_path):
    make_tables(tmp_path, 2)
    with (
        Cluster(tmp_path, version="0.0.1") as cluster,
        pytest.raises(
            ValidationError, match=r"1 workers differ .* has dahl_ident 0\.0\.1; install"
        ),
    ):
        di.campaign(definition(tmp_path), scheduler=cluster.address)
    with _Changed("d000", version="0.0.1") as pool:
        table = di.campaign(definition(tmp_path), executor=pool).table
    assert table["error"].str.contains("this worker has dahl_ident").tolist() == [True, False]


@POSIX
@pytest.mark.usefixtures("dask_leaks")
@pytest.mark.skipif(shutil.which("openssl") is None, reason="there is no openssl")
def test_a_scheduler_behind_certificates(tmp_path, monkeypatch):
    make_tables(tmp_path, 2)
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=lab",
         "-days", "2", "-keyout", key, "-out", certificate],
        check=True, capture_output=True,
    )  # fmt: skip
    tls: dict[str, Any] = {"ca-file": str(certificate)}
    for part in ("scheduler", "worker", "client"):
        tls[part] = {"cert": str(certificate), "key": str(key)}
    (tmp_path / "distributed.yaml").write_text(
        json.dumps({"distributed": {"comm": {"require-encryption": True, "tls": tls}}})
    )
    settings = import_module("dask.config")  # read before the variable: no key in this process
    monkeypatch.setenv("DASK_CONFIG", str(tmp_path))
    given = {f"distributed.comm.tls.{name}": value for name, value in tls.items()}
    with Cluster(tmp_path, "tls://") as cluster:
        with pytest.raises(ValidationError, match="no scheduler answers"):
            di.campaign(definition(tmp_path), scheduler=cluster.address)
        with settings.set(given):
            done = di.campaign(definition(tmp_path), scheduler=cluster.address)
    equal(done.table, serial(tmp_path))


class _Elsewhere(ThreadPoolExecutor):
    """Workers that do not have the files of this machine."""

    def submit(self, function, /, *arguments, **_):
        job, *others = arguments
        files = tuple((f"/elsewhere{name}", content) for name, content in job.files)
        return super().submit(function, replace(job, files=files), *others)


def test_files_that_a_worker_does_not_see_are_done_by_a_second_call(tmp_path):
    make_tables(tmp_path, 2)
    with _Elsewhere(1) as pool:
        first = di.campaign(definition(tmp_path), executor=pool)
        assert first.table["error"].str.contains("send them with send_files=True").all()
        second = di.campaign(definition(tmp_path), executor=pool, send_files=True)
    assert len(second.to_do) == 2
    equal(second.table, serial(tmp_path))


class _Silent(ThreadPoolExecutor):
    """An executor from which nothing comes back."""

    def submit(self, *_, **__):
        return Future()


def test_an_executor_that_does_not_answer_is_not_waited_for(tmp_path):
    make_tables(tmp_path, 2)
    with _Silent(1) as pool, pytest.raises(DataError, match="executor has not answered for 1 s; 0"):
        di.campaign(definition(tmp_path), executor=pool, timeout=0.5, patience=0.5)
    ended = ThreadPoolExecutor(1)
    ended.shutdown()
    with pytest.raises(DataError, match="takes no jobs any more"):
        di.campaign(definition(tmp_path), executor=ended)


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
    with _Changed("d000", files=files) as pool:
        table = di.campaign(definition(tmp_path), executor=pool, **limits).table
    assert table["error"].iloc[0].startswith(says)
    assert di.campaign(definition(tmp_path), jobs=1).statuses == {"trusted": 1}


def test_fits_that_were_stopped_are_done_with_more_time(tmp_path, run):
    make_tables(tmp_path, 2)
    path = str(as_toml(tmp_path))
    stopped = run("campaign", path, "--jobs", "1", "--timeout", "0.001")
    assert stopped.status == 3
    table = pd.read_csv(tmp_path / "results" / "results.csv")
    assert table["error"].str.startswith("stopped after 0.001 s").all()
    assert run("campaign", path, "--jobs", "1").status == 0
    table = pd.read_csv(tmp_path / "results" / "results.csv")
    assert table["status"].tolist() == ["trusted"] * 2
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
    table = pd.read_csv(tmp_path / "results" / "results.csv")
    assert "is a pipe; expected a file" in table["error"][1]
    sent = run("campaign", path, "--jobs", "1", "--send-files", "--redo")
    assert "1 trusted, 1 failed" in sent.out


@POSIX
def test_covariates_in_a_pipe_are_refused(tmp_path):
    make_tables(tmp_path, 2)
    os.mkfifo(tmp_path / "table.csv")
    with pytest.raises(DataError, match="is a pipe; expected a file"):
        di.campaign(
            definition(tmp_path, files__covariates=str(tmp_path / "table.csv")), dry_run=True
        )


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
    assert (done.table["device"][0], done.table["@lab"][0], done.table["t"][0]) == (
        "=1+2",
        "+x",
        -3,
    )
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
    as_waves = path.read_text().replace("response", "record") + '[output]\nfolder = "waves"\n'
    path.write_text(as_waves)
    waves = run("campaign", str(path))
    assert waves.status == 3
    assert "the table says why, such as DataError: " in waves.err
    assert "d000_r0.csv: no motion found" in waves.err
    assert run("campaign", str(path), "--report", "campaign.pdf").status == 0
    assert Path("campaign.pdf").read_bytes().startswith(b"%PDF")


# Population


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
