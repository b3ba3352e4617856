"""Identify Dahl friction from sine-sweep measurements.

``import dahl_ident as di`` gives every public name; each is loaded when first used, so that
the import itself stays light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dahl_ident.control_interop import (
        DahlNonlinearity,
        closed_loop_response,
        equivalent_plant,
        level_responses,
        limit_cycles,
        loop_margins,
        response_branches,
    )
    from dahl_ident.data import FrequencyResponse, Record, read_frequency_response, read_record
    from dahl_ident.diagnostics import compare_models, identifiability
    from dahl_ident.elements import Dahl, Damper, LinearSystem, Mass, Model, Spring
    from dahl_ident.errors import (
        DahlIdentError,
        DataError,
        DataWarning,
        ExtractionError,
        FitError,
        MissingDependencyError,
        ModelError,
        MultipleSolutionsWarning,
        SamplingError,
        UnitError,
        ValidationError,
    )
    from dahl_ident.extraction import extract
    from dahl_ident.problem import Problem
    from dahl_ident.reporting import report
    from dahl_ident.results import (
        FitBatch,
        FitResult,
        Posterior,
        fit,
        fit_many,
        posterior_grid,
        sample,
    )
    from dahl_ident.sensors import Sensors
    from dahl_ident.steady_state import response
    from dahl_ident.synthetic import load_dataset, simulate

__version__ = "0.1.0"

_ROOMS = {
    "dahl_ident.control_interop": (
        "DahlNonlinearity",
        "closed_loop_response",
        "equivalent_plant",
        "level_responses",
        "limit_cycles",
        "loop_margins",
        "response_branches",
    ),
    "dahl_ident.data": (
        "FrequencyResponse",
        "Record",
        "read_frequency_response",
        "read_record",
    ),
    "dahl_ident.diagnostics": ("compare_models", "identifiability"),
    "dahl_ident.elements": ("Dahl", "Damper", "LinearSystem", "Mass", "Model", "Spring"),
    "dahl_ident.errors": (
        "DahlIdentError",
        "DataError",
        "DataWarning",
        "ExtractionError",
        "FitError",
        "MissingDependencyError",
        "ModelError",
        "MultipleSolutionsWarning",
        "SamplingError",
        "UnitError",
        "ValidationError",
    ),
    "dahl_ident.extraction": ("extract",),
    "dahl_ident.problem": ("Problem",),
    "dahl_ident.reporting": ("report",),
    "dahl_ident.results": (
        "FitBatch",
        "FitResult",
        "Posterior",
        "fit",
        "fit_many",
        "posterior_grid",
        "sample",
    ),
    "dahl_ident.sensors": ("Sensors",),
    "dahl_ident.steady_state": ("response",),
    "dahl_ident.synthetic": ("load_dataset", "simulate"),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = [
    "Dahl",
    "DahlIdentError",
    "DahlNonlinearity",
    "Damper",
    "DataError",
    "DataWarning",
    "ExtractionError",
    "FitBatch",
    "FitError",
    "FitResult",
    "FrequencyResponse",
    "LinearSystem",
    "Mass",
    "MissingDependencyError",
    "Model",
    "ModelError",
    "MultipleSolutionsWarning",
    "Posterior",
    "Problem",
    "Record",
    "SamplingError",
    "Sensors",
    "Spring",
    "UnitError",
    "ValidationError",
    "closed_loop_response",
    "compare_models",
    "equivalent_plant",
    "extract",
    "fit",
    "fit_many",
    "identifiability",
    "level_responses",
    "limit_cycles",
    "load_dataset",
    "loop_margins",
    "posterior_grid",
    "read_frequency_response",
    "read_record",
    "report",
    "response",
    "response_branches",
    "sample",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
