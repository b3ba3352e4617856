"""A file with its hash, its format as recognised from the content, and limits of size and time.

A damaged file of some kilobytes may declare exabytes, so sizes are checked before memory is
allocated. Compiled libraries trust what a file declares, so they run in a separate process (where
``fork`` exists): a crash there is reported like any other error.
"""

from __future__ import annotations

import bz2
import contextlib
import faulthandler
import gzip
import hashlib
import io
import lzma
import os
import pickle
import re
import signal
import sys
import threading
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import IO, Any, NamedTuple

from dahl_ident.data.raw_columns import RawChannel, RawFile
from dahl_ident.data.storage import regular
from dahl_ident.errors import DataError

MOST_CHANNELS = 5000
"""Largest number of columns, arrays or data sets in one file; measured files have some tens."""
DEEPEST = 32
"""Deepest nesting of groups, structs or lists."""
_UNPACKED_BYTES = 1 << 27  # 134 MB: more than most tables; parsed, they take ten times as much
_OBJECT_BYTES = 40  # least memory of each line or list into which a text is split
_UNPACKED_RATIO = 8  # text and sampled waveforms rarely compress better


class Format(NamedTuple):
    """A format: its name, its extensions, and its reader as module.function.

    `damaged` is what messages call damaged, if the library that reads the format raises any error.
    """

    name: str
    extensions: str = ""
    reader: str = ""
    damaged: str = ""


FORMATS = {
    "text": Format("a text table", ".csv .tsv .txt .dat .asc .prn", "text_table.read_text_table"),
    "json": Format("JSON", ".json .txt .dat .asc", "tables.read_json"),
    "excel": Format("an Excel workbook", ".xlsx .xlsm", "tables.read_workbook", "the workbook"),
    "old excel": Format("an Excel 97 workbook"),
    "ods": Format("an Open Document sheet", ".ods", "tables.read_workbook", "the workbook"),
    "zip": Format("a ZIP archive"),
    "npz": Format("NumPy's .npz", ".npz", "array_trees.read_npz", "the file"),
    "npy": Format("NumPy's .npy", ".npy", "array_trees.read_npy", "the file"),
    "parquet": Format("Parquet", ".parquet .pq", "tables.read_parquet", "the file"),
    "matlab": Format("MATLAB v5 or v7", ".mat", "array_trees.read_matlab", "the file"),
    "hdf5": Format("HDF5 or MATLAB v7.3", ".mat .h5 .hdf5", "array_trees.read_hdf5", "the file"),
    "uff": Format(
        "a universal file",
        ".uff .unv .bunv .txt .dat .asc",
        "analysers.read_uff",
        "the universal file",
    ),
    "tdms": Format("NI TDMS", ".tdms", "labview.read_tdms", "the TDMS file"),
    "lvm": Format("LabVIEW LVM", ".lvm .txt .dat .asc", "labview.read_lvm", "the LVM file"),
    "sdf": Format("an analyser's SDF", ".sdf .dat", "analysers.read_sdf", "the SDF file"),
}
_UFF = re.compile(rb"-1[ \t]*[\r\n]\s*\d")
_HDF5 = b"\x89HDF\r\n\x1a\n"
_MAGIC: tuple[tuple[bytes, str], ...] = (
    (b"MATLAB 5.0 MAT-file", "matlab"),
    (b"MATLAB 7.3 MAT-file", "hdf5"),
    (_HDF5, "hdf5"),
    (b"PAR1", "parquet"),
    (b"TDSm", "tdms"),
    (b"B\0\0\n\0\0", "sdf"),
    (b"\x93NUMPY", "npy"),
    (b"PK\x03\x04", "zip"),
    (b"\xd0\xcf\x11\xe0", "old excel"),
    (b"LabVIEW Measurement", "lvm"),
)
_PACKED: tuple[tuple[bytes, Callable[[Any], Any], str], ...] = (
    (b"\x1f\x8b", lambda stream: gzip.GzipFile(fileobj=stream), ".gz"),
    (b"BZh", bz2.BZ2File, ".bz2"),
    (b"\xfd7zXZ\x00", lzma.LZMAFile, ".xz"),
)


@dataclass(frozen=True)
class File:
    """A file to read; `content` holds its bytes if they are not on disk in this form.

    Its reader adds its assumptions to `notes`, and its warnings to `warnings`.
    """

    path: Path | None
    name: str
    size: int
    sha256: str
    format: str
    content: bytes | None = None
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def head(self) -> bytes:
        """The first bytes."""
        with self.opened() as stream:
            first: bytes = stream.read(300)
        return first

    @cached_property
    def data(self) -> bytes:
        """All bytes, unpacked."""
        with self.opened() as stream:
            return stream.read() if self.content is None else self.content

    @property
    def length(self) -> int:
        """Number of bytes, unpacked."""
        return self.size if self.content is None else len(self.content)

    def stream(self) -> Any:
        """Return the path of the file, or a stream of its bytes, for a library to open."""
        return self.path if self.content is None else io.BytesIO(self.content)

    def opened(self) -> IO[bytes]:
        """Return the bytes as an open file."""
        stream = self.stream()
        return stream.open("rb") if isinstance(stream, Path) else stream

    @property
    def limit(self) -> int:
        """Bytes that the content of the file may take in memory."""
        return max(_UNPACKED_BYTES, _UNPACKED_RATIO * self.size)

    def lines(self, marks: bytes = b"\n") -> bytes:
        """Return all bytes; refuse text of more lines (or other marks) than memory may hold."""
        count = sum(self.data.count(mark) for mark in marks)
        self.refuse_above_limit(_OBJECT_BYTES * count, f"text of {count} parts")
        return self.data

    def refuse_above_limit(self, claimed: int, what: str) -> None:
        """Refuse content that would take more memory than a file of this size may."""
        if claimed > self.limit:
            raise DataError(
                f"{self.name}: {what} would take {_bytes(claimed)}, and the file has "
                f"{_bytes(self.size)}; at most {_bytes(self.limit)} are read from it. The file is "
                "damaged, or has to be unpacked or cut into parts first"
            )

    def source(self, kind: str, channels: Iterable[RawChannel], **facts: Any) -> RawFile:
        """Return the channels of this file; `facts` are further fields of :class:`RawFile`."""
        channels = tuple(channels)
        if not channels:
            raise DataError(f"{self.name}: the file holds no channels")
        notes, warnings = tuple(self.notes), tuple(self.warnings)
        return RawFile(
            self.name, kind, channels, self.sha256, notes=notes, warnings=warnings, **facts
        )


def refuse_many(name: str, count: int, what: str, most: int = MOST_CHANNELS) -> None:
    """Refuse a file of more columns, arrays or the like than a measured one has."""
    if count > most:
        raise DataError(
            f"{name}: the file has {count} {what}; at most {most} are read. Save what is needed in "
            "a separate file"
        )


def open_file(path: str | Path) -> File:
    """Return a file with its hash and format; ``-`` is standard input."""
    if str(path) == "-":
        if sys.stdin is None:
            raise DataError("standard input is closed; pipe the file into it, or name the file")
        data = sys.stdin.buffer.read()
        digest = hashlib.sha256(data).hexdigest()
        return _recognised(File(None, "standard input", len(data), digest, "", data))
    path = regular(path)
    # bytes in a name that are not UTF-8 could not be written into a report
    name = str(path).encode(errors="backslashreplace").decode()
    try:
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
            size = stream.tell()
        return _recognised(File(path, name, size, digest, ""))
    except OSError as exc:
        raise DataError(f"{name}: the file cannot be read: {exc.strerror or exc}") from exc


def _recognised(file: File) -> File:
    """Return the file with its format, unpacked if it is compressed."""
    suffix = file.path.suffix.lower() if file.path else ""
    head = file.head
    for magic, opener, ending in _PACKED:
        if head.startswith(magic):
            if file.path and suffix == ending:
                suffix = file.path.with_suffix("").suffix.lower()
            try:
                with opener(io.BytesIO(file.data)) as stream:
                    content: bytes = stream.read(file.limit + 1)
            except (OSError, EOFError, ValueError, lzma.LZMAError, zlib.error) as exc:
                raise DataError(f"{file.name}: the compressed file is damaged: {exc}") from exc
            file.refuse_above_limit(len(content), "the content")
            file, head = replace(file, content=content), content[:300]
    if not head or (head.isspace() and file.data.isspace()):
        raise DataError(f"{file.name}: the file is empty")
    name = _format(file, head, suffix)
    actual = FORMATS[name]
    allowed = [f for f in FORMATS.values() if suffix and suffix in f.extensions.split()]
    if allowed and actual not in allowed:
        raise DataError(
            f"{file.name}: the extension {suffix} says {allowed[0].name}, the content is "
            f"{actual.name}; rename the file to what it is"
        )
    if not actual.reader:
        raise DataError(f"{file.name}: {actual.name} is not read; save it as .xlsx or .csv")
    return replace(file, format=name)


def _format(file: File, head: bytes, suffix: str) -> str:
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return _archive(file, suffix) if kind == "zip" else kind
    # HDF5 may begin after a user block of 512 bytes, 1024, 2048, ...
    if suffix in (".h5", ".hdf5") and any(file.data.startswith(_HDF5, 512 << k) for k in range(12)):
        return "hdf5"
    if suffix == ".mat" and b"\0" in head[:4]:
        return "matlab"  # version 4 has no signature
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if _UFF.match(text):
        return "uff"
    start = text[:2]
    if suffix == ".json" or start in (b'{"', b"[{", b"{\n", b"{\r"):
        return "json"
    return "text"


def _archive(file: File, suffix: str) -> str:
    """Return the format of a ZIP archive, after a check of its unpacked size."""
    try:
        with zipfile.ZipFile(file.stream()) as archive:
            members = archive.infolist()
            names = archive.namelist()
            file.refuse_above_limit(sum(m.file_size for m in members), "the content")
            if "xl/workbook.xml" in names:
                return "excel"
            if "mimetype" in names and b"opendocument.spreadsheet" in archive.read("mimetype"):
                return "ods"
    except DataError:
        raise
    except Exception:  # a damaged archive, which its reader will report
        return {".ods": "ods", ".npz": "npz"}.get(suffix, "excel" if "xls" in suffix else "zip")
    if names and all(name.endswith(".npy") for name in names):
        return "npz"
    return "zip"


def _bytes(count: float) -> str:
    for unit in ("bytes", "kB", "MB", "GB", "TB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} PB"


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


def in_child_process(
    work: Callable[[], Any], *, seconds: int, bytes_at_most: int | None = None
) -> tuple[Any, str]:
    """Return a function's result, or None and the reason why there is none, of a child process.

    The time is limited, and the memory to `bytes_at_most` in addition to what is in use.
    """
    if not hasattr(os, "fork"):
        return work(), ""
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the child does not use other threads
        process = os.fork()
    if process == 0:  # pragma: no cover
        try:
            _limit(seconds, bytes_at_most)
            answer = work(), ""
        except BaseException as exc:
            answer = None, str(exc) or type(exc).__name__
        with contextlib.suppress(BaseException), os.fdopen(writing, "wb") as pipe:
            pickle.dump(answer, pipe)
        os._exit(0)
    os.close(writing)
    timer = threading.Timer(2.0 * seconds, os.kill, (process, signal.SIGKILL))  # wall clock
    timer.start()
    with os.fdopen(reading, "rb") as pipe:
        content = pipe.read()
    timer.cancel()
    _, status = os.waitpid(process, 0)
    if status or not content:
        hung = os.waitstatus_to_exitcode(status) in (-signal.SIGXCPU, -signal.SIGKILL)
        return None, f"its reader {'hangs' if hung else 'fails'}"
    value, error = pickle.loads(content)
    return value, error


def _limit(seconds: int, bytes_at_most: int | None) -> None:  # pragma: no cover
    """Limit the processor time and the memory of this process, and silence it."""
    import resource

    faulthandler.disable()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    if bytes_at_most is not None:
        with contextlib.suppress(OSError):  # without /proc, memory in use counts as well
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            bytes_at_most += pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (bytes_at_most, bytes_at_most))
