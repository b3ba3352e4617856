"""A file's bytes, their hash, and which format they are in whatever the name says."""

from __future__ import annotations

import bz2
import gzip
import hashlib
import importlib
import lzma
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from dahl_ident.errors import DataError, MissingDependencyError

_TEXT = ("text", "uff", "lvm")
# Formats that may stand behind an extension; any, where it is not listed.
_EXTENSIONS: dict[str, tuple[str, ...]] = {
    ".csv": ("text",),
    ".tsv": ("text",),
    ".txt": _TEXT,
    ".dat": _TEXT,
    ".asc": _TEXT,
    ".prn": ("text",),
    ".xlsx": ("excel",),
    ".xlsm": ("excel",),
    ".parquet": ("parquet",),
    ".pq": ("parquet",),
    ".mat": ("matlab", "hdf5"),
    ".h5": ("hdf5",),
    ".hdf5": ("hdf5",),
    ".uff": ("uff",),
    ".unv": ("uff",),
    ".bunv": ("uff",),
    ".tdms": ("tdms",),
    ".lvm": ("lvm",),
}
_NAMES = {
    "text": "a text table",
    "excel": "an Excel workbook",
    "old excel": "an Excel 97 workbook",
    "zip": "a ZIP archive",
    "parquet": "Parquet",
    "matlab": "MATLAB v5 or v7",
    "hdf5": "HDF5 or MATLAB v7.3",
    "uff": "a universal file",
    "tdms": "NI TDMS",
    "lvm": "LabVIEW LVM",
}
_MAGIC: tuple[tuple[bytes, str], ...] = (
    (b"MATLAB 5.0 MAT-file", "matlab"),
    (b"MATLAB 7.3 MAT-file", "hdf5"),
    (b"\x89HDF\r\n\x1a\n", "hdf5"),
    (b"PAR1", "parquet"),
    (b"TDSm", "tdms"),
    (b"PK\x03\x04", "zip"),
    (b"\xd0\xcf\x11\xe0", "old excel"),
    (b"LabVIEW Measurement", "lvm"),
)
_PACKED: tuple[tuple[bytes, Callable[[bytes], bytes], str], ...] = (
    (b"\x1f\x8b", gzip.decompress, ".gz"),
    (b"BZh", bz2.decompress, ".bz2"),
    (b"\xfd7zXZ\x00", lzma.decompress, ".xz"),
)


@dataclass(frozen=True)
class File:
    """Bytes of a file, unpacked, and what they are."""

    path: Path | None
    name: str
    data: bytes
    sha256: str
    format: str


def open_file(path: str | PurePath) -> File:
    """Read a file, ``-`` being standard input.

    Raises
    ------
    DataError
        If it cannot be read, is empty, or holds another format than its extension says.
    """
    if str(path) == "-":
        if sys.stdin is None:
            raise DataError("standard input is closed; pipe the file into it, or name the file")
        return _checked(None, "standard input", sys.stdin.buffer.read())
    place = Path(path)
    # names of files are bytes, and what is no UTF-8 in them could not be written into a report
    name = str(place).encode(errors="backslashreplace").decode()
    try:
        return _checked(place, name, place.read_bytes())
    except OSError as exc:
        raise DataError(f"{name}: the file cannot be read: {exc.strerror or exc}") from exc


def _checked(path: Path | None, name: str, data: bytes) -> File:
    digest = hashlib.sha256(data).hexdigest()
    suffix = path.suffix.lower() if path else ""
    for magic, unpack, packed in _PACKED:
        if data.startswith(magic):
            try:
                data = unpack(data)
            except (OSError, EOFError, ValueError, lzma.LZMAError) as exc:
                raise DataError(f"{name}: the compressed file is damaged: {exc}") from exc
            if path and suffix == packed:
                suffix = path.with_suffix("").suffix.lower()
    if not data or data.isspace():
        raise DataError(f"{name}: the file is empty")
    found = _sniff(data)
    if found == "text" and suffix == ".mat" and b"\0" in data[:4]:
        found = "matlab"  # version 4 has no signature
    allowed = _EXTENSIONS.get(suffix, (found,))
    if found not in allowed:
        raise DataError(
            f"{name}: the extension {suffix} says {_NAMES[allowed[0]]}, the content is "
            f"{_NAMES[found]}; rename the file to what it is"
        )
    if found in ("old excel", "zip"):
        raise DataError(f"{name}: {_NAMES[found]} is not read; save it as .xlsx or .csv")
    return File(path, name, data, digest, found)


def _sniff(data: bytes) -> str:
    for magic, found in _MAGIC:
        if data.startswith(magic):
            return "excel" if found == "zip" and b"xl/workbook" in data else found
    lines = data[:200].split(b"\n", 2)
    if lines[0].strip() == b"-1" and len(lines) > 1 and lines[1].strip()[:1].isdigit():
        return "uff"
    return "text"


def utf8(data: bytes) -> bytes:
    """Return a text in UTF-8 without a byte-order mark; instruments also write cp1252."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        data = data.decode("utf-16", errors="replace").encode("utf-8")
    data = data.removeprefix(b"\xef\xbb\xbf")
    if data.isascii():
        return data  # without decoding it, which takes ten times as long
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace").encode("utf-8")
    return data


def library(module: str, extra: str | None = None) -> Any:
    """Import a library that reads a format.

    Raises
    ------
    MissingDependencyError
        If it is not installed, with the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as exc:
        package = f"dahl_ident[{extra}]" if extra else module
        raise MissingDependencyError(
            f"{module} is needed to read this format and is not installed; install it with: "
            f"pip install '{package}'"
        ) from exc
