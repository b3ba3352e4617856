"""Fits as JSON: data, model, noise, sensors and optimum.

The file states its schema and version. It contains only what does not depend on the version of the
package: table or records, the model as plain data, the estimate with its covariance. The version
that loads the file computes residuals, intervals and verdicts again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.columns import COLUMNS
from dahl_ident.data.storage import digest, plain_data
from dahl_ident.elements.element import describe_model, model_from_description
from dahl_ident.elements.law_files import describe_laws, require_laws
from dahl_ident.errors import DataError
from dahl_ident.fitting.optimum import ConstraintCost, DeterminedCombination, Optimum, Status
from dahl_ident.problem import Problem, TableProblem
from dahl_ident.problem.record_problem import RecordProblem
from dahl_ident.sensors import EXACT, Sensors
from dahl_ident.version import __version__

_SCHEMAS = {"table": "dahl_ident.fit_result", "records": "dahl_ident.record_fit"}
VERSION = 5  # version of the layout; any other is refused
_SAME = 1e-6  # relative tolerance; versions of numerical libraries differ by less

_TEXTS = ("level", "run", "controlled", "harmonic")  # labels, words and counts
_SENSORS = ("force_gain", "displacement_gain", "delay")
_CHANNELS = ("displacement", "velocity", "acceleration", "force", "drive")
_OF_RECORD = ("drive_unit", "drive_factor", "drive_factor_uncertainty", "motion", "provenance")
_OF_PROBLEM = ("output", "excitation", "calibration")  # as given by the user


def to_json(optimum: Optimum, first_order: bool, estimates: Mapping[str, Any] | None = None) -> str:
    """Return a fit as JSON text, with infinite numbers and NaN as text.

    `estimates` are for other readers of the file; loading the fit computes them again.
    """
    problem = optimum.problem
    facts = {
        "schema": _SCHEMAS[problem.kind],
        "schema_version": VERSION,
        "dahl_ident_version": __version__,
        "model": describe_model(problem.model),
        "laws": describe_laws(problem.model.elements),
        **_DESCRIBED[problem.kind](problem),
        **({} if estimates is None else {"estimates": estimates}),
        "optimum": _describe_optimum(optimum) | {"first_order": first_order},
    }
    content = plain_data(facts, not_finite=str)
    indent = None if problem.response is None else 1  # not one line for each sample
    return json.dumps({**content, "digest": digest(content)}, allow_nan=False, indent=indent)


def from_json(text: str, source: str = "the text") -> dict[str, Any]:
    """Return the arguments of the fit in JSON text."""
    try:
        content = json.loads(text)
    except (RecursionError, TypeError, ValueError) as exc:
        raise DataError(f"{source} is not JSON: {exc}; expected a saved fit") from exc
    _check(content, source)
    try:
        optimum = _optimum(_BUILT[content["schema"]](content), content["optimum"])
        first_order, laws = content["optimum"]["first_order"], content["laws"]
    except (KeyError, TypeError) as exc:
        raise DataError(
            f"{source} says {content['schema']}, version {VERSION}, but lacks or garbles {exc}; it "
            "may have been edited or cut short"
        ) from exc
    if laws and not first_order and not _agrees(optimum):
        raise DataError(
            f"{source}: the law {laws[0]['kind']!r} does not give the residuals that the fit was "
            "saved with; take the file of the law as it was, or repeat the fit"
        )
    return {"optimum": optimum, "first_order": first_order}


def _check(content: Any, source: str) -> None:
    """Refuse anything but an unchanged fit of this version of the layout."""
    stated = content.get("schema") if isinstance(content, Mapping) else None
    if stated not in [*_BUILT]:
        expected = " or ".join(map(repr, _BUILT))
        raise DataError(f"{source} has the schema {stated!r}; expected {expected}, a saved fit")
    version = content.get("schema_version")
    if type(version) is not int or version != VERSION:
        raise DataError(
            f"{source} has schema version {version!r}; this version of dahl_ident reads {VERSION}: "
            "load it with the version that wrote it, or repeat the fit"
        )
    if content.get("digest") != digest({k: v for k, v in content.items() if k != "digest"}):
        raise DataError(
            f"{source} was changed after the fit was saved: its data, model and estimate do not "
            "agree with each other; take the file as it was written, or repeat the fit"
        )
    require_laws(content.get("laws", ()), source)


def _agrees(optimum: Optimum) -> bool:
    """Return whether the model reproduces the values and the sum of squares of the estimate.

    This detects a change of a user's law. Estimates at a limit, and those with a robust loss, are
    not checked.
    """
    if optimum.status.at_infinity or optimum.loss != "linear":
        return True
    problem = optimum.problem
    cost = float(problem.quadratic(optimum.theta, 1.0).cost)
    same = np.allclose(problem.to_values(optimum.theta), optimum.values, rtol=_SAME, atol=0.0)
    least = problem.n_residuals * float(np.max(problem.rounding)) ** 2
    return bool(same and np.isclose(cost, optimum.cost, rtol=_SAME, atol=least))


def _describe_table(problem: TableProblem) -> dict[str, Any]:
    return {
        "data": _describe_data(problem.data),
        "noise": problem.noise,
        "steady": problem.steady,
        "sensors": {name: _describe_channel(getattr(problem.sensors, name)) for name in _SENSORS},
    }


def _table_problem(content: Mapping[str, Any]) -> TableProblem:
    sensors = Sensors(**{name: _channel(content["sensors"][name]) for name in _SENSORS})
    return TableProblem(
        _data(content["data"]),
        model_from_description(content["model"]),
        noise=content["noise"],
        sensors=EXACT if sensors.are_exact else sensors,
        steady=content["steady"],
    )


def _describe_records(problem: RecordProblem) -> dict[str, Any]:
    names = ("runs", *_OF_PROBLEM, "whitening", "delay", "is_smoothed", "displacement_noise")
    records = []
    for record in problem.records:
        channels = {c: x for c in _CHANNELS if (x := getattr(record, c)) is not None}
        others = {name: getattr(record, name) for name in _OF_RECORD}
        records.append({"time": record.time, **channels, **others})
    return {"records": records, **{name: getattr(problem, name) for name in names}}


def _record_problem(content: Mapping[str, Any]) -> RecordProblem:
    problem = RecordProblem(
        [Record(**record) for record in content["records"]],
        model_from_description(content["model"]),
        **{name: content[name] for name in _OF_PROBLEM},
    )
    problem.runs = tuple(content["runs"])
    problem = problem.with_whitening(_floats(content["whitening"]))
    problem = problem.smoothed(on=content["is_smoothed"]).delayed(content["delay"])
    return problem.without_noise(content["displacement_noise"])


_DESCRIBED: Mapping[str, Callable[[Any], dict[str, Any]]] = {
    "table": _describe_table,
    "records": _describe_records,
}
_BUILT: Mapping[str, Callable[[Mapping[str, Any]], Problem]] = {
    _SCHEMAS["table"]: _table_problem,
    _SCHEMAS["records"]: _record_problem,
}


def _describe_optimum(optimum: Optimum) -> dict[str, Any]:
    """Return an optimum as data, without its problem."""
    cost = optimum.constraint_cost
    combinations = [asdict(c) for c in optimum.combinations]
    stored = {field.name: getattr(optimum, field.name) for field in fields(optimum)}
    stored |= {"status": optimum.status.name, "combinations": combinations}
    stored["constraint_cost"] = None if cost is None else asdict(cost)
    for name in ("source", "index", "scale_known"):  # which follow from other entries
        del stored[name]
    return {"names": list(optimum.names), **stored}


def _optimum(problem: Problem, stored: Mapping[str, Any]) -> Optimum:
    """Return the optimum of a problem that :func:`_describe_optimum` described."""
    known = {name: value for name, value in stored.items() if name not in ("names", "first_order")}
    if list(problem.names) != stored["names"]:
        raise KeyError(f"the free parameters {stored['names']}, found {list(problem.names)}")
    cost = stored["constraint_cost"]
    known |= {name: _floats(known[name]) for name in ("theta", "values", "covariance")}
    known |= {name: float(known[name]) for name in ("scale", "cost")}
    known["status"] = Status[stored["status"]]
    known["combinations"] = tuple(
        DeterminedCombination(c["expression"], float(c["value"]), float(c["stderr"]))
        for c in stored["combinations"]
    )
    if cost is not None:
        rise, dof = float(cost["rise"]), float(cost["dof"])
        known["constraint_cost"] = ConstraintCost(tuple(cost["texts"]), rise, dof)
    return Optimum(source=problem, scale_known=problem.scale_known, **known)


def _describe_data(data: FrequencyResponse) -> dict[str, Any]:
    columns = {name: getattr(data, name) for name in COLUMNS if name != "response"}
    return {
        "quantity": data.quantity,
        "motion": data.motion,
        "drive_factor_uncertainty": data.drive_factor_uncertainty,
        "real": data.response.real,
        "imag": data.response.imag,
        **{name: column for name, column in columns.items() if column is not None},
        "quality": data.quality,
        "provenance": data.provenance,
    }


def _data(content: Mapping[str, Any]) -> FrequencyResponse:
    columns = {
        name: content[name] if name in _TEXTS else _floats(content[name])
        for name in COLUMNS
        if name in content
    }
    return FrequencyResponse(
        response=_floats(content["real"]) + 1j * _floats(content["imag"]),
        quantity=content["quantity"],
        motion=content["motion"],
        drive_factor_uncertainty=content.get("drive_factor_uncertainty", 0.0),
        quality=content["quality"],
        provenance=content["provenance"],
        **columns,
    )


def _describe_channel(channel: Any) -> Any:
    if channel is None or isinstance(channel, float):
        return channel
    return {"norm": [float(channel.mean()), float(channel.std())]}  # a fit takes no other prior


def _channel(content: Any) -> Any:
    if not isinstance(content, Mapping):
        return content
    from scipy import stats

    mean, std = content["norm"]
    return stats.norm(mean, std)


def _floats(values: Any) -> FloatArray:
    return np.array(values, dtype=np.float64) if values else np.zeros(0)
