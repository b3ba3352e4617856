"""The one look upwards: a table draws itself with the functions of the plotting room.

The import happens when a picture is asked for, so that data stay light; the contract between the
rooms names this exception.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dahl_ident.data import layout
from dahl_ident.data.quantities import polar_std

if TYPE_CHECKING:
    from dahl_ident.data.frequency_response import FrequencyResponse


def draw_response(data: FrequencyResponse, ax: Any = None) -> tuple[Any, Any]:
    """Draw gain and phase; see :meth:`FrequencyResponse.plot`."""
    from dahl_ident.plots import plot_amplitude_response, plot_frequency_response

    fundamental = data.select(harmonic=1)
    over_frequency = layout.is_over_frequency(fundamental)
    parts = layout.curves(fundamental)
    if over_frequency or len(parts) > 1:
        return plot_frequency_response(
            [(name, layout.abscissa(part, over_frequency), part.response) for name, part in parts],
            errors=[_stds(part) for _, part in parts],
            gain_label=layout.gain_label(data),
            x_label=layout.abscissa_label(fundamental),
            marker=".",
            ax=ax,
        )
    gain_std, phase_std = _stds(fundamental)
    return plot_amplitude_response(
        layout.held_amplitude(fundamental),
        fundamental.response,
        gain_std=gain_std,
        phase_std=phase_std,
        amplitude_label=layout.held_label(fundamental),
        gain_label=layout.gain_label(data),
        ax=ax,
    )


def _stds(data: FrequencyResponse) -> tuple[Any, Any]:
    return (None, None) if data.covariance is None else polar_std(data.response, data.covariance)
