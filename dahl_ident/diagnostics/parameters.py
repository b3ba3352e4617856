"""Every parameter of a fit by name, free or fixed."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting import Optimum
from dahl_ident.problem import Problem


def parameter_values(optimum: Optimum) -> dict[str, float]:
    """Return the value of every parameter of model and sensors at the optimum, by name."""
    return values_at(optimum.problem, optimum.theta)


def values_at(problem: Problem, theta: FloatArray) -> dict[str, float]:
    """Return the value of every parameter of model and sensors at theta, by name."""
    values = {
        p.name: np.nan if p.value is None else p.value
        for p in (*problem.model.parameters, *problem.sensors.parameters)
    }
    return values | dict(zip(problem.names, problem.to_values(theta).tolist(), strict=True))
