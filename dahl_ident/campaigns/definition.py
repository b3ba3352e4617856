"""Definition of a campaign: a declarative file, checked before anything runs.

    laws = "my_laws.py"            # optional: a Python file with your laws, or a list; it is run

    [files]
    pattern = "data/{device}/{run}_{tension}lb.csv"   # names in braces are read from the path
    kind = "record"                # waveforms; "response" for tables of gain and phase
    covariates = "devices.csv"     # optional table with a column device, and run where needed

    [read]                         # options of read_record or read_frequency_response
    [extract]                      # options of extract
    [fit]                          # options of fit
    [posterior]                    # options of posterior; left out: no posterior

    [[model]]                      # one table for each element
    kind = "dahl"

    [output]
    folder = "results"
    per = "device"                 # one fit for each device; "run": one for each file
    reports = false                # a report for each fit

Paths are relative to the file.
"""

from __future__ import annotations

import csv
import glob
import hashlib
import inspect
import json
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

from dahl_ident.data.entries import checked, expecting
from dahl_ident.data.storage import path_of, read_toml, regular
from dahl_ident.errors import DataError, ModelError, ValidationError, choices

_SET_BY_CAMPAIGN = {"data", "model", "path", "record", "run", "throw", "seed", "progress"}
_FIELD = re.compile(r"\{([A-Za-z_][A-Za-z0-9_]*)\}")
# columns of the table of results, and the beginnings of their names; covariates have other names
_COLUMNS = {
    "device",
    "run",
    "status",
    "error",
    "statements",
    "assumed",
    "points",
    "runs",
    "digests",
    "seconds",
    "version",
    "report",
    "retry",
    "refused",
    "key",
}
_PREFIXES = ("u_", "U_", "dof_", "unit_", "posterior_")
_BLANK = ("", "na", "n/a", "nan")


@dataclass(frozen=True)
class _Files:
    pattern: str = expecting("text such as 'data/{device}.csv'")
    kind: Literal["record", "response"] = "record"
    covariates: str | None = expecting("the path of a table", default=None)


@dataclass(frozen=True)
class _Output:
    folder: str = field(
        default="results", metadata={"description": "the path of a folder", "min_length": 1}
    )
    per: Literal["device", "run"] = "device"
    reports: bool = False


@dataclass(frozen=True)
class _Content:
    """The content of a definition."""

    files: _Files
    model: list[dict[str, Any]] = expecting('[[model]] tables, such as kind = "dahl"')
    laws: str | list[str] = expecting(
        "the path of a Python file, or a list of paths", default_factory=list
    )
    read: dict[str, Any] = field(default_factory=dict)
    extract: dict[str, Any] = field(default_factory=dict)
    fit: dict[str, Any] = field(default_factory=dict)
    posterior: dict[str, Any] | None = None
    output: _Output = field(default_factory=_Output)


@dataclass(frozen=True)
class Task:
    """One fit of a campaign."""

    device: str  # label
    run: str  # label; empty if the fit takes all runs of the device
    files: tuple[Path, ...]  # in the order of the runs
    runs: tuple[str, ...]  # label of each file
    covariates: Mapping[str, float | str]  # from the path and from the table of covariates

    @property
    def name(self) -> str:
        """Device and run, for messages and file names."""
        return f"{self.device}_{self.run}" if self.run else self.device


@dataclass(frozen=True)
class Definition:
    """A checked campaign: files, options and the folder of the results."""

    source: str  # its file, for messages
    # all settings that a result depends on: kind, read, extract, fit, posterior, model, per, and
    # the digests of files that define laws of the model
    options: Mapping[str, Any]
    tasks: tuple[Task, ...]  # in the order of their names
    folder: Path  # of the results
    reports: bool  # whether each fit gets a report

    def key(self, digests: Collection[str], version: str) -> str:
        """Return the key of a result: a digest of files, options and version."""
        content = [version, self.options, list(digests)]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read_definition(source: str | Path | Mapping[str, Any]) -> Definition:
    """Return a checked campaign from a TOML file, or from its content.

    All files exist and all covariates are known. Paths in a mapping are relative to the working
    folder.
    """
    if isinstance(source, Mapping):
        content, name, folder = dict(source), "the campaign", Path.cwd()
    else:
        path = path_of(source, "the campaign")
        content = read_toml(path, "the campaign")
        name, folder = str(path), path.resolve().parent
    known = checked(_Content, content, name)
    try:
        return _definition(name, folder, known)
    except (DataError, ModelError, ValidationError) as exc:
        raise DataError(f"{name}: {exc}") from exc


def _definition(name: str, folder: Path, content: _Content) -> Definition:
    from dahl_ident.elements.law_files import load_laws

    for file in [content.laws] if isinstance(content.laws, str) else content.laws:
        load_laws(folder / file)
    model, parameters, laws = _model(content.model)
    options = {
        "kind": content.files.kind,
        "per": content.output.per,
        "model": model,
        "read": _reading(folder, content.read, content.files.kind == "record"),
        **{table: getattr(content, table) for table in ("extract", "fit", "posterior")},
    }
    if laws:
        options["laws"] = laws
    _check_options(options)
    tasks = _tasks(folder, content.files, content.output.per)
    _check_names(tasks, parameters)
    return Definition(name, options, tasks, folder / content.output.folder, content.output.reports)


def _model(entries: list[Any]) -> tuple[list[Any], Collection[str], dict[str, str]]:
    """Return the model as plain data, the names of its parameters, and digests of its law files."""
    from dahl_ident.elements.element import describe_model, model_from_description
    from dahl_ident.elements.law_files import user_laws
    from dahl_ident.elements.law_module import file_of

    model = model_from_description(entries)
    files = {file for law in user_laws(model.elements) if (file := file_of(law)) is not None}
    digests = {Path(file.path).name: file.digest for file in sorted(files)}
    return describe_model(model), [p.name for p in model.parameters], digests


def _reading(folder: Path, read: Mapping[str, Any], record: bool) -> dict[str, Any]:
    """Return the options of reading, with the entries of a column map in place of its path."""
    from dahl_ident.data.column_map import SETTINGS, column_map
    from dahl_ident.data.columns import RECORD_COLUMNS

    where, options = "[read.columns]", dict(read)
    columns = options.get("columns")
    if columns is not None and not isinstance(columns, Mapping):
        path = folder / path_of(columns, where)
        options["columns"], where = read_toml(path, "the column map"), str(path)
    column_map(options.get("columns"), where)
    entries = (*SETTINGS, *RECORD_COLUMNS) if record else SETTINGS
    column_map({name: read[name] for name in entries if name in read}, "[read]")
    return options


def _check_options(options: Mapping[str, Any]) -> None:
    """Refuse unknown options before any file is read."""
    from dahl_ident.data import read_frequency_response, read_record
    from dahl_ident.extraction import extract
    from dahl_ident.results import fit, posterior

    record = options["kind"] == "record"
    functions: dict[str, Callable[..., Any]] = {
        "read": read_record if record else read_frequency_response,
        "fit": fit,
    }
    if record:
        functions["extract"] = extract
    elif options["extract"]:
        raise ValidationError("[extract] is given, but tables of responses are not extracted")
    if options["posterior"] is not None:
        functions["posterior"] = posterior
    for table, function in functions.items():
        known = set(inspect.signature(function).parameters) - _SET_BY_CAMPAIGN
        if unknown := sorted(options[table].keys() - known):
            raise ValidationError(
                f"unknown options in [{table}]: {', '.join(unknown)}; expected some of "
                f"{choices(sorted(known), *unknown)}"
            )


def _check_names(tasks: Sequence[Task], parameters: Collection[str]) -> None:
    """Refuse covariates with the name of a column of the results, and fits with the same name."""
    reserved = _COLUMNS | set(parameters)
    for column in {column for task in tasks for column in task.covariates}:
        if column in reserved or column.startswith(_PREFIXES):
            raise ValidationError(
                f"a covariate is called {column!r}, like a column of the results; give it "
                "another name"
            )
    for first, second in pairwise(sorted(tasks, key=lambda task: task.name)):
        if first.name == second.name:
            raise ValidationError(
                f"device {first.device!r}, run {first.run!r} and device {second.device!r}, run "
                f"{second.run!r} are both called {first.name}; rename the files of one"
            )


def _tasks(folder: Path, files: _Files, per: str) -> tuple[Task, ...]:
    paths = _matches(folder, files.pattern)
    table = _covariates(folder, files.covariates)
    runs: dict[tuple[str, str], Task] = {}
    for path, fields in paths:
        device = fields.pop("device")
        run = fields.pop("run", path.stem)
        if (device, run) in runs:
            raise ValidationError(
                f"{runs[device, run].files[0]} and {path} are both device {device!r}, run {run!r}; "
                "add what distinguishes them to the pattern, as {run}"
            )
        row = {} if table is None else table.get((device, run), table.get((device, None)))
        if row is None:
            raise ValidationError(
                f"the table of covariates has no row for device {device!r}, run {run!r}; add one"
            )
        if both := fields.keys() & row.keys():
            raise ValidationError(
                f"{', '.join(sorted(both))} is in the pattern and in the table of covariates; "
                "leave it out of one of them"
            )
        values = {key: _value(text) for key, text in fields.items()} | row
        runs[device, run] = Task(device, run, (path,), (run,), values)
    if per == "run":
        return tuple(task for _, task in sorted(runs.items()))
    by_device = sorted(runs.values(), key=attrgetter("device"))
    return tuple(_joined(d, list(tasks)) for d, tasks in groupby(by_device, attrgetter("device")))


def _joined(device: str, runs: list[Task]) -> Task:
    """Return one fit of all runs of a device, with the covariates that the runs share."""
    shared = {
        name: value
        for name, value in runs[0].covariates.items()
        if all(task.covariates.get(name) == value for task in runs)
    }
    files = tuple(path for task in runs for path in task.files)
    return Task(device, "", files, tuple(task.run for task in runs), shared)


def _matches(folder: Path, pattern: str) -> list[tuple[Path, dict[str, str]]]:
    """Return the files that match the pattern, with the fields read from their paths."""
    fields = _FIELD.findall(pattern)
    if "device" not in fields:
        raise ValidationError(
            f"the pattern {pattern!r} has no {{device}}; put it where the path names it"
        )
    if len(set(fields)) < len(fields):
        raise ValidationError(f"the pattern {pattern!r} has the same field twice")
    parts = _FIELD.split(pattern)
    if any(brace in part for part in parts[::2] for brace in "{}"):
        raise ValidationError(
            f"the pattern {pattern!r} has braces without a name of letters, digits and _ "
            "between them"
        )
    wild = "".join("*" if i % 2 else glob.escape(part) for i, part in enumerate(parts))
    expression = re.compile(
        "".join(f"(?P<{part}>[^/]+?)" if i % 2 else re.escape(part) for i, part in enumerate(parts))
    )
    paths = []
    for path in sorted(glob.glob(wild, root_dir=folder)):  # noqa: PTH207  # absolute patterns too
        match = expression.fullmatch(Path(path).as_posix())
        if match is not None:
            paths.append((folder / path, match.groupdict()))
    if not paths:
        raise ValidationError(f"the pattern {pattern!r} finds no file below {folder}")
    return paths


def _covariates(
    folder: Path, table: str | None
) -> dict[tuple[str, str | None], dict[str, float | str]] | None:
    """Return the rows of the table by device and run; None without a table."""
    if table is None:
        return None
    path = folder / table
    try:
        with regular(path).open(encoding="utf-8-sig", newline="") as file:
            header, *lines = list(csv.reader(file)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as exc:
        raise DataError(f"{path}: cannot be read as a CSV table of covariates: {exc}") from exc
    if "device" not in header:
        raise DataError(
            f"{path}: has the columns {', '.join(header) or 'none'}; expected one called device"
        )
    if repeated := {c for c in header if header.count(c) > 1}:
        raise DataError(f"{path}: several columns are called {', '.join(sorted(repeated))}")
    keys = [c for c in ("device", "run") if c in header]
    rows: dict[tuple[str, str | None], dict[str, float | str]] = {}
    for number, line in enumerate(lines, start=2):
        if not line:
            continue
        if len(line) != len(header):
            raise DataError(
                f"{path}: line {number} has {len(line)} values; the header has {len(header)}"
            )
        row = dict(zip(header, line, strict=True))
        if blank := [c for c in header if row[c].strip().lower() in _BLANK]:
            raise DataError(f"{path}: line {number} has no value for {', '.join(blank)}")
        key = (row["device"], row.get("run"))
        if key in rows:
            both = " and ".join(f"{k} {row[k]!r}" for k in keys)
            raise DataError(f"{path}: line {number} repeats the {both}")
        rows[key] = {c: _value(row[c]) for c in header if c not in keys}
    return rows


def _value(text: str) -> float | str:
    try:
        number = float(text)
    except ValueError:
        return text
    return number if math.isfinite(number) else text
