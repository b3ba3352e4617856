"""Models as plain data and back, so that results and experiments can be written to a file."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from dahl_ident.elements.dahl import Dahl
from dahl_ident.elements.element import Element
from dahl_ident.elements.linear import Damper, Mass, Spring
from dahl_ident.elements.linear_system import LinearSystem
from dahl_ident.elements.model import Model, as_model
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError

_KINDS: dict[str, type[Element]] = {
    "dahl": Dahl,
    "mass": Mass,
    "damper": Damper,
    "spring": Spring,
}


def describe_model(model: Element) -> list[dict[str, Any]]:
    """Return a model as a list of plain dicts, ready for JSON or TOML.

    Parameters
    ----------
    model : Element
        One element or a sum.

    Returns
    -------
    list of dict
        One an element: its kind, its name if it has one, and its parameters; a number is a
        fixed value, "free" a parameter to estimate, a table a free one with its start.

    Raises
    ------
    ModelError
        If the model holds a linear system built by a function, which no file can hold.

    Examples
    --------
    >>> describe_model(Dahl(sigma=30.0) + Mass(0.3))
    [{'kind': 'dahl', 'f_max': 'free', 'sigma': 30.0, 'alpha': 1.0}, {'kind': 'mass', 'mass': 0.3}]
    """
    return [_describe(element) for element in as_model(model).elements]


def model_from_description(description: list[Mapping[str, Any]]) -> Model:
    """Return the model that :func:`describe_model` described.

    Parameters
    ----------
    description : list of mapping
        Elements as plain data.

    Returns
    -------
    Model
        Equal in every parameter.

    Raises
    ------
    ModelError
        If a kind or a key is unknown.

    Examples
    --------
    >>> model_from_description([{"kind": "spring", "stiffness": "free"}])
    Spring(stiffness=free)
    """
    return Model(*(_build(entry) for entry in description))


def _describe(element: Element) -> dict[str, Any]:
    if isinstance(element, LinearSystem):
        return _describe_linear_system(element)
    kinds = [kind for kind, cls in _KINDS.items() if type(element) is cls]
    if not kinds:
        raise ModelError(f"{element!r} cannot be written to a file; it is no element of this kind")
    entry: dict[str, Any] = {"kind": kinds[0]}
    if element.name:
        entry["name"] = element.name
    for parameter in element.parameters:
        label = parameter.name.removeprefix(f"{element.name}_")
        entry[label] = _describe_parameter(parameter)
    return entry


def _describe_parameter(parameter: Parameter) -> Any:
    if not parameter.free:
        return parameter.value
    limits = {"lower": parameter.lower, "upper": parameter.upper}
    bounds = {k: v for k, v in limits.items() if math.isfinite(v) and (k, v) != ("lower", 0.0)}
    if parameter.value is None and not bounds:
        return "free"
    start = {} if parameter.value is None else {"start": parameter.value}
    return {"free": True, **start, **bounds}


def _build(entry: Mapping[str, Any]) -> Element:
    rest = dict(entry)
    kind = rest.pop("kind", None)
    name = rest.pop("name", None)
    if kind == "linear_system":
        return _build_linear_system(rest, name)
    if kind not in _KINDS:
        raise ModelError(
            f"the element {dict(entry)} has the kind {kind!r}; expected one of "
            f"{', '.join(_KINDS)}, linear_system"
        )
    element = _KINDS[kind](name=name)  # type: ignore[call-arg]  # every kind takes a name
    prefix = f"{name}_" if name else ""
    known = {p.name: p for p in element.parameters}
    unknown = [label for label in rest if prefix + label not in known]
    if unknown:
        raise ModelError(
            f"the {kind} element has the keys {', '.join(unknown)}; expected "
            f"{', '.join(n.removeprefix(prefix) for n in known)}"
        )
    changes = {prefix + k: _read_parameter(known[prefix + k], v) for k, v in rest.items()}
    (built,) = Model(element).with_parameters(changes).elements
    return built


def _read_parameter(parameter: Parameter, given: Any) -> Parameter:
    if given == "free":
        return Parameter(
            parameter.name, parameter.unit, parameter.description,
            lower=parameter.lower, upper=parameter.upper, transform=parameter.transform,
        )  # fmt: skip
    if isinstance(given, Mapping):
        return Parameter(
            parameter.name, parameter.unit, parameter.description, given.get("start"), True,
            given.get("lower", parameter.lower), given.get("upper", parameter.upper),
            parameter.transform,
        )  # fmt: skip
    return parameter.fixed(given)


def _describe_linear_system(element: LinearSystem) -> dict[str, Any]:
    if element.parameters:
        raise ModelError(
            f"{element!r} is built by a function, which no file can hold; give it as a fixed "
            "python-control system"
        )
    control = importlib.import_module("control")
    system = element.system
    entry: dict[str, Any] = {"kind": "linear_system", "quantity": element.quantity}
    if element.name:
        entry["name"] = element.name
    if isinstance(system, control.FRD):
        response = np.ravel(system(1j * np.asarray(system.omega)))
        return entry | {
            "omega": np.asarray(system.omega).tolist(),
            "real": response.real.tolist(),
            "imag": response.imag.tolist(),
        }
    entry["dt"] = system.dt
    if isinstance(system, control.TransferFunction):
        numerator, denominator = system.num[0][0], system.den[0][0]
        return entry | {"numerator": list(numerator), "denominator": list(denominator)}
    return entry | {key: np.asarray(getattr(system, key)).tolist() for key in "ABCD"}


def _build_linear_system(rest: dict[str, Any], name: str | None) -> LinearSystem:
    control = importlib.import_module("control")
    try:
        if "omega" in rest:
            response = np.asarray(rest["real"]) + 1j * np.asarray(rest["imag"])
            system = control.FRD(response, rest["omega"])
        elif "numerator" in rest:
            system = control.TransferFunction(rest["numerator"], rest["denominator"], rest["dt"])
        else:
            system = control.StateSpace(rest["A"], rest["B"], rest["C"], rest["D"], rest["dt"])
        return LinearSystem(system, quantity=rest["quantity"], name=name)
    except KeyError as exc:
        raise ModelError(
            f"the linear_system element has no {exc.args[0]}; expected quantity with omega, real "
            "and imag, with numerator, denominator and dt, or with A, B, C, D and dt"
        ) from None
