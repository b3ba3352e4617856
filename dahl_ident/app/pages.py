"""What pages show besides forms: reports as blocks, laws with their loops, curves."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from dahl_ident.elements import BoucWen, Dahl, Friction, Iwan, LuGre, MaxwellSlip, PowerDamper
from dahl_ident.elements.law_files import KINDS, load_laws

_PICTURE = re.compile(r"!\[(.*)\]\(<?(.*?)>?\)")
_SHOWN: dict[str, Callable[[], Any]] = {
    "dahl": partial(Dahl, 0.7, 3.0, 1.0),
    "bouc_wen": partial(BoucWen, 3.0, 4.0, 1.0),
    "maxwell_slip": partial(MaxwellSlip, [0.1, 0.3, 0.6], [1.0, 0.8, 0.5]),
    "iwan": partial(Iwan, 0.7, 3.0, -0.5, 0.7),
    "power_damper": partial(PowerDamper, 0.7, 0.3),
    "lugre": partial(LuGre, 0.7, 3.0, 1.4, 0.2, 0.05, 0.05),
}
"""Laws whose loops are drawn, over a displacement of amplitude 1."""
_NAMES = {
    "dahl": "Dahl", "bouc_wen": "Bouc-Wen", "maxwell_slip": "Maxwell slip", "iwan": "Iwan",
    "lugre": "LuGre", "power_damper": "power damper",
}  # fmt: skip
_USES = {
    "dahl": "pivots, bearings, gears: stiffness, then slip",
    "bouc_wen": "hysteresis with a stiffness after slip",
    "maxwell_slip": "several springs that slip one after the other",
    "iwan": "bolted joints: microslip, then slip",
    "lugre": "friction that depends on the speed",
    "power_damper": "damping force as a power of the speed",
}


def blocks(text: str) -> list[dict[str, Any]]:
    """Return the sections of a report in Markdown: tables, pictures, lists and paragraphs."""
    sections: list[dict[str, Any]] = [{"title": "", "blocks": []}]
    for part in re.split(r"\n\s*\n", text):
        lines = part.strip("\n").splitlines()
        if not lines or lines[0].startswith("# "):
            continue
        if lines[0].startswith("## "):
            sections.append({"title": _plain(lines[0][3:]), "blocks": []})
            continue
        sections[-1]["blocks"].append(_block(lines))
    return sections


def _block(lines: Sequence[str]) -> dict[str, Any]:
    picture = _PICTURE.fullmatch(lines[0])
    if picture is not None:
        return {"kind": "picture", "alt": _plain(picture[1]), "source": picture[2]}
    if lines[0].startswith("|"):
        rows = [[_plain(cell) for cell in _cells(line)] for line in lines]
        return {"kind": "table", "header": rows[0], "rows": rows[2:]}
    if all(line.startswith("- ") for line in lines):
        return {"kind": "list", "lines": [_plain(line[2:]) for line in lines]}
    if all(line.startswith("    ") for line in lines):
        return {"kind": "code", "text": "\n".join(line[4:] for line in lines)}
    return {"kind": "text", "text": _plain(" ".join(lines))}


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def _plain(text: str) -> str:
    """Return a text without the signs of Markdown."""
    return re.sub(r"\\(.)", r"\1", re.sub(r"(?<!\\)(\*+|~~)", "", text)).strip()


def laws(files: Sequence[str]) -> list[dict[str, str]]:
    """Return the laws that can be chosen, those of the user's files included."""
    known = [
        {"kind": kind, "name": _NAMES[kind], "use": _USES[kind], "drawn": "yes"} for kind in _NAMES
    ]
    for file in files:
        load_laws(Path(file))
    of_user = [cls for cls in KINDS.values() if issubclass(cls, Friction)]
    of_user = [cls for cls in of_user if not cls.__module__.startswith("dahl_ident.")]
    for cls in of_user if files else ():
        use = (cls.__doc__ or "").strip().partition("\n")[0]
        known.append({"kind": cls.kind, "name": cls.__name__, "use": use, "drawn": ""})
    return known


@cache
def loop_of(kind: str) -> str | None:
    """Return a loop of a law as SVG, None where it has no picture."""
    if kind not in _SHOWN:
        return None
    turns = 2.0 * np.pi * np.linspace(0.0, 2.25, 451)
    element = _SHOWN[kind]()
    values = [np.asarray(parameter.value) for parameter in element.parameters]
    force = element.force_history(values, np.sin(turns), np.cos(turns))[100:]
    x, y = 50.0 + 42.0 * np.sin(turns[100:]), 34.0 - 28.0 * force / np.abs(force).max()
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 68" width="100" height="68">'
        '<path d="M50 2V66M4 34H96" stroke="#8a94a0" stroke-width=".7" fill="none"/>'
        f'<polyline points="{points}" fill="none" stroke="#3b82c4" stroke-width="2"/></svg>'
    )
