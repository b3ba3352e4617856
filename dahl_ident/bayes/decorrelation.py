r"""Decorrelated coordinates, in which the posterior ridges of plants are straight.

The data determine the sum of the stiffnesses of a spring and of friction in parallel. Where they do
not determine f_max and sigma, the stiffness depends on these along a curve, which straight steps
leave. The dependence of the linear parameters l on friction is estimated by weighted least squares
of the describing function N(p), of any law with parameters p, on the columns of spring, damper and
mass, at the amplitudes and with the weights of the data:

    phi = l + W N(p),    W = (G' w^2 G)^-1 G' w^2.

phi is the combination that the data determine. For given friction it is a shift of l, so volumes
are preserved and the density over phi equals the density over l.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements import Element
from dahl_ident.problem import TableProblem

_FARTHEST = 1e300  # replaces a shift that is not finite; no prior reaches it


@dataclass(frozen=True)
class Decorrelation:
    """The shift of the linear parameters; made by :func:`decorrelation_of`.

    Attributes
    ----------
    problem : TableProblem
        Whose search coordinates theta, (S, P), come first in the points moved, (S, D).
    friction : tuple of Element
        The nonlinear elements with free parameters.
    linear : ndarray of int, shape (L,)
        Which coordinates are those in which the force of a linear element is proportional.
    projection : ndarray, shape (2 n, L)
        From real and imaginary parts of N at every row to the shift.
    """

    problem: TableProblem
    friction: tuple[Element, ...]
    linear: NDArray[np.intp]
    projection: FloatArray

    def decorrelated(self, x: FloatArray) -> FloatArray:
        """Return points with phi instead of l."""
        return self._moved(x, 1.0)

    def original(self, x: FloatArray) -> FloatArray:
        """Return points with l instead of phi."""
        return self._moved(x, -1.0)

    def shift(self, x: FloatArray) -> FloatArray:
        """Return phi - l at points, (S, L)."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore", under="ignore"):
            shift = _parts(self._describing_function(x)) @ self.projection
        return np.where(np.isfinite(shift), shift, _FARTHEST)

    def _moved(self, x: FloatArray, sign: float) -> FloatArray:
        moved = x.copy()
        moved[:, self.linear] += sign * self.shift(x)
        return moved

    def _describing_function(self, x: FloatArray) -> ComplexArray:
        names, view = self.problem.names, self.problem.stiffness_data
        values = self.problem.to_values(x[:, : len(names)])
        by_name = dict(zip(names, values.T, strict=True))
        values_of = [
            [by_name.get(p.name, np.asarray(p.value)) for p in e.parameters] for e in self.friction
        ]
        parts = (
            view.of(e, v, at_nodes=True) for e, v in zip(self.friction, values_of, strict=True)
        )
        return np.asarray(sum(parts))


def decorrelation_of(problem: TableProblem) -> Decorrelation | None:
    """Return the coordinates of a problem; None where friction or a linear element is not free."""
    view = problem.stiffness_data
    free = set(problem.names)
    elements = [e for e in problem.model.elements if any(p.name in free for p in e.parameters)]
    friction = tuple(e for e in elements if not e.is_linear)
    linear = [
        (e, p.name)
        for e in elements
        if e.is_linear and len(e.parameters) == 1
        for p in e.parameters
        if e.label(p) in e.linear_parameters
    ]
    if not friction or not linear:
        return None
    weights = np.repeat(view.weights, 2)
    columns = np.stack([_parts(view.of(e, [np.ones(())])) for e, _ in linear], axis=-1)
    weighted = columns * weights[:, None]
    size = np.sqrt((weighted**2).sum(axis=0))
    projection = np.linalg.pinv(weighted / size) * weights / size[:, None]
    at = [problem.names.index(name) for _, name in linear]
    return Decorrelation(problem, friction, np.array(at), projection.T)


def _parts(values: ComplexArray) -> FloatArray:
    return np.ascontiguousarray(values).view(np.float64)
