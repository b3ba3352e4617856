"""A C header with the friction force as a function, for feed-forward compensation."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import Any

import jinja2

from dahl_ident.errors import ModelError
from dahl_ident.results.export.device import LUMPED, Law, device


def _dahl(law: Law, state: str) -> list[str]:
    limit = repr(law["f_max"])
    if asymmetry := law.values.get("asymmetry"):
        limit += f" * (1.0 + (dx < 0.0 ? -1.0 : 1.0) * {asymmetry!r})"
    step = f"friction_dahl({state}, dx, {limit}, {law['sigma']!r}, {law['alpha']!r})"
    return [f"if (dx != 0.0) {state} = {step};", f"force += {state};"]


def _bouc_wen(law: Law, state: str) -> list[str]:
    if "exponent" in law.values:
        raise ModelError("c has Bouc-Wen of exponent 1 alone; modelica has any exponent")
    values = ", ".join(repr(law[name]) for name in ("sigma", "q", "p"))
    return [f"{state} = friction_bouc_wen({state}, dx, {values});", f"force += {state};"]


def _lugre(law: Law, state: str) -> list[str]:
    f_max, sigma, ratio, speed, micro, viscous = law.values.values()
    level = f"{f_max!r} * (1.0 + {ratio - 1.0!r} * exp(-pow({{}} / {speed!r}, 2.0)))"
    slope = f"{sigma!r} * (1.0 - (v < 0.0 ? -1.0 : 1.0) * {state} / level)"
    return [
        f"level = {level.format('(0.5 * (s->v + v))')};",
        f"if (dx != 0.0) {state} = friction_dahl({state}, dx, level, {sigma!r}, 1.0);",
        f"level = {level.format('v')};",
        f"force += {state} + ({micro / sigma!r} * {slope} + {viscous!r}) * v;",
    ]


def _slips(law: Law, state: str) -> list[str]:
    count = len(law.values) // 2
    first = int(state.partition("[")[2].rstrip("]"))
    return [
        f"force += (s->f[{first + i}] = friction_slip(s->f[{first + i}], dx, "
        f"{law[f'stiffness_{i + 1}']!r}, {law[f'slip_{i + 1}']!r}));"
        for i in range(count)
    ]


def _power(law: Law, _: str) -> list[str]:
    c, p, speed = (law[name] for name in ("coefficient", "exponent", "reference_speed"))
    return [f"force += v == 0.0 ? 0.0 : copysign({c!r} * pow(fabs(v) / {speed!r}, {p!r}), v);"]


_LINES: dict[str, Callable[[Law, str], list[str]]] = {
    "dahl": _dahl, "bouc_wen": _bouc_wen, "lugre": _lugre, "maxwell_slip": _slips,
    "power_damper": _power,
}  # fmt: skip


def c_header(result: Any) -> str:
    """Return the header; the mass is a macro, its force is not in the function."""
    parts = device(result, "c", dict.fromkeys((*_LINES, *LUMPED), ""))
    body = ["double level;"] if any(law.kind == "lugre" for law in parts.laws) else []
    states, kinds = 0, set()
    for law in parts.laws:
        body += _LINES[law.kind](law, f"s->f[{states}]")
        states += {"maxwell_slip": len(law.values) // 2, "power_damper": 0}.get(law.kind, 1)
        kinds.add("dahl" if law.kind == "lugre" else law.kind)
    lumped = ((parts.damping, "v"), (parts.stiffness, "x"))
    body += [f"force += {size!r} * {moved};" for size, moved in lumped if size]
    template = (files(__package__) / "friction.h.j2").read_text("utf-8")
    made = jinja2.Template(template, trim_blocks=True, keep_trailing_newline=True)
    return made.render(parts=parts, states=max(states, 1), kinds=kinds, body=body)
