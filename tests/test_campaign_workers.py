"""Campaigns on other workers: killed drivers, lost schedulers, certificates, any executor."""

import contextlib
import gc
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import warnings
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import dahl_ident as di
from dahl_ident.errors import DataError, ValidationError
from tests.campaign_cases import (
    Changed,
    as_toml,
    assert_equal,
    definition,
    make_tables,
    results,
    serial,
)


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


def test_a_killed_driver_and_a_killed_worker_lose_nothing(tmp_path):
    make_tables(tmp_path, 8)
    path = as_toml(tmp_path)
    program = str(Path(sys.executable).with_name("dahl-ident"))
    command = [program, "campaign", str(path), "--jobs", "2"]
    journal = tmp_path / "results" / "journal.jsonl"
    seen = 0
    for victim in (lambda driver: driver, worker_of):
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if victim is worker_of:  # meanwhile
            undisturbed = serial(tmp_path)
        while run.poll() is None:
            now = len(journal.read_bytes().splitlines()) if journal.exists() else 0
            if now > seen:
                os.kill(victim(run.pid), signal.SIGKILL)
                seen = now
                break
            time.sleep(0.01)
        run.wait(timeout=120)
    assert run.returncode == 0
    assert_equal(results(tmp_path), undisturbed)
    keys = [json.loads(line)["key"] for line in journal.read_bytes().splitlines()]
    assert len(keys) == len(set(keys)) == 8, "what was finished is not repeated"


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
    if sys.platform == "win32":
        pytest.skip("signals and pipes are POSIX")
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


@pytest.mark.usefixtures("dask_leaks")
@pytest.mark.versions
def test_a_dask_scheduler_gives_the_serial_table(cluster, tmp_path, run):
    make_tables(tmp_path, 3)
    run("campaign", str(as_toml(tmp_path)), "--scheduler", cluster.address, "--send-files")
    assert_equal(results(tmp_path), serial(tmp_path))


@pytest.mark.usefixtures("dask_leaks")
def test_a_scheduler_that_dies_and_comes_back_loses_nothing(cluster, tmp_path):
    make_tables(tmp_path, 3)

    def restart(done, *_):
        if done == 2:
            cluster.kill()
            cluster.start()

    done = di.campaign(definition(tmp_path), scheduler=cluster.address, progress=restart)
    assert len(done.to_do) == 3
    assert_equal(done.table, serial(tmp_path))


@pytest.mark.usefixtures("dask_leaks")
def test_a_scheduler_that_stays_dead_ends_the_campaign_with_what_is_done(cluster, tmp_path):
    make_tables(tmp_path, 3)

    def lose(done, *_):
        if done == 2:
            cluster.kill()

    with pytest.raises(DataError, match=r"not answered for 2 s; 2 of 3 fits are in .*others"):
        di.campaign(definition(tmp_path), scheduler=cluster.address, patience=2.0, progress=lose)
    assert results(tmp_path)["status"].tolist() == ["trusted"] * 2
    rest = di.campaign(definition(tmp_path), jobs=1)
    assert len(rest.to_do) == 1
    assert_equal(rest.table, serial(tmp_path))


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
    with Changed("d000", version="0.0.1") as pool:
        table = di.campaign(definition(tmp_path), executor=pool).table
    assert table["error"].str.contains("this worker has dahl_ident").tolist() == [True, False]


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
    assert_equal(done.table, serial(tmp_path))


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
    assert_equal(second.table, serial(tmp_path))


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
