"""A C header with the friction force as a function, for feed-forward compensation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dahl_ident.errors import ModelError
from dahl_ident.results.export.device import LUMPED, Law, device

_STEPS = {
    "dahl": """\
/* the force after a step dx: the exact solution of dF/dx = sigma |z|^alpha sgn(z) */
static double friction_dahl(double f, double dx, double limit, double sigma, double alpha)
{
    const double d = dx < 0.0 ? -1.0 : 1.0, b = sigma * fabs(dx) / limit, e = alpha - 1.0;
    const double z = 1.0 - d * f / limit;
    double size = fabs(z), grown;
    if (e == 0.0) {
        size *= exp(-b);
    } else if (size > 0.0) {
        grown = e * b * pow(size, e);
        size *= grown <= -1.0 ? 0.0 : exp(-log1p(grown) / e);
    }
    return d * limit * (1.0 - copysign(size, z));
}
""",
    "bouc_wen": """\
/* exponentials: sigma + p |F| while force and motion are opposite, sigma - q |F| from there on */
static double friction_bouc_wen(double f, double dx, double sigma, double q, double p)
{
    const double d = dx < 0.0 ? -1.0 : 1.0;
    double u = d * f, path = fabs(dx), zero;
    if (u < 0.0) {
        zero = p == 0.0 ? -u / sigma : HUGE_VAL;
        if (p != 0.0 && p * u < sigma) zero = log1p(-p * u / sigma) / p;
        if (path < zero && p == 0.0) return d * (u + sigma * path);
        if (path < zero) return d * (u * exp(-p * path) - sigma * expm1(-p * path) / p);
        path -= zero;
        u = 0.0;
    }
    if (q == 0.0) return d * (u + sigma * path);
    return d * (u * exp(-q * path) - sigma * expm1(-q * path) / q);
}
""",
    "maxwell_slip": """\
static double friction_slip(double f, double dx, double stiffness, double slip)
{
    return fmax(-stiffness * slip, fmin(stiffness * slip, f + stiffness * dx));
}
""",
}  # fmt: skip


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
    states, body, needed = 0, [], set()
    for law in parts.laws:
        body += [f"    {line}" for line in _LINES[law.kind](law, f"s->f[{states}]")]
        states += {"maxwell_slip": len(law.values) // 2, "power_damper": 0}.get(law.kind, 1)
        needed.add("dahl" if law.kind == "lugre" else law.kind)
    body += [
        f"    force += {size!r} * {moved};"
        for size, moved in ((parts.damping, "v"), (parts.stiffness, "x"))
        if size
    ]
    level = ["    double level;"] if any(law.kind == "lugre" for law in parts.laws) else []
    notes = "".join(f" * {note}\n" for note in parts.notes)
    return f"""\
/*
{notes} */
#ifndef IDENTIFIED_FRICTION_H
#define IDENTIFIED_FRICTION_H

#include <math.h>

#define FRICTION_MASS {parts.mass!r}  /* its force is not in friction_force */

typedef struct {{
    double x, v;  /* last displacement and velocity, {"rad" if parts.rotation else "m"} */
    double f[{max(states, 1)}];  /* forces with a memory, {"N m" if parts.rotation else "N"} */
}} friction_state;

{"".join(text for kind, text in _STEPS.items() if kind in needed)}
/* Begin at a displacement and a velocity, with no force. */
static void friction_start(friction_state *s, double x, double v)
{{
    unsigned i;
    s->x = x;
    s->v = v;
    for (i = 0; i < sizeof s->f / sizeof s->f[0]; ++i) s->f[i] = 0.0;
}}

/* The force that moves the device to x at the velocity v; call it once a sample. */
static double friction_force(friction_state *s, double x, double v)
{{
    const double dx = x - s->x;
    double force = 0.0;
{chr(10).join([*level, *body])}
    s->x = x;
    s->v = v;
    return force;
}}

#endif
"""
