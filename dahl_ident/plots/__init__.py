"""Plots. Every function takes plain numbers and ``ax=``, draws, and returns the axes."""

from __future__ import annotations

from matplotlib.axes import Axes

from dahl_ident.plots.fit_diagnostics import (
    plot_bench_time,
    plot_budget,
    plot_control_charts,
    plot_corner,
    plot_correlation,
    plot_devices,
    plot_information,
    plot_profile,
    plot_residuals,
    plot_trace,
)
from dahl_ident.plots.responses import (
    Curve,
    plot_amplitude_response,
    plot_backbone,
    plot_frequency_response,
    plot_margins,
    plot_nichols,
    plot_nyquist,
)
from dahl_ident.plots.waveforms import (
    plot_cycles,
    plot_loops,
    plot_recorded_loops,
    plot_sample_residuals,
    plot_universal_curve,
    plot_waveforms,
)

__all__ = [
    "Axes",
    "Curve",
    "plot_amplitude_response",
    "plot_backbone",
    "plot_bench_time",
    "plot_budget",
    "plot_control_charts",
    "plot_corner",
    "plot_correlation",
    "plot_cycles",
    "plot_devices",
    "plot_frequency_response",
    "plot_information",
    "plot_loops",
    "plot_margins",
    "plot_nichols",
    "plot_nyquist",
    "plot_profile",
    "plot_recorded_loops",
    "plot_residuals",
    "plot_sample_residuals",
    "plot_trace",
    "plot_universal_curve",
    "plot_waveforms",
]
