"""The plant in time: equations of motion, driven by any force or base motion."""

from __future__ import annotations

from dahl_ident.time_domain.differentiation import differentiated
from dahl_ident.time_domain.drive import band_limited
from dahl_ident.time_domain.forced_motion import ForcedMotion
from dahl_ident.time_domain.plant import Excitation, Plant

__all__ = ["Excitation", "ForcedMotion", "Plant", "band_limited", "differentiated"]
