"""Friction in control engineering: loops, limit cycles, margins, branches.

Systems of python-control can be used in models as :class:`~dahl_ident.elements.LinearSystem`
elements; this subpackage goes in the other direction.

- :class:`FrictionNonlinearity` puts friction into python-control's describing-function tools.
- :func:`limit_cycles` finds the free oscillations of a loop, and which of them are stable.
- :func:`level_responses` gives responses over frequency at several levels, as FRD or plots.
- :func:`equivalent_plant` and :func:`loop_margins` help to design a controller: the linear plant
  at one amplitude, and the loop's margins against amplitude.
- :func:`response_branches` gives every steady response of an active plant, with its stability.
- :func:`closed_loop_response` prepares data of a plant that was measured under feedback.
"""

from __future__ import annotations

from dahl_ident.control_interop.levels import (
    Branches,
    LevelResponses,
    level_responses,
    response_branches,
)
from dahl_ident.control_interop.limit_cycles import LimitCycle, LimitCycles, limit_cycles
from dahl_ident.control_interop.linear_part import closed_loop_response
from dahl_ident.control_interop.linearization import LoopMargins, equivalent_plant, loop_margins
from dahl_ident.control_interop.nonlinearity import FrictionNonlinearity

__all__ = [
    "Branches",
    "FrictionNonlinearity",
    "LevelResponses",
    "LimitCycle",
    "LimitCycles",
    "LoopMargins",
    "closed_loop_response",
    "equivalent_plant",
    "level_responses",
    "limit_cycles",
    "loop_margins",
    "response_branches",
]
