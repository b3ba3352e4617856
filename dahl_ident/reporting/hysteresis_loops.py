"""Hysteresis loops of the fitted friction, and loops from the measured harmonics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from dahl_ident import plots
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.diagnostics.bands import ENERGY
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.elements import Friction
from dahl_ident.reporting.document import Picture, figure_of
from dahl_ident.units import engineering, si_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dahl_ident.results import FitResult

_WIDE = 20.0  # of amplitudes beyond which loops are drawn over displacement / amplitude
_POINTS = 73  # of a measured loop, every 5 degrees; one in six of the model's


def loops(fit: FitResult, friction: Friction) -> Picture:
    """Return the picture of the loops at the smallest, a middle and the largest amplitude."""
    sizes, measured = _chosen(fit, friction)
    unit, force_unit = (si_unit(kind, fit.data.motion) for kind in ("displacement", "force"))
    losses = [q for q in fit.derived(sizes.tolist()) if q.name == ENERGY]
    drawn = [friction.loop(float(A), 6 * (_POINTS - 1) + 1) for A in sizes]
    over_amplitude = bool(sizes[-1] > _WIDE * sizes[0])

    def draw() -> Figure:
        scale = sizes if over_amplitude else np.ones_like(sizes)
        model = [
            (x / by, force, engineering(A, unit))
            for A, by, (x, force) in zip(sizes, scale, drawn, strict=True)
        ]
        dots = [(x / by, force) for by, (x, force) in zip(scale, measured, strict=False)]
        x_label = "displacement over amplitude" if over_amplitude else f"displacement [{unit}]"
        return figure_of(
            plots.plot_loops(
                model,
                measured=dots,
                displacement_label=x_label,
                force_label=f"friction [{force_unit}]",
            )
        )

    lines = "Lines: friction of the fitted element at three amplitudes of the data."
    dots = (
        "Dots: the sum of the measured harmonics, less the force of the other elements."
        if measured
        else "The data hold no higher harmonics of the force, so there is no measured loop."
    )
    finding = (
        f"A cycle loses {with_unit(losses[0].value, losses[0].stderr, 'J')} at {sizes[0]:.3g} "
        f"{unit} and {with_unit(losses[-1].value, losses[-1].stderr, 'J')} at {sizes[-1]:.3g} "
        f"{unit} (standard uncertainties)."
    )
    if measured:
        finding += f" {_distance(drawn, measured)}"
    return Picture("loops", f"{lines} {dots}", finding, draw)


def measured_loop(
    amplitude: float, harmonics: Sequence[int], stiffness: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Return displacement and force of one cycle from F_k/X_1, X_1 taken as real."""
    theta = np.linspace(0.0, 2.0 * np.pi, _POINTS)
    turning = np.exp(1j * np.outer(harmonics, theta))
    return amplitude * np.cos(theta), amplitude * (stiffness @ turning).real


def _chosen(
    fit: FitResult, friction: Friction
) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """Return three amplitudes and their measured loops, where harmonics were measured."""
    data = fit.data
    fundamental = data.harmonic == 1
    if (data.harmonic != 1).any() and fit.problem.sensors.are_exact:
        assert data.amplitude is not None  # harmonics belong to a displacement
        run = np.zeros(data.n) if data.run is None else np.unique(data.run, return_inverse=True)[1]
        points = np.stack([data.frequency_hz, data.amplitude, run])
        own = [np.flatnonzero((points[:, i] == points.T).all(axis=1)) for i in range(data.n)]
        full = [i for i in np.flatnonzero(fundamental) if own[i].size > 1]
        rank = [full[i] for i in np.argsort(data.amplitude[full])]
        three = [rank[0], rank[len(rank) // 2], rank[-1]]
        rest = fit.best_fit - friction.dynamic_stiffness(
            data.amplitude, 2.0 * np.pi * data.frequency_hz
        )
        friction_alone = np.where(fundamental, data.response - rest, data.response)
        cycles = [
            measured_loop(data.amplitude[i], data.harmonic[own[i]].tolist(), friction_alone[own[i]])
            for i in three
        ]
        return data.amplitude[three], cycles
    amplitude = fit.problem.stiffness_data.amplitude[fundamental]
    return np.geomspace(amplitude.min(), amplitude.max(), 3), []


def _distance(
    drawn: Sequence[tuple[FloatArray, FloatArray]],
    measured: Sequence[tuple[FloatArray, FloatArray]],
) -> str:
    """Return a sentence on the distance of the measured loops from those of the model."""
    away = []
    for (_, model), (_, force) in zip(drawn, measured, strict=True):
        same = model[:: (model.size - 1) // (force.size - 1)]
        away.append(np.sqrt(np.mean((force - same) ** 2)) / np.abs(force).max())
    return f"The measured loops are within {100.0 * max(away):.2g} % rms of the model's."
