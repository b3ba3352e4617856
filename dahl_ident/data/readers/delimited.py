"""Text tables: any delimiter, decimal comma, comments, several header lines, a row of units.

The layout is found from the numbers: the delimiter and decimal mark are those under which the
longest run of lines reads as numbers; the lines above it with as many fields are the header,
and its last line is a row of units where each of its cells is one. Lines further up are the
instrument's own preamble.
"""

from __future__ import annotations

import csv
import io
import json
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.readers.file import utf8
from dahl_ident.data.readers.layout import Header, best_run, header, named_channels
from dahl_ident.data.source import Source
from dahl_ident.data.storage import METADATA_MARK
from dahl_ident.errors import DataError

if TYPE_CHECKING:
    import pandas as pd

_COMMENT = re.compile(r"\s*(?:#|%|//|!)")
_COMMENT_LINE = re.compile(rb"^[ \t]*(?:#|%|//|!)[^\r\n]*", re.MULTILINE)
_LINE_END = re.compile(rb"\r\n|\n|\r")
_BEFORE_BRACKET = re.compile(r"(?<=[^\s\])])[ \t]+(?=[\[(])")  # "time [s]" is one field
_BLANK_SEPARATED = re.compile(r"(?:\[[^\]]*\]|\([^)]*\)|\S)+")
_HEAD_BYTES = 1 << 15
_MANY_LINES = 50  # from which decimals of one length are a format, not chance
_MISSING = ["", "nan", "NaN", "NAN", "-nan", "NA", "N/A", "n/a", "#N/A", "null", "1.#QNAN"]
_DIALECTS = (
    ("\t", "."), (";", "."), (",", "."), ("|", "."),
    ("\t", ","), (";", ","), ("|", ","), (None, "."), (None, ","),
)  # fmt: skip


@dataclass(frozen=True)
class _Layout:
    """Delimiter (None: blanks), decimal mark, first line of numbers, fields in it, header."""

    delimiter: str | None
    mark: str
    line: int
    offset: int
    width: int
    header: Header


def read_text_table(data: bytes, name: str, sha256: str | None = None) -> Source:
    """Return the columns of a text table.

    Raises
    ------
    DataError
        If the bytes are no text, or no table of numbers is found, or lines differ in width.
    """
    data = utf8(data)
    if b"\0" in data:
        raise DataError(
            f"{name}: the file is binary (byte {data.index(0)} is 0); expected a text table"
        )
    lines = _head(data)
    layout = _layout(lines, name)
    metadata = _metadata(lines, name)
    _refuse_cut_end(data, layout, name)
    columns = _parse(data, layout, metadata, name)
    channels = named_channels(columns, layout.header, name)
    return Source(
        name,
        "text table",
        channels,
        sha256,
        headerless=not layout.header.names,
        decimal=layout.mark,
        row_name=lambda i: f"line {_line_of(data[layout.offset :], layout.line, i)}",
        metadata=metadata,
    )


def _head(data: bytes) -> list[tuple[int, str]]:
    """Return offset and text of the first lines."""
    lines: list[tuple[int, str]] = []
    start, numbers = 0, 0
    for end in _LINE_END.finditer(data + b"\n" if len(data) < _HEAD_BYTES else data):
        lines.append((start, data[start : end.start()].decode("utf-8", "replace")))
        start = end.end()
        numbers = numbers or (0 if _COMMENT.match(lines[-1][1]) else start)
        if numbers and start > numbers + _HEAD_BYTES:
            break
    return lines


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return _BLANK_SEPARATED.findall(_BEFORE_BRACKET.sub("", line))
    if '"' not in line:
        return line.split(delimiter)
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return [line]


def _layout(lines: list[tuple[int, str]], name: str) -> _Layout:
    """Find dialect and start of the numbers, and read the header above them."""
    passed = [not text.strip() or _COMMENT.match(text) is not None for _, text in lines]
    best: _Layout | None = None
    merit = (False, 0)  # a header that fits the columns tells more than another number
    for delimiter, mark in _DIALECTS:
        rows = [
            None if skip else _split(text, delimiter)
            for (_, text), skip in zip(lines, passed, strict=True)
        ]
        run = best_run(rows, mark)
        if run is None:
            continue
        found = header([row for row in rows[: run.start] if row is not None], run.width)
        if not found.names:
            found = header(_commented(lines[: run.start], delimiter), run.width)
        if (bool(found.names), run.score) > merit:
            merit = (bool(found.names), run.score)
            offset = lines[run.start][0]
            best = _Layout(delimiter, mark, run.start + 1, offset, run.width, found)
    if best is None:
        raise DataError(
            f"{name}: no table of numbers found; expected at least two columns of numbers under a "
            "header line"
        )
    return best


def _commented(lines: list[tuple[int, str]], delimiter: str | None) -> list[list[str]]:
    """Return the cells of the comment lines, without their marks."""
    texts = [text[m.end() :] for _, text in lines if (m := _COMMENT.match(text))]
    return [_split(text, delimiter) for text in texts if METADATA_MARK not in text]


def _metadata(lines: list[tuple[int, str]], name: str) -> Mapping[str, Any]:
    """Return what an earlier save of this package wrote into a comment line."""
    for i, (_, text) in enumerate(lines):
        found = re.match(rf"\s*#\s*{METADATA_MARK}(.*)", text)
        if found:
            try:
                metadata = json.loads(found[1])
            except json.JSONDecodeError:
                metadata = None
            if not isinstance(metadata, dict):
                raise DataError(
                    f"{name}, line {i + 1}: the comment after '{METADATA_MARK}' is not what this "
                    "package wrote; delete the line to read the table without it"
                )
            return metadata
    return {}


def _refuse_cut_end(data: bytes, layout: _Layout, name: str) -> None:
    """Refuse a last line with missing fields, or with missing digits and no line end."""
    ends = _LINE_END.split(data[max(layout.offset, len(data) - _HEAD_BYTES) :])
    *before, last = [t.decode("utf-8", "replace") for t in ends if _counts(t)]
    cells = _split(last, layout.delimiter)
    if len(cells) < layout.width:
        raise DataError(
            f"{name}: the last line has {len(cells)} fields, {last[:40]!r}, where the others have "
            f"{layout.width}; the file looks cut off"
        )
    if not ends[-1] or len(before) < _MANY_LINES:
        return
    found, usual = _decimals(last, layout), {_decimals(line, layout) for line in before[1:]}
    if len(usual) == 1 and found < min(usual):
        raise DataError(
            f"{name}: the last number, {cells[-1]!r}, has {found} decimals and no line end, where "
            f"all above have {min(usual)}; the file looks cut off"
        )


def _decimals(line: str, layout: _Layout) -> int:
    """Return how much of the line's last number stands behind its decimal mark."""
    return len(_split(line, layout.delimiter)[-1].strip().partition(layout.mark)[2])


def _counts(line: bytes) -> bool:
    """Return whether a line among the numbers is one, and not blank or a comment."""
    return bool(line.strip()) and not _COMMENT_LINE.match(line)


def _parse(
    data: bytes, layout: _Layout, metadata: Mapping[str, Any], name: str
) -> list[NDArray[Any]]:
    import pandas as pd

    # pandas 3.1 reads to the last digit by default, earlier ones have to be asked
    exact = tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1)
    precision: dict[str, Any] = {} if exact else {"float_precision": "round_trip"}
    keys = [str(i) for i in range(layout.width)]
    known = metadata.get("text", [])
    texts = {key for key, n in zip(keys, layout.header.names, strict=False) if n in known}

    def read(in_parts: bool) -> pd.DataFrame:
        frame: pd.DataFrame = pd.read_csv(
            _numbers(data, layout),
            sep=layout.delimiter or r"\s+",
            decimal=layout.mark,
            header=None,
            names=keys,
            skipinitialspace=True,
            keep_default_na=False,
            na_values={key: [""] if key in texts else _MISSING for key in keys},
            dtype=dict.fromkeys(texts, str),
            low_memory=in_parts,
            encoding="utf-8",
            **precision,
        )
        return frame

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.DtypeWarning)
            try:
                frame = read(in_parts=True)  # twice as fast, but each part guesses its own types
            except pd.errors.DtypeWarning:
                frame = read(in_parts=False)
    except pd.errors.ParserError as exc:
        raise DataError(f"{name}: {_where_ragged(str(exc), layout)}") from exc
    except (ValueError, OverflowError) as exc:
        raise DataError(f"{name}: the table cannot be read: {exc}") from exc
    return [_plain(frame[key].to_numpy()) for key in keys]


def _numbers(data: bytes, layout: _Layout) -> io.BytesIO:
    """Return the lines below the header, comments blanked."""
    if any(data.find(mark, layout.offset) >= 0 for mark in b"#%/!"):
        return io.BytesIO(_COMMENT_LINE.sub(b"", data[layout.offset :]))
    stream = io.BytesIO(data)
    stream.seek(layout.offset)
    return stream


def _where_ragged(message: str, layout: _Layout) -> str:
    found = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", message)
    if found is None:
        return f"the table cannot be read: {message.strip()}"
    line = int(found[2]) + layout.line - 1
    return f"line {line} has {found[3]} fields; expected {found[1]} as in the lines above"


def _plain(values: NDArray[Any]) -> NDArray[Any]:
    """Return numbers or truth values as they are, anything else as text, empty cells as ''."""
    if values.dtype.kind in "fiub":
        return values
    return np.array(["" if v is None or v != v else str(v) for v in values], dtype=np.str_)


def _line_of(body: bytes, first: int, row: int) -> int:
    """Return the line number of a row, past blank lines and comments."""
    kept = [i for i, text in enumerate(_LINE_END.split(body)) if _counts(text)]
    return first + kept[row]
