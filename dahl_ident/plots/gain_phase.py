"""Gain above phase: the common parts of plots against amplitude and against frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from dahl_ident.arrays import ComplexArray, FloatArray


@dataclass(frozen=True)
class Curve:
    """A model's response along an axis, with its band where known.

    Parameters
    ----------
    x : ndarray, shape (m,)
        Amplitude or frequency, increasing.
    response : ndarray of complex, shape (m,)
        In the unit of the gain.
    gain_band, phase_band : tuple of two ndarrays, shape (m,), optional
        Lower and upper limits, in the unit of the gain and rad.
    label : str
        For the legend.
    """

    x: FloatArray
    response: ComplexArray
    gain_band: tuple[FloatArray, FloatArray] | None = None
    phase_band: tuple[FloatArray, FloatArray] | None = None
    label: str = "fit"


@dataclass(frozen=True)
class Points:
    """Measured responses along an axis, with standard deviations where known.

    Parameters
    ----------
    x : array_like, shape (n,)
        Amplitude or frequency.
    response : array_like of complex, shape (n,)
        In the unit of the gain.
    gain_std, phase_std : array_like, shape (n,), optional
        In the unit of the gain and rad.
    """

    x: ArrayLike
    response: ArrayLike
    gain_std: ArrayLike | None = None
    phase_std: ArrayLike | None = None


def draw_points(axes: Sequence[Axes], points: Points, **look: Any) -> None:
    """Draw points with error bars, in order of their place."""
    order = np.argsort(np.asarray(points.x))
    x, R = np.asarray(points.x)[order], np.asarray(points.response)[order]
    errors = [
        None if std is None else factor * np.asarray(std)[order]
        for std, factor in ((points.gain_std, 1.0), (points.phase_std, 180.0 / np.pi))
    ]
    marks = {"capsize": 2, "elinewidth": 1, "zorder": 3, **look}
    axes[0].errorbar(x, np.abs(R), yerr=errors[0], **marks)
    axes[1].errorbar(x, _degrees(R), yerr=errors[1], **marks)


def draw_curve(axes: Sequence[Axes], curve: Curve, *, near: Points, **look: Any) -> None:
    """Draw a curve and its band, with its phase shifted by whole turns to match the points."""
    phase = _degrees(curve.response)
    turns = _turns_away(curve.x, phase, near)
    axes[0].plot(curve.x, np.abs(curve.response), **look)
    axes[1].plot(curve.x, phase + turns, **look)
    band: dict[str, Any] = {"color": look.get("color"), "alpha": 0.2, "lw": 0}
    if curve.gain_band is not None:
        axes[0].fill_between(curve.x, *curve.gain_band, **band)
    if curve.phase_band is not None:
        middle = np.angle(curve.response)
        low, high = (phase + turns + np.degrees(limit - middle) for limit in curve.phase_band)
        axes[1].fill_between(curve.x, low, high, **band)


def _degrees(response: ComplexArray) -> FloatArray:
    return np.asarray(np.degrees(np.unwrap(np.angle(response))))


def _turns_away(x: FloatArray, phase: FloatArray, near: Points) -> float:
    """Return by how many degrees, whole turns, the points lie above a curve."""
    order = np.argsort(np.asarray(near.x))
    there = _degrees(np.asarray(near.response)[order])
    away = there - np.interp(np.asarray(near.x)[order], x, phase)
    return 360.0 * float(np.round(np.median(away) / 360.0))
