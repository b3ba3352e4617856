"""How a table is best laid out on paper: over which axis, and which rows make one curve."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.units import engineering, si_unit

if TYPE_CHECKING:
    from dahl_ident.data.frequency_response import FrequencyResponse

_SAME_FREQUENCY = 5e-3  # relative
_NOMINAL = 1.5  # factor within which a numeric level is the amplitude that was held


def is_force_controlled(data: FrequencyResponse) -> bool:
    """Return whether most rows were driven by force."""
    return bool(np.mean(data.controlled == "force") > 0.5)


def held_amplitude(data: FrequencyResponse) -> FloatArray:
    """Return the amplitude that the laboratory held, or the other one where that is unknown."""
    held, other = data.amplitude, data.drive
    if is_force_controlled(data):
        held, other = other, held
    found = other if held is None else held
    assert found is not None  # a table has one of the two
    return found


def held_label(data: FrequencyResponse) -> str:
    """Return the axis label of that amplitude."""
    kind = "force" if held_amplitude(data) is data.drive else "displacement"
    return f"{kind} amplitude [{si_unit(kind, data.motion)}]"


def gain_label(data: FrequencyResponse) -> str:
    """Return the axis label of the gain."""
    return f"{data.quantity.replace('_', ' ')} [{data.unit}]"


def is_over_frequency(data: FrequencyResponse) -> bool:
    """Return whether curves over frequency suit the table better than curves over amplitude."""
    parts = [data.select(level=label) for label in data.levels] or [data]
    return all(
        2 * np.unique(_nominal_frequency(part.frequency_hz)).size > part.n > 1 for part in parts
    )


def curves(data: FrequencyResponse) -> list[tuple[str, FrequencyResponse]]:
    """Return the parts of the table that make one curve each, with their labels.

    One a level over frequency, or one a frequency over amplitude.
    """
    if is_over_frequency(data):
        levels = [(label, data.select(level=label)) for label in data.levels]
        return [(_level(label, part), part) for label, part in levels] or [("", data)]
    nominal = _nominal_frequency(data.frequency_hz)
    return [(f"{f:.4g} Hz", data.select(rows=nominal == f)) for f in np.unique(nominal)]


def curve_of_row(data: FrequencyResponse) -> FloatArray:
    """Return for each row the frequency or the level's index that it shares with its curve."""
    if not is_over_frequency(data):
        return _nominal_frequency(data.frequency_hz)
    if data.level is None:
        return np.zeros(data.n)
    return np.array([data.levels.index(label) for label in data.level.tolist()], dtype=float)


def abscissa(part: FrequencyResponse, over_frequency: bool) -> FloatArray:
    """Return the places of some rows on the axis."""
    return part.frequency_hz if over_frequency else held_amplitude(part)


def abscissa_label(data: FrequencyResponse) -> str:
    """Return the label of the axis that suits the table."""
    return "frequency [Hz]" if is_over_frequency(data) else held_label(data)


def _level(label: Any, part: FrequencyResponse) -> str:
    """Return a level with a unit where it is the amplitude that was held, not just a name."""
    if not isinstance(label, (int, float)):
        return str(label)
    held = float(np.median(held_amplitude(part)))
    if not held / _NOMINAL < label < held * _NOMINAL:
        return f"{label:g}"
    kind = "force" if held_amplitude(part) is part.drive else "displacement"
    return engineering(float(label), si_unit(kind, part.motion))


def _nominal_frequency(f: FloatArray) -> FloatArray:
    """Return frequencies that differ by measurement alone as one; those of a fine grid as given."""
    order = np.argsort(f)
    jump = np.diff(f[order], prepend=f[order][0]) > _SAME_FREQUENCY * f[order]
    group = np.empty(f.size, dtype=int)
    group[order] = np.cumsum(jump)
    members = [f[group == g] for g in range(group.max() + 1)]
    if any(np.ptp(m) > 2.0 * _SAME_FREQUENCY * m.min() for m in members):
        return f
    return np.array([np.median(m) for m in members])[group]
