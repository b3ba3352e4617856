"""Reports as a laboratory signs them: header, order, what is crossed out, comparison, schema."""

import hashlib
import io
import json
import math
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import trapezoid

import dahl_ident as di
from dahl_ident import report
from dahl_ident.errors import DataError, ValidationError
from tests.browser import CHROMIUM, chromium
from tests.friction_tables import relative_noise

METADATA: dict[str, Any] = {
    "specimen": "Flex pivot 12",
    "operator": "A. Smith",
    "measured": "2026-11-20",
    "ambient": {"temperature": "22.1 °C"},
    "instruments": [
        {"name": "Force sensor", "serial": "4711", "calibration": "2026-03-01",
         "uncertainty": "0.5 %"},
        {"name": "LVDT"},
    ],
}  # fmt: skip
SCHEMA = json.loads((files("dahl_ident.reporting") / "report.schema.json").read_text("utf-8"))


def measured(f_max, seed, *, amplitudes=(3e-4, 3e-2), file=""):
    A = np.geomspace(amplitudes[0], amplitudes[1], 20)
    response = di.Dahl(f_max, 30.0).describing_function(A) * relative_noise(20, 0.01, seed)
    provenance = {"file": file, "sha256": "ab" * 32} if file else None
    return di.FrequencyResponse(np.ones(20), response, A, provenance=provenance)


def text_of(*results, metadata=None):
    """Return a report as text without escapes."""
    with TemporaryDirectory() as folder:
        place = report(list(results), Path(folder) / "r.md", metadata=metadata)
        return place.read_text("utf-8").replace("\\", "")


def facts_of(results, place, **options):
    """Return a report as data."""
    return json.loads(report(results, place, overwrite=True, **options).read_text("utf-8"))


def changes_of(facts):
    """Return what a report says of the change of each parameter."""
    return {change["parameter"]: change for change in facts["changes"]}


@pytest.fixture(scope="module")
def fit():
    return di.fit(measured(0.1, 1, file="pivot.csv"), di.Dahl())


@pytest.fixture(scope="module")
def microslip():
    return di.fit(measured(0.1, 1, amplitudes=(1e-7, 1e-6)), di.Dahl(), throw=False)


def test_the_header_states_what_was_measured_and_with_what(fit):
    text = text_of(fit, metadata=METADATA)
    head = text.split("\n## ")[0]
    for row in (
        "| Specimen | Flex pivot 12 |",
        "| Model | Dahl friction: dF/dx = sigma",
        "SHA-256 " + "ab" * 6 + "...",
        "| Instruments | Force sensor, serial 4711, calibrated: 2026-03-01, uncertainty 0.5 %; "
        "LVDT, calibration not stated, uncertainty not stated |",
        "| Ambient conditions | temperature 22.1 °C |",
        "| Operator | A. Smith |",
        f"| Software | dahl_ident {di.__version__} |",
    ):
        assert row in head
    assert "____" not in head


def test_what_nobody_stated_is_a_line_to_fill_in(fit, tmp_path):
    head = text_of(fit).split("\n## ")[0]
    blank = re.findall(r"^\| ([\w ]+) \| _+ \|$", head, re.MULTILINE)
    assert blank == [
        "Specimen", "Instruments", "Ambient conditions", "Date of measurement", "Operator"
    ]  # fmt: skip
    page = report(fit, tmp_path / "r.html").read_text("utf-8")
    assert page.count('class="blank"') == len(blank) + 3, "and date, name, signature"


def test_metadata_from_a_file(fit, tmp_path):
    place = tmp_path / "lab.toml"
    place.write_text('specimen = "S 1"\nmeasured = 2026-11-20\n[ambient]\nhumidity = "41 %"\n')
    facts = facts_of(fit, tmp_path / "r.json", metadata=place)
    assert facts["metadata"]["specimen"] == "S 1"
    assert facts["metadata"]["measured"] == "2026-11-20"
    assert facts["metadata"]["ambient"] == ["humidity 41 %"]
    place.write_text("specimen = ")
    with pytest.raises(DataError, match=r"lab\.toml: is not a TOML file"):
        report(fit, tmp_path / "s.json", metadata=place)
    with pytest.raises(DataError, match=r"absent\.toml: the file cannot be read"):
        report(fit, tmp_path / "s.json", metadata=tmp_path / "absent.toml")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"speciman": "x"}, r"field 'speciman'; expected any of title, number, lab"),
        ({"operator": ["x"]}, r"operator is \['x'\]; expected a text"),
        ({"ambient": False}, "ambient is False; expected a text, a number or a date"),
        ({"instruments": "x"}, "instruments is 'x'; expected a list"),
        ({"instruments": [{"nmae": "x"}]}, r"instruments\[0\] has the field 'nmae'"),
    ],
)
def test_metadata_of_another_kind_is_refused(fit, tmp_path, given, message):
    with pytest.raises(ValidationError, match=message):
        report(fit, tmp_path / "r.json", metadata=given)


def test_the_hash_is_that_of_the_file_that_was_read(tmp_path, run):
    """Also where the file is a copy that carries the hash of what it was made from."""
    place = tmp_path / "noisy.csv"
    assert run("datasets", "noisy", "-o", str(place)).status == 0
    again = di.fit(di.read_frequency_response(place), di.Dahl())
    facts = facts_of(again, tmp_path / "r.json")
    read = [one for one in facts["files"] if one["read"]]
    assert [Path(one["file"]).name for one in read] == ["noisy.csv"]
    assert read[0]["sha256"] == hashlib.sha256(place.read_bytes()).hexdigest()
    assert len(facts["files"]) == 2, "the shipped file it was made from stands after it"


def test_the_order_is_answer_assumed_signature_details(fit, tmp_path):
    text = text_of(fit)
    sections = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert sections[:7] == [
        "Result", "Expanded uncertainty", "What was assumed", "Signature", "Pictures",
        "Sources of uncertainty", "Parameters"
    ]  # fmt: skip
    assumed = text.split("## What was assumed")[1].split("## ")[0]
    alpha = f"{fit.errors.values['alpha']:.3f} ± {fit.errors.stderr['alpha']:.3f}"
    assert f"Not given, so that the uncertainty counts it: alpha, here {alpha}." in assumed
    (exact,) = re.findall(r"Taken as exact: (.*?)\.", assumed)
    assert [name for name in fit.budget().exact if name not in exact] == []
    stated = fit.budget()["f_max"]
    combined = text.split("## Expanded uncertainty")[1].split("## ")[0]
    shown = _result_rows(text)["f_max"][2]
    assert f"| f_max | {shown} |" in combined, "one notation of u in both tables"
    assert f"| {stated.k:.2f} |" in combined
    assert f"{stated.rows[0].source} {100.0 * stated.rows[0].share:.0f} %" in combined
    budget = text.split("## Sources of uncertainty")[1].split("## ")[0]
    for row in stated.rows:
        assert f"| f_max | {row.source} | {row.kind} | {row.u:.2g} |" in budget
    for kind in ("Figure", "Table"):
        numbers = [int(n) for n in re.findall(rf"[*]{kind} (\d+)\.", text)]
        assert numbers == list(range(1, len(numbers) + 1))


def test_what_must_not_be_used_is_crossed_out_with_its_reason(fit, microslip, tmp_path):
    rows = _result_rows(text_of(microslip))
    assert rows["f_max"][1].startswith("~~")
    assert "not determined, because no amplitude" in rows["f_max"][-1]
    assert not any("~~" in cell for cell in rows["sigma"])
    dahl = measured(0.1, 1)
    bent = replace(dahl, response=dahl.response * (1 + 2 * (np.arange(20) % 2)))
    text = text_of(di.fit(bent, di.Dahl(), throw=False))
    assert "Derived: " not in text
    for table, columns in (("## Parameters", slice(1, 3)), ("## Stiffness and d", slice(1, None))):
        lines = text.split(table)[1].split("\n## ")[0].splitlines()
        struck = [line.strip("| ").split(" | ") for line in lines if line.startswith("|")][2:]
        assert [row for row in struck if row[0] != "alpha" and "~~" not in row[columns][0]] == []
    rows = _result_rows(text)
    for cells in rows.values():
        assert all(cell.startswith("~~") for cell in cells[1:4])
    assert "does not describe the data" in rows["sigma"][-1]
    assert "~~" not in text_of(fit)
    page = report(microslip, tmp_path / "a.html").read_text("utf-8")
    assert re.search(r"<s>[0-9.e+-]+</s>", page)


def _result_rows(text):
    table = text.split("## Result")[1].split("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("|")]
    return {row[0]: row for row in rows[2:]}


def runs(f_max, seed, scatter, count):
    """Return a fit of some runs between which the friction scatters, exactly by its share."""
    rng = np.random.default_rng(seed)
    shares = 1.0 + scatter * stats.zscore(rng.standard_normal(count), ddof=1)
    tables = [
        replace(measured(f_max * share, 100 * seed + i), run=np.full(20, f"day {i + 1}"))
        for i, share in enumerate(shares)
    ]
    return di.fit(di.FrequencyResponse.concatenate(tables), di.Dahl(alpha=1.0))


def test_two_devices_are_overlaid_and_their_changes_judged(tmp_path):
    fit, later = runs(0.1, 1, 0.01, 4), runs(0.15, 2, 0.01, 4)
    found = changes_of(facts_of([fit, later], tmp_path / "r.json"))
    assert found["f_max"]["significant"]
    assert not found["sigma"]["significant"]
    for name, change in found.items():
        one, other = fit.budget()[name], later.budget()[name]
        u = math.hypot(one.u, other.u)
        z = (other.value - one.value) / u
        assert change["u"] == pytest.approx(u)
        assert change["p"] == pytest.approx(2.0 * (1.0 - stats.norm.cdf(abs(z))), abs=1e-12)
    text = report([fit, later], tmp_path / "r.md").read_text("utf-8").replace("\\", "")
    assert re.search(r"f_max from .*: 0.0[45]\d* ± 0.00\d* N .*: significant", text)
    assert (tmp_path / "r_pictures" / "overlay.png").exists()


def test_scatter_between_runs_counts_in_the_change_of_a_single_run(fit, tmp_path):
    """A single day compared with four: its own scatter is that of the four."""
    several = runs(0.103, 3, 0.02, 4)
    change = changes_of(facts_of([fit, several], tmp_path / "r.json"))["f_max"]
    assert change["runs_known"]
    assert change["u"] > 0.02 * 0.1, "one day of a device that scatters by 2 % between days"
    assert not change["significant"]
    later = di.fit(measured(0.1, 2), di.Dahl())
    alone = changes_of(facts_of([fit, later], tmp_path / "r.json"))
    assert not alone["f_max"]["runs_known"]


def test_two_single_runs_leave_open_whether_the_device_changed(fit, tmp_path):
    later = di.fit(measured(0.11, 2, file="later.csv"), di.Dahl())
    facts = facts_of([fit, later], tmp_path / "r.json")
    assert [file["file"] for file in facts["files"]] == ["pivot.csv", "later.csv"]
    change = changes_of(facts)["f_max"]
    assert (change["p"] < 1e-4, change["significant"]) == (True, False)
    assert any("scatter between runs" in line for line in facts["verdict"])


def test_a_change_of_what_is_not_determined_is_not_judged(fit, microslip, tmp_path):
    found = changes_of(facts_of([fit, microslip], tmp_path / "r.json"))
    assert (found["f_max"]["p"], found["f_max"]["significant"]) == (None, False)
    assert found["sigma"]["p"] is not None


def test_two_saved_fits_say_what_changed(run, fit):
    fit.save("monday.json")
    di.fit(measured(0.11, 2), di.Dahl()).save("friday.json")
    told = run("fit", "monday.json", "friday.json", "--report", "change.html")
    assert told.status == 0, told.err
    assert re.search(r"f_max from monday to friday: 0.0\d+ ± 0.00\d+ N \(\+1\d %, p < 0", told.out)
    assert "sigma from monday to friday: " in told.out
    assert "Each fit is of a single run" in told.out
    assert Path("change.html").exists()
    assert "give no other options" in run("fit", "monday.json", "friday.json", "--mass", "1").err
    as_json = json.loads(run("fit", "monday.json", "friday.json", "--json").out)
    assert {c["parameter"] for c in as_json} == {"f_max", "sigma"}
    di.fit(measured(50.0, 2, amplitudes=(0.15, 15.0)), di.Dahl()).save("other.json")
    told = run("fit", "other.json", "monday.json")
    assert re.search(r"f_max from other to monday: .* N \(-100 %, p < 0", told.out)


def test_fits_that_describe_nothing_say_nothing_of_changes(run):
    for name in ("monday", "friday"):
        wrong = di.fit(di.load_dataset("alpha_2"), di.Dahl(alpha=1.0))
        assert wrong.status == "not described"
        wrong.save(f"{name}.json")
    told = run("fit", "monday.json", "friday.json").out
    assert "Whether a parameter changes cannot be stated" in told
    assert "No parameter changes" not in told


def test_equal_devices_seldom_change_significantly(tmp_path):
    """At 5 %, 2 parameters of 15 pairs: more than 6 significant ones have probability 0.1 %."""
    fits, found = [di.fit(measured(0.1, seed), di.Dahl()) for seed in range(30)], []
    for a, b in zip(fits[::2], fits[1::2], strict=True):
        changes = changes_of(facts_of([a, b], tmp_path / "r.json"))
        found += [changes[name]["p"] < 0.05 for name in ("f_max", "sigma")]
    assert len(found) == 30
    assert stats.binom.sf(sum(found) - 1, 30, 0.05) > 1e-3


def test_json_follows_the_published_schema(fit, microslip, tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    chain = di.posterior(fit.data, di.Dahl(alpha=1.0), seed=1, steps=60)
    cases: tuple[list[Any], ...] = ([fit], [microslip], [fit, chain], [chain], [fit, microslip])
    for results in cases:
        facts = facts_of(results, tmp_path / "r.json")
        jsonschema.validate(facts, SCHEMA)
    facts["fits"][0]["status"] = "fine"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(facts, SCHEMA)


def _computed(page, selector, property_name):
    every = f"[...document.querySelectorAll('{selector}')]"
    return set(page.value(f"{every}.map(e => getComputedStyle(e).{property_name})"))


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_the_page_on_a4(fit, microslip, tmp_path):
    """At most two pages before the details; tables keep headings, nothing is split or lost."""
    pypdf = pytest.importorskip("pypdf")
    with chromium(tmp_path / "profile") as page:
        for name, result in (("good", fit), ("bad", microslip)):
            place = report(result, tmp_path / f"{name}.html", metadata=METADATA)
            page.open(place, 1400)
            page.call("Emulation.setEmulatedMedia", media="print")
            for what in ("figure", "tr", ".verdict", ".signature"):
                assert _computed(page, what, "breakInside") == {"avoid"}, what
            assert _computed(page, "h2, .bar", "breakAfter") == {"avoid"}
            assert _computed(page, "nav, .copy", "display") == {"none"}
            sheets = pypdf.PdfReader(io.BytesIO(page.print_to_pdf())).pages
            printed = [sheet.extract_text() for sheet in sheets]
            page.call("Emulation.setEmulatedMedia", media="screen")
            sizes = {len(text.strip()) > 30 for text in printed}
            assert sizes == {True}, "no page is blank"
            (signed,) = (i for i, text in enumerate(printed) if "Signature" in text)
            (pictures,) = (i for i, text in enumerate(printed) if "Figure 1." in text)
            assert signed <= 1
            assert pictures == signed + 1
            for i, text in enumerate(printed):
                assert f"Page {i + 1} of {len(printed)}" in text
            rows = [t for t in printed if re.search(r"^1 +[0-9.e-]+ ", t, re.MULTILINE)]
            assert rows
            assert all("frequency [Hz]" in t for t in rows), "the heading is repeated"


def test_pdf_marks_its_headings_for_reading_aloud(fit, tmp_path):
    pypdf = pytest.importorskip("pypdf")
    reader = pypdf.PdfReader(report(fit, tmp_path / "r.pdf"))
    tree = reader.trailer["/Root"]["/StructTreeRoot"]["/K"][0].get_object()["/K"]
    elements = [element.get_object() for element in tree]
    tags = [element["/S"] for element in elements]
    for table in (element for element in elements if element["/S"] == "/Table"):
        lines = [row.get_object()["/K"] for row in table["/K"]]
        kinds = [[cell.get_object()["/S"] for cell in line] for line in lines]
        assert set(kinds[0]) == {"/TH"}
        assert {kind for row in kinds[1:] for kind in row} == {"/TD"}
        assert {len(row) for row in kinds} == {len(kinds[0])}
    assert tags.count("/Table") >= 4
    assert tags.count("/H1") == 1
    assert tags.count("/H2") >= 6
    assert tags.count("/Figure") >= 5
    front = [page.extract_text() for page in reader.pages]
    (signed,) = (i for i, text in enumerate(front) if "Signature" in text)
    assert signed <= 1


CERTIFIED = {
    **METADATA,
    "number": "2026-117",
    "laboratory": "Friction Laboratory\n12 Example Road",
    "authorised_by": "B. Sample",
    "role": "head of laboratory",
    "instruments": [
        {"name": "Load cell", "channel": "force", "uncertainty": "1 %", "k": 2},
        {"name": "Amplifier", "channel": "force", "uncertainty": "0.6 %", "k": 2},
        {"name": "Digitiser", "channel": "delay", "uncertainty": "20 us", "k": 1},
    ],
}


def test_the_instruments_calibrations_are_the_priors_of_the_sensors():
    sensors = di.Sensors.from_metadata(CERTIFIED)
    assert sensors.priors["force_gain"].mean() == 1.0
    assert sensors.priors["force_gain"].std() == pytest.approx(np.hypot(0.005, 0.003))
    assert sensors.priors["delay"].mean() == 0.0
    assert sensors.priors["delay"].std() == pytest.approx(20e-6)
    assert sensors.displacement_gain == 1.0


def test_a_report_refuses_a_fit_that_did_not_count_its_instruments(fit, tmp_path):
    with pytest.raises(ValidationError, match=r"0\.00583 for force_gain, but the fit takes it as"):
        report(fit, tmp_path / "r.html", metadata=CERTIFIED)
    counted = di.fit(fit.data, di.Dahl(), sensors=di.Sensors.from_metadata(CERTIFIED))
    text = text_of(counted, metadata=CERTIFIED)
    assert "force calibration" not in text.split("Taken as exact: ")[1].split("\n")[0]
    assert "force calibration" in text.split("## Sources of uncertainty")[1].split("## ")[0]
    assert report(counted, tmp_path / "r.html", metadata=CERTIFIED).exists()


@pytest.mark.parametrize(
    ("instrument", "message"),
    [
        ({"channel": "forse"}, r"\[0\]\.channel is 'forse'; expected force, displacement, delay"),
        ({"channel": "force", "uncertainty": "0.5 %"}, r"\[0\] has an uncertainty .* but no k"),
        ({"channel": "force", "uncertainty": "0.2 N", "k": 2}, "expected a share of the reading"),
        ({"channel": "force", "uncertainty": "-1 %", "k": 2}, "a number above zero"),
        ({"channel": "delay", "uncertainty": "1 %", "k": 2}, 'expected "20 us"'),
        ({"channel": "force", "uncertainty": "1 %", "k": "two"}, "k 'two'"),
    ],
)
def test_an_uncertainty_without_its_meaning_is_refused(instrument, message):
    with pytest.raises(ValidationError, match=message):
        di.Sensors.from_metadata({"instruments": [instrument]})


def test_number_title_hash_and_page_stand_on_every_page(tmp_path):
    pypdf = pytest.importorskip("pypdf")
    data, sensors = measured(0.1, 1, file="pivot.csv"), di.Sensors.from_metadata(CERTIFIED)
    counted = di.fit(data, di.Dahl(), sensors=sensors)
    place = report(counted, tmp_path / "r.pdf", title="Pivot 12", metadata=CERTIFIED)
    pages = [page.extract_text() for page in pypdf.PdfReader(place).pages]
    for i, text in enumerate(pages, 1):
        assert "Pivot 12 \u00b7 Report 2026-117 \u00b7 pivot.csv, SHA-256 abababababab" in text
        assert f"Page {i} of {len(pages)}" in text
    assert "Authorised by, B. Sample, head of laboratory" in " ".join("".join(pages[:2]).split())
    assert "The results relate only to the item that was measured." in pages[0]


def test_the_energy_of_a_cycle_has_the_uncertainty_of_the_budget(fit):
    """The loop of Dahl's law from its differential equation, integrated over its displacement."""
    found = re.search(
        r"A cycle loses \S+ ± \S+ J at \S+ m and (\S+) ± (\S+) J at (\S+) m", text_of(fit)
    )
    lost, u, A = map(float, found.groups())
    truth = di.Dahl(0.1, 30.0, alpha=1.0).loop(A, 20001)
    assert abs(lost - abs(float(trapezoid(truth[1], truth[0])))) < 3.0 * u
    assert u > 0.5 * lost * fit.budget()["f_max"].u / fit.budget()["f_max"].value


@pytest.mark.parametrize("f_max", [0.1, 0.07])
def test_a_table_and_waveforms_of_one_test_are_compared(f_max, tmp_path):
    time = np.arange(400) / 100.0
    x = 5e-3 * np.sin(2.0 * time) * (0.2 + 0.8 * np.sin(0.6 * time) ** 2)
    noise = 5e-4 * np.random.default_rng(2).standard_normal(400)
    force = di.Dahl(f_max, 30.0, 1.0).force(x) + noise
    fits: list[Any] = [
        di.fit(measured(0.1, 1), di.Dahl()),
        di.fit(di.Record(time, displacement=x, force=force), di.Dahl()),
    ]
    facts = facts_of(fits, tmp_path / "both.json")
    pytest.importorskip("jsonschema").validate(facts, SCHEMA)
    assert changes_of(facts).keys() == {"f_max", "sigma"}
    assert ("f_max" in facts["disagree"]) is (f_max != 0.1)
    assert (facts["status"] == "not described") is (f_max != 0.1)
    first = facts["verdict"][0]
    if f_max == 0.1:
        assert first == "Table and waveforms agree within their uncertainties."
    else:
        assert first.startswith("Table and waveforms disagree: f_max is 0.0")
        assert " from the table and 0.0699" in first
    text = report(fits, tmp_path / "both.md").read_text("utf-8")
    assert text.index("## Table and waveforms") < text.index("## Result")
    assert text.count("## Result") == 2


def test_pictures_of_two_fits_are_files_of_their_own(fit, tmp_path):
    other = di.fit(fit.data, di.BoucWen())
    text = report([fit, other], tmp_path / "both.md").read_text("utf-8")
    named = re.findall(r"<(both_pictures/\S+)>", text)
    assert len(named) == len(set(named)) > 8
    assert all((tmp_path / name).exists() for name in named)
