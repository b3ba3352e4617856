"""Provenance of a result: files and their hashes, options, versions."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from dahl_ident.version import __version__

Provenances = Iterable[Mapping[str, Any] | None]
"""Of a table, or of each record."""
_PACKAGES = ("numpy", "scipy", "casadi", "emcee", "pandas", "matplotlib", "pint")
_LISTED_ELSEWHERE = {"parts", "file", "sha256", "notes", "warnings"}


@dataclass(frozen=True)
class SourceFile:
    """A file that the data came from; `read` is false for the original of such a file."""

    file: str
    sha256: str
    read: bool


def sources(provenances: Provenances) -> Iterator[SourceFile]:
    """Yield every file that was read, each followed by its originals."""
    for part in parts(provenances):
        for i, one in enumerate(_with_origins(part)):
            if "file" in one:
                yield SourceFile(str(one["file"]), str(one.get("sha256", "")), read=i == 0)


def notes(provenances: Provenances) -> list[str]:
    """Return the assumptions made when reading."""
    return list(
        dict.fromkeys(str(note) for part in parts(provenances) for note in part.get("notes", []))
    )


def options(provenances: Provenances) -> list[tuple[str, str]]:
    """Return how the data were made, key by key, if stated and not the default."""
    stated: dict[str, str] = {}
    for part in (one for whole in parts(provenances) for one in _with_origins(whole)):
        given_keys = {k: v for k, v in part.items() if k not in _LISTED_ELSEWHERE}
        for name in ("options", "extraction"):
            inner = given_keys.pop(name, None)
            entries = inner if isinstance(inner, Mapping) else {"": inner}
            given_keys |= {f"{name} {key}".strip(): value for key, value in entries.items()}
        for key, value in given_keys.items():
            if not isinstance(value, Mapping) and value not in (None, [], ()):
                stated.setdefault(key, str(value))
    return list(stated.items())


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package and of those that it computes with."""
    python = {"dahl_ident": __version__, "python": platform.python_version()}
    return python | {name: importlib.metadata.version(name) for name in _PACKAGES}


def listed_versions() -> str:
    """Return the versions in one line."""
    return ", ".join(f"{name} {version}" for name, version in versions().items())


def today() -> str:
    """Return date and time of day, with the offset to UTC."""
    return datetime.datetime.now().astimezone().isoformat(" ", timespec="minutes")


def parts(provenances: Provenances) -> list[Mapping[str, Any]]:
    """Return the provenance of each record, and of each table that was joined."""
    return [part for one in provenances for part in (one or {}).get("parts", [one or {}])]


def _with_origins(part: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the provenance of a table, followed by that of its originals."""
    waiting = [part]
    while waiting:
        part = waiting.pop(0)
        yield part
        origin = part.get("origin")
        if isinstance(origin, Mapping):
            waiting[:0] = origin.get("parts", [origin])
