"""MATLAB files up to v7.2. Those of v7.3 are HDF5."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from dahl_ident.data.raw_columns import Source
from dahl_ident.data.readers.array_trees import Leaf, tree_source
from dahl_ident.data.readers.child_process import apart
from dahl_ident.data.readers.file import DEEPEST, File
from dahl_ident.errors import DataError

_SECONDS, _BYTES_A_SECOND = 5, 10_000_000


def read_matlab(file: File) -> Source:
    """Return the arrays of a MATLAB v4, v5 or v7 file."""
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
    leaves = (leaf for name in names for leaf in _leaves(file, content[name], name, 0))
    return tree_source(file, "MATLAB", leaves)


def _leaves(file: File, value: Any, path: str, depth: int) -> Iterator[Leaf]:
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
            if value.dtype.names:
                for field in value.dtype.names:
                    yield from _leaves(file, item[field], f"{where}.{field}", depth + 1)
            else:
                yield from _leaves(file, item, where, depth + 1)
    else:
        yield path, value, None
