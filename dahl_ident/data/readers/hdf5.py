"""HDF5, and MATLAB v7.3, which is HDF5 inside. Arrays stay in the file until they are used."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import RawFile, Stored, words
from dahl_ident.data.readers.array_trees import Leaf, tree_source
from dahl_ident.data.readers.child_process import apart
from dahl_ident.data.readers.file import DEEPEST, MOST_CHANNELS, File
from dahl_ident.data.storage import library, read_metadata
from dahl_ident.errors import DataError

_SECONDS = 1  # a look at a good file takes some milliseconds,
_BYTES_A_SECOND = 1_000_000  # and at one of many small objects 0.2 ms for each 300 bytes
_PACKING = {"scale_factor", "add_offset", "_FillValue", "missing_value"}
_LOOKED_AT = 1 << 24  # bytes in all


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
        raise DataError(
            f"{file.name}: the file is damaged: it has {file.length} bytes, and says that it ends "
            f"after {end}"
        )
    matlab = root.userblock_size >= 512 and file.head.startswith(b"MATLAB")
    tree = _Tree(file, root, h5py)
    leaves = list(tree.matlab_group(root, "", 0) if matlab else tree.group(root, "", 0))
    text = root.attrs.get("dahl_ident")
    metadata = {} if text is None else read_metadata(text)
    return tree_source(file, "MATLAB v7.3" if matlab else "HDF5", iter(leaves), metadata)


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

    error = apart(look, seconds=_SECONDS + file.length // _BYTES_A_SECOND).error
    if error:
        raise DataError(f"{file.name}: the file is damaged: {error} on its structure")


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
            if self.count > 2 * MOST_CHANNELS:
                raise DataError(
                    f"{self.file.name}: the file holds more than {2 * MOST_CHANNELS} objects; save "
                    "what is needed in a file of its own"
                )
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
                dtype = item.dtype[name]
                yield f"{path}.{name}", self.stored(item, path, dtype, lambda a, n=name: a[n]), unit
        elif _PACKING & item.attrs.keys():
            yield path, self.stored(item, path, np.float64, partial(_unpacked, item.attrs)), unit
        else:
            yield path, self.stored(item, path, item.dtype, lambda a: a), unit

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
            if item.size > MOST_CHANNELS:
                raise DataError(f"{self.file.name}: {where} has {item.size} cells; too many")
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
