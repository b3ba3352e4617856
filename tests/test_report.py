"""Reports: what they say, in every format, and how the page behaves in a browser."""

import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from scipy import stats

import dahl_ident as di
from dahl_ident import report
from dahl_ident.errors import DataError, ValidationError
from dahl_ident.reporting.document import Cell, Document, Paragraph, Section, TextTable
from dahl_ident.reporting.pdf import pdf
from tests.browser import CHROMIUM, chromium
from tests.friction_tables import PLANT, driven, table

NASTY = "<img src=x onerror=alert(1)>&\"'|*_`[x](y)#.csv"
WIDTHS = (400, 1400)


@pytest.fixture(scope="module")
def fit():
    provenance = {"file": NASTY, "sha256": "ab" * 32, "options": "x", "notes": ["zero to peak"]}
    return di.fit(replace(table(n=20), provenance=provenance), di.Dahl())


@pytest.fixture(scope="module")
def posterior(fit):
    return di.posterior(fit, seed=3, ess=200.0, uncertainty="noise")


@pytest.fixture(scope="module")
def page_file(fit, posterior, tmp_path_factory):
    return report([fit, posterior], tmp_path_factory.mktemp("report") / "report.html")


class Outline(HTMLParser):
    """Headings, pictures and links to elsewhere, as a reader program meets them."""

    def __init__(self, text):
        super().__init__()
        self.headings: list[int] = []
        self.alts: list[str] = []
        self.outside: list[str] = []
        self.scripts = 0
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if tag == "img":
            self.alts.append(given.get("alt") or "")
        self.scripts += tag == "script"
        places = [given.get(name) or "" for name in ("src", "href")]
        self.outside += [p for p in places if p and not p.startswith(("data:", "#"))]


@pytest.mark.versions
def test_html_is_one_file_with_headings_in_order_and_alt_texts(page_file):
    outline = Outline(page_file.read_text(encoding="utf-8"))
    assert outline.outside == []
    assert outline.headings[0] == 1
    assert outline.headings.count(1) == 1
    assert all(b - a <= 1 for a, b in zip(outline.headings, outline.headings[1:], strict=False))
    assert len(outline.alts) >= 7
    assert all(re.search(r"\d", alt) for alt in outline.alts), outline.alts
    assert [p.name for p in page_file.parent.iterdir()] == ["report.html"]


def test_text_from_files_is_escaped(page_file):
    text = page_file.read_text(encoding="utf-8")
    assert "<img src=x" not in text
    assert "&lt;img src=x onerror=alert(1)&gt;" in text
    assert Outline(text).scripts == 1


def test_html_tells_the_numbers_side_by_side(page_file, fit):
    text = page_file.read_text(encoding="utf-8")
    for method in ("Wald 95.45 %", "profile 95.45 %", "posterior 95.45 %"):
        assert method in text
    assert f'data-value="{fit.params["f_max"].value}"' in text
    software = f"dahl_ident {di.__version__}, python"
    for fact in ("ab" * 32, software, "Seed 3", "dahl-ident fit", "Zero to peak"):
        assert fact in text


@pytest.mark.pictures
def test_the_same_result_gives_the_same_pictures(fit, tmp_path):
    one, two = (report(fit, tmp_path / name) for name in ("a.html", "b.html"))
    pictures = [re.findall(r'src="data:image[^"]*"', p.read_text()) for p in (one, two)]
    assert pictures[0] == pictures[1]


@pytest.mark.versions
def test_json_holds_the_numbers(fit, posterior, tmp_path):
    told = json.loads(report([fit, posterior], tmp_path / "report.json").read_text())
    f_max = told["fits"][0]["parameters"]["f_max"]
    assert f_max["value"] == fit.params["f_max"].value
    assert f_max["interval_95.45"][0] < 0.1 < f_max["interval_95.45"][1]
    assert told["posteriors"][0]["seed"] == 3
    assert told["files"] == [{"file": NASTY, "sha256": "ab" * 32, "read": True}]
    assert told["versions"]["numpy"] == np.__version__


@pytest.mark.versions
def test_markdown_links_pictures_that_exist(fit, tmp_path):
    place = report(fit, tmp_path / "my report.md")
    text = place.read_text(encoding="utf-8")
    links = re.findall(r"!\[[^\n]*\]\(<([^>]*)>\)", text)
    assert len(links) >= 5
    for link in links:
        assert (tmp_path / link).read_bytes().startswith(b"\x89PNG")
    prose = [line for line in text.splitlines() if not line.startswith("    ")]
    assert not any("<img src=x" in line.replace(r"\<img", "") for line in prose)


@pytest.mark.pictures
@pytest.mark.versions
def test_pdf_has_text_pictures_and_outline(fit, tmp_path):
    pypdf = pytest.importorskip("pypdf")
    reader = pypdf.PdfReader(report(fit, tmp_path / "report.pdf"))
    text = "".join("".join(page.extract_text().split()) for page in reader.pages)
    for fact in ("Trusted", "f_max", "ab" * 32, "sigma", "Page1of"):
        assert fact in text
    assert sum(len(page.images) for page in reader.pages) >= 5
    assert next(item.title for item in reader.outline) == "Result"
    sizes = {(round(p.mediabox.width), round(p.mediabox.height)) for p in reader.pages}
    assert sizes == {(595, 842)}


def test_headings_and_captions_in_pdf_stay_with_what_they_head():
    pypdf = pytest.importorskip("pypdf")

    def section(i):
        rows = tuple((Cell(f"row {i}.{j}."),) for j in range(i))
        return Section(f"heading {i}.", (TextTable(f"caption {i}.", ("x",), rows),))

    sections = tuple(map(section, range(1, 25)))
    whole = Document(title="t", status="trusted", verdict=("v",), sections=sections)
    pages = [page.extract_text() for page in pypdf.PdfReader(io.BytesIO(pdf(whole))).pages]
    assert len(pages) > 5
    for i in range(1, 25):
        (page,) = (text for text in pages if f"caption {i}." in text)
        assert f"heading {i}." in page
        assert f"row {i}.0." in page


@pytest.mark.parametrize("count", [36, 39])
def test_fields_for_the_signature_are_not_alone_on_a_page(count):
    pypdf = pytest.importorskip("pypdf")
    facts = Section("facts", tuple(Paragraph(f"fact {i}.") for i in range(count)))
    sections = (facts, Section("details", (Paragraph("more"),), details=True))
    whole = Document(title="t", status="trusted", verdict=("v",), sections=sections)
    pages = [page.extract_text() for page in pypdf.PdfReader(io.BytesIO(pdf(whole))).pages]
    (signed,) = (text for text in pages if "Signature" in text)
    assert f"fact {count - 1}." in signed


def test_the_verdict_is_told_once(fit, tmp_path):
    text = report(fit, tmp_path / "once.md").read_text(encoding="utf-8")
    told = [line for line in text.splitlines() if not line.startswith("![")]  # alt texts tell more
    assert sum("The residuals are consistent with noise" in line for line in told) == 1
    assert f"| rms misfit | {100.0 * fit.goodness.rms_misfit:.2g} % |" in text


def test_a_fit_that_ran_away_is_not_trusted(tmp_path):
    amplitude = np.geomspace(1e-6, 1e-5, 8)
    response = 30.0 * np.exp(1j * 1e-3 * ((-1.0) ** np.arange(8) - 0.5))
    fit = di.fit(di.FrequencyResponse(np.ones(8), response, amplitude), di.Dahl(), throw=False)
    text = report(fit, tmp_path / "lost.html").read_text(encoding="utf-8")
    assert '<p class="mark">Not determined</p>' in text
    assert "No finite optimum" in text
    assert not re.search(r">\s*(nan|inf)\b|data-value=.nan", text)


@pytest.mark.pictures
def test_a_plant_over_frequency_is_reported(tmp_path):
    f, u = np.tile(np.geomspace(0.1, 3.0, 5), 3), np.repeat([0.05, 0.15, 1.0], 5)
    data = driven(f, di.response(PLANT, f, u).receptance, u, level=u)
    free = di.Dahl(alpha=1.0) + di.Mass() + di.Damper() + di.Spring()
    place = report(di.fit(data, free), tmp_path / "plant.html", title="A plant")
    text = place.read_text(encoding="utf-8")
    assert "<h1>A plant</h1>" in text
    assert "over frequency, by level" in text
    assert "equivalent damping [N s/m]" in text


def test_what_cannot_be_written_is_refused(fit, tmp_path):
    with pytest.raises(ValidationError, match=r"written as \.html, \.pdf, \.md, \.json"):
        report(fit, tmp_path / "report.docx")
    with pytest.raises(ValidationError, match="there is no result to report on"):
        report([], tmp_path / "report.html")
    with pytest.raises(ValidationError, match="result 1 is a str; expected a FitResult"):
        report([fit, "fit"], tmp_path / "report.html")  # type: ignore[list-item]
    with pytest.raises(DataError, match="cannot be written"):
        report(fit, tmp_path / "absent" / "report.json")


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_the_page_in_chromium(page_file, tmp_path):
    with chromium(tmp_path / "profile") as page:
        for width in WIDTHS:
            page.open(page_file, width)
            assert page.value("document.documentElement.scrollWidth") <= width
            broken = "[...document.images].filter(i => !i.complete || !i.naturalWidth).length"
            assert page.value(broken) == 0
            assert page.screenshot().startswith(b"\x89PNG")
        page.open(page_file, 1000)
        first = "document.querySelector('.scroll')"
        assert page.value(f"{first}.scrollWidth") == page.value(f"{first}.clientWidth")
        _check_sorting(page)
        _check_copying(page)
        _check_contrast(page)
        assert page.print_to_pdf().startswith(b"%PDF")
        assert page.problems == []
        assert [url for url in page.requests if not url.startswith(("file:", "data:"))] == []


def _check_sorting(page):
    page.value("window.data = [...document.querySelectorAll('table')].find(t => "
               "t.ariaLabel.endsWith('The points as they were fitted')); 1")  # fmt: skip
    gains = "[...data.tBodies[0].rows].map(r => Number(r.cells[2].dataset.value))"
    for direction in (1, -1):
        page.value("data.tHead.rows[0].cells[2].querySelector('button').click()")
        values = page.value(gains)
        assert values == sorted(values, reverse=direction < 0)
    assert page.value("data.tHead.rows[0].cells[2].getAttribute('aria-sort')") == "descending"


def _check_copying(page):
    page.value("navigator.clipboard.writeText = async (t) => { window.copied = t; }; 1")
    page.value("document.querySelector('.table .copy').click()")
    rows = page.value("copied").split("\n")
    assert rows[0].split("\t")[:2] == ["parameter", "estimate"]
    assert float(rows[1].split("\t")[1]) == pytest.approx(0.1, rel=0.05)
    assert len(rows[1].split("\t")[1]) > 10, "every digit is copied"


def _check_contrast(page):
    """All text stands out from its ground by 4.5 to 1 (WCAG 2), in light and dark."""
    script = """
    (() => {
      const rgb = (c) => c.match(/[\\d.]+/g).map(Number);
      const light = (c) => {
        const [r, g, b] = c.map((v) => v / 255)
          .map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
      };
      const ground = (e) => {
        for (let n = e; n; n = n.parentElement) {
          const c = rgb(getComputedStyle(n).backgroundColor);
          if (c.length < 4 || c[3] > 0) return c.slice(0, 3);
        }
        return [255, 255, 255];
      };
      let worst = 21;
      const texts = "p, li, a, td, th button, figcaption, pre, h1, h2, h3, .copy";
      for (const e of document.querySelectorAll(texts)) {
        const [a, b] = [light(rgb(getComputedStyle(e).color).slice(0, 3)), light(ground(e))];
        worst = Math.min(worst, (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05));
      }
      return worst;
    })()
    """
    for scheme in ("light", "dark"):
        feature = {"name": "prefers-color-scheme", "value": scheme}
        page.call("Emulation.setEmulatedMedia", features=[feature])
        assert page.value(script) >= 4.5, scheme


def test_provenance_of_several_files_is_listed(fit, tmp_path):
    parts = [{"file": f"run{i}.csv", "sha256": str(i) * 64} for i in range(2)]
    data = replace(fit.data, provenance={"parts": parts})
    told = json.loads(report(di.fit(data, di.Dahl()), tmp_path / "r.json").read_text())
    assert [(one["file"], one["sha256"]) for one in told["files"]] == [
        ("run0.csv", "0" * 64), ("run1.csv", "1" * 64)
    ]  # fmt: skip
    assert "run0.csv run1.csv" in told["command"]


@pytest.mark.pictures
def test_measured_loops_and_settling_are_shown(tmp_path):
    friction = di.Dahl(0.1, 30.0)
    t = np.arange(6000) / 200.0
    x = 0.008 * np.sin(2.0 * np.pi * 1.25 * t)
    noise = 1e-4 * np.random.default_rng(0).standard_normal(t.size)
    record = di.Record(t, displacement=x, force=friction.force(x) + 0.5 * x + noise)
    fit = di.fit(di.extract(record), di.Dahl() + di.Spring(0.5), throw=False)
    place = report(fit, tmp_path / "r.html", record=record)
    text = place.read_text(encoding="utf-8")
    told = re.search(r"measured loops are within ([0-9.]+) % rms", text)
    assert 0.0 < float(told[1]) < 3.0, "harmonics up to the ninth make the loop"
    assert "Quality of each point" in text
    assert "Points measured from waveforms: 1, all good." in text
    assert "Settling of the point at 1.25 Hz, 0.008 m" in text
    gain = di.Sensors(force_gain=stats.norm(1.0, 0.01))
    calibrated = di.fit(fit.data, fit.model, sensors=gain, throw=False)
    text = report(calibrated, tmp_path / "r.md").read_text(encoding="utf-8")
    assert "There is no measured loop, because a calibration is not exact." in text
    other = di.Record(t, displacement=x, force=x, provenance={"sha256": "00"})
    with pytest.raises(ValidationError, match="not extracted from this record"):
        report(fit, tmp_path / "other.html", record=other)
    with pytest.raises(ValidationError, match="not extracted from this record"):
        report(di.fit(table(n=12), di.Dahl()), tmp_path / "other.html", record=record)


def test_the_bootstrap_stands_next_to_the_others_once_it_was_run(tmp_path):
    fit = di.fit(table(n=12), di.Dahl())
    before = report(fit, tmp_path / "a.md").read_text(encoding="utf-8")
    assert "bootstrap" not in before
    fit.conf_interval("bootstrap", replicates=200)
    after = report(fit, tmp_path / "b.md").read_text(encoding="utf-8")
    assert "| bootstrap 95.45 % |" in after


def first_page(title):
    """Return the text of the first page of a report without sections."""
    whole = Document(title=title, status="trusted", verdict=("Holds.",), sections=())
    pages = pytest.importorskip("pypdf").PdfReader(io.BytesIO(pdf(whole))).pages
    return str(pages[0].extract_text())


def test_pdf_shows_characters_that_its_font_lacks():
    assert first_page("pivot \u65e5 \u03a9").startswith("pivot <U+65E5> \u03a9")


@pytest.mark.parametrize(
    ("title", "printed"),
    [("a\ud800b\x00\n c", "a?b c"), ("W" * 5000, "W" * 200 + "..."), ("word " * 1000, "word word")],
    ids=["half a character", "long", "many words"],
)
def test_titles_that_no_page_has_room_for(fit, tmp_path, title, printed):
    place = report(fit, tmp_path / "r.json", title=title)
    found = json.loads(place.read_text(encoding="utf-8"))["title"]
    assert found.startswith(printed)
    assert printed in report(fit, tmp_path / "r.html", title=title).read_text(encoding="utf-8")
    page = first_page(found)
    assert page.replace("\n", "").startswith(printed)
    assert page.endswith("Page 1 of 1")


def test_files_and_the_files_that_those_were_made_from_are_listed(tmp_path):
    origin = {"file": "raw.csv", "sha256": "1" * 64, "extraction": {"mode": "steps"}}
    read = {"file": "levels.csv", "sha256": "2" * 64, "origin": origin}
    data = replace(table(n=12), provenance=read)
    text = report(di.fit(data, di.Dahl()), tmp_path / "r.md").read_text(encoding="utf-8")
    assert text.startswith("# Friction identified from levels.csv\n")
    for row in (
        "| levels.csv | read | " + "2" * 64,
        "| raw.csv | origin of the file above | " + "1" * 64,
        "extraction mode | steps",
    ):
        assert row in text


def test_a_report_is_replaced_on_request_only(fit, tmp_path):
    place = tmp_path / "r.md"
    (tmp_path / "r_pictures").mkdir()
    mine = tmp_path / "r_pictures" / "residuals.png"
    mine.write_text("mine", encoding="utf-8")
    with pytest.raises(DataError, match=r"residuals\.png: the file exists already"):
        report(fit, place)
    assert [p.name for p in tmp_path.rglob("*.*")] == ["residuals.png"]
    assert report(fit, place, overwrite=True).exists()
    assert mine.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(DataError, match="overwrite=True"):
        report(fit, place)


def test_a_fit_is_saved_as_json_and_replaced_on_request_only(fit, tmp_path):
    place = fit.save(tmp_path / "fit.json")
    assert di.FitResult.load(place).params == fit.params
    with pytest.raises(DataError, match="the file exists already"):
        fit.save(place)
    assert fit.save(place, overwrite=True) == place
    with pytest.raises(ValidationError, match=r"a fit is written as \.json; got '\.txt'"):
        fit.save(tmp_path / "fit.txt")


def test_of_several_fits_each_verdict_names_its_model(fit, tmp_path):
    with_spring = di.fit(fit.data, di.Dahl() + di.Spring(), throw=False)
    path = report([fit, with_spring], tmp_path / "report.md")
    head = path.read_text().split("\n## ")[0]
    for one in (fit, with_spring):
        trust = f"{one.status.capitalize()}. "
        assert f"{one.problem.model!r}: {trust}" in head.replace("\\", "")


def test_a_fit_with_constraints_is_reported(tmp_path):
    """Without profiles, which would not keep them."""

    def constraints(p):
        return [p["sigma"] == 300 * p["f_max"]]

    data, law = di.load_dataset("noisy"), di.Dahl(alpha=1.0)
    fit = di.fit(data, law, method="ipopt", constraints=constraints)
    text = di.report(fit, tmp_path / "report.md").read_text("utf-8")
    assert "Wald 95.45 %" in text
    assert "profile" not in text.split("## Parameters")[1].split("## ")[0]


def test_profiles_have_their_minima_at_the_estimates(tmp_path):
    """The exponent that was not given is held at its estimate, as in the table of intervals."""
    fit = di.fit(di.load_dataset("noisy"), di.Dahl())
    html = di.report(fit, tmp_path / "report.html").read_text("utf-8")
    minima = ", ".join(f"{name} is {fit.params[name].value:.4g}" for name in fit.var_names)
    assert f"at the minima {minima}." in html
