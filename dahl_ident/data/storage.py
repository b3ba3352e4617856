"""Tables to files and nothing lost: CSV, TSV, Parquet and HDF5.

Files are written beside their place under another name and moved there when complete, so that
an interrupted run leaves no half table. What was there before is replaced on request only.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dahl_ident.data.readers.file import library
from dahl_ident.data.source import split_header
from dahl_ident.errors import DataError, ValidationError

if TYPE_CHECKING:
    import pandas as pd

METADATA_MARK = "dahl_ident:"


def save_frame(frame: pd.DataFrame, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write a table in the format of the path's extension.

    Raises
    ------
    ValidationError
        If the extension is none that is written.
    DataError
        If a file is there already and `overwrite` is not set, or the place cannot be written to.
    """
    place = Path(path)
    packed = place.suffix.lower() == ".gz"
    suffix = (place.with_suffix("") if packed else place).suffix.lower()
    if suffix not in _WRITERS or (packed and suffix not in (".csv", ".tsv")):
        raise ValidationError(
            f"{place}: tables are written as {', '.join(_WRITERS)}, and .csv.gz; got "
            f"{place.suffix or 'no extension'!r}"
        )
    content = _WRITERS[suffix](frame)
    packing = gzip.compress(content, mtime=0) if packed else content
    write_whole(place, packing, overwrite=overwrite)
    return place


def place_of(path: str | Path, what: str, endings: Sequence[str]) -> Path:
    """Return the path, which has to have one of the endings.

    Raises
    ------
    ValidationError
        If it has another.
    """
    place = Path(path)
    if place.suffix.lower() not in endings:
        raise ValidationError(
            f"{place}: {what} is written as {', '.join(endings)}; got "
            f"{place.suffix or 'no ending'!r}"
        )
    return place


def refuse_existing(path: Path) -> None:
    """Refuse to replace a file.

    Raises
    ------
    DataError
        If there is one, or a folder.
    """
    if path.is_dir():
        raise DataError(f"{path} is a folder; give the path of a file in it")
    if path.exists():
        raise DataError(
            f"{path}: there is such a file already; give another name, or replace it with "
            "overwrite=True (on the command line --overwrite)"
        )


def write_whole(path: Path, content: bytes, *, overwrite: bool = False) -> None:
    """Write a file so that it is there whole or not at all.

    Raises
    ------
    DataError
        If a file is there already and `overwrite` is not set, or the place cannot be written to.
    """
    if not overwrite:
        refuse_existing(path)
    # not a file of tempfile, which nobody else may read
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            part.write_bytes(content)
            part.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink()
            raise
    except OSError as exc:
        raise DataError(f"{path}: cannot be written: {exc.strerror or exc}") from exc


def _text(frame: pd.DataFrame, separator: str) -> bytes:
    metadata = json.dumps(frame.attrs["dahl_ident"], ensure_ascii=False)
    table = frame.to_csv(index=False, sep=separator, na_rep="nan", lineterminator="\n")
    return f"# {METADATA_MARK} {metadata}\n{table}".encode()


def _csv(frame: pd.DataFrame) -> bytes:
    return _text(frame, ",")


def _tsv(frame: pd.DataFrame) -> bytes:
    return _text(frame, "\t")


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
            name, unit = split_header(str(label))
            values = frame[label].to_numpy()
            text = values.dtype.kind not in "fiub"
            item = root.create_dataset(
                name, data=values, dtype=h5py.string_dtype() if text else values.dtype
            )
            if unit is not None:
                item.attrs["unit"] = unit
    return buffer.getvalue()


_WRITERS: dict[str, Callable[[pd.DataFrame], bytes]] = {
    ".csv": _csv,
    ".tsv": _tsv,
    ".parquet": _parquet,
    ".h5": _hdf5,
    ".hdf5": _hdf5,
}
