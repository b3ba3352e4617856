"""Responses of plants with friction to a sinusoidal force, and friction in control engineering.

Systems of python-control can be used in models as :class:`~dahl_ident.elements.LinearSystem`
elements; most of this subpackage goes in the other direction. Names are imported when first used,
because python-control is slow to import.

- :func:`response` gives the steady response of a plant with known parameters; for estimation,
  :func:`~dahl_ident.control_interop.force_balance.solve` balances fundamentals only.
- :func:`level_responses` gives responses over frequency at several levels, as FRD or plots, and
  :func:`response_branches` every steady response of an active plant, with its stability.
- :class:`FrictionNonlinearity` puts friction into python-control's describing-function tools.
- :func:`limit_cycles` finds the limit cycles of a loop, and which of them are stable.
- :func:`equivalent_plant` and :func:`loop_margins` help to design a controller: the linear plant
  at one amplitude, and the loop's margins against amplitude.
- :func:`closed_loop_response` prepares data of a plant that was measured in closed loop.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dahl_ident.control_interop.cycles import LimitCycle, LimitCycles, limit_cycles
    from dahl_ident.control_interop.levels import (
        Branches,
        LevelResponses,
        level_responses,
        response_branches,
    )
    from dahl_ident.control_interop.linearization import (
        FrictionNonlinearity,
        LoopMargins,
        closed_loop_response,
        equivalent_plant,
        loop_margins,
    )
    from dahl_ident.control_interop.steady_response import SteadyResponse, response

_FILES = {
    "levels": "Branches LevelResponses level_responses response_branches",
    "cycles": "LimitCycle LimitCycles limit_cycles",
    "linearization": "FrictionNonlinearity LoopMargins closed_loop_response equivalent_plant "
    "loop_margins",
    "steady_response": "SteadyResponse response",
}
_HOME = {name: file for file, names in _FILES.items() for name in names.split()}

__all__ = [
    "Branches",
    "FrictionNonlinearity",
    "LevelResponses",
    "LimitCycle",
    "LimitCycles",
    "LoopMargins",
    "SteadyResponse",
    "closed_loop_response",
    "equivalent_plant",
    "level_responses",
    "limit_cycles",
    "loop_margins",
    "response",
    "response_branches",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"dahl_ident.control_interop.{_HOME[name]}"), name)
    globals()[name] = value
    return value
