"""Named arrays in a tree, as MATLAB, HDF5 and NumPy keep them, to channels.

A path names an array: ``FRdata.ForceControl[2].frequency`` in MATLAB files, where indices of
struct and cell arrays count from 0, ``group/dataset`` in HDF5. A matrix appears as its columns
or rows, whichever are fewer: ``data[:,0]``, ``data[:,1]``.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import RawChannel, RawFile, Stored, split_header
from dahl_ident.data.readers.child_process import apart
from dahl_ident.data.readers.file import DEEPEST, MOST_CHANNELS, File
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError

_WIDEST = 64  # columns; a matrix with more both ways is a map or a picture
_SECONDS, _BYTES_A_SECOND = 5, 10_000_000  # in which MATLAB's files are read
Leaf = tuple[str, Any, str | None]  # path, array or Stored, unit


def tree_source(
    file: File, kind: str, leaves: Iterator[Leaf], metadata: Mapping[str, Any] | None = None
) -> RawFile:
    """Return the numeric vectors and matrices of a tree as channels."""
    channels: list[RawChannel] = []
    notes: list[str] = []
    for path, value, unit in leaves:
        if unit is None:
            path, unit = split_header(path)
        file.refuse_above_limit(8 * math.prod(np.shape(value)), path)  # as numbers, once read
        those = list(_channels(path, value, unit))
        channels += those
        if not those:
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
    return file.source(
        kind, channels, row_name=lambda i: f"index {i}", metadata=metadata or {}, notes=tuple(notes)
    )


def _channels(path: str, value: Any, unit: str | None) -> Iterator[RawChannel]:
    """Yield an array as one channel, or a matrix as several."""
    short = re.split(r"[./]", path)[-1]
    array = value if isinstance(value, Stored) else np.asarray(value)
    if array.dtype.kind not in "fiubcU" or 0 in array.shape:
        return
    shape = tuple(n for n in array.shape if n != 1)
    upright = len(shape) < 2 or shape[1] <= shape[0]
    if len(shape) < 2:
        parts = [""]
    elif len(shape) == 2 and min(shape) <= _WIDEST:
        parts = [f"[:,{i}]" if upright else f"[{i},:]" for i in range(min(shape))]
    else:
        return
    for i, index in enumerate(parts):
        read = _column(array, shape, i, upright)
        if not isinstance(array, Stored):
            content: Any = read(slice(None))
        elif array.shape == shape and len(shape) == 1:
            content = array
        else:
            content = Stored((max(shape),) if shape else (), array.dtype, read, array.what)
        yield RawChannel(path + index, content, unit, short=short + index)


def _column(array: Any, shape: tuple[int, ...], i: int, upright: bool) -> Any:
    """Return what reads a part of one column or row of a matrix, or of a vector in one."""

    def read(rows: slice) -> NDArray[Any]:
        if not isinstance(array, Stored):
            matrix = array.reshape(shape)
        elif rows != slice(None) and upright and array.shape == shape:
            matrix, rows = array[rows], slice(None)
        else:
            matrix = array.array.reshape(shape)
        if len(shape) < 2:
            return np.asarray(matrix[rows] if shape else matrix)
        return np.asarray(matrix[rows, i] if upright else matrix[i, rows])

    return read


def read_npz(file: File) -> RawFile:
    """Return the arrays of a ``.npz`` file; objects, which would have to be run, are refused."""
    with np.load(io.BytesIO(file.data), allow_pickle=False) as content:
        names = content.files[: MOST_CHANNELS + 1]
        arrays = {name: content[name] for name in names}
    repeated = [name for name in arrays if names.count(name) > 1]
    if repeated:
        raise DataError(f"{file.name}: two arrays are called {repeated[0]!r}; expected one")
    leaves = (leaf for name, array in arrays.items() for leaf in _fields(name, array))
    return tree_source(file, "NumPy .npz", leaves)


def read_npy(file: File) -> RawFile:
    """Return the columns of the matrix, or the fields of the table, in a ``.npy`` file."""
    mapped = file.content is None
    stream = file.stream()
    array = np.load(stream, mmap_mode="r" if mapped else None, allow_pickle=False)
    end = getattr(array, "offset", 0) + array.nbytes if mapped else stream.tell()
    if file.length != end:
        raise DataError(
            f"{file.name}: the file is damaged: {file.length - end} bytes behind its array; were "
            "some added?"
        )
    return tree_source(file, "NumPy .npy", _fields("data", array, file if mapped else None))


def _fields(path: str, array: NDArray[Any], mapped: File | None = None) -> Iterator[Leaf]:
    """Yield an array, or each field of a table; of a mapped file each part is a mapping again."""
    for field in array.dtype.names or (None,):
        values = array if field is None else array[field]
        where = path if field is None else f"{path}.{field}"

        def read(rows: slice, field: str | None = field) -> NDArray[Any]:
            assert mapped is not None  # others are in memory
            again = np.load(mapped.stream(), mmap_mode="r", allow_pickle=False)
            return np.array((again if field is None else again[field])[rows])

        if mapped is None or not values.ndim:
            yield where, values, None
        else:
            yield where, Stored(values.shape, values.dtype, read, f"{mapped.name}: {where}"), None


def read_matlab(file: File) -> RawFile:
    """Return the arrays of a MATLAB v4, v5 or v7 file; those of v7.3 are HDF5."""
    from scipy.io import loadmat

    def load() -> dict[str, Any]:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a variable twice, or one that cannot be read
            content: dict[str, Any] = loadmat(file.stream(), appendmat=False)
        return content

    seconds = _SECONDS + file.length // _BYTES_A_SECOND
    content, error = apart(load, seconds=seconds, bytes_at_most=2 * file.limit)
    if error:
        raise DataError(f"{file.name}: the file is damaged or no MATLAB file: {error}")
    names = [name for name in content if not name.startswith("__")]
    leaves = (leaf for name in names for leaf in _matlab_leaves(file, content[name], name, 0))
    return tree_source(file, "MATLAB", leaves)


def _matlab_leaves(file: File, value: Any, path: str, depth: int) -> Iterator[Leaf]:
    """Walk through an array: its numbers, its cells, or the fields of each struct."""
    from scipy.io.matlab import MatlabFunction, MatlabOpaque

    if depth > DEEPEST:
        raise DataError(f"{file.name}: {path} is nested deeper than {DEEPEST} levels")
    if not isinstance(value, np.ndarray):
        yield path, "sparse matrix", None
    elif isinstance(value, (MatlabFunction, MatlabOpaque)):
        yield path, "function or object", None
    elif value.dtype.names or value.dtype.kind == "O":
        for i, item in enumerate(value.ravel()):
            where = path if value.size == 1 else f"{path}[{i}]"
            parts = {f"{where}.{name}": item[name] for name in value.dtype.names or ()}
            for inner, part in (parts or {where: item}).items():
                yield from _matlab_leaves(file, part, inner, depth + 1)
    else:
        yield path, value, None
