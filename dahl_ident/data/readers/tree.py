"""Files of named arrays in a tree: MATLAB up to v7.2, MATLAB v7.3 and HDF5.

A path names an array: ``FRdata.ForceControl[2].frequency`` in MATLAB files, where indices of
struct and cell arrays count from 0, ``group/dataset`` in HDF5. A matrix appears as its columns
or rows, whichever are fewer: ``data[:,0]``, ``data[:,1]``.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.readers.file import File, library
from dahl_ident.data.source import Channel, Source
from dahl_ident.data.summary import listed
from dahl_ident.errors import DataError

_WIDEST = 64
Leaf = tuple[str, Any, str | None]  # path, array, unit


def read_matlab(file: File) -> Source:
    """Return the arrays of a MATLAB v4, v5 or v7 file."""
    try:
        content = library("scipy.io").loadmat(io.BytesIO(file.data), simplify_cells=True)
    except Exception as exc:  # scipy raises errors of many kinds on damaged files
        raise DataError(f"{file.name}: the file is damaged or no MATLAB file: {exc!r}") from exc
    leaves = (
        leaf
        for name, value in content.items()
        if not name.startswith("__")
        for leaf in _branches(name, value)
    )
    return _source(file, "MATLAB", leaves)


def read_hdf5(file: File) -> Source:
    """Return the datasets of an HDF5 or MATLAB v7.3 file."""
    h5py = library("h5py")
    matlab = file.data.startswith(b"MATLAB")
    try:
        with h5py.File(io.BytesIO(file.data), "r") as root:
            walk = _matlab_group(root, "", root, h5py) if matlab else _hdf5_group(root, h5py)
            leaves = list(walk)
            metadata = json.loads(root.attrs.get("dahl_ident", "{}"))
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as exc:
        raise DataError(f"{file.name}: the file is damaged: {exc}") from exc
    return _source(file, "MATLAB v7.3" if matlab else "HDF5", iter(leaves), metadata)


def _source(
    file: File, kind: str, leaves: Iterator[Leaf], metadata: dict[str, Any] | None = None
) -> Source:
    channels: list[Channel] = []
    notes: list[str] = []
    for path, value, unit in leaves:
        found = list(_channels(path, np.asarray(value), unit))
        channels += found
        if not found:
            notes.append(f"{path} ({np.shape(value)}, {np.asarray(value).dtype}) is not used")
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


def _branches(path: str, value: Any) -> Iterator[Leaf]:
    """Walk through structs, struct arrays and cell arrays."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _branches(f"{path}.{name}", inner)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        for i, inner in enumerate(np.ravel(np.asarray(value, dtype=object))):
            yield from _branches(f"{path}[{i}]", inner)
    else:
        yield path, value, None


def _channels(path: str, array: NDArray[Any], unit: str | None) -> Iterator[Channel]:
    """Yield an array as one channel, or a matrix as several."""
    short = re.split(r"[./]", path)[-1]
    if array.dtype.kind not in "fiubcU":
        return
    array = np.squeeze(array)
    if array.size == 0:
        return
    if array.ndim < 2:
        yield Channel(path, array, unit, short=short)
    elif array.ndim == 2 and min(array.shape) <= _WIDEST:
        upright = array.shape[1] <= array.shape[0]
        for i in range(min(array.shape)):
            index = f"[:,{i}]" if upright else f"[{i},:]"
            values = array[:, i] if upright else array[i]
            yield Channel(path + index, values, unit, short=short + index)


def _hdf5_group(group: Any, h5py: Any) -> Iterator[Leaf]:
    found: list[Leaf] = []

    def visit(path: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or (item.dtype.kind == "O" and item.ndim > 1):
            return
        unit = item.attrs.get("unit", item.attrs.get("units"))
        unit = unit.decode() if isinstance(unit, bytes) else unit
        unit = unit if isinstance(unit, str) and unit.strip() else None
        if h5py.check_string_dtype(item.dtype) is not None:
            found.append((path, np.asarray(item.asstr()[()], dtype=np.str_), unit))
        elif item.dtype.names:
            found.extend((f"{path}.{n}", item[n], unit) for n in item.dtype.names)
        else:
            found.append((path, item[()], unit))

    group.visititems(visit)
    yield from found


def _matlab_group(group: Any, path: str, root: Any, h5py: Any) -> Iterator[Leaf]:
    """Walk through a v7.3 file, whose struct arrays are datasets of references."""
    for name, item in group.items():
        if name.startswith("#"):
            continue
        where = f"{path}.{name}" if path else name
        yield from _matlab_item(item, where, path, name, root, h5py)


def _matlab_item(
    item: Any, where: str, path: str, name: str, root: Any, h5py: Any
) -> Iterator[Leaf]:
    if isinstance(item, h5py.Group):
        yield from _matlab_group(item, where, root, h5py)
    elif h5py.check_ref_dtype(item.dtype) is not None:
        cell = item.attrs.get("MATLAB_class") == b"cell"
        # MATLAB stores its arrays transposed
        for i, reference in enumerate(np.ravel(item[()].T)):
            inner = f"{where}[{i}]" if cell else f"{path}[{i}].{name}"
            yield from _matlab_item(root[reference], inner, path, name, root, h5py)
    elif "MATLAB_empty" not in item.attrs:
        yield where, _matlab_array(item), None


def _matlab_array(item: Any) -> NDArray[Any]:
    array = np.asarray(item[()]).T
    if item.attrs.get("MATLAB_class") == b"char":
        return np.asarray("".join(map(chr, np.ravel(array))))
    if array.dtype.names == ("real", "imag"):
        return np.asarray(array["real"] + 1j * array["imag"])
    return array
