"""Named arrays in a tree, as MATLAB, HDF5 and NumPy keep them, to channels.

A path names an array: ``FRdata.ForceControl[2].frequency`` in MATLAB files (indices count from 0),
``group/dataset`` in HDF5. A matrix is its columns or rows, whichever are fewer: ``data[:,0]``.
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
from dahl_ident.data.readers.file import DEEPEST, MOST_CHANNELS, File, apart, refuse_many
from dahl_ident.data.storage import library, read_metadata
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError

_WIDEST = 64  # columns and rows: a matrix with more of both is a map or a picture
_SECONDS, _BYTES_A_SECOND = 5, 10_000_000  # in which MATLAB's files are read
_LOOK_SECONDS = 1  # a look at a good file takes some milliseconds,
_LOOK_BYTES_A_SECOND = 1_000_000  # and at one of many small objects 0.2 ms for each 300 bytes
_PACKING = {"scale_factor", "add_offset", "_FillValue", "missing_value"}
_LOOKED_AT = 1 << 24  # bytes that are searched in all
Leaf = tuple[str, Any, str | None]  # path, array or Stored, unit


def tree_source(
    file: File, kind: str, leaves: Iterable[Leaf], metadata: Mapping[str, Any] | None = None
) -> RawFile:
    """Return the numeric vectors and matrices of a tree as channels."""
    channels: list[RawChannel] = []
    for path, value, unit in leaves:
        if unit is None:
            path, unit = split_header(path)
        file.refuse_above_limit(8 * math.prod(np.shape(value)), path)  # as numbers, once read
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
    """Yield an array as one channel, or a matrix as several."""
    short = re.split(r"[./]", path)[-1]
    array = value if isinstance(value, Stored) else np.asarray(value)
    shape = tuple(n for n in array.shape if n != 1)
    too_wide = len(shape) > 2 or (len(shape) == 2 and min(shape) > _WIDEST)
    if array.dtype.kind not in "fiubcU" or 0 in array.shape or too_wide:
        return
    upright = len(shape) < 2 or shape[1] <= shape[0]
    parts = [""]
    if len(shape) == 2:
        parts = [f"[:,{i}]" if upright else f"[{i},:]" for i in range(min(shape))]
    for i, index in enumerate(parts):
        read = partial(_column, array, shape, i, upright)
        if not isinstance(array, Stored):
            content: Any = read(slice(None))
        elif array.shape == shape and len(shape) == 1:
            content = array
        else:
            content = Stored((max(shape),) if shape else (), array.dtype, read, array.what)
        yield RawChannel(path + index, content, unit, short=short + index)


def _column(array: Any, shape: tuple[int, ...], i: int, upright: bool, rows: slice) -> NDArray[Any]:
    """Return a part of one column or row of a matrix, or of a vector in one."""
    if not isinstance(array, Stored):
        matrix = array.reshape(shape)
    elif rows != slice(None) and upright and array.shape == shape:
        matrix = array[rows]
        rows = slice(None)
    else:
        matrix = array.array.reshape(shape)
    if len(shape) < 2:
        return np.asarray(matrix[rows] if shape else matrix)
    return np.asarray(matrix[rows, i] if upright else matrix[i, rows])


def read_npz(file: File) -> RawFile:
    """Return the arrays of a ``.npz`` file; objects, which would have to be run, are refused."""
    with np.load(io.BytesIO(file.data), allow_pickle=False) as content:
        names = content.files
        refuse_many(file.name, len(names), "arrays")
        arrays = {name: content[name] for name in names}
    if len(arrays) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DataError(f"{file.name}: two arrays are called {twice!r}; expected one")
    leaves = (leaf for name, array in arrays.items() for leaf in _fields(name, array))
    return tree_source(file, "NumPy .npz", leaves)


def read_npy(file: File) -> RawFile:
    """Return the columns of the matrix, or the fields of the table, in a ``.npy`` file."""
    mapped = file.content is None
    stream = file.stream()
    array = np.load(stream, mmap_mode="r" if mapped else None, allow_pickle=False)
    end = getattr(array, "offset", 0) + array.nbytes if mapped else stream.tell()
    if file.length != end:
        raise ValueError(f"{file.length - end} bytes behind its array; were some added?")
    return tree_source(file, "NumPy .npy", _fields("data", array, file if mapped else None))


def _fields(path: str, array: NDArray[Any], mapped: File | None = None) -> Iterator[Leaf]:
    """Yield an array, or each field of a table; of a mapped file each part is a mapping again."""

    def read(field: str | None, rows: slice) -> NDArray[Any]:
        assert mapped is not None  # others are in memory
        again = np.load(mapped.stream(), mmap_mode="r", allow_pickle=False)
        return np.array((again if field is None else again[field])[rows])

    for field in array.dtype.names or (None,):
        values: Any = array if field is None else array[field]
        where = path if field is None else f"{path}.{field}"
        if mapped is not None and values.ndim:
            what = f"{mapped.name}: {where}"
            values = Stored(values.shape, values.dtype, partial(read, field), what)
        yield where, values, None


def read_matlab(file: File) -> RawFile:
    """Return the arrays of a MATLAB v4, v5 or v7 file; v7.3 is HDF5."""
    from scipy.io import loadmat

    def load() -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a variable twice, or one that cannot be read
            return loadmat(file.stream(), appendmat=False)

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


def read_hdf5(file: File) -> RawFile:
    """Return the data sets of an HDF5 or MATLAB v7.3 file."""
    h5py = library("h5py")
    _refuse_fatal(file, h5py)
    root = h5py.File(file.stream(), "r")  # open as long as an array of it waits to be read
    # Bytes that were added move others; the library itself refuses a file that is too short.
    # (HDF5 File Format Specification, II.A: the superblock)
    with file.opened() as content:
        content.seek(root.userblock_size)
        block = content.read(100)
    width = block[13 if block[8] < 2 else 9]  # bytes of an address
    at = {0: 24, 1: 28}.get(block[8], 12) + 2 * width
    end = int.from_bytes(block[at : at + width], "little")
    if file.length != end:
        raise ValueError(f"it has {file.length} bytes, and says that it ends after {end}")
    text = root.attrs.get("dahl_ident")
    metadata = {} if text is None else read_metadata(text)
    tree = _Tree(file, root, h5py)
    if root.userblock_size >= 512 and file.head.startswith(b"MATLAB"):
        return tree_source(file, "MATLAB v7.3", list(tree.matlab_group(root, "", 0)), metadata)
    return tree_source(file, "HDF5", list(tree.group(root, "", 0)), metadata)


def _refuse_fatal(file: File, h5py: Any) -> None:
    """Visit every object, and read the data sets whose places the file has to look up."""

    def look() -> None:  # pragma: no cover
        with contextlib.suppress(Exception), h5py.File(file.stream(), "r") as root:
            dict(root.attrs)  # an error will be met again, and named, by the reader
            left = _LOOKED_AT
            for _, item in _Tree(file, root, h5py).all_items(root, 0):
                with contextlib.suppress(Exception):
                    dict(item.attrs)
                if isinstance(item, h5py.Dataset) and item.chunks is not None:
                    with contextlib.suppress(Exception):
                        _ = item[()] if item.nbytes < left else (item[:1], item[-1:])
                    left -= min(item.nbytes, left)

    error = apart(look, seconds=_LOOK_SECONDS + file.length // _LOOK_BYTES_A_SECOND).error
    if error:
        raise ValueError(f"{error} on its structure")


class _Tree:
    """Walks through the groups of a file, each object once."""

    def __init__(self, file: File, root: Any, h5py: Any) -> None:
        self.file, self.root, self.h5py = file, root, h5py
        self.seen: set[Any] = set()
        self.count = 0

    def members(self, group: Any, depth: int) -> Iterator[tuple[str, Any]]:
        """Yield what a group holds itself; links to elsewhere are not followed."""
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
        """Yield every object below a group."""
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
                form = operator.itemgetter(name)
                yield f"{path}.{name}", self.stored(item, path, item.dtype[name], form), unit
        elif _PACKING & item.attrs.keys():
            yield path, self.stored(item, path, np.float64, partial(_unpacked, item.attrs)), unit
        else:
            yield path, self.stored(item, path, item.dtype, np.asarray), unit

    def stored(
        self, item: Any, path: str, dtype: Any, form: Any, *, turned: bool = False
    ) -> Stored:
        """Return an array that is read when it is used."""

        def read(rows: slice) -> NDArray[Any]:
            self.refuse(item, path)
            array = form(item[()] if rows == slice(None) or turned else item[rows])
            return np.asarray(array[rows] if turned else array)

        shape = tuple(int(n) for n in (item.shape[::-1] if turned else item.shape))
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
            form = _joined if parts else np.transpose
            yield where, self.stored(item, where, kind, form, turned=True), None


def _unpacked(attributes: Any, array: NDArray[Any]) -> NDArray[np.float64]:
    """Return what numbers stand for, as NetCDF packs them; a missing one is NaN."""
    values = array * float(np.squeeze(attributes.get("scale_factor", 1.0)))
    values = np.asarray(values + float(np.squeeze(attributes.get("add_offset", 0.0))))
    for name in ("_FillValue", "missing_value"):
        values[np.isin(array, np.asarray(attributes.get(name, [])))] = np.nan
    return values


def _joined(parts: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(parts["real"].T + 1j * parts["imag"].T)
