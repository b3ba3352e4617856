"""The engine: equations are compiled once, and every motion is one compiled integration."""

from __future__ import annotations

from dahl_ident.engine.motion import Marched, Settled, loops, march, settled, steady_motions
from dahl_ident.engine.sampled import (
    band_limited,
    differentiated,
    filter_window,
    noise_left,
    smoothed,
)
from dahl_ident.engine.translate import Equations, System, translate

__all__ = [
    "Equations",
    "Marched",
    "Settled",
    "System",
    "band_limited",
    "differentiated",
    "filter_window",
    "loops",
    "march",
    "noise_left",
    "settled",
    "smoothed",
    "steady_motions",
    "translate",
]
