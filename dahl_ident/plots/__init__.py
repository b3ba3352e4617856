"""Pictures. Every function takes plain numbers and ``ax=``, draws, and returns the axes."""

from __future__ import annotations

from matplotlib.axes import Axes

from dahl_ident.plots.frequency import plot_frequency_response
from dahl_ident.plots.friction import (
    plot_amplitude_response,
    plot_loops,
    plot_universal_curve,
)
from dahl_ident.plots.gain_phase import Curve
from dahl_ident.plots.judging import (
    plot_correlation,
    plot_information,
    plot_profile,
    plot_residuals,
)
from dahl_ident.plots.posterior import plot_corner, plot_trace
from dahl_ident.plots.quality import plot_cycles

__all__ = [
    "Axes",
    "Curve",
    "plot_amplitude_response",
    "plot_corner",
    "plot_correlation",
    "plot_cycles",
    "plot_frequency_response",
    "plot_information",
    "plot_loops",
    "plot_profile",
    "plot_residuals",
    "plot_trace",
    "plot_universal_curve",
]
