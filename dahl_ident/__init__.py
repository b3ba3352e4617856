"""Identify friction from measurements: parameters, their uncertainty, and what is not determined.

``import dahl_ident as di`` provides the names that are used most; each is loaded when first used,
so that the import itself stays fast. The others are in subpackages: ``di.control`` (friction in
control loops), ``di.synthetic`` (data with known truth) and ``di.errors``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from dahl_ident.version import __version__ as __version__

if TYPE_CHECKING:
    import dahl_ident.control_interop as control
    from dahl_ident import errors, synthetic
    from dahl_ident.campaigns.population import population
    from dahl_ident.campaigns.run import campaign
    from dahl_ident.control_interop import response
    from dahl_ident.data import FrequencyResponse, Record, read_frequency_response, read_record
    from dahl_ident.diagnostics import compare_models
    from dahl_ident.elements import (
        Backlash,
        BoucWen,
        Dahl,
        Damper,
        Element,
        Friction,
        Iwan,
        LinearSystem,
        LuGre,
        Mass,
        MaxwellSlip,
        Model,
        Parameter,
        PowerDamper,
        Spring,
    )
    from dahl_ident.extraction import extract
    from dahl_ident.planning import plan
    from dahl_ident.reporting import report
    from dahl_ident.results import FitResult, fit, fit_many, posterior
    from dahl_ident.sensors import Sensors
    from dahl_ident.synthetic import Experiment, load_dataset, simulate


_ROOMS = {
    "campaigns.population": "population",
    "campaigns.run": "campaign",
    "control_interop": "response",
    "data": "FrequencyResponse Record read_frequency_response read_record",
    "diagnostics": "compare_models",
    "elements": "Backlash BoucWen Dahl Damper Element Friction Iwan LinearSystem LuGre Mass "
    "MaxwellSlip Model Parameter PowerDamper Spring",
    "extraction": "extract",
    "planning": "plan",
    "reporting": "report",
    "results": "FitResult fit fit_many posterior",
    "sensors": "Sensors",
    "synthetic": "Experiment load_dataset simulate",
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names.split()}
_MODULES = {"control": "control_interop", "errors": "errors", "synthetic": "synthetic"}

__all__ = [
    "Backlash",
    "BoucWen",
    "Dahl",
    "Damper",
    "Element",
    "Experiment",
    "FitResult",
    "FrequencyResponse",
    "Friction",
    "Iwan",
    "LinearSystem",
    "LuGre",
    "Mass",
    "MaxwellSlip",
    "Model",
    "Parameter",
    "PowerDamper",
    "Record",
    "Sensors",
    "Spring",
    "campaign",
    "compare_models",
    "control",
    "errors",
    "extract",
    "fit",
    "fit_many",
    "load_dataset",
    "plan",
    "population",
    "posterior",
    "read_frequency_response",
    "read_record",
    "report",
    "response",
    "simulate",
    "synthetic",
]


def __getattr__(name: str) -> Any:
    value: Any
    if name in _MODULES:
        value = importlib.import_module(f"dahl_ident.{_MODULES[name]}")
    elif name in _HOME:
        value = getattr(importlib.import_module(f"dahl_ident.{_HOME[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
