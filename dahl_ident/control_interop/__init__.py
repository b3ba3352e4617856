"""Friction among control engineers' objects: loops, limit cycles, margins, branches.

python-control's systems come in as :class:`~dahl_ident.elements.LinearSystem` elements; this
room is the way back.

- :class:`DahlNonlinearity` puts friction into python-control's describing-function tools.
- :func:`limit_cycles` finds the free oscillations of a loop, and which of them are approached.
"""

from __future__ import annotations

from dahl_ident.control_interop.limit_cycles import LimitCycle, limit_cycles
from dahl_ident.control_interop.nonlinearity import DahlNonlinearity

__all__ = ["DahlNonlinearity", "LimitCycle", "limit_cycles"]
