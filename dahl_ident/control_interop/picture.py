"""The one look upwards: results draw themselves with the functions of the plotting room."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dahl_ident.errors import ValidationError
from dahl_ident.units import si_unit

if TYPE_CHECKING:
    from dahl_ident.control_interop.equivalent import LoopMargins
    from dahl_ident.control_interop.levels import LevelResponses


def draw_levels(data: LevelResponses, kind: str, ax: Any) -> Any:
    """Draw responses; see :meth:`LevelResponses.plot`."""
    from dahl_ident.plots import plot_frequency_response
    from dahl_ident.plots.loops import plot_nichols, plot_nyquist

    unit = "N" if data.controlled == "force" else "m"
    label = f"{data.quantity.replace('_', ' ')} [{si_unit(data.quantity)}]"
    rows = [
        (f"{level:.3g} {unit}", data.frequency_hz, row)
        for level, row in zip(data.levels.tolist(), data.response, strict=True)
    ]
    if kind == "bode":
        return plot_frequency_response(rows, gain_label=label, ax=ax)
    curves = [(name, row) for name, _, row in rows]
    if kind == "nyquist":
        return plot_nyquist(curves, label=label, ax=ax)
    if kind == "nichols":
        return plot_nichols(curves, gain_label=label, ax=ax)
    raise ValidationError(f"kind is {kind!r}; expected 'bode', 'nyquist' or 'nichols'")


def draw_margins(margins: LoopMargins, ax: Any) -> tuple[Any, Any]:
    """Draw margins; see :meth:`LoopMargins.plot`."""
    from dahl_ident.plots.loops import plot_margins

    if margins.gain_margin.ndim == 1:
        return plot_margins(margins.amplitude, margins.gain_margin, margins.phase_margin_deg, ax=ax)
    return plot_margins(
        margins.amplitude,
        margins.band("gain_margin", 0.0)[0],
        margins.band("phase_margin_deg", 0.0)[0],
        gain_band=margins.band("gain_margin"),
        phase_band=margins.band("phase_margin_deg"),
        ax=ax,
    )
