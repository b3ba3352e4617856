"""Provenance of a result: files and their hashes, options, and versions."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from dahl_ident.version import __version__

Provenances = Iterable[Mapping[str, Any] | None]
"""Provenance of a table, or of each record."""
_PACKAGES = ("numpy", "scipy", "casadi", "emcee", "pandas", "matplotlib", "pint")
_LISTED_ELSEWHERE = {"parts", "file", "sha256", "notes", "warnings"}


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
