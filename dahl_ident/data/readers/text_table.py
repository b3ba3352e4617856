"""Text tables: any delimiter, decimal comma, comments, several header lines, a row of units.

Delimiter and decimal mark are those for which the longest run of lines can be read as numbers; the
lines above it with the same number of fields are the header.
"""

from __future__ import annotations

import csv
import io
import re
import warnings
from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import (
    CELL,
    TRACE,
    RawChannel,
    RawFile,
    cell_text,
    plain,
    split_header,
    words,
)
from dahl_ident.data.readers.file import File, refuse_many, utf8
from dahl_ident.data.readers.tables import (
    Header,
    Run,
    are_units,
    best_run,
    contradict,
    header,
    named_channels,
    refuse_second_header,
)
from dahl_ident.data.rows import stated_levels
from dahl_ident.data.storage import METADATA_MARK, as_before_inert, read_metadata
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError

_COMMENT = re.compile(r"\s*(?:#|%|//|!)")
_COMMENT_LINE = re.compile(rb"^[ \t]*(?:#|%|//|!)", re.MULTILINE)
_LINE_END, _LINE_END_TEXT = re.compile(rb"\r\n|\n|\r"), re.compile(r"\r\n|\n|\r")
_BEFORE_BRACKET = re.compile(r"(?<=[^\s\])])[ \t]+(?=[\[(])")  # "time [s]" is one field
# the length of text in brackets is limited, so that a line of brackets takes linear time
_BLANK_SEPARATED = re.compile(r"(?:\[[^\]]{0,60}\]|\([^)]{0,60}\)|\S)+")
_HEAD_BYTES = 1 << 15  # from the first numbers; hundreds of lines are enough for the format
_HEAD_LINES = 4  # least number of lines, whatever their length
_LONGEST_LINE = 1 << 18  # bytes, for more than 10,000 columns
_MOST_COMMENTS = 20_000  # lines, before the first numbers or among them, to limit the time
_MANY_LINES = 50  # with so many, an equal number of decimals is a format, not chance
_LAST_LINES = 400  # in which the number of decimals is compared
_ROWS_AT_ONCE = 1 << 16  # as lists of cells, which take much memory
_FOOTER_LINES = 20  # most lines left out; more text after the numbers is an error
_ERROR_VALUE = re.compile(r"\s*#(?:N/A|DIV/0!|[A-Z]{2,9}[!?])\s*")  # a spreadsheet's error
# the number of points above pairs of numbers, as in traces of the SR785 and SR780
_TRACE = re.compile(
    rb"[ \t]*(\d{1,9})[ \t]*(?:\r\n|\n|\r)"
    rb"(?=[ \t]*[-+.\d][^\s,;]*(?:[ \t]*,[ \t]*|[ \t]+)[-+.\d][^\s,;]*[ \t]*[\r\n])"
)
_FOOTER = re.compile(r"\s*[\"']?[^\W\d_]{2}|\s*(?:\*\*|==|--)", re.UNICODE)
_SUMMARIES = ("min", "max", "mean", "average", "avg", "std", "rms", "sum", "total", "median")
_SMALL_TABLE = 1 << 16  # most bytes of a table that is read without pandas
_LIKE_DATA = (
    "the line begins as a comment, yet its cells look like data, {!r}; expected a measured number "
    "in each. Delete the line, or put a number there"
)
_INTEGER = re.compile(r"-?\d{1,18}")
_MISSING = ["", "nan", "NaN", "NAN", "-nan", "NA", "N/A", "n/a", "#N/A", "null", "1.#QNAN"]
_DELIMITERS = (("\t", ";", ",", "|", None), (":",))  # colons last, as in times of day
_MARKS = (".", ",", ".,", ",.")  # decimal mark, and that of thousands


@dataclass(frozen=True)
class _Layout:
    """Delimiter (None: blanks), decimal mark, first line of numbers, fields in it, score, header.

    `repeated` is the line above the numbers, which identifies a second header in the file;
    `comments` are all lines above them if the header is in comments.
    """

    delimiter: str | None
    mark: str
    start: int
    width: int
    score: int
    header: Header
    repeated: str = ""
    comments: tuple[str, ...] = ()


def read_text_table(file: File) -> RawFile:
    """Return the columns of a text table."""
    data, name = utf8(file.data), file.name
    if b"\0" in data:
        raise DataError(
            f"{name}: the file is binary (byte {data.index(0)} is 0); expected a text table"
        )
    trace = _TRACE.match(data)
    if trace is not None:
        data = _LINE_END.findall(trace[0])[0] + data[trace.end() :]  # lines keep their numbers
    lines = _head(data, name)
    head = [text for _, text in lines]
    layout = _layout(head, name)
    rows = [None if _skipped(text) else _split(text, layout.delimiter) for text in head]
    refuse_second_header(rows, layout.start, layout.mark, lambda i: f"{name}, line {i + 1}")
    refuse_many(name, layout.width, "fields")
    metadata = _metadata(head, name)
    _refuse_data_in_comments(head[: layout.start], layout, name)
    _refuse_decimal_commas(rows, layout, name)
    body = data[lines[layout.start][0] :]
    count = max(body.count(b"\n"), body.count(b"\r"))
    file.refuse_above_limit(8 * count * layout.width, f"a table of {count} by {layout.width}")
    large = len(body) > _SMALL_TABLE and not metadata.get("text")
    first = rows[layout.start] or []
    columns = _block(body, layout, first, name) if large else None
    places, runs = array("q"), list[int]()
    if columns is None:
        kept = _rows(body, layout, file, places, runs)
        columns = _block("\n".join(kept).encode(), layout, first, name) if large else None
        columns = columns or _columns(kept, places, layout, metadata, name)
    named = layout.header
    if trace is not None:
        points, count = int(trace[1]), len(columns[0])
        if count != points:
            raise DataError(
                f"{name}: the first line says {points} points, and {count} follow; the file "
                f"{'looks cut off' if count < points else 'is damaged'}"
            )
        named = Header(("real", "imag"), (None, None), 2)
    above = _commented(head[: layout.start], layout.delimiter)
    pairs = list(zip(named.names, named.units, strict=True))
    if any(contradict(pairs, [split_header(cell) for cell in row]) for row in above):
        named = replace(named, contradicted=True)
    channels = named_channels(columns, named, name)
    if runs and all(plain(c.name) != "run" for c in channels):
        labels = np.searchsorted(runs, np.arange(len(columns[0])), side="right") + 1
        channels = (*channels, RawChannel("run", labels.astype(np.str_)))
    return file.source(
        "text table" if trace is None else TRACE,
        channels,
        headerless=not named.names,
        decimal=layout.mark,
        row_name=lambda i: f"line {layout.start + 1 + (places or _filled_lines(body))[i]}",
        metadata=metadata,
        runs=tuple(runs),
        stated={} if metadata else stated_levels(head[: layout.start]),
    )


def _head(data: bytes, name: str) -> list[tuple[int, str]]:
    """Return offset and text of the first lines."""
    lines: list[tuple[int, str]] = []
    start = numbers = first = 0
    for end in _LINE_END.finditer(data if data.endswith((b"\n", b"\r")) else data + b"\n"):
        if end.start() - start > _LONGEST_LINE:
            raise DataError(
                f"{name}: line {len(lines) + 1} has more than {_LONGEST_LINE} bytes; expected a "
                "table with a line for each sample"
            )
        lines.append((start, data[start : end.start()].decode("utf-8", "replace")))
        start = end.end()
        if not numbers and lines[-1][1].strip() and _COMMENT.match(lines[-1][1]) is None:
            numbers, first = start, len(lines)
        if numbers and start > numbers + _HEAD_BYTES and len(lines) >= first + _HEAD_LINES:
            break
        if not numbers and len(lines) > _MOST_COMMENTS:
            raise DataError(
                f"{name}: the first {_MOST_COMMENTS} lines are comments or blank; expected a table "
                "of numbers after fewer"
            )
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


def _layout(lines: list[str], name: str) -> _Layout:
    for delimiters in _DELIMITERS:
        layouts = [layout for delimiter in delimiters for layout in _layouts(lines, delimiter)]
        if layouts:  # a header that fits the columns has precedence over the number of numbers
            return max(layouts, key=lambda layout: (bool(layout.header.names), layout.score))
    raise DataError(
        f"{name}: no table of numbers found; expected at least two columns of numbers under a "
        "header line"
    )


def _layouts(lines: list[str], delimiter: str | None) -> Iterator[_Layout]:
    """Yield the layout for each decimal mark with which there are numbers."""
    rows = [None if _skipped(text) else _split(text, delimiter) for text in lines]
    if all(row is None or len(row) < 2 for row in rows):
        return
    for mark in _MARKS:
        run = best_run(rows, mark)
        if run is not None and (not mark[1:] or _has_thousands(rows[run.start :], mark)):
            yield _with_header(lines, rows, run, delimiter, mark)


def _has_thousands(rows: list[list[str] | None], mark: str) -> bool:
    """Return whether a cell needs the mark of thousands, such as 1,234.5."""
    group = rf"\s*[-+]?\d{{1,3}}(?:\{mark[1]}\d{{3}})"
    needs = re.compile(rf"{group}+\{mark[0]}\d*\s*|{group}{{2,}}\s*").fullmatch
    return any(needs(cell) for row in rows for cell in row or ())


def _with_header(
    lines: list[str], rows: list[list[str] | None], run: Run, delimiter: str | None, mark: str
) -> _Layout:
    """Read the header above the numbers."""
    start = run.start
    repeated = lines[start - 1].strip() if start and rows[start - 1] is not None else ""
    if repeated:  # the numbers begin below the first of several equal headers
        first = next(i for i, text in enumerate(lines) if text.strip() == repeated)
        later = next(i for i in range(first + 1, start + 1) if rows[i] is not None)
        start = later if len(rows[later] or []) == run.width else start
    filled = max((i + 1 for i, c in enumerate(rows[start] or []) if c.strip()), default=run.width)
    named = header([row for row in rows[:start] if row is not None], run.width, filled)
    comments: tuple[str, ...] = ()
    if not named.names:
        named = header(_commented(lines[:start], delimiter), run.width, filled)
        comments = tuple(text.strip() for text in lines[:start]) if named.names else ()
        repeated = next((text for text in reversed(comments) if text), "")
    repeated = repeated if named.names else ""
    return _Layout(delimiter, mark, start, run.width, run.score, named, repeated, comments)


def _commented(lines: Iterable[str], delimiter: str | None) -> list[list[str]]:
    """Return the cells of the comment lines, without their marks."""
    texts = [text[m.end() :] for text in lines if (m := _COMMENT.match(text))]
    return [_split(text, delimiter) for text in texts if METADATA_MARK not in text]


def _metadata(lines: Iterable[str], name: str) -> Mapping[str, Any]:
    """Return the metadata that an earlier save of this package wrote into a comment line."""
    for i, text in enumerate(lines):
        comment = re.match(rf"\s*#\s*{METADATA_MARK}(.*)", text)
        if comment:
            try:
                return read_metadata(comment[1])
            except ValueError as exc:
                raise DataError(
                    f"{name}, line {i + 1}: the comment after '{METADATA_MARK}' is not what this "
                    "package wrote; delete the line to read the table without it"
                ) from exc
    return {}


def _skipped(text: str) -> bool:
    return not text.strip() or _COMMENT.match(text) is not None


def _refuse_data_in_comments(above: list[str], layout: _Layout, name: str) -> None:
    """Refuse comments directly above the numbers that are rows themselves."""
    for i in range(len(above) - 1, -1, -1):
        if not _skipped(above[i]):
            break
        if _looks_like_data(above[i], layout):
            raise DataError(f"{name}, line {i + 1}: {_LIKE_DATA.format(above[i].strip()[:40])}")


def _rows(
    body: bytes, layout: _Layout, file: File, places: array[int], runs: list[int]
) -> list[str]:
    """Return the lines of numbers, without comments, repeated headers, and lines below the table.

    Their `places` in the body are added, and the first rows of `runs` below repeated headers.
    """
    file.lines()  # refuses more than memory may hold
    lines = _LINE_END_TEXT.split(body.decode("utf-8", "replace"))
    end = _end(lines, layout)
    below = [line.strip()[:60] for line in lines[end:] if line.strip()]
    file.notes.extend(f"left out below the table: {line!r}" for line in below)
    is_open = end == len(lines) and bool(lines[-1])
    _refuse_cut_end(lines[max(end - _LAST_LINES, 0) : end], is_open, layout, file.name)
    kept: list[str] = []
    comments = 0
    for place, line in enumerate(lines[:end]):
        if layout.repeated and line.strip() == layout.repeated:
            while kept and not _numbers_in(kept[-1], layout):
                del kept[-1], places[-1]  # a line of that header
            runs.append(len(places))
        elif _COMMENT.match(line):
            comments += 1
            if why := _objection(line, comments, layout):
                raise DataError(f"{file.name}, line {layout.start + 1 + place}: {why}")
        elif line.strip():
            kept.append(line)
            places.append(place)
    if runs:
        rows = listed([i + 1 for i in runs])
        file.notes.append(f"the header is repeated in the file: new runs begin at rows {rows}")
    return kept


def _columns(
    lines: list[str], places: array[int], layout: _Layout, metadata: Mapping[str, Any], name: str
) -> list[NDArray[Any]]:
    """Parse lines one by one."""
    parts: list[list[NDArray[Any]]] = []
    for start in range(0, len(lines), _ROWS_AT_ONCE):
        rows = [_split(line, layout.delimiter) for line in lines[start : start + _ROWS_AT_ONCE]]
        for i, cells in enumerate(rows):
            if len(cells) > layout.width:
                raise DataError(
                    f"{name}: line {layout.start + 1 + places[start + i]} has {len(cells)} fields; "
                    f"expected {layout.width} as in the lines above"
                )
            cells += [""] * (layout.width - len(cells))
        parts.append([words(column) for column in zip(*rows, strict=True)])
    texts = metadata.get("text", [])
    if layout.mark[1:]:  # read strictly when they are used: 12,34 is not 1234
        texts = layout.header.names
    columns = []
    for pieces, label in zip_longest(zip(*parts, strict=True), layout.header.names):
        column = np.concatenate(pieces)
        if label not in texts:
            column = _typed(column.tolist(), layout.mark)
        elif metadata:
            column = words(map(as_before_inert, column.tolist()))
        columns.append(column)
    return columns


def _filled_lines(body: bytes) -> list[int]:
    return [i for i, line in enumerate(_LINE_END.split(body)) if line.strip()]


def _numbers_in(line: str, layout: _Layout) -> bool:
    return any(map(CELL[layout.mark].fullmatch, _split(line, layout.delimiter)))


def _end(lines: list[str], layout: _Layout) -> int:
    """Return the end of the table: lines of words, "Mean,0.1" or ",," are below."""
    end, left = len(lines), _FOOTER_LINES
    for i in range(len(lines) - 1, 0, -1):
        if not lines[i].strip():
            continue
        cells = _split(lines[i], layout.delimiter)
        if any(cell.strip() for cell in cells):  # otherwise an empty row of a spreadsheet
            summary = cells[0].strip(" \"':.").casefold() in _SUMMARIES
            words_first = _FOOTER.match(lines[i]) and cells[0].strip() not in _MISSING
            if not words_first or (_numbers_in(lines[i], layout) and not summary):
                break
        end, left = i, left - 1
        if not left:
            break
    return end


def _typed(cells: list[str], mark: str) -> NDArray[Any]:
    """Return whole numbers, numbers or truth values if all cells are such, otherwise words."""
    cells = ["" if (cell := c.strip()) in _MISSING else cell for c in cells]
    if all(map(_INTEGER.fullmatch, cells)):
        return np.array([int(cell) for cell in cells])
    if all(not cell or CELL[mark].fullmatch(cell) for cell in cells):
        return np.array([float(c.replace(mark, ".")) if c else np.nan for c in cells])
    if {*cells} <= {"True", "False"}:
        return np.array([cell == "True" for cell in cells])
    return words(cells)


def _objection(comment: str, count: int, layout: _Layout) -> str:
    """Return what is wrong with a comment among the numbers: it is a row, or another header."""
    if _looks_like_data(comment, layout):
        return _LIKE_DATA.format(comment.strip()[:40])
    if count > _MOST_COMMENTS:
        return (
            f"more than {_MOST_COMMENTS} comments stand among the numbers; expected fewer. "
            "Delete them"
        )
    if comment.strip() in layout.comments:
        return ""
    cells = next(iter(_commented([comment], layout.delimiter)), [""])
    names, units = zip(*(split_header(cell) for cell in cells), strict=True)
    header_names = sorted(plain(name) for name in layout.header.names if name)
    repeats_names = header_names and sorted(plain(n) for n in names if n) == header_names
    only_units = len(cells) == layout.header.cells > 1 and not any(units) and are_units(cells)
    if not repeats_names and not only_units:
        return ""
    return (
        f"{comment.strip()[:60]!r} names the columns again, with other units, marks or order; "
        "expected one header. Split the file there"
    )


def _looks_like_data(text: str, layout: _Layout) -> bool:
    """Return whether the cells of an apparent comment hold an error value or numbers."""
    cells = _split(text, layout.delimiter)
    if len(cells) > 1 and _ERROR_VALUE.fullmatch(cells[0]):
        return True
    others = [cell for cell in cells[1:] if cell.strip()]
    numeric = [CELL[layout.mark].fullmatch(cell) is not None for cell in others]
    return len(cells) == layout.width and bool(numeric) and all(numeric)


def _refuse_decimal_commas(rows: list[list[str] | None], layout: _Layout, name: str) -> None:
    """Refuse whole numbers between commas that are more than the titles above them."""
    titles = [len(row) for row in rows[: layout.start] if row and len(row) > 1]
    table = [row for row in rows[layout.start :] if row]
    if layout.delimiter != "," or not titles or any("." in c for row in table for c in row):
        return
    fields = [len(row) for row in table]
    if np.median(fields) > titles[-1] and not (layout.header.names and len(set(fields)) == 1):
        raise DataError(
            f"{name}: {titles[-1]} columns are named and most lines have more fields, none with a "
            "decimal point: commas seem to be decimal marks and separators at once. Separate the "
            "columns by semicolons or tabs, or write decimal points"
        )


def _refuse_cut_end(lines: list[str], is_open: bool, layout: _Layout, name: str) -> None:
    """Refuse a last line with missing fields, or, without a line end, with missing digits."""
    texts = [line for line in lines if not _skipped(line)]
    rows = [_split(text, layout.delimiter) for text in texts]
    if not rows:  # comments alone
        return
    if len(rows[-1]) < layout.width:
        raise DataError(
            f"{name}: the last line has {len(rows[-1])} fields, {texts[-1][:40]!r}, where the "
            f"others have {layout.width}; the file looks cut off"
        )
    if not is_open or len(rows) <= _MANY_LINES:
        return
    numbers = [row[-1].strip() for row in rows]
    *others, decimals = [len(number.partition(layout.mark)[2]) for number in numbers]
    usual = set(others)
    if len(usual) == 1 and decimals < min(usual):
        raise DataError(
            f"{name}: the last number, {numbers[-1]!r}, has {decimals} decimals and no line end, "
            f"where all above have {min(usual)}; the file looks cut off"
        )


def _block(body: bytes, layout: _Layout, first: list[str], name: str) -> list[NDArray[Any]] | None:
    """Parse a large table of rows alike, return None for any other; `first` is the first row."""
    import pandas as pd

    is_number = CELL[layout.mark].fullmatch
    text = [i for i, c in enumerate(first) if c.strip() not in _MISSING and not is_number(c)]
    # pandas 3.1 reads to the last digit by default, earlier versions only on request
    exact = tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1)
    precision: dict[str, Any] = {} if exact else {"float_precision": "round_trip"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pd.errors.DtypeWarning)
        try:
            frame = pd.read_csv(
                io.BytesIO(body),
                sep=layout.delimiter or r"\s+",
                decimal=layout.mark[0],
                header=None,
                names=range(layout.width),
                skipinitialspace=True,
                keep_default_na=False,
                na_values=_MISSING,
                dtype=dict.fromkeys(text, object),
                **precision,
            )
        except ValueError:
            return None
    columns = [frame[i].to_numpy() for i in range(layout.width)]
    numeric = [column for column in columns if column.dtype.kind in "ifb"]
    last = body.rstrip().rsplit(b"\n" if b"\n" in body else b"\r", _LAST_LINES)[1:]
    below = all(np.isnan(column[-1]) for column in numeric)
    if text and (_COMMENT_LINE.search(body) or _FOOTER.match(last[-1].decode())):
        below = True
    if below or len(numeric) + len(text) < layout.width:
        return None
    for i in text:
        columns[i] = words(map(str.strip, map(cell_text, columns[i])))
    _refuse_cut_end([line.decode() for line in last], body[-1:] not in b"\r\n", layout, name)
    return columns
