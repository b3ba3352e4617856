"""The page's server: who may use it, what it keeps, and what it does with bad input."""

import json
import subprocess
import sys
from html import unescape
from pathlib import Path

import pytest

import dahl_ident as di
from tests.app_server import started

NOISY = Path(__file__).parents[1] / "datasets" / "synthetic" / "noisy.csv"
LAW = '''
import dahl_ident as di

class Worn(di.Friction):
    """A law of the workshop."""

    kind = "worn"
    parameters = (
        di.Parameter("k", "N/m", "stiffness", transform="log"),
        di.Parameter("limit", "N", "friction limit", transform="log"),
    )

    def slope(self, force, direction, velocity, values):
        k, limit = values
        return k * (direction * force < limit)
'''


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with started(tmp_path_factory.mktemp("work")) as running:
        yield running


@pytest.fixture(scope="module")
def work(server):
    """A table that has been read and confirmed."""
    place = server.upload([("noisy.csv", NOISY.read_bytes())])
    assert "Read as a table of responses" in server.page(place)
    assert server.send(place, next="model", found="table") == f"{place}/model"
    return place


@pytest.fixture(scope="module")
def fitted(server, work):
    """A fit of that table, with a known mass and a calibration."""
    return server.fitted(
        work, mass="known", mass_value="1 g", force_uncertainty="0.5 %", force_k="2",
        meta_specimen="Pivot 12",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("method", "headers", "status"),
    [
        ("GET", {"Cookie": None}, 403),
        ("GET", {"Cookie": "dahl_ident=guess"}, 403),
        ("GET", {"Host": "friction.example"}, 421),
        ("GET", {"Origin": "http://friction.example"}, 403),
        ("POST", {"Origin": "http://friction.example"}, 403),
        ("POST", {"Origin": "null"}, 403),
        ("POST", {"Origin": None}, 403),
        ("POST", {"Content-Length": "2000000001"}, 413),
        ("POST", {"Content-Length": None, "Transfer-Encoding": "chunked"}, 411),
    ],
)
@pytest.mark.versions
def test_a_request_that_is_not_of_the_page_is_refused(server, method, headers, status):
    assert server.request(method, "/", headers=headers)[0] == status


@pytest.mark.versions
def test_the_token_is_needed_once_and_pages_load_nothing_from_elsewhere(server):
    assert server.request("GET", "/?token=guess", headers={"Cookie": None})[0] == 403
    status, headers, _ = server.request("GET", "/")
    assert status == 200
    assert headers["content-security-policy"].startswith("default-src 'self';")
    assert headers["cache-control"] == "no-store"


@pytest.mark.versions
def test_the_name_of_a_file_is_not_a_path(server):
    names = [
        "../../outside.csv", "C:data level.csv", "-o.csv", ".csv", "..", "a%2fb.csv",
        "Ölprüfung.csv", "*.csv", "<b>bold.csv", "x" * 300 + ".csv", "report.toml",
    ]  # fmt: skip
    place = server.upload([(name, NOISY.read_bytes()) for name in names])
    folder = server.folder / place[1:]
    stored = [path for path in folder.rglob("*") if path.is_file() and path.name != "work.json"]
    assert len(stored) == len(names)
    assert {path.parent for path in stored} == {folder / "data"}
    assert not any(path.name.startswith("-") for path in stored)
    shown = server.page(place)
    assert "<b>bold" not in shown
    assert [name for name in names if name not in unescape(shown)] == []


@pytest.mark.versions
def test_of_two_files_with_one_name_both_are_kept(server):
    place = server.upload([("run.csv", b"one"), ("run.csv", b"two")])
    server.upload([("run.csv", b"three")], f"{place}/files")
    kept = sorted(p.read_bytes() for p in (server.folder / place[1:] / "data").iterdir())
    assert kept == [b"one", b"three", b"two"]
    assert "run.csv (2), run.csv (3)" in server.page(place)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b"\x00\x01\x02\x03" * 100, "a file.csv"),
        (b"frequency [Hz],amplitude [m],gain [N/m],phase [deg]\n1,1e-3,30,5\n1,2e-3,x9,6\n", "x9"),
    ],
)
def test_a_bad_file_is_refused_in_the_reader_s_words(server, content, message):
    page = unescape(server.page(server.upload([("a file.csv", content)])))
    assert 'role="alert"' in page
    alert = page.partition('role="alert"')[2].partition("</div>")[0]
    assert message in alert
    assert "a file.csv" in alert
    assert 'value="model" disabled' in page


def test_the_program_gives_what_the_page_shows(server, work, fitted):
    run = fitted
    page = unescape(server.page(run))
    assert '<p class="mark">Trusted</p>' in page
    assert "Pivot 12" in server.page(f"{run}/file/report.html")
    folder = server.folder / work[1:]
    stated = di.FitResult.load(folder / run.rpartition("/")[2] / "fit.json")
    assert "dahl-ident fit data/noisy.csv --element dahl --mass '1 g'" in page
    program = [sys.executable, run.rpartition("/")[2] + "/program.py"]
    subprocess.run(program, cwd=folder, check=True, capture_output=True)
    other = di.FitResult.load(folder / "fit.json")
    assert repr(other.params) == repr(stated.params)
    assert "force_gain" in stated.params  # the calibration counts


def test_downloads_are_complete(server, fitted):
    run = fitted
    assert server.page(f"{run}/file/report.html").startswith("<!doctype html>")
    assert server.page(f"{run}/file/report.pdf").startswith("%PDF")
    assert json.loads(server.page(f"{run}/file/fit.json"))["schema"] == "dahl_ident.fit_result"
    place = server.folder / run[1:] / "points.csv"
    assert server.page(f"{run}/file/points.csv") == place.read_bytes().decode()
    assert len(di.read_frequency_response(place)) == 30
    assert "<joint" in server.page(f"{run}/export/mujoco")
    for missing in ("file/../work.json", "file/0.err", "export/x", "file/%2e%2e/work.json"):
        assert server.request("GET", f"{run}/{missing}")[0] == 404


def test_comparison_and_plan_go_on_from_a_fit(server, fitted):
    run = fitted
    server.send(f"{run}/compare")
    server.wait(run)
    assert "No model compared is better" in server.page(run)
    server.send(
        f"{run}/plan", frequency="0.5:5Hz", displacement="0.1:10mm", time="10min",
        sample_rate="500Hz", controlled="displacement",
    )  # fmt: skip
    server.wait(run)
    page = server.page(run)
    assert "2 levels in 600 s" in page
    assert f"{run}/file/plan-1/waveform.csv" in page
    assert server.page(f"{run}/file/plan-1/waveform.csv").startswith("time")


def test_what_a_form_says_wrongly_fails_with_the_reason(server, work):
    page = unescape(server.page(server.fitted(work, known="); import os (")))
    assert "import os" in page.partition('role="alert"')[2].partition("</div>")[0]


def test_a_fit_is_cancelled(server, work):
    run = server.send(f"{work}/model", law="dahl")
    server.send(f"{run}/cancel")
    server.wait(run)
    assert "Cancelled" in server.page(run)
    assert not (server.folder / run[1:] / "report.pdf").exists()


def test_work_is_found_again_and_laws_of_the_user_are_run_only_where_they_were_named(tmp_path):
    laws, folder = tmp_path / "laws.py", tmp_path / "work"
    laws.write_text(LAW)
    folder.mkdir()
    with started(folder, "--laws", str(laws)) as first:
        work = first.upload([("noisy.csv", NOISY.read_bytes())])
        first.send(work, next="model", found="table")
        assert "A law of the workshop." in first.page(f"{work}/model")
        run = first.send(f"{work}/model", law="dahl")
    with started(folder) as second:
        assert "noisy.csv" in second.page("/")
        assert "A law of the workshop." not in second.page(f"{work}/model")
        assert "Cancelled" in second.page(run)
        assert second.send(f"{work}/model", law="dahl").endswith("run-2")


def test_a_folder_that_is_not_there_is_named(tmp_path):
    words = [sys.executable, "-m", "dahl_ident.cli", "app", str(tmp_path / "none")]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "none is not a folder" in ended.stderr
