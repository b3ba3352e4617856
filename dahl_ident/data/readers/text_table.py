"""Text tables: any delimiter, decimal comma, comments, several header lines, a row of units.

Delimiter and decimal mark are those for which the longest run of lines can be read as numbers; the
lines above it with the same number of fields are the header.
"""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import CELL, TRACE, RawChannel, RawFile, plain, split_header, words
from dahl_ident.data.readers.file import File, refuse_many, utf8
from dahl_ident.data.readers.tables import (
    Header,
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

if TYPE_CHECKING:
    import pandas as pd

_COMMENT = re.compile(r"\s*(?:#|%|//|!)")
_COMMENT_LINE = re.compile(rb"^[ \t]*(?:#|%|//|!)[^\r\n]*", re.MULTILINE)
_LINE_END = re.compile(rb"\r\n|\n|\r")
_BEFORE_BRACKET = re.compile(r"(?<=[^\s\])])[ \t]+(?=[\[(])")  # "time [s]" is one field
# the length of text in brackets is limited, so that a line of brackets takes linear time
_BLANK_SEPARATED = re.compile(r"(?:\[[^\]]{0,60}\]|\([^)]{0,60}\)|\S)+")
_HEAD_BYTES = 1 << 15  # from the first numbers; hundreds of lines are enough for the format
_HEAD_LINES = 4  # least number of lines, whatever their length
_LONGEST_LINE = 1 << 18  # bytes, for more than 10,000 columns
_MOST_COMMENTS = 20_000  # lines, before the first numbers or among them, to limit the time
_MANY_LINES = 50  # with so many, an equal number of decimals is a format, not chance
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
_FLOAT = re.compile(r"-?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|-?inf")
_WORD = re.compile(r"(?!(?i:true|false|nan|na|null|none|inf|infinity)$)[A-Za-z][A-Za-z_]*")
_MISSING = ["", "nan", "NaN", "NAN", "-nan", "NA", "N/A", "n/a", "#N/A", "null", "1.#QNAN"]
_DIALECTS = (
    ("\t", "."),
    (";", "."),
    (",", "."),
    ("|", "."),
    ("\t", ","),
    (";", ","),
    ("|", ","),
    (",", ","),
    (None, "."),
    (None, ","),
    ("\t", ".,"),
    (";", ".,"),
    (",", ".,"),
    ("|", ".,"),
    (None, ".,"),
    ("\t", ",."),
    (";", ",."),
    ("|", ",."),
)
_LAST_DIALECTS = ((":", "."), (":", ","))  # tried last, as times of day contain colons


@dataclass(frozen=True)
class _Layout:
    """Delimiter (None: blanks), decimal mark, first line of numbers, fields in it, header.

    `repeated` is the line above the numbers, which identifies a second header in the file;
    `comments` are all lines above them if the header is in comments.
    """

    delimiter: str | None
    mark: str
    start: int
    width: int
    header: Header
    repeated: bytes = b""
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
    layout = _layout([text for _, text in lines], name)
    offset = lines[layout.start][0]
    head = [text for _, text in lines]
    rows = [
        None if not t.strip() or _COMMENT.match(t) else _split(t, layout.delimiter) for t in head
    ]
    refuse_second_header(rows, layout.start, layout.mark, lambda i: f"{name}, line {i + 1}")
    refuse_many(name, layout.width, "fields")
    metadata = _metadata(head, name)
    body, runs = _body(data, offset, layout, file)
    _refuse_decimal_commas(head[: layout.start], body, layout, name)
    _refuse_cut_end(body, layout, name)
    count = max(body.count(b"\n"), body.count(b"\r"))
    file.refuse_above_limit(8 * count * layout.width, f"a table of {count} by {layout.width}")
    columns = _parse(body, layout, metadata, name)
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
        row_name=lambda i: f"line {layout.start + 1 + _places(body)[i]}",
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
    """Find dialect and start of the numbers, and read the header above them."""
    skipped = [not text.strip() or _COMMENT.match(text) is not None for text in lines]
    texts = [text for text, skip in zip(lines, skipped, strict=True) if not skip]
    for dialects in (_DIALECTS, _LAST_DIALECTS):
        trials = (
            _in_dialect(lines, skipped, delimiter, mark)
            for delimiter, mark in _possible(dialects, texts)
        )
        # a header that fits the columns has precedence over the number of numbers
        best = max(filter(None, trials), key=lambda trial: trial[0], default=None)
        if best is not None and best[0] > (False, 0):
            return best[1]
    raise DataError(
        f"{name}: no table of numbers found; expected at least two columns of numbers under a "
        "header line"
    )


def _possible(
    dialects: Iterable[tuple[str | None, str]], texts: list[str]
) -> Iterator[tuple[str | None, str]]:
    """Yield the dialects whose delimiter, and decimal comma if any, occur in the lines."""
    text = "\n".join(texts)
    blanks = any(len(_BEFORE_BRACKET.sub("", line).split(None, 1)) > 1 for line in texts)
    for delimiter, mark in dialects:
        split = blanks if delimiter is None else delimiter in text
        quoted = delimiter is None or delimiter not in mark or '"' in text
        if split and quoted and ("," not in mark or "," in text):
            yield delimiter, mark


def _in_dialect(
    lines: list[str], skipped: list[bool], delimiter: str | None, mark: str
) -> tuple[tuple[bool, int], _Layout] | None:
    """Return the layout in one dialect and its merit, if there are numbers in it."""
    rows = [
        None if skip else _split(text, delimiter) for text, skip in zip(lines, skipped, strict=True)
    ]
    run = best_run(rows, mark)
    if run is None:
        return None
    if mark[1:]:  # accepted only if a cell needs the mark of thousands, such as 1,234.5
        group = rf"\s*[-+]?\d{{1,3}}(?:\{mark[1]}\d{{3}})"
        has_thousands = re.compile(rf"{group}+\{mark[0]}\d*\s*|{group}{{2,}}\s*").fullmatch
        if not any(has_thousands(cell) for row in rows[run.start :] for cell in row or ()):
            return None
    start = run.start
    repeated = lines[start - 1].strip() if start and not skipped[start - 1] else ""
    if repeated:  # the numbers begin below the first of several equal headers
        first = next(i for i, text in enumerate(lines) if text.strip() == repeated)
        later = next((i for i in range(first + 1, start + 1) if not skipped[i]), start)
        row = rows[later]
        start = later if row is not None and len(row) == run.width else start
    filled = max((i + 1 for i, c in enumerate(rows[start] or []) if c.strip()), default=run.width)
    named = header([row for row in rows[:start] if row is not None], run.width, filled)
    comments: tuple[str, ...] = ()
    if not named.names:
        named = header(_commented(lines[:start], delimiter), run.width, filled)
        comments = tuple(text.strip() for text in lines[:start]) if named.names else ()
        repeated = next((text for text in reversed(comments) if text), "")
    repeated_line = repeated.encode() if named.names else b""
    layout = _Layout(delimiter, mark, start, run.width, named, repeated_line, comments)
    return (bool(named.names), run.score), layout


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


def _body(data: bytes, offset: int, layout: _Layout, file: File) -> tuple[bytes, list[int]]:
    """Return the lines of numbers, with all others blanked, and the first rows of the runs."""
    body = data[offset:]
    above = _LINE_END.split(data[:offset])[:-1]
    for i in range(len(above) - 1, -1, -1):  # upwards through the comments directly above
        text = above[i].decode("utf-8", "replace")
        if text.strip() and not _COMMENT.match(text):
            break
        if _looks_like_data(text, layout):
            raise DataError(f"{file.name}, line {i + 1}: {_LIKE_DATA.format(text.strip()[:40])}")
    commented = any(mark in body for mark in (b"#", b"%", b"//", b"!"))
    if commented:
        _refuse_odd_comments(body, layout, file.name)
    body, footers = _without_footers(body, layout)
    file.notes.extend(f"left out below the table: {text.strip()[:60]!r}" for text in footers)
    body, runs = _without_repeated_headers(body, layout)
    if runs:
        rows = listed([i + 1 for i in runs])
        file.notes.append(f"the header is repeated in the file: new runs begin at rows {rows}")
    return _COMMENT_LINE.sub(b"", body) if commented else body, runs


def _refuse_odd_comments(body: bytes, layout: _Layout, name: str) -> None:
    """Refuse comments among the numbers that are rows, or another header."""
    for count, comment in enumerate(_COMMENT_LINE.finditer(body)):
        text = comment[0].decode("utf-8", "replace")
        if _looks_like_data(text, layout):
            why = _LIKE_DATA.format(text.strip()[:40])
        elif _is_another_header(text, layout):
            why = (
                f"{text.strip()[:60]!r} names the columns again, with other units, marks or order; "
                "expected one header. Split the file there"
            )
        elif count >= _MOST_COMMENTS:
            why = (
                f"more than {_MOST_COMMENTS} comments stand among the numbers; expected fewer. "
                "Delete them"
            )
        else:
            continue
        line = layout.start + 1 + len(_LINE_END.findall(body, 0, comment.start()))
        raise DataError(f"{name}, line {line}: {why}")


def _looks_like_data(text: str, layout: _Layout) -> bool:
    """Return whether the cells of an apparent comment hold an error value or numbers."""
    cells = _split(text, layout.delimiter)
    if len(cells) > 1 and _ERROR_VALUE.fullmatch(cells[0]):
        return True
    others = [cell for cell in cells[1:] if cell.strip()]
    numeric = [CELL[layout.mark].fullmatch(cell) is not None for cell in others]
    return len(cells) == layout.width and bool(numeric) and all(numeric)


def _is_another_header(text: str, layout: _Layout) -> bool:
    """Return whether a comment is a header that does not occur above the numbers."""
    if text.strip() in layout.comments:
        return False
    cells = next(iter(_commented([text], layout.delimiter)), [""])
    names, units = zip(*(split_header(cell) for cell in cells), strict=True)
    header_names = sorted(plain(name) for name in layout.header.names if name)
    return (
        bool(header_names) and sorted(plain(name) for name in names if name) == header_names
    ) or (len(cells) == layout.header.cells > 1 and not any(units) and are_units(cells))


def _without_footers(body: bytes, layout: _Layout) -> tuple[bytes, list[str]]:
    """Blank the lines of words or nothing below the table: "End of data", "Mean,0.1,0.2", ",,"."""
    footers: list[str] = []
    end = len(body.rstrip())
    for _ in range(_FOOTER_LINES):
        start = max(body.rfind(b"\n", 0, end), body.rfind(b"\r", 0, end)) + 1
        text = body[start:end].decode("utf-8", "replace")
        cells = _split(text, layout.delimiter)
        if any(cell.strip() for cell in cells):  # otherwise an empty row of a spreadsheet
            numbers = any(CELL[layout.mark].fullmatch(cell) for cell in cells)
            summary = cells[0].strip(" \"':.").casefold() in _SUMMARIES
            words_first = _FOOTER.match(text) and cells[0].strip() not in _MISSING
            if not words_first or (numbers and not summary):
                break
        if not start:
            break
        footers.insert(0, text)
        end = len(body[:start].rstrip())
    return (body[:end] + b"\n" if footers else body), footers


def _without_repeated_headers(body: bytes, layout: _Layout) -> tuple[bytes, list[int]]:
    """Blank every later line that repeats the header, and return the first rows below them."""
    if not layout.repeated or layout.repeated not in body:
        return body, []
    lines = re.split(rb"(\r\n|\n|\r)", body)
    runs: list[int] = []
    rows = 0
    for i in range(0, len(lines), 2):
        if lines[i].strip() != layout.repeated:
            rows += _is_row(lines[i])
            continue
        lines[i] = b""
        for k in range(i - 2, -1, -2):  # and the lines of its header above it
            cells = _split(lines[k].decode("utf-8", "replace"), layout.delimiter)
            if any(CELL[layout.mark].fullmatch(cell) for cell in cells):
                break
            rows -= _is_row(lines[k])
            lines[k] = b""
        runs.append(rows)
    return b"".join(lines), runs


def _refuse_decimal_commas(above: list[str], body: bytes, layout: _Layout, name: str) -> None:
    """Refuse whole numbers between commas that are more than the titles above them."""
    titles = [n for text in above if (n := text.count(",") + 1) > 1 and not _COMMENT.match(text)]
    if layout.delimiter != "," or not titles or any(mark in body for mark in (b".", b'"')):
        return
    fields = [line.count(b",") + 1 for line in _LINE_END.split(body) if _is_row(line)]
    if np.median(fields) > titles[-1] and not (layout.header.names and len(set(fields)) == 1):
        raise DataError(
            f"{name}: {titles[-1]} columns are named and most lines have more fields, none with a "
            "decimal point: commas seem to be decimal marks and separators at once. Separate the "
            "columns by semicolons or tabs, or write decimal points"
        )


def _refuse_cut_end(body: bytes, layout: _Layout, name: str) -> None:
    """Refuse a last line with missing fields, or with missing digits and no line end."""
    start = max(0, len(body) - _HEAD_BYTES)
    start = max(body.rfind(b"\n", 0, start), body.rfind(b"\r", 0, start)) + 1
    lines = _LINE_END.split(body[start:])
    *before, last = [t.decode("utf-8", "replace") for t in lines if _is_row(t)] or [""]
    cells = _split(last, layout.delimiter)
    if len(cells) < layout.width:
        raise DataError(
            f"{name}: the last line has {len(cells)} fields, {last[:40]!r}, where the others have "
            f"{layout.width}; the file looks cut off"
        )
    if not lines[-1] or len(before) < _MANY_LINES:
        return
    numbers = [_split(line, layout.delimiter)[-1].strip() for line in [last, *before[1:]]]
    decimals, *others = [len(number.partition(layout.mark)[2]) for number in numbers]
    usual = set(others)
    if len(usual) == 1 and decimals < min(usual):
        raise DataError(
            f"{name}: the last number, {cells[-1]!r}, has {decimals} decimals and no line end, "
            f"where all above have {min(usual)}; the file looks cut off"
        )


def _is_row(line: bytes) -> bool:
    """Return whether a line is a row of numbers: not blank, and not a comment."""
    return bool(line.strip()) and not _COMMENT_LINE.match(line)


def _places(body: bytes) -> list[int]:
    """Return the line of each row, counted from the first, past blank lines and comments."""
    return [i for i, text in enumerate(_LINE_END.split(body)) if _is_row(text)]


def _small(body: bytes, layout: _Layout, texts: set[str]) -> list[NDArray[Any]] | None:
    """Return the columns of a small table of plain numbers and words, None for any other."""
    if len(body) > _SMALL_TABLE or layout.mark != "." or b'"' in body or not body.isascii():
        return None
    rows = [line.decode().split(layout.delimiter) for line in _LINE_END.split(body) if line.strip()]
    if any(len(row) != layout.width for row in rows):
        return None
    columns: list[NDArray[Any]] = []
    for i, column in enumerate(zip(*rows, strict=True)):
        cells = [cell.strip() for cell in column]
        unpadded = cells == list(column)
        if str(i) in texts:
            if not unpadded or any(cell[:1] == "'" for cell in cells):
                return None
            columns.append(words(cells))
        elif all(map(_FLOAT.fullmatch, cells)):
            whole = all(map(_INTEGER.fullmatch, cells))
            columns.append(np.array([int(cell) if whole else float(cell) for cell in cells]))
        elif unpadded and {*cells} <= {"True", "False"}:
            columns.append(np.array([cell == "True" for cell in cells]))
        elif unpadded and all(map(_WORD.fullmatch, cells)):
            columns.append(words(cells))
        else:
            return None
    return columns


def _parse(
    body: bytes, layout: _Layout, metadata: Mapping[str, Any], name: str
) -> list[NDArray[Any]]:
    keys = [str(i) for i in range(layout.width)]
    text_names = metadata.get("text", [])
    if layout.mark[1:]:  # read strictly when they are used: 12,34 is not 1234
        text_names = list(layout.header.names)
    texts = {key for key, n in zip(keys, layout.header.names, strict=False) if n in text_names}
    small = _small(body, layout, texts)
    if small is not None:
        return small
    import pandas as pd

    # pandas 3.1 reads to the last digit by default, earlier versions only on request
    exact = tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1)
    precision: dict[str, Any] = {} if exact else {"float_precision": "round_trip"}

    def read(in_parts: bool) -> pd.DataFrame:
        frame: pd.DataFrame = pd.read_csv(
            io.BytesIO(body),
            sep=layout.delimiter or r"\s+",
            decimal=layout.mark[0],
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
        ragged = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", str(exc))
        if ragged is None:
            raise DataError(f"{name}: the table cannot be read: {str(exc).strip()}") from exc
        raise DataError(
            f"{name}: line {int(ragged[2]) + layout.start} has {ragged[3]} fields; expected "
            f"{ragged[1]} as in the lines above"
        ) from exc
    except (ValueError, OverflowError) as exc:
        raise DataError(f"{name}: the table cannot be read: {exc}") from exc
    if metadata:  # written by this package
        frame = as_before_inert(frame)
    columns = (frame[key].to_numpy() for key in keys)
    return [c if c.dtype.kind in "fiub" else words(c) for c in columns]
