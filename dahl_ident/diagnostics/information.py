"""How well each direction of parameter space is determined, by the Fisher information."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dahl_ident.arrays import TINY, BoolArray, FloatArray
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.asymptotes import Chart
from dahl_ident.fitting.optimum import NO_EFFECT, NOTICEABLE_PART, UNDETERMINED
from dahl_ident.problem import TableProblem

NOTICED = 1e-5  # singular value over the largest, below which a direction is undetermined
_UNDETERMINED_PART = 1e-3  # undetermined part of a direction that counts as rounding


def parameter_values(optimum: Optimum) -> dict[str, float]:
    """Return the value of every parameter of model and sensors at the optimum, by name."""
    return values_at(optimum.problem, optimum.theta)


def values_at(problem: TableProblem, theta: FloatArray) -> dict[str, float]:
    """Return the value of every parameter of model and sensors at theta, by name."""
    values = {
        p.name: np.nan if p.value is None else p.value
        for p in (*problem.model.parameters, *problem.sensors.parameters)
    }
    return values | dict(zip(problem.names, problem.to_values(theta).tolist(), strict=True))


class Information:
    """First-order variances of anything that depends on the parameters.

    The optimum's covariance is used if it is finite. If a direction is undetermined, quantities
    that do not depend on it still have a finite variance. Variances are NaN if the noise's scale
    cannot be estimated.
    """

    def __init__(self, optimum: Optimum) -> None:
        self._covariance = optimum.covariance
        self.regular = bool(np.isfinite(optimum.covariance).all())
        self._scaled = bool(np.isfinite(optimum.scale) and optimum.scale > 0.0)
        scale = optimum.scale if self._scaled else 1.0
        information = optimum.problem.information(optimum.theta, scale)
        size = np.sqrt(np.diagonal(information))
        self._size = np.where((size > 0.0) & np.isfinite(size), size, 1.0)
        scaled = information / np.outer(self._size, self._size)
        self._eigenvalues, self._vectors = np.linalg.eigh(
            np.where(np.isfinite(scaled), scaled, 0.0)
        )
        self._null = self._eigenvalues <= UNDETERMINED * max(1.0, float(self._eigenvalues[-1]))

    def variance(self, directions: FloatArray) -> FloatArray:
        """Return the variance of directions . theta, shape (...), for directions (..., P)."""
        if not self._scaled:
            return np.full(np.shape(directions)[:-1], np.nan)
        if self.regular:
            C = self._covariance
            return np.asarray(np.einsum("...i,ij,...j->...", directions, C, directions))
        scaled = directions / self._size
        parts = scaled @ self._vectors
        length = np.linalg.norm(scaled, axis=-1, keepdims=True)
        lost = np.abs(parts[..., self._null]) > NOTICEABLE_PART * length
        known = parts[..., ~self._null] ** 2 / self._eigenvalues[~self._null]
        return np.where(lost.any(axis=-1), np.inf, known.sum(axis=-1))

    def std(self, directions: FloatArray) -> FloatArray:
        """Return the standard deviation of directions . theta."""
        return np.sqrt(np.maximum(self.variance(directions), 0.0))  # -eps on a constraint

    def weakest(self, natural: FloatArray) -> FloatArray:
        """Return the least determined direction of theta/natural, a unit vector, shape (P,)."""
        information = (self._vectors * np.maximum(self._eigenvalues, 0.0)) @ self._vectors.T
        lever = self._size * natural
        vector = np.linalg.eigh(information * np.outer(lever, lever))[1][:, 0]
        return np.asarray(vector * np.sign(vector[np.argmax(np.abs(vector))]))


def shares(optimum: Optimum) -> FloatArray:
    """Return each row's share of the information on each parameter, shape (P, n).

    It is information that other parameters cannot explain; the shares of a parameter sum to 1.
    """
    m = optimum.problem.n_residuals
    J = optimum.jacobian[:m]
    result = []
    for i in range(J.shape[1]):
        others = np.delete(J, i, axis=1)
        size = np.linalg.norm(others, axis=0)
        others = others / np.where(size > 0.0, size, 1.0)
        independent = J[:, i] - others @ np.linalg.lstsq(others, J[:, i], rcond=None)[0]
        squares = independent[0::2] ** 2 + independent[1::2] ** 2
        total = squares.sum()
        result.append(squares / total if total > 0.0 else np.full(m // 2, np.nan))
    return np.array(result)


@dataclass(frozen=True)
class Basis:
    """Orthonormal directions, (C, r), of the scaled coordinates that the data determine."""

    size: FloatArray
    directions: FloatArray
    slopes: FloatArray  # (Q, C): derivatives of theta with respect to the coordinates
    chart: Chart  # gives theta at the coordinates

    @classmethod
    def every(cls, count: int) -> Basis:
        """Return all directions of theta."""
        unit = np.eye(count)
        return cls(np.ones(count), unit, unit, Chart(unit, np.zeros(count), unit))

    @classmethod
    def of(cls, J: FloatArray, theta: FloatArray, chart: Chart) -> Basis:
        """Return the directions that residuals with the Jacobian J determine."""
        slopes = chart.derivative(theta)
        columns = J @ slopes
        size = 1.0 / np.maximum(np.linalg.norm(columns, axis=0), NO_EFFECT)
        _, singular, directions = np.linalg.svd(columns * size, full_matrices=False)
        return cls(size, directions[singular > NOTICED * singular[0]].T, slopes, chart)

    @property
    def matrix(self) -> FloatArray:
        """Changes of theta, shape (Q, r)."""
        return np.asarray(self.slopes @ (self.size[:, None] * self.directions))

    def at(self, theta: FloatArray) -> Basis:
        """Return the same changes of the coordinates at another theta."""
        return replace(self, slopes=self.chart.derivative(theta))

    def holds(self, slopes: FloatArray) -> BoolArray:
        """Return whether quantities with the derivatives (..., Q) are determined, shape (...).

        A quantity that depends on theta, but on no coordinate, is infinite in the limit.
        """
        largest = np.abs(slopes).max(axis=-1, keepdims=True, initial=TINY)  # against overflow
        scaled = (slopes / largest) @ self.slopes * self.size
        outside = scaled - (scaled @ self.directions) @ self.directions.T
        length = np.linalg.norm(scaled, axis=-1)
        determined = np.linalg.norm(outside, axis=-1) <= _UNDETERMINED_PART * length
        return np.asarray(determined & ((length > 0.0) | ~slopes.any(axis=-1)))
