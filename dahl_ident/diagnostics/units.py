"""Units as they are shown: those of a parameter, in translation or rotation."""

from __future__ import annotations

from dahl_ident.units import Motion

_ROTATION = {
    "N": "N m",
    "m": "rad",
    "N/m": "N m/rad",
    "N/m^2": "N m/rad^2",
    "N s/m": "N m s/rad",
    "kg": "kg m^2",
}


def shown_unit(unit: str, motion: Motion) -> str:
    """Return a translational unit as it is written for `motion`."""
    return _ROTATION.get(unit, unit) if motion == "rotation" else unit
