"""Tables written without loss to CSV, TSV, Parquet and HDF5; no incomplete file is ever left."""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import importlib
import io
import json
import math
import os
import stat
import threading
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.errors import (
    DahlIdentError,
    DataError,
    MissingDependencyError,
    ValidationError,
    argument,
)

if TYPE_CHECKING:
    import pandas as pd

METADATA_MARK = "dahl_ident:"
_IRREGULAR = {stat.S_IFIFO: "pipe", stat.S_IFSOCK: "socket"}


def save_frame(frame: pd.DataFrame, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write a table in the format of the path's extension."""
    path = path_of(path)
    packed = path.suffix.lower() == ".gz" and Path(path.stem).suffix.lower() in (".csv", ".tsv")
    table = Path(path.stem) if packed else place_of(path, "a table", (*_WRITERS, ".csv.gz"))
    content = _WRITERS[table.suffix.lower()](frame)
    write_whole(path, gzip.compress(content, mtime=0) if packed else content, overwrite=overwrite)
    return path


def path_of(path: object, what: str = "the file") -> Path:
    """Return the path of a file; raise for what is not a path."""
    if isinstance(path, str | os.PathLike):
        return Path(path)
    raise ValidationError(f"{what} is {path!r}; expected its path, as text or pathlib.Path")


def place_of(path: str | Path, what: str, endings: Sequence[str]) -> Path:
    """Return the path; raise if it has none of the endings."""
    path = path_of(path, what)
    if path.suffix.lower() not in endings:
        raise ValidationError(
            f"{path}: {what} is written as {', '.join(endings)}; got {path.suffix or 'no ending'!r}"
        )
    return path


def regular(path: str | Path, what: str = "the file") -> Path:
    """Return the path of a regular file; raise for others, because reading them may never end."""
    place = path_of(path, what)
    try:
        kind = stat.S_IFMT(place.stat().st_mode)
    except (OSError, ValueError) as exc:
        why = getattr(exc, "strerror", None) or exc
        raise DataError(f"{path}: {what} cannot be read: {why}") from exc
    if kind == stat.S_IFDIR:
        raise DataError(f"{path} is a folder; give the path of a file in it")
    if kind != stat.S_IFREG:
        raise DataError(
            f"{path} is a {_IRREGULAR.get(kind, 'device')}; expected a file: copy what it holds "
            "into one, or pipe it into standard input (-)"
        )
    return place


def read_text(path: str | Path, what: str = "the file") -> str:
    """Return the text of a file."""
    try:
        return regular(path, what).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        why = exc.strerror if isinstance(exc, OSError) else "it is not text"
        raise DataError(f"{path}: {what} cannot be read: {why}") from exc


def read_toml(path: str | Path, what: str = "the file") -> dict[str, Any]:
    """Return the entries of a TOML file."""
    content: dict[str, Any] = parsed(
        tomllib.loads, read_text(path, what), f"{path}: is not a TOML file"
    )
    return content


def parsed(loads: Callable[[str], Any], text: str, otherwise: str) -> Any:
    """Return the content of a JSON or TOML text, or raise an error that says what it is not."""
    try:
        return loads(text)
    except (AttributeError, RecursionError, TypeError, ValueError) as exc:
        raise DataError(f"{otherwise}: {exc}") from exc


def refuse_existing(path: Path, *, overwrite: bool = False) -> None:
    """Refuse to replace a folder, or without `overwrite` a file."""
    if path.is_dir():
        raise DataError(f"{path} is a folder; give the path of a file in it")
    if path.exists() and not overwrite:
        raise DataError(
            f"{path}: the file exists already; give another name, or replace it with "
            f"{argument('overwrite', True)}"
        )


def make_folder(folder: Path, *, parents: bool = True) -> None:
    """Make a folder if it does not exist."""
    try:
        folder.mkdir(parents=parents, exist_ok=True)
    except (OSError, ValueError) as exc:
        why = getattr(exc, "strerror", None) or exc
        raise DataError(f"{folder}: the folder cannot be made: {why}") from exc


def write_whole(path: Path, content: bytes, *, overwrite: bool = False) -> None:
    """Write a file completely, or not at all."""
    refuse_existing(path, overwrite=overwrite)
    try:
        put_in_place(path, lambda part: part.write_bytes(content), overwrite=overwrite)
    except FileExistsError:  # another process has written it meanwhile
        refuse_existing(path)
        raise
    except OSError as exc:
        raise DataError(f"{path}: cannot be written: {exc.strerror or exc}") from exc


def put_in_place(path: Path, write: Callable[[Path], object], *, overwrite: bool = True) -> None:
    """Write a file under another name, flush it to the disk, and rename it when complete.

    `write` gets the path to write to; if it raises, `path` is unchanged. Of several writers
    without `overwrite`, all but the first get a FileExistsError.
    """
    # not by tempfile, whose files other users cannot read
    part = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.part")
    try:
        write(part)
        with part.open("rb+") as written:
            os.fsync(written.fileno())
        if not overwrite:
            try:
                os.link(part, path)  # fails if the name is taken, and never shows half a file
            except FileExistsError:
                raise
            except (OSError, NotImplementedError, AttributeError):  # no links on this file system
                path.open("xb").close()
            else:
                part.unlink()
                return
        part.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


@contextlib.contextmanager
def locked(file: Path, error: type[DahlIdentError]) -> Iterator[None]:
    """Hold the lock ``<file>.lock``; raise `error` if another process holds it."""
    from filelock import FileLock, Timeout

    path = file.with_name(file.name + ".lock")
    lock = FileLock(path, timeout=0)
    try:
        path.touch()  # where no file can be made, filelock would wait as for a lock that is held
        lock.acquire()
    except Timeout:
        raise error(
            f"another run is writing {file}; wait for its end, or give another file"
        ) from None
    except (OSError, ValueError) as exc:
        why = getattr(exc, "strerror", None) or exc
        raise error(f"{file} cannot be written: {why}") from exc
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()  # first: a run that waits for it then makes its own
        lock.release()


def inert(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table in which texts that are formulas to a spreadsheet start with an apostrophe."""
    return with_texts(frame, lambda text: f"'{text}" if _is_formula(text) else text)


def as_before_inert(text: str) -> str:
    """Return a text of a table before :func:`inert`."""
    return text[1:] if text[:1] == "'" and _is_formula(text) else text


def _is_formula(text: str) -> bool:
    """Return whether a text, without leading apostrophes, is a formula to a spreadsheet."""
    bare = text.lstrip("'")
    try:
        float(bare)
    except ValueError:
        return bare.startswith(("=", "+", "-", "@", "\t", "\r"))
    return False


def with_texts(frame: pd.DataFrame, change: Callable[[str], str]) -> pd.DataFrame:
    """Return a table with each text changed, in cells and in column names."""

    def cell(value: Any) -> Any:
        return change(value) if isinstance(value, str) else value

    changed = frame.rename(columns=cell)
    for i, kind in enumerate(dtype.kind for dtype in frame.dtypes):
        if kind not in "fiubc":
            changed.isetitem(i, frame.iloc[:, i].map(cell).array)
    return changed


def library(module: str, extra: str | None = None) -> Any:
    """Import a library that reads a format."""
    try:
        return importlib.import_module(module)
    except ImportError as exc:
        package = f"dahl_ident[{extra}]" if extra else module
        raise MissingDependencyError(
            f"{module} is needed to read this format and is not installed; install it with: "
            f"pip install '{package}'"
        ) from exc


def digest(value: Any) -> str:
    """Return the SHA-256 of plain data; it does not depend on the order of mappings."""
    text = json.dumps(plain_data(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def read_metadata(text: Any) -> dict[str, Any]:
    """Return the metadata that an earlier save of this package wrote with a table."""
    try:
        content = json.loads(text)
        valid = isinstance(content, dict) and all(
            key in _SAVED and _SAVED[key](value) for key, value in content.items()
        )
    except (RecursionError, TypeError) as exc:
        raise ValueError("the comment of this package is not JSON") from exc
    if not valid:
        raise ValueError("the comment of this package is not in the form that it writes")
    return dict(content)


def _is_words(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(word, str) for word in value)


def _is_number(value: Any) -> bool:
    return value is None or (type(value) in (int, float) and 0 <= value < 1e90)


def _is_provenance(value: Any) -> bool:
    """Return whether a value is provenance as written by this package, or None."""
    if not isinstance(value, dict):
        return value is None
    parts = value.get("parts", [])
    return (
        all(_is_words(value[key]) for key in ("notes", "warnings") if key in value)
        and isinstance(parts, list)
        and all(part is not None and _is_provenance(part) for part in parts)
        and _is_provenance(value.get("origin"))
    )


_SAVED: dict[str, Callable[[Any], bool]] = {
    "quality": lambda v: isinstance(v, dict) and set(map(str, v.values())) <= set("biufU"),
    "text": _is_words,
    "provenance": _is_provenance,
    "drive_factor": _is_number,
    "drive_factor_uncertainty": _is_number,
}


def plain_data(value: Any, *, not_finite: Callable[[float], Any] = float) -> Any:
    """Return mappings as dicts, sequences as lists and complex numbers as pairs, for JSON.

    `not_finite` replaces NaN and infinity, which strict JSON does not have.
    """
    if isinstance(value, Mapping):
        return {str(k): plain_data(v, not_finite=not_finite) for k, v in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain_data(v, not_finite=not_finite) for v in value]
    if isinstance(value, complex):
        return plain_data([value.real, value.imag], not_finite=not_finite)
    if isinstance(value, float):
        return value if math.isfinite(value) else not_finite(value)
    return value if isinstance(value, (str, int, bool, type(None))) else str(value)


def _text(frame: pd.DataFrame, separator: str) -> bytes:
    metadata = json.dumps(frame.attrs["dahl_ident"], ensure_ascii=False)
    table = inert(frame).to_csv(index=False, sep=separator, na_rep="nan", lineterminator="\n")
    return f"# {METADATA_MARK} {metadata}\n{table}".encode()


def _parquet(frame: pd.DataFrame) -> bytes:
    library("pyarrow", "parquet")
    buffer = io.BytesIO()
    frame.to_parquet(buffer, engine="pyarrow", index=False)
    return buffer.getvalue()


def _hdf5(frame: pd.DataFrame) -> bytes:
    h5py = library("h5py")
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as root:
        root.attrs["dahl_ident"] = json.dumps(frame.attrs["dahl_ident"], ensure_ascii=False)
        for label in frame.columns:
            name, _, unit = str(label).removesuffix("]").partition(" [")
            values = frame[label].to_numpy()
            text = values.dtype.kind not in "fiub"
            item = root.create_dataset(
                name, data=values, dtype=h5py.string_dtype() if text else values.dtype
            )
            if unit:
                item.attrs["unit"] = unit
    return buffer.getvalue()


_WRITERS: dict[str, Callable[[pd.DataFrame], bytes]] = {
    ".csv": partial(_text, separator=","),
    ".tsv": partial(_text, separator="\t"),
    ".parquet": _parquet,
    ".h5": _hdf5,
    ".hdf5": _hdf5,
}
