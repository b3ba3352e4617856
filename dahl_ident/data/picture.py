"""The one look upwards: a table draws itself with the functions of the plotting room.

The import happens when a picture is asked for, so that data stay light; the contract between the
rooms names this exception.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.data.quantities import polar_std
from dahl_ident.units import si_unit

if TYPE_CHECKING:
    from dahl_ident.data.frequency_response import FrequencyResponse


def draw_response(data: FrequencyResponse, ax: Any = None) -> tuple[Any, Any]:
    """Draw gain and phase; see :meth:`FrequencyResponse.plot`."""
    from dahl_ident.plots import plot_amplitude_response, plot_frequency_response

    fundamental = data.select(harmonic=1)
    gain_label = f"{data.quantity.replace('_', ' ')} [{data.unit}]"
    parts = [(label, fundamental.select(level=label)) for label in fundamental.levels]
    parts = parts or [("", fundamental)]
    if any(np.unique(part.frequency_hz).size > 1 for _, part in parts):
        curves = [(str(label), part.frequency_hz, part.response) for label, part in parts]
        return plot_frequency_response(curves, gain_label=gain_label, marker=".", ax=ax)
    gain_std = phase_std = None
    if fundamental.covariance is not None:
        gain_std, phase_std = polar_std(fundamental.response, fundamental.covariance)
    amplitude, axis = fundamental.amplitude, "displacement"
    if amplitude is None:
        amplitude, axis = fundamental.drive, "force"
    assert amplitude is not None  # one of the two is always there
    return plot_amplitude_response(
        amplitude,
        fundamental.response,
        gain_std=gain_std,
        phase_std=phase_std,
        amplitude_label=f"{axis} amplitude [{si_unit(axis, data.motion)}]",
        gain_label=gain_label,
        ax=ax,
    )
