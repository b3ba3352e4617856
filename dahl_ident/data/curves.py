"""Curves of a frequency response: the choice of axis, and of the rows of each curve.

The plot functions belong to a higher layer, and are imported when a plot is requested.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.columns import Table, backbone_std
from dahl_ident.errors import ValidationError
from dahl_ident.units import engineering, polar_std, si_unit

if TYPE_CHECKING:
    import pandas as pd

_SAME_FREQUENCY = 5e-3  # largest relative difference of frequencies that count as equal
_NOMINAL = 1.5  # factor within which a numeric level is the controlled amplitude


Stds = tuple[FloatArray | None, FloatArray | None]


def draw(
    data: Table,
    ax: Any = None,
    *,
    stds: Callable[[Table], Stds] | None = None,
    fitted: Callable[[Table, bool], Any] | None = None,
) -> tuple[Any, Any]:
    """Draw gain and phase of the fundamental, or a backbone, over amplitude or frequency.

    `stds` gives the standard deviations of gain and phase of some rows, by default those of their
    covariance; `fitted` gives a curve through some rows, over frequency or over amplitude.
    """
    from dahl_ident.plots import plot_amplitude_response, plot_backbone, plot_frequency_response

    if data.quantity == "backbone":
        rows = [
            ("natural frequency [Hz]", data.frequency_hz, backbone_std(data, 0)),
            ("damping ratio [1]", data.response.imag, backbone_std(data, 1)),
        ]
        return plot_backbone(held_amplitude(data), rows, amplitude_label=held_label(data), ax=ax)

    def errors(part: Table) -> Stds:
        if stds is not None:
            return stds(part)
        if part.covariance is None:
            return None, None
        return polar_std(part.response, part.covariance)

    fundamental = data.select(harmonic=1)
    over_frequency = is_over_frequency(fundamental)
    parts = curves(fundamental)
    if over_frequency or len(parts) > 1:
        return plot_frequency_response(
            [(name, abscissa(part, over_frequency), part.response) for name, part in parts],
            errors=[errors(part) for _, part in parts],
            fitted=[] if fitted is None else [fitted(part, over_frequency) for _, part in parts],
            gain_label=gain_label(data),
            x_label="frequency [Hz]" if over_frequency else held_label(fundamental),
            marker="." if fitted is None else "",
            ax=ax,
        )
    gain_std, phase_std = errors(fundamental)
    return plot_amplitude_response(
        held_amplitude(fundamental),
        fundamental.response,
        gain_std=gain_std,
        phase_std=phase_std,
        curve=None if fitted is None else fitted(fundamental, over_frequency),
        amplitude_label=held_label(fundamental),
        gain_label=gain_label(data),
        ax=ax,
    )


def draw_waveforms(time: FloatArray, frame: pd.DataFrame, kind: str, ax: Any = None) -> Any:
    """Draw waveforms or loops of a record's table; see :meth:`Record.plot`."""
    from dahl_ident.plots import plot_recorded_loops, plot_waveforms

    labels = [str(name) for name in frame.columns[1:]]
    if kind == "waveforms":
        return plot_waveforms(time, [(name, frame[name]) for name in labels], ax=ax)
    if kind == "loops":
        motion, force = labels[:2]
        return plot_recorded_loops(
            frame[motion], frame[force], displacement_label=motion, force_label=force, ax=ax
        )
    raise ValidationError(f"kind is {kind!r}; expected 'waveforms' or 'loops'")


def is_force_controlled(data: Table) -> bool:
    """Return whether the force was controlled in most rows."""
    return bool(np.mean(data.controlled == "force") > 0.5)


def held_amplitude(data: Table) -> FloatArray:
    """Return the controlled amplitude, or the other one if that is unknown."""
    amplitudes = [data.amplitude, data.drive][:: -1 if is_force_controlled(data) else 1]
    return np.asarray(next(size for size in amplitudes if size is not None))


def held_label(data: Table) -> str:
    """Return the axis label of the controlled amplitude."""
    kind = _held_kind(data)
    return f"{kind} amplitude [{si_unit(kind, data.motion)}]"


def _held_kind(data: Table) -> str:
    return "force" if held_amplitude(data) is data.drive else "displacement"


def gain_label(data: Table) -> str:
    """Return the axis label of the gain."""
    return f"{data.quantity.replace('_', ' ')} [{data.unit}]"


def is_over_frequency(data: Table) -> bool:
    """Return whether curves over frequency suit the table better than curves over amplitude."""
    parts = [data.select(level=label) for label in data.levels] or [data]
    return all(
        2 * np.unique(_nominal_frequency(part.frequency_hz)).size > part.n > 1 for part in parts
    )


def curves(data: Table) -> list[tuple[str, Table]]:
    """Return the part of the table for each curve, with its label."""
    if is_over_frequency(data):
        levels = [(label, data.select(level=label)) for label in data.levels]
        return [(_level(label, part), part) for label, part in levels] or [("", data)]
    nominal = _nominal_frequency(data.frequency_hz)
    return [(f"{f:.4g} Hz", data.select(rows=nominal == f)) for f in np.unique(nominal)]


def curve_of_row(data: Table) -> FloatArray:
    """Return a number for each row that identifies its curve: frequency, or index of the level."""
    if not is_over_frequency(data):
        return _nominal_frequency(data.frequency_hz)
    if data.level is None:
        return np.zeros(data.n)
    return np.array([data.levels.index(label) for label in data.level.tolist()], dtype=float)


def abscissa(part: Table, over_frequency: bool) -> FloatArray:
    """Return the abscissae of some rows."""
    return part.frequency_hz if over_frequency else held_amplitude(part)


def _level(label: Any, part: Table) -> str:
    """Return the label of a level, with a unit if the level is the controlled amplitude."""
    if not isinstance(label, (int, float)):
        return str(label)
    held = float(np.median(held_amplitude(part)))
    if not held / _NOMINAL < label < held * _NOMINAL:
        return f"{label:g}"
    return engineering(float(label), si_unit(_held_kind(part), part.motion))


def _nominal_frequency(f: FloatArray) -> FloatArray:
    """Return frequencies; those that differ only by measurement error become one."""
    order = np.argsort(f)
    jump = np.diff(f[order], prepend=f[order][0]) > _SAME_FREQUENCY * f[order]
    group = np.empty(f.size, dtype=int)
    group[order] = np.cumsum(jump)
    members = [f[group == g] for g in range(group.max() + 1)]
    if any(np.ptp(m) > 2.0 * _SAME_FREQUENCY * m.min() for m in members):
        return f
    return np.array([np.median(m) for m in members])[group]
