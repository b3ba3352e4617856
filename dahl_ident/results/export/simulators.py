"""Parameter files of simulators and controllers: MuJoCo, URDF, Modelica, MATLAB, C."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
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
    """A friction element: its kind, its equation, and its values by the parameters of its class."""

    kind: str
    equation: str
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
        values = _values(element)
        if element.kind in LUMPED and element.kind in supported:
            lumped[LUMPED[element.kind]] += values[LUMPED[element.kind]]
        elif element.kind in supported:
            laws.append(Law(element.kind, element.equation, values))
        else:
            raise ModelError(
                f"{form} carries {', '.join(supported)}, and the model has {element.kind}; fit "
                "without it, or export to another format, such as matlab"
            )
        if supported[element.kind]:
            notes.append(f"{element.kind}: {supported[element.kind]}")
    units = {p.unit for p in result.params.values()}
    rotation = any("rad" in unit or unit.startswith("N m") for unit in units)
    return Device(tuple(laws), **lumped, rotation=rotation, notes=tuple(notes))


def short(value: float) -> float:
    """Return a number rounded to ten digits."""
    return float(f"{value:.10g}")


def _values(element: Any) -> dict[str, float]:
    """Return the values of an element by the names of parameters in its class."""
    prefix = f"{element.name}_" if getattr(element, "name", None) else ""
    return {p.name.removeprefix(prefix): short(p.value) for p in element.parameters}


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


def mujoco(result: Any) -> str:
    """Return a joint with a passive motor that has the friction of the fit as LuGre friction."""
    parts = device(result, "mujoco", {"dahl": "", "lugre": "", **dict.fromkeys(LUMPED, "")})
    notes, motors, damping = list(parts.notes), [], parts.damping
    for number, law in enumerate(parts.laws, start=1):
        f_max = static = law["f_max"]
        micro, speed = 0.0, 1.0  # without effect, as both limits are equal
        if law.kind == "dahl":
            notes += _note_on_exponent(law)
        else:
            static, speed = short(f_max * law["static_ratio"]), law["stribeck_speed"]
            micro, damping = law["micro_damping"], damping + law["viscous"]
        numbers = _numbers(law["sigma"], micro, f_max, static, speed)
        motors.append(
            f'    <dcmotor name="friction{number}" joint="joint" input="none" motorconst="0 0" '
            f'resistance="1" lugre="{numbers}"/>'
        )
    actuators = ["  <actuator>", *motors, "  </actuator>"] if motors else []
    notes.append("lugre: stiffness, damping, Coulomb, static, Stribeck; MuJoCo 4 or later")
    return _mjcf(parts, notes, damping, 0.0, actuators)


def frictionloss(result: Any) -> str:
    """Return a joint with a friction limit only, for any release of MuJoCo."""
    parts = device(result, "mujoco-frictionloss", _COULOMB)
    limit = sum(_limit(law, "mujoco-frictionloss") for law in parts.laws)
    return _mjcf(parts, parts.notes, parts.damping, limit, ())


def _mjcf(
    parts: Device, notes: Sequence[str], damping: float, limit: float, actuators: Sequence[str]
) -> str:
    attributes = {
        "armature": parts.mass,
        "damping": damping,
        "stiffness": parts.stiffness,
        "frictionloss": limit,
    }
    fields = "".join(f' {name}="{value!r}"' for name, value in attributes.items() if value)
    kind = "hinge" if parts.rotation else "slide"
    body = "1e-9" if parts.mass else "1"
    remark = "the fit has no mass; the body's is 1, to be replaced"
    if parts.mass:
        remark = "the mass, or inertia, of the fit is the armature; that of the body is negligible"
    lines = [
        "<!--",
        *(f"  {note.replace('--', '-')}" for note in notes),
        f"  {remark}",
        "-->",
        '<mujoco model="identified">',
        '  <option timestep="0.0001" integrator="implicitfast" gravity="0 0 0"/>',
        "  <worldbody>",
        '    <body name="body">',
        f'      <joint name="joint" type="{kind}" axis="1 0 0"{fields}/>',
        f'      <inertial pos="0 0 0" mass="{body}" diaginertia="{body} {body} {body}"/>',
        "    </body>",
        "  </worldbody>",
        *actuators,
        "</mujoco>",
    ]
    return "\n".join(lines) + "\n"


def urdf(result: Any) -> str:
    """Return the dynamics element of a joint of a robot."""
    supported = {**_COULOMB, "mass": "belongs to the inertial element of the link"}
    supported.pop("spring")
    parts = device(result, "urdf", supported)
    limit = sum(_limit(law, "urdf") for law in parts.laws)
    kind = "revolute" if parts.rotation else "prismatic"
    comment = "\n".join(f"  {note.replace('--', '-')}" for note in parts.notes)
    mass = f'<!-- <inertial><mass value="{parts.mass!r}"/></inertial> -->\n' if parts.mass else ""
    return (
        f"<!--\n{comment}\n  put it into the {kind} joint\n-->\n{mass}"
        f'<dynamics damping="{parts.damping!r}" friction="{limit!r}"/>\n'
    )


def _limit(law: Law, form: str) -> float:
    """Return the limit of friction, which has to be the same in both directions."""
    if law.values.get("asymmetry"):
        raise ModelError(f"{form} has one limit of friction for both directions, and the model two")
    return law["f_max"]


def modelica(result: Any) -> str:
    """Return a compliant component between two flanges, with the mass as a constant."""
    kinds = ("dahl", "bouc_wen", "lugre", "power_damper", *LUMPED)
    parts = device(result, "modelica", {**dict.fromkeys(kinds, ""), "mass": "a constant alone"})
    base, s, v, out = (
        ("Rotational", "phi_rel", "w_rel", "tau")
        if parts.rotation
        else ("Translational", "s_rel", "v_rel", "f")
    )
    declared, equations, total = [], [], [f"damping*{v}", f"stiffness*{s}"]
    for i, law in enumerate(parts.laws, start=1):
        declared += [f"  parameter Real {name}{i}={x!r};" for name, x in law.values.items()]
        if law.kind != "power_damper":
            declared.append(f'  Real z{i}(start=0, fixed=true) "state of {law.kind}";')
            equations.append(f"  der(z{i}) = {v}*({_slope(law, i, v)});")
        total.append(_force(law, i, v))
    declared += [f"  constant Real {name}={getattr(parts, name)!r};" for name in LUMPED.values()]
    lines = [
        *(f"// {note}" for note in parts.notes),
        'model Friction "identified friction"',
        f"  extends Modelica.Mechanics.{base}.Interfaces.PartialCompliantWithRelativeStates;",
        *declared,
        "equation",
        *equations,
        f"  {out} = {' + '.join(total)};",
        "end Friction;",
    ]
    return "\n".join(lines) + "\n"


def _slope(law: Law, i: int, v: str) -> str:
    """Return the derivative of the force with respect to displacement, in Modelica."""
    if law.kind == "bouc_wen" and "exponent" in law.values:
        soft, stiff = (f"sign({r}{i})*abs({r}{i})^exponent{i}" for r in "qp")
        rate = f"(({soft} - {stiff}) + ({soft} + {stiff})*sign({v}*z{i}))"
        return f"sigma{i}*(1 - 0.5*{rate}*abs(z{i}/sigma{i})^exponent{i})"
    if law.kind == "bouc_wen":
        return f"sigma{i} - 0.5*((q{i} + p{i})*sign({v})*z{i} + (q{i} - p{i})*abs(z{i}))"
    if law.kind == "lugre":
        ratio = f"(1 + (static_ratio{i} - 1)*exp(-({v}/stribeck_speed{i})^2))"
        return f"sigma{i}*(1 - sign({v})*z{i}/(f_max{i}*{ratio}))"
    level = f"(f_max{i}*(1 + sign({v})*asymmetry{i}))" if "asymmetry" in law.values else f"f_max{i}"
    z = f"(1 - sign({v})*z{i}/{level})"
    return f"sigma{i}*abs({z})^alpha{i}*sign({z})"


def _force(law: Law, i: int, v: str) -> str:
    if law.kind == "power_damper":
        return f"coefficient{i}*abs({v}/reference_speed{i})^exponent{i}*sign({v})"
    if law.kind == "lugre":
        return f"z{i} + (micro_damping{i}/sigma{i}*({_slope(law, i, v)}) + viscous{i})*{v}"
    return f"z{i}"


def matlab(result: Any) -> str:
    """Return a script that defines a struct: values, uncertainties, covariance, equations."""
    lines = [f"% the fit is {result.status.value}"]
    lines += [
        f"% {e.kind}: {e.equation}" for e in result.model.elements if getattr(e, "equation", "")
    ]
    values = {p.name: p.value for p in result.model.parameters}
    for name, p in result.params.items():
        value = _matlab(values.get(name, p.value))
        lines.append(f"friction.{name} = {value};  % {p.unit}".rstrip(" %"))
    try:
        budget, covariance = uncertain(result)
    except FitError as exc:
        return "\n".join([*lines, f"% {exc}", ""])
    lines += [f"friction.u.{name} = {_matlab(part.u)};" for name, part in budget.items()]
    names = ", ".join(f"'{name}'" for name in budget)
    rows = "; ".join(_numbers(*row) for row in covariance.tolist())
    lines += [f"friction.names = {{{names}}};", f"friction.covariance = [{rows}];"]
    return "\n".join(lines) + "\n"


def _matlab(value: float | None) -> str:
    return (
        "NaN" if value is None else repr(float(value)).replace("inf", "Inf").replace("nan", "NaN")
    )


def _numbers(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


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
    c, p, speed = law["coefficient"], law["exponent"], law["reference_speed"]
    return [f"force += v == 0.0 ? 0.0 : copysign({c!r} * pow(fabs(v) / {speed!r}, {p!r}), v);"]


_LINES: dict[str, Callable[[Law, str], list[str]]] = {
    "dahl": _dahl,
    "bouc_wen": _bouc_wen,
    "lugre": _lugre,
    "maxwell_slip": _slips,
    "power_damper": _power,
}


def c_header(result: Any) -> str:
    """Return the C header; the mass is a macro, and its force is not in the function."""
    parts = device(result, "c", dict.fromkeys((*_LINES, *LUMPED), ""))
    body = ["double level;"] if any(law.kind == "lugre" for law in parts.laws) else []
    states = 0
    kinds = set()
    for law in parts.laws:
        body += _LINES[law.kind](law, f"s->f[{states}]")
        states += {"maxwell_slip": len(law.values) // 2, "power_damper": 0}.get(law.kind, 1)
        kinds.add("dahl" if law.kind == "lugre" else law.kind)
    lumped = ((parts.damping, "v"), (parts.stiffness, "x"))
    body += [f"force += {size!r} * {motion};" for size, motion in lumped if size]
    source = (files(__package__) / "friction.h.j2").read_text("utf-8")
    template = jinja2.Template(source, trim_blocks=True, keep_trailing_newline=True)
    text: str = template.render(parts=parts, states=max(states, 1), kinds=kinds, body=body)
    return text
