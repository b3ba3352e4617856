"""Channels from the trees of named arrays in MATLAB, HDF5 and NumPy files.

A path names an array: ``FRdata.ForceControl[2].frequency`` in MATLAB files (indices count from 0),
``group/dataset`` in HDF5. A matrix gives a channel for each of its columns, or of its rows if these
are fewer: ``data[:,0]``.
"""

from __future__ import annotations

import contextlib
import io
import math
import operator
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import RawChannel, RawFile, Stored, split_header, words
from dahl_ident.data.readers.file import DEEPEST, MOST_CHANNELS, File, in_child_process, refuse_many
from dahl_ident.data.storage import library, read_metadata
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError

_MOST_SERIES = 64  # a matrix with more columns and more rows is a map or an image
_SECONDS, _BYTES_PER_SECOND = 5, 10_000_000  # time limit for a MATLAB file: constant, and by size
# The same for a check of an HDF5 file. Most take some milliseconds; one of many small objects takes
# 0.2 ms for each 300 bytes.
_CHECK_SECONDS, _CHECK_BYTES_PER_SECOND = 1, 1_000_000
_CHECKED_BYTES = 1 << 24  # of data that the check reads
_PACKING = {"scale_factor", "add_offset", "_FillValue", "missing_value"}
Leaf = tuple[str, Any, str | None]  # path, array or Stored, unit


def tree_source(
    file: File, kind: str, leaves: Iterable[Leaf], metadata: Mapping[str, Any] | None = None
) -> RawFile:
    """Return the numeric vectors and matrices of a tree as channels."""
    channels: list[RawChannel] = []
    for path, value, unit in leaves:
        if unit is None:
            path, unit = split_header(path)
        file.refuse_above_limit(8 * math.prod(np.shape(value)), path)  # 8 bytes for each number
        columns = list(_channels(path, value, unit))
        channels += columns
        if not columns:
            dtype = getattr(value, "dtype", type(value).__name__)
            file.notes.append(f"{path} ({np.shape(value)}, {dtype}) is not used")
        refuse_many(file.name, len(channels) + len(file.notes), "arrays")
    if not channels:
        others = f"; {listed(file.notes, 3)}" if file.notes else ""
        raise DataError(f"{file.name}: the file holds no vector or matrix of numbers{others}")
    return file.source(kind, channels, row_name="index {}".format, metadata=metadata or {})


def _channels(path: str, value: Any, unit: str | None) -> Iterator[RawChannel]:
    short = re.split(r"[./]", path)[-1]
    array = value if isinstance(value, Stored) else np.asarray(value)
    shape = tuple(n for n in array.shape if n != 1)
    too_wide = len(shape) > 2 or (len(shape) == 2 and min(shape) > _MOST_SERIES)
    if array.dtype.kind not in "fiubcU" or 0 in array.shape or too_wide:
        return
    by_columns = len(shape) < 2 or shape[1] <= shape[0]
    parts = [""]
    if len(shape) == 2:
        parts = [f"[:,{i}]" if by_columns else f"[{i},:]" for i in range(min(shape))]
    for i, index in enumerate(parts):
        read = partial(_column, array, shape, i, by_columns)
        if not isinstance(array, Stored):
            content: Any = read(slice(None))
        elif array.shape == shape and len(shape) == 1:
            content = array
        else:
            content = Stored((max(shape),) if shape else (), array.dtype, read, array.what)
        yield RawChannel(path + index, content, unit, short=short + index)


def _column(
    array: Any, shape: tuple[int, ...], i: int, by_columns: bool, rows: slice
) -> NDArray[Any]:
    """Return `rows` of the column (or row) `i` of a matrix, or of a vector stored as a matrix."""
    if not isinstance(array, Stored):
        matrix = array.reshape(shape)
    elif rows != slice(None) and by_columns and array.shape == shape:
        matrix = array[rows]
        rows = slice(None)
    else:
        matrix = array.array.reshape(shape)
    if len(shape) < 2:
        return np.asarray(matrix[rows] if shape else matrix)
    return np.asarray(matrix[rows, i] if by_columns else matrix[i, rows])


def read_npz(file: File) -> RawFile:
    """Return the arrays of a ``.npz`` file; refuse pickled objects, which could run code."""
    with np.load(io.BytesIO(file.data), allow_pickle=False) as content:
        names = content.files
        refuse_many(file.name, len(names), "arrays")
        arrays = {name: content[name] for name in names}
    if len(arrays) < len(names):
        repeated = next(name for name in names if names.count(name) > 1)
        raise DataError(f"{file.name}: two arrays are called {repeated!r}; expected one")
    leaves = (leaf for name, array in arrays.items() for leaf in _fields(name, array))
    return tree_source(file, "NumPy .npz", leaves)


def read_npy(file: File) -> RawFile:
    """Return the columns of a ``.npy`` file's matrix, or the fields of its structured array."""
    mapped = file.content is None
    stream = file.stream()
    array = np.load(stream, mmap_mode="r" if mapped else None, allow_pickle=False)
    end = getattr(array, "offset", 0) + array.nbytes if mapped else stream.tell()
    if file.length != end:
        raise ValueError(f"{file.length - end} bytes behind its array; were some added?")
    return tree_source(file, "NumPy .npy", _fields("data", array))


def _fields(path: str, array: NDArray[Any]) -> Iterator[Leaf]:
    """Yield an array, or each field of a structured one."""
    for field in array.dtype.names or ():
        yield f"{path}.{field}", array[field], None
    if array.dtype.names is None:
        yield path, array, None


def read_matlab(file: File) -> RawFile:
    """Return the arrays of a MATLAB v4, v5 or v7 file; v7.3 is HDF5."""
    from scipy.io import loadmat

    def load() -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a duplicate variable, or one that cannot be read
            return loadmat(file.stream(), appendmat=False)

    seconds = _SECONDS + file.length // _BYTES_PER_SECOND
    content, error = in_child_process(load, seconds=seconds, bytes_at_most=2 * file.limit)
    if error:
        raise DataError(f"{file.name}: the file is damaged or not a MATLAB file: {error}")
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


def read_hdf5(file: File) -> RawFile:
    """Return the data sets of an HDF5 or MATLAB v7.3 file."""
    h5py = library("h5py")
    _refuse_fatal(file, h5py)
    root = h5py.File(file.stream(), "r")  # stays open until its arrays have been read
    # Added bytes have shifted others; h5py itself refuses a file that is too short.
    # (HDF5 File Format Specification, II.A: the superblock)
    with file.opened() as content:
        content.seek(root.userblock_size)
        block = content.read(100)
    width = block[13 if block[8] < 2 else 9]  # bytes of an address
    at = {0: 24, 1: 28}.get(block[8], 12) + 2 * width
    end = int.from_bytes(block[at : at + width], "little")
    if file.length != end:
        raise ValueError(f"it has {file.length} bytes, but its header says {end}")
    text = root.attrs.get("dahl_ident")
    metadata = {} if text is None else read_metadata(text)
    tree = _Tree(file, root, h5py)
    if root.userblock_size >= 512 and file.head.startswith(b"MATLAB"):
        return tree_source(file, "MATLAB v7.3", list(tree.matlab_group(root, "", 0)), metadata)
    return tree_source(file, "HDF5", list(tree.group(root, "", 0)), metadata)


def _refuse_fatal(file: File, h5py: Any) -> None:
    """Refuse a file on which the library hangs or crashes.

    A child process visits every object, and reads chunked data sets, which have an index.
    """

    def visit() -> None:  # pragma: no cover
        with contextlib.suppress(Exception), h5py.File(file.stream(), "r") as root:
            dict(root.attrs)  # the reader will meet an error again, and report it
            remaining = _CHECKED_BYTES
            for _, item in _Tree(file, root, h5py).all_items(root, 0):
                with contextlib.suppress(Exception):
                    dict(item.attrs)
                if isinstance(item, h5py.Dataset) and item.chunks is not None:
                    with contextlib.suppress(Exception):
                        _ = item[()] if item.nbytes < remaining else (item[:1], item[-1:])
                    remaining -= min(item.nbytes, remaining)

    seconds = _CHECK_SECONDS + file.length // _CHECK_BYTES_PER_SECOND
    _, error = in_child_process(visit, seconds=seconds)
    if error:
        raise ValueError(f"{error} on its structure")


class _Tree:
    """Walks through the groups of a file, each object once."""

    def __init__(self, file: File, root: Any, h5py: Any) -> None:
        self.file, self.root, self.h5py = file, root, h5py
        self.seen: set[Any] = set()
        self.count = 0

    def members(self, group: Any, depth: int) -> Iterator[tuple[str, Any]]:
        """Yield the members of a group; soft and external links are not followed."""
        if depth > DEEPEST:
            raise DataError(f"{self.file.name}: groups are nested deeper than {DEEPEST} levels")
        for name in group:
            self.count += 1
            refuse_many(self.file.name, self.count, "objects", 2 * MOST_CHANNELS)
            if not isinstance(group.get(name, getlink=True), self.h5py.HardLink):
                continue
            item = group[name]
            key = self.h5py.h5o.get_info(item.id).addr
            if key not in self.seen:
                self.seen.add(key)
                yield name, item

    def all_items(self, group: Any, depth: int) -> Iterator[tuple[str, Any]]:
        for name, item in self.members(group, depth):
            yield name, item
            if isinstance(item, self.h5py.Group):
                yield from self.all_items(item, depth + 1)

    def group(self, group: Any, path: str, depth: int) -> Iterator[Leaf]:
        for name, item in self.members(group, depth):
            where = f"{path}/{name}" if path else name
            if isinstance(item, self.h5py.Group):
                yield from self.group(item, where, depth + 1)
            elif isinstance(item, self.h5py.Dataset):
                yield from self.dataset(item, where)

    def dataset(self, item: Any, path: str) -> Iterator[Leaf]:
        if item.shape is None or (item.dtype.kind == "O" and item.ndim > 1):
            return
        unit = item.attrs.get("unit", item.attrs.get("units"))
        unit = unit.decode() if isinstance(unit, bytes) else unit
        unit = unit if isinstance(unit, str) and unit.strip() else None
        if self.h5py.check_string_dtype(item.dtype) is not None:
            self.refuse(item, path)
            yield path, words(np.ravel(item.asstr()[()])).reshape(item.shape), unit
        elif item.dtype.names:
            for name in item.dtype.names:
                convert = operator.itemgetter(name)
                yield f"{path}.{name}", self.stored(item, path, item.dtype[name], convert), unit
        elif _PACKING & item.attrs.keys():
            yield path, self.stored(item, path, np.float64, partial(_unpacked, item.attrs)), unit
        else:
            yield path, self.stored(item, path, item.dtype, np.asarray), unit

    def stored(
        self, item: Any, path: str, dtype: Any, convert: Any, *, transposed: bool = False
    ) -> Stored:

        def read(rows: slice) -> NDArray[Any]:
            self.refuse(item, path)
            array = convert(item[()] if rows == slice(None) or transposed else item[rows])
            return np.asarray(array[rows] if transposed else array)

        shape = tuple(int(n) for n in (item.shape[::-1] if transposed else item.shape))
        return Stored(shape, np.dtype(dtype), read, f"{self.file.name}: {path}")

    def refuse(self, item: Any, path: str) -> None:
        """Refuse a data set that is too large, or whose values are in other files."""
        if item.external or item.is_virtual:
            how = "virtual, made of parts of others" if item.is_virtual else "in an external file"
            raise DataError(
                f"{self.file.name}: the values of {path} are {how}; write them into one file, "
                "such as with h5repack"
            )
        self.file.refuse_above_limit(int(item.size) * max(item.dtype.itemsize, 8), path)

    def matlab_group(self, group: Any, path: str, depth: int) -> Iterator[Leaf]:
        """Walk through a v7.3 file, whose struct arrays are data sets of references."""
        for name, item in self.members(group, depth):
            if not name.startswith("#"):
                where = f"{path}.{name}" if path else name
                yield from self.matlab_item(item, where, path, name, depth)

    def matlab_item(
        self, item: Any, where: str, path: str, name: str, depth: int
    ) -> Iterator[Leaf]:
        if depth > DEEPEST:
            raise DataError(f"{self.file.name}: {path} is nested deeper than {DEEPEST} levels")
        if isinstance(item, self.h5py.Group):
            yield from self.matlab_group(item, where, depth + 1)
        elif not isinstance(item, self.h5py.Dataset) or item.shape is None:
            return
        elif self.h5py.check_ref_dtype(item.dtype) is not None:
            self.refuse(item, where)
            refuse_many(self.file.name, item.size, f"cells in {where}")
            cell = item.attrs.get("MATLAB_class") == b"cell"
            # MATLAB stores its arrays transposed
            for i, reference in enumerate(np.ravel(item[()].T)):
                inner = f"{where}[{i}]" if cell else f"{path}[{i}].{name}"
                if reference:  # a null reference is an empty cell
                    yield from self.matlab_item(self.root[reference], inner, path, name, depth + 1)
        elif item.attrs.get("MATLAB_class") == b"char" and "MATLAB_empty" not in item.attrs:
            self.refuse(item, where)
            codes = np.ravel(np.asarray(item[()]).T).tolist()
            yield where, np.asarray("".join(map(chr, codes))), None
        elif "MATLAB_empty" not in item.attrs:
            parts = item.dtype.names == ("real", "imag")
            kind = np.dtype(np.complex128) if parts else item.dtype
            convert = _as_complex if parts else np.transpose
            yield where, self.stored(item, where, kind, convert, transposed=True), None


def _unpacked(attributes: Any, array: NDArray[Any]) -> NDArray[np.float64]:
    """Return the values from numbers packed by NetCDF; missing ones are NaN."""
    values = array * float(np.squeeze(attributes.get("scale_factor", 1.0)))
    values = np.asarray(values + float(np.squeeze(attributes.get("add_offset", 0.0))))
    for name in ("_FillValue", "missing_value"):
        values[np.isin(array, np.asarray(attributes.get(name, [])))] = np.nan
    return values


def _as_complex(parts: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(parts["real"].T + 1j * parts["imag"].T)
