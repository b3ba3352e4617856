"""Named arrays in a tree, as MATLAB, HDF5 and NumPy keep them, to channels.

A path names an array: ``FRdata.ForceControl[2].frequency`` in MATLAB files, where indices of
struct and cell arrays count from 0, ``group/dataset`` in HDF5. A matrix appears as its columns
or rows, whichever are fewer: ``data[:,0]``, ``data[:,1]``.
"""

from __future__ import annotations

import io
import math
import re
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import Channel, Source, Stored, split_header
from dahl_ident.data.readers.file import MOST_CHANNELS, File
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError

_WIDEST = 64  # columns; a matrix with more both ways is a map or a picture
Leaf = tuple[str, Any, str | None]  # path, array or Stored, unit
_NUMPY_ERRORS = (
    ValueError, OSError, EOFError, KeyError, TypeError, SyntaxError, MemoryError, OverflowError,
    RuntimeError, UnicodeDecodeError, zipfile.BadZipFile, zlib.error, NotImplementedError,
    tokenize.TokenError,
)  # fmt: skip


def tree_source(
    file: File, kind: str, leaves: Iterator[Leaf], metadata: Mapping[str, Any] | None = None
) -> Source:
    """Return the numeric vectors and matrices of a tree as channels."""
    channels: list[Channel] = []
    notes: list[str] = []
    for path, value, unit in leaves:
        if unit is None:
            path, unit = split_header(path)
        file.refuse_above_limit(8 * math.prod(np.shape(value)), path)  # as numbers, once read
        found = list(_channels(path, value, unit))
        channels += found
        if not found:
            dtype = getattr(value, "dtype", type(value).__name__)
            notes.append(f"{path} ({np.shape(value)}, {dtype}) is not used")
        if len(channels) + len(notes) > MOST_CHANNELS:
            raise DataError(
                f"{file.name}: the file holds more than {MOST_CHANNELS} arrays; expected a "
                "record or a table. Save what is needed in a file of its own"
            )
    if not channels:
        others = f"; {listed(notes, 3)}" if notes else ""
        raise DataError(f"{file.name}: the file holds no vector or matrix of numbers{others}")
    return Source(
        file.name,
        kind,
        tuple(channels),
        file.sha256,
        row_name=lambda i: f"index {i}",
        metadata=metadata or {},
        notes=tuple(notes),
    )


def _channels(path: str, value: Any, unit: str | None) -> Iterator[Channel]:
    """Yield an array as one channel, or a matrix as several."""
    short = re.split(r"[./]", path)[-1]
    array = value if isinstance(value, Stored) else np.asarray(value)
    if array.dtype.kind not in "fiubcU" or 0 in array.shape:
        return
    shape = tuple(n for n in array.shape if n != 1)
    if len(shape) < 2:
        if isinstance(array, Stored):
            whole = len(array.shape) == 1
            flat = array if whole else Stored(shape, array.dtype, _column(array, shape, 0, True))
            yield Channel(path, flat, unit, short=short)
        else:
            yield Channel(path, np.squeeze(array), unit, short=short)
    elif len(shape) == 2 and min(shape) <= _WIDEST:
        upright = shape[1] <= shape[0]
        for i in range(min(shape)):
            index = f"[:,{i}]" if upright else f"[{i},:]"
            read = _column(array, shape, i, upright)
            if isinstance(array, Stored):
                content: Any = Stored((max(shape),), array.dtype, read)
            else:
                content = read(slice(None))
            yield Channel(path + index, content, unit, short=short + index)


def _column(array: Any, shape: tuple[int, ...], i: int, upright: bool) -> Any:
    """Return what reads a part of one column or row of a matrix, or of a vector in one."""

    def read(rows: slice) -> NDArray[Any]:
        if not isinstance(array, Stored):
            matrix = array.reshape(shape)
        elif rows != slice(None) and upright and array.shape == shape:
            matrix, rows = array.read(rows), slice(None)
        else:
            matrix = array.array.reshape(shape)
        if len(shape) < 2:
            return np.asarray(matrix[rows] if shape else matrix)
        return np.asarray(matrix[rows, i] if upright else matrix[i, rows])

    return read


def read_npz(file: File) -> Source:
    """Return the arrays of a ``.npz`` file; objects, which would have to be run, are refused."""
    try:
        with np.load(io.BytesIO(file.data), allow_pickle=False) as content:
            names = content.files[: MOST_CHANNELS + 1]
            arrays = {name: _numpy_array(content[name]) for name in names}
    except _NUMPY_ERRORS as exc:
        raise DataError(f"{file.name}: the file is damaged: {exc}") from exc
    twice = [name for name in arrays if names.count(name) > 1]
    if twice:
        raise DataError(f"{file.name}: two arrays are called {twice[0]!r}; expected one")
    return tree_source(file, "NumPy .npz", _fields(arrays))


def read_npy(file: File) -> Source:
    """Return the columns of the matrix, or the fields of the table, in a ``.npy`` file."""
    try:
        if file.content is None:
            array = np.load(file.stream(), mmap_mode="r", allow_pickle=False)
            left = file.size - getattr(array, "offset", 0) - array.nbytes
        else:
            stream = file.stream()
            array = np.load(stream, allow_pickle=False)
            left = len(file.content) - stream.tell()
    except _NUMPY_ERRORS as exc:
        raise DataError(f"{file.name}: the file is damaged: {exc}") from exc
    if left:
        raise DataError(
            f"{file.name}: the file is damaged: {left} bytes behind its array; were some added?"
        )
    leaves = _fields({"data": _numpy_array(array)}, file if file.content is None else None)
    return tree_source(file, "NumPy .npy", leaves)


def _numpy_array(array: Any) -> NDArray[Any]:
    if not isinstance(array, np.ndarray):
        raise TypeError("it holds no array")
    return array


def _fields(arrays: Mapping[str, NDArray[Any]], mapped: File | None = None) -> Iterator[Leaf]:
    """Walk through arrays, tables of named fields among them."""
    for path, array in arrays.items():
        for field in array.dtype.names or (None,):
            values = array if field is None else array[field]
            content = (
                values if mapped is None or not values.ndim else _mapped(mapped, field, values)
            )
            yield path if field is None else f"{path}.{field}", content, None


def _mapped(file: File, field: str | None, like: NDArray[Any]) -> Stored:
    """Return a field of a .npy file; each part is a mapping of its own, which ends with it."""

    def read(rows: slice) -> NDArray[Any]:
        array = np.load(file.stream(), mmap_mode="r", allow_pickle=False)
        return np.array((array if field is None else array[field])[rows])

    return Stored(like.shape, like.dtype, read)
