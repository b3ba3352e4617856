"""The page in a real browser: from files to a signed report, as a technician goes through it."""

import io
import json
import os
from importlib.resources import files
from pathlib import Path

import pytest
from PIL import Image

from dahl_ident import Damper
from tests.app_server import started
from tests.browser import CHROMIUM, chromium
from tests.test_record_fit import DAHL, recorded

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
SETS = Path(__file__).parents[1] / "datasets" / "synthetic"
_READY = "document.readyState == 'complete'"
_RUN = "location.pathname.includes('/run-')"
_ENDED = f"{_RUN} && {_READY} && !document.getElementById('progress')"


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with started(tmp_path_factory.mktemp("work")) as running:
        yield running


@pytest.fixture
def page(server, tmp_path):
    """A page that has been opened with the token; nothing may come from another machine."""
    with chromium(tmp_path / "profile") as opened:
        opened.attach()
        opened.open(server.address, 1100)
        yield opened
        inside = (server.address[:17], "data:")
        foreign = [url for url in opened.requests if not url.startswith(inside)]
        assert foreign == []
        assert opened.problems == []


def _check_access(page, place):
    """Check labels, contrast and the like, in light and dark, and at the width of a phone."""
    for scheme in ("light", "dark"):
        wanted = {"name": "prefers-color-scheme", "value": scheme}
        page.call("Emulation.setEmulatedMedia", features=[wanted])
        page.value((files("axe_core_python") / "axe.min.js").read_text("utf-8") + "; 1")
        found = page.value("axe.run().then(r => JSON.stringify(r.violations))")
        broken = [(v["id"], [n["html"] for n in v["nodes"]][:3]) for v in json.loads(found)]
        assert broken == [], (place, scheme)
    page.call("Emulation.setEmulatedMedia", features=[])
    page.call(
        "Emulation.setDeviceMetricsOverride",
        width=390,
        height=900,
        deviceScaleFactor=1,
        mobile=True,
    )
    assert page.value("document.documentElement.scrollWidth") <= 390, place
    page.call(
        "Emulation.setDeviceMetricsOverride",
        width=1100,
        height=900,
        deviceScaleFactor=1,
        mobile=False,
    )


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


def test_a_table_becomes_a_report_and_every_page_is_accessible(page, server, tmp_path):
    pictures = Path(os.environ.get("DAHL_IDENT_PICTURES", tmp_path))
    _check_access(page, "start")
    page.choose("#files", [SETS / "noisy.csv"])
    _click(page, "form.drop button", "location.pathname != '/'")
    assert "Read as a table of responses" in page.value("document.body.innerText")
    _check_access(page, "data")
    _keep_picture(page, "data", pictures)
    _click(page, "button[name=next]", "location.pathname.endsWith('/model')")
    page.wait("document.querySelector('#commands pre').textContent.includes('--element dahl')")
    _keep_picture(page, "model", pictures)
    page.value("document.querySelectorAll('details').forEach(one => one.open = true)")
    _check_access(page, "model")
    _click(page, "form > .buttons button", _RUN)
    page.wait(_ENDED)
    assert page.value("document.querySelector('.verdict .mark').innerText") == "Trusted"
    images = "[...document.images].map(one => one.decode().then(() => one.naturalWidth))"
    assert min(page.value(f"Promise.all({images})")) > 100
    _keep_picture(page, "result", pictures)
    page.value("document.querySelectorAll('details').forEach(one => one.open = true)")
    _check_access(page, "result")
    run = page.value("location.pathname")
    assert server.page(f"{run}/file/report.pdf").startswith("%PDF")


def test_waveforms_become_a_report(page, server, tmp_path):
    truth = DAHL + Damper(0.3)
    recorded(truth, "random", 500, 1e-3).to_frame().to_csv(tmp_path / "run.csv", index=False)
    _to_model(page, tmp_path / "run.csv")
    page.value("document.getElementById('damping').value = 'free'")
    _click(page, "form > .buttons button", _RUN)
    page.wait(_ENDED)
    text = page.value("document.body.innerText")
    assert "Trusted" in text
    assert "dahl-ident fit data/run.csv --record" in text
    assert server.page(f"{page.value('location.pathname')}/file/report.pdf").startswith("%PDF")


def test_a_technician_gets_to_the_report_with_the_keyboard(page):
    def go_to(selector):
        for _ in range(80):
            if page.value(f"document.activeElement.matches({json.dumps(selector)})"):
                return
            page.press("Tab")
        raise AssertionError(f"{selector} is not reached by the tab key")

    page.choose("#files", [SETS / "noisy.csv"])  # the system's window, which is not of the page
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


def test_nothing_is_lost_by_reload_back_button_or_a_second_tab(page, server):
    _to_model(page, SETS / "noisy.csv")
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
