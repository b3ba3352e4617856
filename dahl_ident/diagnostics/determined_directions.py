"""Changes of the parameters that data determine, where they do not determine every parameter.

Where the optimum lies at infinity, the coordinates are those of its limit
(:mod:`dahl_ident.fitting.asymptotes`): such as sigma^2/f_max and sigma + stiffness in microslip,
where sigma itself is arbitrarily large and a step along a straight line would leave the limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.asymptotes import Chart, limits
from dahl_ident.problem import Problem

_NOTICED = 1e-5  # change of residuals over the largest, below which a direction is undetermined
_OUTSIDE = 1e-3  # share of a direction that the data may leave open, from rounding


@dataclass(frozen=True)
class Basis:
    """Orthonormal directions, (C, r), of coordinates over the sizes that residuals notice, (C,)."""

    size: FloatArray
    directions: FloatArray
    slopes: FloatArray  # (Q, C): of theta by the coordinates
    chart: Chart | None = None  # gives theta at the coordinates; None where they are theta

    @classmethod
    def of(cls, J: FloatArray, theta: FloatArray, chart: Chart | None) -> Basis:
        """Return the directions that residuals with the derivatives J by theta notice."""
        slopes = np.eye(len(theta)) if chart is None else chart.derivative(theta)
        by_coordinates = J @ slopes
        size = 1.0 / np.maximum(np.linalg.norm(by_coordinates, axis=0), np.finfo(float).tiny)
        _, singular, directions = np.linalg.svd(by_coordinates * size, full_matrices=False)
        return cls(size, directions[singular > _NOTICED * singular[0]].T, slopes, chart)

    @property
    def matrix(self) -> FloatArray:
        """Changes of theta, shape (Q, r)."""
        return np.asarray(self.slopes @ (self.size[:, None] * self.directions))

    def at(self, theta: FloatArray) -> Basis:
        """Return the same changes of the coordinates at another theta."""
        return self if self.chart is None else replace(self, slopes=self.chart.derivative(theta))

    def moved(
        self, theta: FloatArray, step: FloatArray, part: Callable[[FloatArray], float]
    ) -> FloatArray:
        """Return theta after the part of a step (r,) that a move of the coordinates allows."""
        move = self.size * (self.directions @ step)
        move = move * part(move)
        if self.chart is None:
            return np.asarray(theta + move)
        return self.chart.theta(self.chart.phi(theta) + move)

    def holds(self, slopes: FloatArray) -> NDArray[np.bool_]:
        """Return whether numbers with the slopes (..., Q) by theta are determined, shape (...).

        One that no coordinate changes is infinite in the limit, unless nothing changes it at all.
        """
        scaled = slopes @ self.slopes * self.size
        left = scaled - (scaled @ self.directions) @ self.directions.T
        whole = np.linalg.norm(scaled, axis=-1)
        known = np.linalg.norm(left, axis=-1) <= _OUTSIDE * whole
        return np.asarray(known & ((whole > 0.0) | ~slopes.any(axis=-1)))


def chart_of_limit(optimum: Optimum, problem: Problem) -> Chart | None:
    """Return the coordinates of the limit at which an optimum lies; None where it is finite.

    `problem` may have more free parameters, coordinates in addition to those of the limit.
    """
    gone = {
        p.name: value
        for p, value in zip(optimum.problem.parameters, optimum.values.tolist(), strict=True)
        if np.isinf(value) or (value == 0.0 and p.positive)
    }
    if not gone:
        return None
    found = [one for one in limits(optimum.problem) if one.extremes == gone]
    if not found:
        return None
    chart = min(
        (one.chart.one for one in found),
        key=lambda c: float(np.abs(c.theta(c.phi(optimum.theta)) - optimum.theta).max()),
    )
    own = [problem.names.index(name) for name in optimum.names]
    others = [i for i in range(len(problem.names)) if i not in own]
    C, size = chart.matrix.shape[1], len(problem.names)
    matrix, offset = np.zeros((size, C + len(others))), np.zeros(size)
    back = np.zeros((C + len(others), size))
    matrix[own, :C], offset[own], back[:C, own] = chart.matrix, chart.offset, chart.back
    for k, i in enumerate(others, start=C):
        matrix[i, k] = back[k, i] = 1.0
    tied = None if chart.tied is None else (own[chart.tied[0]], own[chart.tied[1]])
    return Chart(matrix, offset, back, tied)
