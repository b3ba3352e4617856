"""Provenance of a result: files and their hashes, options, versions, and the command for it."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from dahl_ident.elements.law_checks import is_of_package
from dahl_ident.elements.law_files import user_laws
from dahl_ident.elements.law_module import source_path
from dahl_ident.problem import TableProblem
from dahl_ident.reporting.comparison import of_kind
from dahl_ident.reporting.tables import prior_text
from dahl_ident.results import FitResult, Posterior
from dahl_ident.version import __version__

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse
    from dahl_ident.elements import Element, Parameter

Provenances = Iterable[Mapping[str, Any] | None]
"""Provenance of a table, or of each record."""
_PACKAGES = ("numpy", "scipy", "casadi", "emcee", "pandas", "matplotlib", "pint")
_LISTED_ELSEWHERE = {"parts", "file", "sha256", "notes", "warnings"}
_DEFAULTS = {
    "f_max": None,
    "sigma": None,
    "alpha": 1.0,
    "force_gain": 1.0,
    "displacement_gain": 1.0,
    "delay": 0.0,
}
"""Values of parameters whose options are left out; None if they are then estimated."""
_OPTIONS = {"f_max", "sigma", "alpha", "mass", "damping", "stiffness"}
"""Parameters with an option; elements with other parameters are written with --element."""


@dataclass(frozen=True)
class SourceFile:
    """A source of the data; `read` is false for the original of a file that was read."""

    file: str
    sha256: str
    read: bool


def sources(provenances: Provenances) -> Iterator[SourceFile]:
    """Yield every file that was read, each followed by its originals."""
    for part in parts(provenances):
        for i, origin in enumerate(_with_origins(part)):
            if "file" in origin:
                yield SourceFile(str(origin["file"]), str(origin.get("sha256", "")), read=i == 0)


def notes(provenances: Provenances) -> list[str]:
    """Return the assumptions made when reading."""
    return list(
        dict.fromkeys(str(note) for part in parts(provenances) for note in part.get("notes", []))
    )


def options(provenances: Provenances) -> list[tuple[str, str]]:
    """Return names and values of the options with which the data were read or extracted."""
    stated: dict[str, str] = {}
    for origin in (origin for part in parts(provenances) for origin in _with_origins(part)):
        entries = {k: v for k, v in origin.items() if k not in _LISTED_ELSEWHERE}
        for name in ("options", "extraction"):
            inner = entries.pop(name, None)
            group = inner if isinstance(inner, Mapping) else {"": inner}
            entries |= {f"{name} {key}".strip(): value for key, value in group.items()}
        for key, value in entries.items():
            if not isinstance(value, Mapping) and value not in (None, [], ()):
                stated.setdefault(key, str(value))
    return list(stated.items())


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package and of its dependencies."""
    python = {"dahl_ident": __version__, "python": platform.python_version()}
    return python | {name: importlib.metadata.version(name) for name in _PACKAGES}


def today() -> str:
    """Return date and time of day, with the offset to UTC."""
    return datetime.datetime.now().astimezone().isoformat(" ", timespec="minutes")


def parts(provenances: Provenances) -> list[Mapping[str, Any]]:
    """Return the provenance of each record, and of each table that was joined."""
    return [part for p in provenances for part in (p or {}).get("parts", [p or {}])]


def _with_origins(part: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the provenance of a table, followed by that of its originals."""
    waiting = [part]
    while waiting:
        part = waiting.pop(0)
        yield part
        origin = part.get("origin")
        if isinstance(origin, Mapping):
            waiting[:0] = origin.get("parts", [origin])


def equivalent_command(results: Sequence[FitResult | Posterior]) -> str | None:
    """Return the commands, one per line; None if no options describe data or model."""
    table = results[0].problem.response
    if table is None or len(of_kind("table", results)) < len(results):
        return None
    source = _source(table)
    elements = (e for result in results for e in result.problem.model.elements)
    if source is None or not all(_has_text(element) for element in elements):
        return None
    before, files = source
    lines = []
    for result in results:
        words = _fit(result) if isinstance(result, FitResult) else _sample(result)
        lines.append(
            " | ".join([*before, shlex.join(["dahl-ident", words[0], *files, *words[1:]])])
        )
    return "\n".join(lines)


def _source(data: FrequencyResponse) -> tuple[list[str], list[str]] | None:
    """Return the preceding commands, and the files with the options for reading them."""
    all_parts = parts([data.provenance])
    first = all_parts[0]
    options, extraction = _options_of(first), _extraction_of(first)
    alike = all((_options_of(p), _extraction_of(p)) == (options, extraction) for p in all_parts)
    if not alike or "file" not in first:
        return None
    files = [str(part["file"]) for part in all_parts]
    before = []
    if "generator" in first:  # a shipped data set, which has no path
        before.append(f"dahl-ident datasets {first['name']} -o -")
        files = ["-"]
    if not extraction:
        return before, [*files, *_words(options)]
    words = ["extract", *files, *_words(options), *_words(extraction)]
    words += ["--controlled", str(data.controlled[0])]
    if (data.quality["verdict"] == "good").all():
        words.append("--good-only")
    return [*before, shlex.join(["dahl-ident", *words, "-o", "-"])], ["-"]


def _options_of(part: Mapping[str, Any]) -> Mapping[str, Any]:
    options = part.get("options")
    if not isinstance(options, Mapping):
        return {}
    band = options.get("frequency_hz")
    where = None if band is None else f"{band[0]} <= frequency_hz <= {band[1]}"
    return {**options, "frequency_hz": None, "where": where}


def _extraction_of(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of an extraction as typed; empty without an extraction."""
    options = part.get("extraction")
    if not isinstance(options, Mapping):
        return {}
    harmonics = ",".join(map(str, options["harmonics"]))
    return {k: v for k, v in options.items() if k != "refused"} | {"harmonics": harmonics}


def _words(options: Mapping[str, Any]) -> list[str]:
    pairs = ((f"--{k.replace('_', '-')}", v) for k, v in options.items() if v is not None)
    return [word for name, value in pairs for word in (name, str(value))]


def _has_text(element: Element) -> bool:
    """Return whether --element can describe an element, by its declared parameters alone."""
    described = set(element.describe()) - {"kind", "name"}
    known = is_of_package(type(element)) or source_path(type(element)) is not None
    return known and described == set(element.labels)


def _as_text(element: Element) -> str:
    """Return an element as the argument of --element, without defaults."""
    declared = {p.name: p for p in type(element).parameters}
    values = [f"name={element.name}"] if element.name else []
    for label, parameter in zip(element.labels, element.parameters, strict=True):
        if not parameter.free and not parameter.assumed:
            values.append(f"{label}={parameter.value!r}")
        elif parameter.free and not (label in declared and declared[label].free):
            values.append(f"{label}=free")
    return f"{element.kind}({', '.join(values)})" if values else element.kind


def _fit(fit: FitResult) -> list[str]:
    return [
        "fit",
        *_model(fit.problem),
        "--noise",
        fit.noise,
        *_changed(
            method=(fit.method, "lm"),
            loss=(fit.optimum.loss, "linear"),
            steady=(fit.problem.steady, "exact"),
        ),
    ]


def _sample(posterior: Posterior) -> list[str]:
    priors = [f"{name}={prior_text(given)}" for name, given in posterior.given_priors.items()]
    how = ["--method", "grid"]
    if posterior.is_chain:
        how = ["--seed", str(posterior.seed), "--steps", str(posterior.steps)]
    return [
        "sample",
        *_model((posterior.fit or posterior).problem),
        "--noise",
        posterior.problem.noise,
        *how,
        *_changed(
            likelihood=(posterior.likelihood, "gaussian"),
            uncertainty=(posterior.uncertainty, "combined"),
            steady=(posterior.problem.steady, "exact"),
        ),
        *(word for prior in priors for word in ("--prior", prior)),
    ]


def _model(problem: TableProblem) -> list[str]:
    """Return the options of elements and sensors that are not defaults."""
    model = problem.model
    names = {p.name for p in model.parameters}
    laws = user_laws(model.elements)
    if names <= _OPTIONS and {"f_max", "sigma"} <= names and not laws:
        words = [word for p in model.parameters for word in _parameter(p, problem)]
    else:
        words = [word for e in model.elements for word in ("--element", _as_text(e))]
    files = dict.fromkeys(map(source_path, laws))
    words = [*(word for file in files for word in ("--laws", str(file))), *words]
    return [*words, *(w for p in problem.sensors.parameters for w in _parameter(p, problem))]


def _parameter(parameter: Parameter, problem: TableProblem) -> Iterator[str]:
    name = parameter.name
    value = "free"
    if name in problem.priors:
        value = prior_text(problem.priors[name])
    elif name not in problem.names:
        value = repr(parameter.value)
        stated = parameter.prior is not None and not parameter.assumed
        if parameter.value == _DEFAULTS.get(name) and not stated:
            return
    elif name in _DEFAULTS and _DEFAULTS[name] is None:
        return
    yield from (f"--{name.replace('_', '-')}", value)


def _changed(**options: tuple[str, str]) -> list[str]:
    changed = {name: value for name, (value, default) in options.items() if value != default}
    return _words(changed)
