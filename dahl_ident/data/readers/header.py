"""The start of the numbers in a sheet of cells, and the header above them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import RawChannel, plain, split_header
from dahl_ident.errors import DataError, UnitError
from dahl_ident.units import parse_unit

# Decimal mark, and behind it that of thousands where there is one.
CELL = {
    mark: re.compile(
        r"\s*[-+]?(?:"
        + (rf"\d{{1,3}}(?:\{mark[1]}\d{{3}})+(?:\{mark[0]}\d*)?|" if mark[1:] else "")
        + rf"(?:\d+(?:\{mark[0]}\d*)?|\{mark[0]}\d+)(?:[eE][-+]?\d+)?|nan|inf(?:inity)?)\s*",
        re.IGNORECASE | re.ASCII,
    )
    for mark in (".", ",", ".,", ",.")
}
_NUMBERED = "x-axis"  # before the numbers by which Keysight oscilloscopes call their channels


class Run(NamedTuple):
    """Consecutive rows of one width, each with a number in it, and how numeric they are."""

    start: int
    width: int
    score: int


@dataclass(frozen=True)
class Header:
    """Names and units of the columns; no names for a table without a header.

    `cells` is how many columns the header line has; `contradicted` is whether another line differs.
    """

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    cells: int
    contradicted: bool = False


def best_run(rows: Iterable[Sequence[str] | None], mark: str) -> Run | None:
    """Return the run with the most numbers, half weighed against by cells of text.

    None stands for a blank line or a comment. A line of another width belongs to the run it breaks.
    """
    is_number = CELL[mark].fullmatch
    best: Run | None = None
    start = width = score = 0
    for i, row in enumerate(rows):
        if row is None:
            continue
        numbers = len([cell for cell in row if is_number(cell)])
        if not numbers:
            width = 0
            continue
        if not width:
            start, width, score = i, len(row), 0
        if len(row) == width > 1:
            filled = len(row) if numbers == len(row) else len([c for c in row if c.strip()])
            score += 3 * numbers - filled
        if best is None or score > best.score:
            best = Run(start, width, score)
    return best if best and best.score > 0 else None


def refuse_second_header(
    rows: Sequence[Sequence[str] | None], start: int, mark: str, where: Callable[[int], str]
) -> None:
    """Refuse rows of the table's own form above its header: the file has another one there."""

    def numeric(row: Sequence[str]) -> list[bool | None]:  # None for empty cells
        return [CELL[mark].fullmatch(c) is not None if c.strip() else None for c in row]

    first = numeric(rows[start] or [])
    for i, row in enumerate(rows[: start if first.count(True) > 1 else 0]):
        if row is not None and len(row) == len(first):
            same = zip(numeric(row), first, strict=True)
            if all(one is other or None in (one, other) for one, other in same):
                raise DataError(
                    f"{where(i)} is a row of numbers like those from {where(start)} on, and "
                    "between them are lines of words: the file has more than one header. Split "
                    "it there"
                )


def header(above: Sequence[Sequence[str]], width: int, filled: int | None = None) -> Header:
    """Return names and units from the lines directly above the numbers, the nearest last."""
    least = width - 1 if filled is None else min(filled, width - 1)
    lines: list[list[str]] = []
    for row in reversed(above):
        cells = _without_trailing(row)
        fits = least <= len(cells) <= width and len(row) == len(above[-1])
        numbered = bool(cells) and cells[0].casefold() == _NUMBERED
        holds_number = any(CELL["."].fullmatch(c) or CELL[","].fullmatch(c) for c in cells)
        if not cells or not fits or (holds_number and not numbered):
            break
        lines.insert(0, [*cells, *[""] * (width - len(cells))])
    if not lines:
        return Header((), (), 0)
    k = next((k for k in range(len(lines) - 1, 0, -1) if are_units(lines[k])), None)
    split = [[split_header(cell) for cell in line] for line in reversed(lines)]
    if k is None:
        named = max(split, key=lambda cells: sum(unit is not None for _, unit in cells))
    else:
        stated = split[len(lines) - k]
        split.append(
            [(name, _bare(cell)) for (name, _), cell in zip(stated, lines[k], strict=True)]
        )
        named = [(n, own or u) for (n, own), (_, u) in zip(stated, split[-1], strict=True)]
    names, units = zip(*named, strict=True)
    contradicted = any(contradict(named, other) for other in split)
    if k is not None and k + 1 < len(lines):  # real and imaginary part, say, of one name
        parts = zip(names, lines[k + 1], strict=True)
        names = tuple(part if part and names.count(n) > 1 else n for n, part in parts)
    return Header(names, units, len(_without_trailing(names)), contradicted)


def contradict(
    one: Sequence[tuple[str, str | None]], other: Sequence[tuple[str, str | None]]
) -> bool:
    """Return whether two lines of names and units name the same columns, but not alike."""
    names, others = ([plain(name) for name, _ in line] for line in (one, other))
    if sorted(filter(None, names)) != sorted(filter(None, others)) or len(set(names)) < 2:
        return False
    units = [(a, b) for (_, a), (_, b) in zip(one, other, strict=True) if a and b and a != b]
    return names != others or any(_differ(*pair) for pair in units)


def _differ(unit: str, other: str) -> bool:
    try:
        return replace(parse_unit(unit), text="") != replace(parse_unit(other), text="")
    except UnitError:
        return False


def _without_trailing(row: Sequence[str]) -> list[str]:
    cells = [cell.strip() for cell in row]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _bare(cell: str) -> str | None:
    """Return the unit in a cell of a row of units; None for an empty one."""
    text = cell.strip()
    if text[:1] in ("[", "(") and text[-1] in "])":
        text = text[1:-1].strip()
    return "1" if text == "-" else text or None


def are_units(cells: Sequence[str]) -> bool:
    """Return whether each cell is empty or a unit, and some is one."""
    try:
        return bool([parse_unit(unit) for cell in cells if (unit := _bare(cell)) is not None])
    except UnitError:
        return False


def named_channels(
    columns: Sequence[NDArray[Any]], named: Header, file: str
) -> tuple[RawChannel, ...]:
    """Return the columns with their names and units, blank ones without a name left out."""
    if named.contradicted:
        raise DataError(
            f"{file}: several lines above the numbers name the columns, with different units or "
            "in different order; expected one header. Delete the wrong one"
        )
    channels = []
    for i, values in enumerate(columns):
        label, unit = (named.names[i], named.units[i]) if named.names else ("", None)
        blank = np.char.strip(values) == "" if values.dtype.kind == "U" else values != values
        if not label and np.all(blank):
            continue
        if named.names and i >= named.cells:
            raise DataError(
                f"{file}: the header names {named.cells} columns, the rows have {len(columns)}; "
                "expected a name for each"
            )
        channels.append(RawChannel(label or f"column {i + 1}", values, unit))
    return tuple(channels)
