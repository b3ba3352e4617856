"""Parameter files of simulators: MuJoCo, URDF, Modelica, MATLAB."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dahl_ident.errors import FitError, ModelError
from dahl_ident.results.export.device import LUMPED, Device, Law, device, linear, short
from dahl_ident.results.export.numbers import uncertain

_COULOMB = {
    "dahl": "as a friction limit; the contact stiffness sigma is left out",
    **dict.fromkeys(LUMPED, ""),
}


def mujoco(result: Any) -> str:
    """Return a joint with a passive motor whose LuGre friction is that of the fit."""
    parts = device(result, "mujoco", {"dahl": "", "lugre": "", **dict.fromkeys(LUMPED, "")})
    notes, motors, damping = list(parts.notes), [], parts.damping
    for number, law in enumerate(parts.laws, start=1):
        f_max = static = law["f_max"]
        micro, speed = 0.0, 1.0  # of no effect where both limits are equal
        if law.kind == "dahl":
            notes += linear(law, "mujoco")
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
    """Return a joint whose friction has a limit alone, for any release of MuJoCo."""
    parts = device(result, "mujoco-frictionloss", _COULOMB)
    limit = sum(_limit(law, "mujoco-frictionloss") for law in parts.laws)
    return _mjcf(parts, parts.notes, parts.damping, limit, ())


def _mjcf(
    parts: Device, notes: Sequence[str], damping: float, limit: float, actuators: Sequence[str]
) -> str:
    given = {
        "armature": parts.mass, "damping": damping, "stiffness": parts.stiffness,
        "frictionloss": limit,
    }  # fmt: skip
    fields = "".join(f' {name}="{value!r}"' for name, value in given.items() if value)
    kind = "hinge" if parts.rotation else "slide"
    body = "1e-9" if parts.mass else "1"
    remark = "the fit has no mass; the body's is 1, to be replaced"
    if parts.mass:
        remark = "the mass, or inertia, of the fit is the armature; that of the body is negligible"
    lines = [
        "<!--", *(f"  {note.replace('--', '-')}" for note in notes),
        f"  {remark}",
        "-->", '<mujoco model="identified">',
        '  <option timestep="0.0001" integrator="implicitfast" gravity="0 0 0"/>', "  <worldbody>",
        '    <body name="body">',
        f'      <joint name="joint" type="{kind}" axis="1 0 0"{fields}/>',
        f'      <inertial pos="0 0 0" mass="{body}" diaginertia="{body} {body} {body}"/>',
        "    </body>",
        "  </worldbody>", *actuators, "</mujoco>",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def urdf(result: Any) -> str:
    """Return the dynamics of a joint, to be put into the joint of a robot."""
    carried = {**_COULOMB, "mass": "belongs to the inertial element of the link"}
    carried.pop("spring")
    parts = device(result, "urdf", carried)
    limit = sum(_limit(law, "urdf") for law in parts.laws)
    kind = "revolute" if parts.rotation else "prismatic"
    comment = "\n".join(f"  {note.replace('--', '-')}" for note in parts.notes)
    mass = f'<!-- <inertial><mass value="{parts.mass!r}"/></inertial> -->\n' if parts.mass else ""
    return (
        f"<!--\n{comment}\n  put it into the {kind} joint\n-->\n{mass}"
        f'<dynamics damping="{parts.damping!r}" friction="{limit!r}"/>\n'
    )


def _limit(law: Law, form: str) -> float:
    if law.values.get("asymmetry"):
        raise ModelError(f"{form} has one limit of friction for both directions, and the model two")
    return law["f_max"]


def modelica(result: Any) -> str:
    """Return a compliant component between two flanges; the mass is a constant in it."""
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
        *(f"// {note}" for note in parts.notes), 'model Friction "identified friction"',
        f"  extends Modelica.Mechanics.{base}.Interfaces.PartialCompliantWithRelativeStates;",
        *declared, "equation", *equations, f"  {out} = {' + '.join(total)};", "end Friction;",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _slope(law: Law, i: int, v: str) -> str:
    """Return the change of force over displacement as an expression of Modelica."""
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
    """Return a script that makes a struct: values, uncertainties, covariance, equations."""
    lines = [f"% the fit is {result.status.value}"]
    lines += [
        f"% {e.kind}: {e.equation}" for e in result.model.elements if getattr(e, "equation", "")
    ]
    held = {p.name: p.value for p in result.model.parameters}
    for name, p in result.params.items():
        value = held.get(name, p.value)
        lines.append(f"friction.{name} = {_matlab(value)};  % {p.unit}".rstrip(" %"))
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
