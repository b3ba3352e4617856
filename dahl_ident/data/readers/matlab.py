"""MATLAB files up to v7.2, every tag and size checked before a byte is used.

Libraries that trust the tags of a damaged file end the interpreter. Level 5 files are a sequence
of elements with a type and a length; a matrix element holds its class, its shape, its name and
then its numbers, its cells, or its fields (MathWorks, MAT-File Format, 2023). Level 4 files are
matrices one behind the other.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import Source
from dahl_ident.data.readers.array_trees import Leaf, tree_source
from dahl_ident.data.readers.file import DEEPEST, MOST_CHANNELS, File
from dahl_ident.errors import DataError

_TYPES = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
    16: "u1", 17: "u2", 18: "u4",
}  # fmt: skip
_MATRIX, _COMPRESSED, _UTF8 = 14, 15, 16  # types of elements, in the format
_CELL, _STRUCT, _OBJECT, _CHAR = 1, 2, 3, 4  # classes of arrays, in the format
_CLASSES = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
_NOT_READ = {5: "sparse matrix", 16: "function handle", 17: "object"}
_COMPLEX, _LOGICAL = 0x0800, 0x0200  # flags of an array, in the format
_LEVEL_4 = ("f8", "f4", "i4", "i2", "u2", "u1")
_MOST_DIMENSIONS = 32  # that an array of NumPy 1 may have; damaged files claim any number


class _DamagedError(Exception):
    """The bytes contradict themselves; the message says how."""


def read_matlab(file: File) -> Source:
    """Return the arrays of a MATLAB v4, v5 or v7 file."""
    data = file.data
    level_5 = data.startswith(b"MATLAB 5.0 MAT-file")
    try:
        leaves = list(_Level5(file, data).leaves() if level_5 else _level_4(data))
    except (_DamagedError, struct.error, zlib.error, UnicodeDecodeError) as exc:
        raise DataError(f"{file.name}: the file is damaged or no MATLAB file: {exc}") from exc
    return tree_source(file, "MATLAB", iter(leaves))


class _Level5:
    """The elements of a level 5 file."""

    def __init__(self, file: File, data: bytes) -> None:
        if len(data) < 128 or data[126:128] not in (b"IM", b"MI"):
            raise _DamagedError("its header of 128 bytes is incomplete")
        self.file = file
        self.data = memoryview(data)
        self.order = "<" if data[126:128] == b"IM" else ">"
        self.unpacked = 0
        self.count = 0

    def leaves(self) -> Iterator[Leaf]:
        subsystem = struct.unpack_from(f"{self.order}Q", self.data, 116)[0]
        stop = len(self.data)
        at = 128
        while at < stop:
            kind, content, following = self.element(self.data, at)
            if kind == _COMPRESSED:
                kind, content, _ = self.element(self.inflated(content), 0)
            if kind != _MATRIX:
                raise _DamagedError(f"element type {kind} at byte {at} is not a matrix")
            if at != subsystem:  # what MATLAB keeps of objects for itself
                yield from self.matrix(content, None, 0)
            at = following

    def inflated(self, packed: memoryview) -> memoryview:
        room = self.file.limit - self.unpacked
        unpacker = zlib.decompressobj()
        data = unpacker.decompress(packed, room + 1)
        self.unpacked += len(data)
        self.file.refuse_above_limit(self.unpacked, "the content")
        if not unpacker.eof:
            raise _DamagedError("a compressed element is cut off")
        return memoryview(data)

    def element(self, data: memoryview, at: int) -> tuple[int, memoryview, int]:
        """Return type and content of the element at a place, and where the next one starts."""
        if at + 8 > len(data):
            raise _DamagedError("an element's tag is cut off")
        kind, size = struct.unpack_from(f"{self.order}II", data, at)
        if kind >> 16:  # up to four bytes in the tag itself
            kind, size = kind & 0xFFFF, kind >> 16
            if size > 4:
                raise _DamagedError(f"a small element of {size} bytes at byte {at}")
            return kind, data[at + 4 : at + 4 + size], at + 8
        start, stop = at + 8, at + 8 + size
        if stop > len(data):
            raise _DamagedError(
                f"the element at byte {at} says {size} bytes, {len(data) - start} are left"
            )
        padded = stop if kind == _COMPRESSED else stop + -size % 8
        return kind, data[start:stop], min(padded, len(data))

    def numbers(self, data: memoryview, at: int, what: str) -> tuple[int, NDArray[Any], int]:
        """Return the stored numbers of an element."""
        kind, content, following = self.element(data, at)
        if kind not in _TYPES:
            raise _DamagedError(f"{what} has the element type {kind}")
        dtype = np.dtype(self.order + _TYPES[kind])
        if len(content) % dtype.itemsize:
            raise _DamagedError(f"{what} has {len(content)} bytes of {dtype} numbers")
        return kind, np.frombuffer(content, dtype), following

    def matrix(self, data: memoryview, path: str | None, depth: int) -> Iterator[Leaf]:
        """Walk through a matrix: its numbers, its cells, or its fields."""
        self.count += 1
        if self.count > 20 * MOST_CHANNELS:
            raise _DamagedError(f"it holds more than {20 * MOST_CHANNELS} arrays")
        if depth > DEEPEST:
            raise _DamagedError(f"{path} is nested deeper than {DEEPEST} levels")
        if not len(data):
            return  # an empty cell
        _, flags, at = self.numbers(data, 0, "array flags")
        if flags.size < 1 or flags.dtype.itemsize != 4:
            raise _DamagedError("array flags are incomplete")
        word = int(flags[0]) & 0xFFFFFFFF
        kind = word & 0xFF
        if kind == 17:  # opaque: no shape
            yield path or "object", _NOT_READ[kind], None
            return
        _, shape, at = self.numbers(data, at, "the shape")
        _, letters, at = self.numbers(data, at, "the name")
        name = _text(letters)
        where = (name or "unnamed") if path is None else path
        dims = [int(n) for n in shape]
        if not 2 <= len(dims) <= _MOST_DIMENSIONS or min(dims) < 0 or max(dims) > 1 << 40:
            raise _DamagedError(f"{where} has the shape {dims[:8]}")
        total = math.prod(dims)
        if kind in (_CELL, _STRUCT, _OBJECT):
            yield from self.members(data, at, kind, where, dims, total, depth)
        elif kind in _CLASSES or kind == _CHAR:
            yield where, self.array(data, at, where, word, dims, total), None
        elif kind in _NOT_READ:
            yield where, _NOT_READ[kind], None
        else:
            raise _DamagedError(f"{where} has the unknown class {kind}")

    def members(
        self, data: memoryview, at: int, kind: int, where: str, dims: list[int], total: int,
        depth: int,
    ) -> Iterator[Leaf]:  # fmt: skip
        """Walk through cells, or the fields of each struct."""
        fields = [""]
        if kind == _OBJECT:
            _, _, at = self.numbers(data, at, "the class name")
        if kind != _CELL:
            _, width, at = self.numbers(data, at, "the length of field names")
            _, letters, at = self.numbers(data, at, "the field names")
            if width.size != 1 or not 0 < int(width[0]) <= 4096:
                raise _DamagedError(f"{where}: field names of length {width.tolist()[:4]}")
            text, n = letters.tobytes(), int(width[0])
            fields = [
                "." + text[i : i + n].split(b"\0")[0].decode("utf-8", "replace")
                for i in range(0, len(text), n)
            ]
        if 8 * total * len(fields) > len(data):
            raise _DamagedError(f"{where} says {total} members, more than its bytes can hold")
        found: list[list[tuple[str, memoryview]]] = []
        for _ in range(total):
            row = []
            for field in fields:
                inner, content, at = self.element(data, at)
                if inner != _MATRIX:
                    raise _DamagedError(f"{where}{field} has the element type {inner}")
                row.append((field, content))
            found.append(row)
        order = np.arange(total).reshape(dims, order="F").ravel()
        for i, k in enumerate(order):
            index = "" if total == 1 else f"[{i}]"
            for field, content in found[k]:
                yield from self.matrix(content, f"{where}{index}{field}", depth + 1)

    def array(
        self, data: memoryview, at: int, where: str, word: int, dims: list[int], total: int
    ) -> NDArray[Any]:
        kind = word & 0xFF
        stored, real, at = self.numbers(data, at, where)
        if kind == _CHAR:
            return _characters(stored, real, dims, total, where)
        array: NDArray[Any] = self.shaped(real, _CLASSES[kind], dims, total, where)
        if word & _COMPLEX:
            _, imag, _ = self.numbers(data, at, where)
            return array + 1j * self.shaped(imag, _CLASSES[kind], dims, total, where)
        return array.astype(np.bool_) if word & _LOGICAL else array

    def shaped(
        self, numbers: NDArray[Any], dtype: str, dims: list[int], total: int, where: str
    ) -> NDArray[Any]:
        if numbers.size != total:
            raise _DamagedError(f"{where} has {numbers.size} numbers for the shape {dims[:8]}")
        return numbers.astype(dtype, copy=False).reshape(dims, order="F")


def _text(letters: NDArray[Any]) -> str:
    return letters.tobytes().split(b"\0")[0].decode("utf-8", "replace")


def _characters(
    kind: int, codes: NDArray[Any], dims: list[int], total: int, where: str
) -> NDArray[Any]:
    """Return the rows of a matrix of characters as text."""
    if kind == _UTF8:
        letters = list(codes.tobytes().decode("utf-8", "replace"))
    else:
        if codes.dtype.kind not in "iu" or (codes.size and int(codes.max()) > 0x10FFFF):
            raise _DamagedError(f"{where} has no characters")
        letters = [chr(int(code)) if code >= 0 else "?" for code in codes]
    if len(letters) != total or len(dims) > 2:
        return np.asarray("".join(letters))
    rows = ["".join(letters[i :: dims[0]]) for i in range(dims[0])]
    return np.asarray(rows[0] if len(rows) == 1 else rows or "")


def _level_4(data: bytes) -> Iterator[Leaf]:
    """Walk through the matrices of a level 4 file."""
    order = "<" if int.from_bytes(data[:4], "little") < 5000 else ">"
    at = count = 0
    while at < len(data):
        if at + 20 > len(data):
            raise _DamagedError(f"the header at byte {at} is cut off")
        code, rows, columns, imaginary, length = struct.unpack_from(f"{order}5i", data, at)
        precision, kind = code // 10 % 10, code % 10
        count += 1
        good = 0 <= code < 5000 and precision < 6 and kind < 3 and min(rows, columns) >= 0
        if not good or not 0 < length < 4096 or imaginary not in (0, 1) or count > MOST_CHANNELS:
            raise _DamagedError(f"the header at byte {at} is that of no matrix")
        dtype = np.dtype(order + _LEVEL_4[precision])
        start = at + 20 + length
        size = rows * columns * (1 + imaginary)
        at = start + size * dtype.itemsize
        if at > len(data):
            raise _DamagedError(f"a matrix of {rows} by {columns} goes beyond the end of the file")
        name = data[start - length : start].split(b"\0")[0].decode("latin-1")
        numbers = np.frombuffer(data, dtype, size, start)
        if kind:
            yield name, "text" if kind == 1 else _NOT_READ[5], None
            continue
        matrix = numbers[: rows * columns].reshape((rows, columns), order="F")
        if imaginary:
            matrix = matrix + 1j * numbers[rows * columns :].reshape((rows, columns), order="F")
        yield name, matrix, None
