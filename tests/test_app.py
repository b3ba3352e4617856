"""The page: who may use it, what it keeps, and the way from files to a report in a browser."""

import io
import json
import math
import os
import subprocess
import sys
from html import unescape
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.io import savemat

import dahl_ident as di
from tests.app_server import started
from tests.browser import CHROMIUM, chromium
from tests.test_record_fit import DAHL, recorded

IN_A_BROWSER = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
NOISY = Path(__file__).parents[1] / "datasets" / "synthetic" / "noisy.csv"
_READY = "document.readyState == 'complete'"
_RUN = "location.pathname.includes('/run-')"
_ENDED = f"{_RUN} && {_READY} && !document.getElementById('progress')"
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


def test_a_bad_file_is_refused_in_the_reader_s_words(server):
    page = unescape(server.page(server.upload([("a file.csv", b"")])))
    alert = page.partition('role="alert"')[2].partition("</div>")[0]
    assert "a file.csv: the file is empty" in alert
    assert 'value="model" disabled' in page


def test_an_error_names_the_fields_of_the_form(server):
    page = unescape(
        server.page(server.upload([("a.csv", b"frequency_hz,gain [m/N],phase_deg\n1,2,3\n")]))
    )
    alert = page.partition('role="alert"')[2].partition("</div>")[0]
    assert 'Name a column with the meaning "amplitude", or give "Force amplitude' in alert
    assert "or \"Displacement amplitude\" '5 um' for the whole file" in alert
    assert '<label for="amplitude">Displacement amplitude</label>' in page


def test_channels_are_read_as_the_page_proposes(server):
    rows = "\n".join(f"{0.01 * i},{math.sin(0.1 * i)},{math.cos(0.1 * i)}" for i in range(400))
    waves = f"time [s],LVDT [um],load cell [N]\n{rows}"
    table = "Frequenz [Hz],Weg [um],Steifigkeit [N/m],Phase [deg]\n1,1,30,3\n1,9,20,30\n1,90,3,70"
    for text, found in ((waves, "waveforms"), (table, "a table of responses")):
        page = server.page(server.upload([("own.csv", text.encode())]))
        assert f"Read as {found}" in page


def test_a_struct_array_is_one_channel_for_each_name(server, tmp_path):
    levels = np.zeros((1, 2), [(name, object) for name in ("frequency", "drive", "gain", "phase")])
    for u, level in enumerate(levels.flat, 1):
        rows = np.arange(1.0, 8.0)
        level["frequency"], level["drive"] = rows, np.full(7, 0.1 * u)
        level["gain"], level["phase"] = 1e-3 / rows, -10.0 * rows
    savemat(tmp_path / "levels.mat", {"FR": levels})
    place = server.upload([("levels.mat", (tmp_path / "levels.mat").read_bytes())])
    units = {"frequency": "Hz", "drive": "N", "gain": "m/N", "phase": "deg"}
    form: dict[str, str] = {}
    for n, (name, unit) in enumerate(units.items(), 1):
        form |= {f"channel_{n}": f"FR[*].{name}", f"role_{n}": name, f"unit_{n}": unit}
    server.send(place, **form)
    page = unescape(server.page(place))
    for n, name in enumerate(units, 1):
        assert f'name="channel_{n}" value="FR[*].{name}"' in page
        assert f'<option value="{name}" selected>' in page
    assert "channel_5" not in page
    assert "FrequencyResponse: 14 points of receptance" in page


def test_two_channels_with_one_role_are_named(server):
    place = server.upload([("run.csv", b"t,a,b\n0,1,2\n1,2,3\n")])
    form = b"channel_0=a&role_0=force&channel_1=b&role_1=force"
    kind = {"Content-Type": "application/x-www-form-urlencoded"}
    status, _, text = server.request("POST", place, form, kind)
    assert status == 400
    assert "a and b are both the force; go back and choose" in unescape(text)


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


def test_a_folder_that_is_not_there_is_named(run):
    assert "none is not a folder" in run.refused("app", "none")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture
def page(server, browser):
    """A page that has been opened with the token; nothing may come from another machine."""
    browser.requests.clear()
    browser.open(server.address, 1100)
    yield browser
    browser.open("about:blank", 1100)
    inside = (server.address[:17], "data:", "about:")
    assert [url for url in browser.requests if not url.startswith(inside)] == []
    assert browser.problems == []


def _check_access(page, place):
    """Check labels, contrast and the like, contrast in the dark as well, and a phone's width."""
    page.value((files("axe_core_python") / "axe.min.js").read_text("utf-8") + "; 1")
    for scheme, rules in (("light", "{}"), ("dark", "{runOnly: ['color-contrast']}")):
        wanted = {"name": "prefers-color-scheme", "value": scheme}
        page.call("Emulation.setEmulatedMedia", features=[wanted])
        found = page.value(f"axe.run({rules}).then(r => JSON.stringify(r.violations))")
        broken = [(v["id"], [n["html"] for n in v["nodes"]][:3]) for v in json.loads(found)]
        assert broken == [], (place, scheme)
    page.call("Emulation.setEmulatedMedia", features=[])
    page.resize(390, mobile=True)
    assert page.value("document.documentElement.scrollWidth") <= 390, place
    page.resize(1100)


def _click(page, selector, until):
    page.value(f"document.querySelector({json.dumps(selector)}).click()")
    page.wait(f"{until} && {_READY}")


def _keep_picture(page, name, folder):
    """Keep a picture of the page for the manual, in few colours; the test shows that it is one."""
    with Image.open(io.BytesIO(page.screenshot())) as shot:
        assert shot.width == 1100
        top = shot.convert("RGB").crop((0, 0, shot.width, min(shot.height, 1700)))
        assert len(top.getcolors(1 << 24) or ()) > 20
        top.quantize(64).save(folder / f"app_{name}.png", optimize=True)


def _to_model(page, file):
    page.choose("#files", [file])
    _click(page, "form.drop button", "location.pathname != '/'")
    _click(page, "button[name=next]", "location.pathname.endsWith('/model')")


@IN_A_BROWSER
def test_every_page_is_accessible(page, server, work, fitted, tmp_path):
    pictures = Path(os.environ.get("DAHL_IDENT_PICTURES", tmp_path))
    place = server.address.partition("/?")[0]
    _check_access(page, "start")
    for name, path in (("data", work), ("model", f"{work}/model"), ("result", fitted)):
        page.open(place + path, 1100)
        if name == "model":
            page.wait(
                "document.querySelector('#commands pre').textContent.includes('--element dahl')"
            )
        if name == "result":
            images = "[...document.images].map(one => one.decode().then(() => one.naturalWidth))"
            assert min(page.value(f"Promise.all({images})")) > 100
        _keep_picture(page, name, pictures)
        page.value("document.querySelectorAll('details').forEach(one => one.open = true)")
        _check_access(page, name)


@IN_A_BROWSER
def test_waveforms_become_a_report(page, server, tmp_path):
    truth = DAHL + di.Damper(0.3)
    recorded(truth, "random", 500, 1e-3).to_frame().to_csv(tmp_path / "run.csv", index=False)
    _to_model(page, tmp_path / "run.csv")
    page.value("document.getElementById('damping').value = 'free'")
    _click(page, "form > .buttons button", _RUN)
    page.wait(_ENDED)
    text = page.value("document.body.innerText")
    assert "Trusted" in text
    assert "dahl-ident fit data/run.csv --record" in text
    assert server.page(f"{page.value('location.pathname')}/file/report.pdf").startswith("%PDF")


@IN_A_BROWSER
def test_a_technician_gets_to_the_report_with_the_keyboard(page):
    def go_to(selector):
        for _ in range(80):
            if page.value(f"document.activeElement.matches({json.dumps(selector)})"):
                return
            page.press("Tab")
        raise AssertionError(f"{selector} is not reached by the tab key")

    page.choose("#files", [NOISY])  # the system's window, which is not of the page
    go_to("form.drop button")
    page.press("Enter", "\r")
    page.wait(f"location.pathname != '/' && {_READY}")
    go_to("button[name=next]")
    page.press("Enter", "\r")
    page.wait(f"location.pathname.endsWith('/model') && {_READY}")
    go_to("input[name=law]")
    page.press("ArrowDown")
    assert page.value("document.querySelector('[name=law]:checked').value") == "bouc_wen"
    go_to("form > .buttons button")
    page.press("Enter", "\r")
    page.wait(f"{_RUN} && {_READY}")
    go_to(".buttons button")  # cancel
    page.press("Enter", "\r")
    page.wait("document.querySelector('.mark').innerText == 'Cancelled'")


@IN_A_BROWSER
def test_nothing_is_lost_by_reload_back_button_or_a_second_tab(page, server):
    _to_model(page, NOISY)
    page.value("document.getElementById('meta_specimen').value = 'Pivot 12'")
    _click(page, "form > .buttons button", _RUN)
    run = page.value("location.pathname")
    page.call("Page.reload")
    page.wait(f"{_RUN} && {_READY}")
    assert "noisy.csv" in server.page(run)  # another tab
    server.send(f"{run}/cancel")
    page.wait(_ENDED)
    page.value("history.back()")
    page.wait(f"location.pathname.endsWith('/model') && {_READY}")
    page.call("Page.reload")
    page.wait(f"{_READY} && document.getElementById('meta_specimen').value == 'Pivot 12'")
    assert page.value(f"[...document.links].some(one => one.pathname == {json.dumps(run)})")


@IN_A_BROWSER
def test_a_bad_file_is_explained_and_goes_no_further(page, tmp_path):
    bad = tmp_path / "level 3.csv"
    bad.write_text(
        "frequency [Hz],amplitude [m],gain [N/m],phase [deg]\n1,1e-3,30,5\n1,2e-3,x9,6\n"
    )
    page.choose("#files", [bad])
    _click(page, "form.drop button", "location.pathname != '/'")
    alert = page.value("document.querySelector('[role=alert]').innerText")
    assert "level 3.csv" in alert
    assert "x9" in alert
    assert page.value("document.querySelector('button[name=next]').disabled")
    _check_access(page, "bad file")
