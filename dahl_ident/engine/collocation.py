"""Tables of the Radau IIA method with five stages: collocation of order 9."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre

from dahl_ident.arrays import FloatArray

STAGES = 5
SHORTEST = 12.0  # least number of steps in a cycle of the highest harmonic


def _tables() -> tuple[FloatArray, ...]:
    """Return nodes and matrix of the method, and weights of the stages at both ends of a step.

    The last three are weights of the changes at the stages in the slope at the beginning and at the
    end, and weights of values at the stages in the value at the beginning.
    """
    series = np.zeros(STAGES + 1)
    series[STAGES - 1 :] = -1.0, 1.0  # P_s - P_(s-1), whose roots are the nodes
    nodes = np.sort(np.real(legendre.legroots(series)))
    for _ in range(3):
        nodes -= legendre.legval(nodes, series) / legendre.legval(nodes, legendre.legder(series))
    nodes = 0.5 * (nodes + 1.0)
    nodes[-1] = 1.0
    powers = np.arange(STAGES)
    inverse = np.linalg.inv(nodes[:, None] ** powers)
    matrix = nodes[:, None] ** (powers + 1) / (powers + 1) @ inverse
    slopes = np.linalg.inv(matrix)  # of the stages, from the changes
    return nodes, matrix, inverse[0] @ slopes, slopes[-1], inverse[0]


NODES, MATRIX, SLOPE_BEFORE, SLOPE_AFTER, VALUE_BEFORE = _tables()
FACTORS = tuple(
    1.0 / np.prod([NODES[j]] + [NODES[j] - NODES[k] for k in range(STAGES) if k != j])
    for j in range(STAGES)
)
"""Leading coefficients of the polynomials that are 1 at one node, 0 at the others and at 0."""

CHECKED = np.array([0.5 * NODES[0], 0.5 * (NODES[-2] + NODES[-1])])  # positions of error checks
POSITIONS = np.concatenate(
    [a + (b - a) * np.arange(1, 5) / 4 for a, b in zip([0.0, *NODES[:-1]], NODES, strict=True)]
)
"""Positions in a step at which events are looked for."""

_POWERS = np.arange(STAGES + 1)
_CHANGES = np.linalg.inv(NODES[:, None] ** _POWERS[1:])  # coefficients, from changes at the stages
SLOPE_CHECKED = (_POWERS[1:] * CHECKED[:, None] ** _POWERS[:-1]) @ _CHANGES
CHANGE_CHECKED = CHECKED[:, None] ** _POWERS[1:] @ _CHANGES
"""Weights of the changes at the stages in the slopes, and in the changes, at `CHECKED`."""

VALUE_AT = POSITIONS[:, None] ** _POWERS @ np.linalg.inv(np.append(0.0, NODES)[:, None] ** _POWERS)
"""Weights of values at the beginning and the stages in those at `POSITIONS`."""
