"""The header of a column: a name, and often a unit."""

from __future__ import annotations

import re

from dahl_ident.errors import UnitError
from dahl_ident.units import parse_unit

_LONGEST_HEADER = 400  # from which a cell holds no name and unit
_INDEX = re.compile(r"[\d:, ]+")
_UNBRACKETED = re.compile(r"\s*(.*\S)\s+(?:/|in)\s+(\S.*)")  # as ISO 80000 has it, F / N
_CURVED = re.compile(r"\s*(.*?\S)\s*\((.*)\)\s*")


def split_header(text: str) -> tuple[str, str | None]:
    """Split ``"force [kN]"``, ``"force (kN)"``, ``"F / kN"`` or ``"force in kN"``.

    What stands in square brackets is the unit, unless it is an index; the other ways count
    only where they lead to a unit.
    """
    if len(text) > _LONGEST_HEADER:
        return text.strip(), None
    square = re.fullmatch(r"\s*(.*?)(\s*)\[([^\[\]]*)\]\s*", text)
    if square and square[1] and square[3].strip():
        unit = square[3].strip()
        if not _INDEX.fullmatch(unit) or (unit == "1" and square[2]):
            return square[1], unit
    for found in filter(None, (p.fullmatch(text) for p in (_CURVED, _UNBRACKETED))):
        if found[2].strip() == "dB":
            return found[1], "dB"  # of what, whoever needs the gain will ask
        try:
            return found[1], parse_unit(found[2]).text
        except UnitError:
            continue
    return text.strip(), None
