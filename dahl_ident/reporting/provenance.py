"""Where a result comes from: files and their hashes, options, versions."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import dahl_ident

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse

_PACKAGES = ("numpy", "scipy", "casadi", "emcee", "pandas", "matplotlib", "pint")
_TOLD_APART = {"parts", "file", "sha256", "notes"}


def sources(data: FrequencyResponse) -> Iterator[tuple[str, str]]:
    """Yield name and SHA-256 of every file that the data came from, and what those came from."""
    for part in _with_origins(data):
        if "file" in part:
            yield str(part["file"]), str(part.get("sha256", ""))


def notes(data: FrequencyResponse) -> list[str]:
    """Return what had to be assumed on reading."""
    return list(dict.fromkeys(str(note) for part in parts(data) for note in part.get("notes", [])))


def options(data: FrequencyResponse) -> list[tuple[str, str]]:
    """Return how the data were made, key by key, where they say so and it is not the default."""
    found: dict[str, str] = {}
    for part in _with_origins(data):
        told = {k: v for k, v in part.items() if k not in _TOLD_APART}
        for name in ("options", "extraction"):
            inner = told.pop(name, None)
            given = inner if isinstance(inner, Mapping) else {"": inner}
            told |= {f"{name} {key}".strip(): value for key, value in given.items()}
        for key, value in told.items():
            if not isinstance(value, Mapping) and value not in (None, [], ()):
                found.setdefault(key, str(value))
    return list(found.items())


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package and of those that it computes with."""
    found = {"dahl_ident": dahl_ident.__version__, "python": platform.python_version()}
    return found | {name: importlib.metadata.version(name) for name in _PACKAGES}


def today() -> str:
    """Return date and time of day, with the offset to UTC."""
    return datetime.datetime.now().astimezone().isoformat(timespec="minutes")


def parts(data: FrequencyResponse) -> list[Mapping[str, Any]]:
    """Return the provenance of each table that was joined."""
    provenance = data.provenance or {}
    return list(provenance.get("parts", [provenance]))


def _with_origins(data: FrequencyResponse) -> Iterator[Mapping[str, Any]]:
    """Yield the provenance of each table, and after it of what that was made from."""
    waiting = list(parts(data))
    while waiting:
        part = waiting.pop(0)
        yield part
        origin = part.get("origin")
        if isinstance(origin, Mapping):
            waiting[:0] = origin.get("parts", [origin])
