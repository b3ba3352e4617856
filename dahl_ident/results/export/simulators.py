"""Parameter files of simulators and controllers: MuJoCo, URDF, Modelica, MATLAB, C."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from itertools import accumulate
from typing import Any

import jinja2
import numpy as np

from dahl_ident.errors import FitError, ModelError, argument
from dahl_ident.results.export.numbers import uncertain
from dahl_ident.units import percent
from dahl_ident.version import __version__

LUMPED = {"mass": "mass", "damper": "damping", "spring": "stiffness"}
_EXPONENT_MATTERS = 0.02  # error of the force over f_max due to the exponent


@dataclass(frozen=True)
class Law:
    """A friction element: its kind, and its values by the parameters of its class."""

    kind: str
    values: Mapping[str, float]

    def __getitem__(self, name: str) -> float:
        return self.values[name]


@dataclass(frozen=True)
class Device:
    """The elements of a fit."""

    laws: tuple[Law, ...]  # all but masses, viscous dampers and springs
    mass: float  # sum over the elements, as are damping and stiffness
    damping: float
    stiffness: float
    rotation: bool  # whether forces are torques
    notes: tuple[str, ...]  # origin, verdict, and omissions of the format


def device(result: Any, form: str, supported: Mapping[str, str]) -> Device:
    """Return the device of a fit; `supported` has a note, or "", for each kind of element."""
    laws = []
    lumped = dict.fromkeys(LUMPED.values(), 0.0)
    notes = [f"made by dahl_ident {__version__}, SI units; the fit is {result.status.value}"]
    lost = [name for name, p in result.params.items() if not math.isfinite(p.value)]
    if lost:
        raise FitError(
            f"{', '.join(lost)} has no finite estimate, so there is no model to export; see the "
            "verdict"
        )
    for element in result.model.elements:
        prefix = f"{element.name}_" if getattr(element, "name", None) else ""
        values = {p.name.removeprefix(prefix): short(p.value) for p in element.parameters}
        if element.kind in LUMPED and element.kind in supported:
            lumped[LUMPED[element.kind]] += values[LUMPED[element.kind]]
        elif element.kind in supported:
            laws.append(Law(element.kind, values))
        else:
            raise ModelError(
                f"{form} carries {', '.join(supported)}, and the model has {element.kind}; fit "
                "without it, or export to another format, such as matlab"
            )
        if supported[element.kind]:
            notes.append(f"{element.kind}: {supported[element.kind]}")
    rotation = result.problem.motion == "rotation"
    return Device(tuple(laws), **lumped, rotation=rotation, notes=tuple(notes))


def short(value: float) -> float:
    """Return a number rounded to ten digits."""
    return float(f"{value:.10g}")


def _note_on_exponent(law: Law) -> tuple[str, ...]:
    """Return a note if alpha is not 1, which MuJoCo assumes; refuse an error that matters."""
    _limit(law, "mujoco")
    a = law["alpha"] - 1.0
    if a == 0.0:
        return ()
    path = np.geomspace(1e-3, 1e3, 2001)  # after a reversal from full slip: 1 - s F/f_max = 2
    with np.errstate(invalid="ignore", divide="ignore"):
        z = np.maximum(2.0**-a + a * path, 0.0) ** (-1.0 / a)
    worst = float(np.max(np.abs(z - 2.0 * np.exp(-path))))
    if not worst <= _EXPONENT_MATTERS:
        raise ModelError(
            f"mujoco carries Dahl with the exponent 1, and alpha is {1.0 + a:.4g}: the force would "
            f"differ by {percent(worst)} of f_max; fit with {argument('alpha', 1)} if that "
            "describes the data"
        )
    return (f"alpha = {1.0 + a:.5g} is taken as 1: within {percent(worst)} of f_max",)


_COULOMB = {
    "dahl": "as a friction limit; the contact stiffness sigma is left out",
    **dict.fromkeys(LUMPED, ""),
}


def _rendered(template: str, **values: Any) -> str:
    """Return the text of a template in this folder."""
    environment = jinja2.Environment(
        trim_blocks=True, keep_trailing_newline=True, undefined=jinja2.StrictUndefined
    )
    source = (files(__package__) / template).read_text("utf-8")
    return str(environment.from_string(source).render(values))


def mujoco(result: Any) -> str:
    """Return a joint with a passive motor that has the friction of the fit as LuGre friction."""
    parts = device(result, "mujoco", {"dahl": "", "lugre": "", **dict.fromkeys(LUMPED, "")})
    notes, motors, damping = list(parts.notes), [], parts.damping
    for law in parts.laws:
        f_max = static = law["f_max"]
        micro, speed = 0.0, 1.0  # without effect, as both limits are equal
        if law.kind == "dahl":
            notes += _note_on_exponent(law)
        else:
            static, speed = short(f_max * law["static_ratio"]), law["stribeck_speed"]
            micro, damping = law["micro_damping"], damping + law["viscous"]
        motors.append((law["sigma"], micro, f_max, static, speed))
    notes.append("lugre: stiffness, damping, Coulomb, static, Stribeck; MuJoCo 4 or later")
    return _rendered(
        "mjcf.xml.j2", parts=parts, notes=notes, damping=damping, limit=0.0, motors=motors
    )


def frictionloss(result: Any) -> str:
    """Return a joint with a friction limit only, for any release of MuJoCo."""
    parts = device(result, "mujoco-frictionloss", _COULOMB)
    limit = sum(_limit(law, "mujoco-frictionloss") for law in parts.laws)
    values = {"notes": parts.notes, "damping": parts.damping, "limit": limit, "motors": ()}
    return _rendered("mjcf.xml.j2", parts=parts, **values)


def urdf(result: Any) -> str:
    """Return the dynamics element of a joint of a robot."""
    supported = {**_COULOMB, "mass": "belongs to the inertial element of the link"}
    supported.pop("spring")
    parts = device(result, "urdf", supported)
    limit = sum(_limit(law, "urdf") for law in parts.laws)
    return _rendered("urdf.xml.j2", parts=parts, limit=limit)


def _limit(law: Law, form: str) -> float:
    """Return the limit of friction, which has to be the same in both directions."""
    if law.values.get("asymmetry"):
        raise ModelError(f"{form} has one limit of friction for both directions, and the model two")
    return law["f_max"]


def modelica(result: Any) -> str:
    """Return a compliant component between two flanges, with the mass as a constant."""
    kinds = ("dahl", "bouc_wen", "lugre", "power_damper", *LUMPED)
    parts = device(result, "modelica", {**dict.fromkeys(kinds, ""), "mass": "a constant alone"})
    translation = {"base": "Translational", "s": "s_rel", "v": "v_rel", "out": "f"}
    rotation = {"base": "Rotational", "s": "phi_rel", "v": "w_rel", "out": "tau"}
    return _rendered("friction.mo.j2", parts=parts, **(rotation if parts.rotation else translation))


def matlab(result: Any) -> str:
    """Return a script that defines a struct: values, uncertainties, covariance, equations."""
    at = {p.name: p.value for p in result.model.parameters}
    values = [(name, _matlab(at.get(name, p.value)), p.unit) for name, p in result.params.items()]
    try:
        budget, covariance = uncertain(result)
    except FitError as exc:
        return _rendered("friction.m.j2", result=result, values=values, missing=exc)
    return _rendered(
        "friction.m.j2",
        result=result,
        values=values,
        missing=None,
        u={name: _matlab(part.u) for name, part in budget.items()},
        covariance=covariance.tolist(),
    )


def _matlab(value: float | None) -> str:
    return (
        "NaN" if value is None else repr(float(value)).replace("inf", "Inf").replace("nan", "NaN")
    )


def c_header(result: Any) -> str:
    """Return the C header; the mass is a macro, and its force is not in the function."""
    kinds = ("dahl", "bouc_wen", "lugre", "maxwell_slip", "power_damper", *LUMPED)
    parts = device(result, "c", dict.fromkeys(kinds, ""))
    if any(law.kind == "bouc_wen" and "exponent" in law.values for law in parts.laws):
        raise ModelError("c has Bouc-Wen of exponent 1 alone; modelica has any exponent")
    states = (
        {"maxwell_slip": len(law.values) // 2, "power_damper": 0}.get(law.kind, 1)
        for law in parts.laws
    )
    first = list(accumulate(states, initial=0))
    return _rendered(
        "friction.h.j2",
        parts=parts,
        kinds={law.kind for law in parts.laws},
        laws=list(zip(parts.laws, first, strict=False)),
        states=max(first[-1], 1),
    )
