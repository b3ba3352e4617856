"""Conversion of the entries of the forms to commands, and to the equivalent Python program."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from dahl_ident.elements import (
    BoucWen,
    Dahl,
    Damper,
    Friction,
    Iwan,
    LuGre,
    Mass,
    MaxwellSlip,
    PowerDamper,
    Spring,
)
from dahl_ident.elements.element import KINDS, class_named
from dahl_ident.elements.law_files import load_laws
from dahl_ident.errors import DahlIdentError, DataError
from dahl_ident.units import SI_UNITS, parse_quantity

_LAWS: tuple[tuple[str, str, Any], ...] = (
    ("Dahl", "pivots, bearings, gears: stiffness, then slip", Dahl(0.7, 3.0, 1.0)),
    ("Bouc-Wen", "hysteresis with a stiffness after slip", BoucWen(3.0, 4.0, 1.0)),
    (
        "Maxwell slip",
        "several springs that slip one after the other",
        MaxwellSlip([0.1, 0.3, 0.6], [1.0, 0.8, 0.5]),
    ),
    ("Iwan", "bolted joints: microslip, then slip", Iwan(0.7, 3.0, -0.5, 0.7)),
    ("LuGre", "friction that depends on the speed", LuGre(0.7, 3.0, 1.4, 0.2, 0.05, 0.05)),
    ("power damper", "damping force as a power of the speed", PowerDamper(0.7, 0.3)),
)
"""Name and use of each law, and an element whose loop is drawn for an amplitude of 1."""
LINEAR = {"mass": Mass, "damping": Damper, "stiffness": Spring}
"""The options of elements without friction, and their classes."""
TABLE_OPTIONS = ("quantity", "amplitude", "frequency", "sweep", "level_from_name", "controlled")
RECORD_OPTIONS = ("sample_rate",)
COMMON_OPTIONS = ("drive", "drive_factor")
FIELDS = {
    "columns": "What the channels are",
    "kind": "They hold",
    "controlled": "Held by the bench",
    "quantity": "Response quantity",
    "frequency": "Frequency of all rows",
    "sweep": "Frequencies in order",
    "amplitude": "Displacement amplitude",
    "drive": "Force amplitude, or its column",
    "drive_factor": "Force for one unit of drive",
    "level_from_name": "Level in the files' names (regular expression)",
    "sample_rate": "Sample rate",
}
"""What the form of the data calls the options of reading, on the page and in messages."""
ROLES = (
    "",
    "time",
    "displacement",
    "velocity",
    "acceleration",
    "force",
    "drive",
    "frequency",
    "amplitude",
    "response",
    "real",
    "imag",
    "gain",
    "gain_db",
    "phase",
    "level",
    "run",
    "controlled",
    "harmonic",
)
"""Possible roles of a channel; "" is that of its name, or none."""
_COLUMNS, _REPORT = "columns.toml", "report.toml"
REPORTS = ("report.html", "report.pdf")


def laws(files: Sequence[str]) -> list[dict[str, str]]:
    """Return the laws that can be chosen, including those in the user's files."""
    known = [{"kind": e.kind, "name": name, "use": use, "drawn": "yes"} for name, use, e in _LAWS]
    for file in files:
        load_laws(Path(file))
    for cls in KINDS.values() if files else ():
        if issubclass(cls, Friction) and not cls.__module__.startswith("dahl_ident."):
            use = (cls.__doc__ or "").strip().partition("\n")[0]
            known.append({"kind": cls.kind, "name": cls.__name__, "use": use, "drawn": ""})
    return known


@cache
def loop_picture(kind: str) -> str | None:
    """Return a picture of a law's loop as SVG, None for laws of the user."""
    element = next((element for _, _, element in _LAWS if element.kind == kind), None)
    if element is None:
        return None
    theta = 2.0 * np.pi * np.linspace(0.0, 2.25, 451)
    values = [np.asarray(parameter.value) for parameter in element.parameters]
    force = element.force_history(values, np.sin(theta), np.cos(theta))[100:]
    x, y = 50.0 + 42.0 * np.sin(theta[100:]), 34.0 - 28.0 * force / np.abs(force).max()
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 68" width="100" height="68">'
        '<path d="M50 2V66M4 34H96" stroke="#8a94a0" stroke-width=".7" fill="none"/>'
        f'<polyline points="{points}" fill="none" stroke="#3b82c4" stroke-width="2"/></svg>'
    )


@dataclass(frozen=True)
class JobStep:
    """A command of a job: its title, and its words after ``dahl-ident``."""

    title: str
    words: tuple[str, ...]


def fit_steps(work: Mapping[str, Any], folder: Path, run: str, *, metadata: bool) -> list[JobStep]:
    """Return the commands of a fit and its report, in the folder of the work."""
    source, extraction = _source(work, folder, run)
    laws = _law_options(work["laws"])
    report_data = ["--metadata", _REPORT] if metadata else []
    outputs = [word for name in REPORTS for word in ("-o", f"{run}/{name}")]
    saved = f"{run}/fit.json"
    fit = ("fit", *source, *laws, *_model_words(work["model"]), *report_data, "--save", saved)
    return [
        *extraction,
        JobStep("Fit", fit),
        JobStep("Report", ("report", saved, *laws, *report_data, *outputs)),
    ]


def _law_options(files: Sequence[str]) -> list[str]:
    return [word for file in files for word in ("--laws", file)]


def compare_step(steps: Sequence[Mapping[str, Any]]) -> JobStep:
    """Return the command that compares the model of a fit with others."""
    fit = next(step["words"] for step in steps if step["title"] == "Fit")
    return JobStep("Comparison", (*fit[: fit.index("--save")], "--compare"))


def plan_step(run: str, form: Mapping[str, str], folder: str, laws: Sequence[str]) -> JobStep:
    """Return the command that plans the next measurement from a saved fit."""
    words = ["plan", f"{run}/fit.json", *_law_options(laws)]
    words += _options(form, ("frequency", "displacement", "force", "time", "controlled"))
    for target in form.get("target", "").split():
        words += ["--target", target]
    words += ["--table", f"{folder}/plan.csv", "--picture", f"{folder}/plan.png"]
    if form.get("sample_rate"):
        words += ["--sample-rate", form["sample_rate"], "--waveform", f"{folder}/waveform.csv"]
    return JobStep("Plan", tuple(words))


def _source(work: Mapping[str, Any], folder: Path, run: str) -> tuple[list[str], list[JobStep]]:
    """Return the files and their options for the fit, and the step of extraction if needed."""
    reading = work["reading"]
    kind = reading.get("kind", "")
    files = [str(file["stored"]) for file in work["files"]]
    columns = ["--columns", _COLUMNS] if (folder / _COLUMNS).exists() else []
    common = [*columns, *_options(reading, COMMON_OPTIONS)]
    if kind == "extract":
        words = ["extract", *files, *common, *_options(reading, (*RECORD_OPTIONS, "controlled"))]
        points = f"{run}/points.csv"
        return [points], [JobStep("Extraction", (*words, "-o", points))]
    if kind == "record":
        return [*files, "--record", *common, *_options(reading, RECORD_OPTIONS)], []
    return [*files, *common, *_options(reading, TABLE_OPTIONS)], []


def _model_words(model: Mapping[str, str]) -> list[str]:
    """Return the options of the model."""
    law = f"{model['law']}({model['known'].strip()})".removesuffix("()")
    words = ["--element", f"backlash({law})" if model["play"] else law]
    for name, value in _linear(model):
        words += [f"--{name}", value]
    return words


def _linear(model: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield option and value (or "free") of each linear element of the model."""
    for name in LINEAR:
        choice = model.get(name, "none")
        if choice != "none":
            yield name, "free" if choice == "free" else model.get(f"{name}_value", "").strip()


def _options(form: Mapping[str, str], names: Sequence[str]) -> list[str]:
    stated = ((name, form.get(name, "").strip()) for name in names)
    return [w for name, text in stated if text for w in (f"--{name.replace('_', '-')}", text)]


def as_python(work: Mapping[str, Any], folder: Path, *, metadata: bool) -> str:
    """Return a Python program that is equivalent to the commands."""
    reading, model = work["reading"], work["model"]
    kind = reading.get("kind", "")
    is_table = kind in ("", "table")
    names = (*COMMON_OPTIONS, *(TABLE_OPTIONS if is_table else RECORD_OPTIONS))
    keywords = {"columns": _COLUMNS} if (folder / _COLUMNS).exists() else {}
    keywords |= {name: reading[name] for name in names if reading.get(name)}
    options = "".join(f", {name}={value!r}" for name, value in keywords.items())
    files = [str(file["stored"]) for file in work["files"]]
    data = f"di.read_frequency_response({files!r}{options})"
    if not is_table:
        data = f"[di.read_record(file{options}) for file in {files!r}]"
    data = f"di.extract({data})" if kind == "extract" else data
    law = class_named(model["law"])
    name = law.__name__ if law is not None else model["law"]
    of_package = law is not None and law.__module__.startswith("dahl_ident.")
    element = f"{'di.' if of_package else ''}{name}({model['known'].strip()})"
    element = f"di.Backlash({element})" if model["play"] else element
    for option, value in _linear(model):
        element += f" + di.{LINEAR[option].__name__}({_in_si(value, option)})"
    report_data = f", metadata={_REPORT!r}" if metadata else ""
    sensors = f", sensors=di.Sensors.from_metadata({_REPORT!r})" if metadata else ""
    return (
        f"import dahl_ident as di\n\ndata = {data}\nfit = di.fit(data, {element}{sensors})\n"
        f"print(fit.verdict)\nfit.save('fit.json')\ndi.report(fit, 'report.html'{report_data})\n"
    )


def _in_si(text: str, option: str) -> str:
    """Return a quantity as a number in SI units for a program; "" if it is free."""
    unit = LINEAR[option].parameters[0].unit
    kinds = tuple(kind for kind, both in SI_UNITS.items() if unit in both)
    try:
        return "" if text == "free" else f"{parse_quantity(text, kinds, option)[0]:.12g}"
    except DahlIdentError:  # the command reports the error
        return text


def columns_toml(form: Mapping[str, str]) -> str:
    """Return the column map of the data form: role, unit and sign of each channel."""
    entries: dict[str, dict[str, Any]] = {}
    for key, column in form.items():
        number = key.removeprefix("channel_")
        role = form.get(f"role_{number}", "")
        if number == key or not role:
            continue
        if role in entries:
            raise DataError(
                f"{entries[role]['column']} and {column} are both the {role}; go back and choose "
                "another role for one of them"
            )
        entries[role] = {"column": column}
        if form.get(f"unit_{number}", "").strip():
            entries[role]["unit"] = form[f"unit_{number}"].strip()
        if form.get(f"sign_{number}") == "-1":
            entries[role]["sign"] = -1
    return tomli_w.dumps(entries)


def report_toml(form: Mapping[str, str]) -> str:
    """Return the metadata of the report from the form, without empty fields."""
    entries = {name: text.strip() for name, text in form.items() if text.strip()}
    stated: dict[str, Any] = {
        name.removeprefix("meta_"): text
        for name, text in entries.items()
        if name.startswith("meta_")
    }
    for channel in ("force", "displacement", "delay"):
        fields = ("name", "serial", "calibration", "uncertainty", "k")
        instrument: dict[str, Any] = {
            f: entries[f"{channel}_{f}"] for f in fields if f"{channel}_{f}" in entries
        }
        if set(instrument) - {"k"}:
            instrument = {
                "channel": channel,
                "name": f"{channel} channel".capitalize(),
                **instrument,
            }
            with suppress(ValueError):
                if math.isfinite(k := float(instrument.get("k", ""))):
                    instrument["k"] = k
            stated.setdefault("instruments", []).append(instrument)
    return tomli_w.dumps(stated)
