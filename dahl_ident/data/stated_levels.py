"""The level of a test, as the header of a laboratory's file states it.

A line such as ``Excitation level: 0.2 N rms``, ``Control amplitude;5;um`` or ``DRIVE = 1 V``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from dahl_ident.errors import UnitError, ValidationError
from dahl_ident.units import DRIVE_KINDS, MOTION_KINDS, parse_quantity

_NUMBER = r"(?P<value>[0-9]+(?:[.,][0-9]+)?(?:e[-+]?[0-9]+)?)"
_UNIT = r"[^\W\d_][^;,\t\])\"']{0,20}"
_LINE = re.compile(
    rf"[\W_]*(?P<key>[a-z][a-z _.-]{{2,40}}?)\s*(?:[\[(](?P<own>{_UNIT})[\])]\s*)?[\"']?\s*"
    rf"(?:[:=;,\t]\s*|\s)[\"']?{_NUMBER}(?:[\"']?\s*[;,\t]?\s*[\[(\"']?(?P<unit>{_UNIT}))?",
    re.IGNORECASE,
)
_SUBJECTS = {
    "drive", "driving", "excitation", "source", "force", "control", "target", "reference", "test",
    "shaker", "input", "sine", "load", "torque", "displacement", "velocity", "acceleration",
    "response", "nominal",
}  # fmt: skip
_SIZES = {"level", "amplitude"}


def stated_levels(lines: Iterable[str]) -> dict[str, str]:
    """Return the drive and the amplitude that lines of a header state, if each states one only.

    Examples
    --------
    >>> stated_levels(["Date: 2024-01-01", "Excitation level: 0.2 N rms"])
    {'drive': '0.2 N rms'}
    >>> stated_levels(["Control amplitude (um),5"])
    {'amplitude': '5 um'}
    """
    found: dict[str, set[str]] = {}
    for line in lines:
        match = _LINE.match(line[:200])
        if match is None:
            continue
        words = set(re.split(r"[\s_.-]+", match["key"].casefold())) - {""}
        if not words <= _SUBJECTS | _SIZES or not (words & _SIZES or words == {"drive"}):
            continue
        unit = match["own"] or match["unit"] or ""
        text = f"{match['value'].replace(',', '.')} {unit.strip()}"
        try:
            _, kind, _ = parse_quantity(text, (*DRIVE_KINDS, *MOTION_KINDS), "level")
        except (UnitError, ValidationError):
            continue
        role = "drive" if kind in DRIVE_KINDS else "amplitude"
        found.setdefault(role, set()).add(text)
    return {role: texts.pop() for role, texts in found.items() if len(texts) == 1}
