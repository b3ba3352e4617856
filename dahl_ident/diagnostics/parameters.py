"""Every parameter of a fit by name, free or fixed."""

from __future__ import annotations

import numpy as np

from dahl_ident.fitting import Optimum


def parameter_values(optimum: Optimum) -> dict[str, float]:
    """Return the value of every parameter of model and sensors, by name."""
    problem = optimum.problem
    values = {
        p.name: np.nan if p.value is None else p.value
        for p in (*problem.model.parameters, *problem.sensors.parameters)
    }
    found = problem.to_values(optimum.theta).tolist()
    return values | dict(zip(problem.names, found, strict=True))
