r"""The smallest misfit of any sum of Jenkins elements.

A symmetric rate-independent Masing law is a sum of Jenkins elements over their slip
displacements, and N is linear in their stiffnesses, none of which is negative:

    N(A) = sum over i of k_i J(d_i/A),    k_i >= 0.

Finding the best of these laws is a convex problem, non-negative least squares, which has a unique
solution and needs no initial values. Parallel masses, dampers and springs are linear as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from dahl_ident.arrays import ComplexArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.elements import Element, MaxwellSlip, Model
from dahl_ident.elements.masing import jenkins
from dahl_ident.errors import DahlIdentError
from dahl_ident.fitting import Optimum
from dahl_ident.problem import TableProblem

_PER_DECADE = 48  # slip displacements, 5 % apart
_BELOW = 100.0  # smallest amplitude over the smallest slip displacement, where all elements slip
_FEWEST_ROWS = 6  # for which a misfit is informative
FAR_LESS = 0.5  # of a model's misfit, below which another law is far better


def least_misfit_of(optimum: Optimum) -> float | None:
    """Return the least misfit if parallel Jenkins elements replace a model's friction.

    None with few rows, unknown calibrations, no friction, or a displacement that is not a sine.
    """
    problem = optimum.problem
    linear = [e for e in problem.model.elements if e.is_linear]
    unknown = any(p.free for p in problem.sensors.parameters)
    few = (problem.data.harmonic == 1).sum() < _FEWEST_ROWS
    if few or unknown or problem.is_exact or len(linear) == len(problem.model.elements):
        return None
    try:
        return least_misfit(problem.data, linear)
    except DahlIdentError:
        return None


def least_misfit(data: FrequencyResponse, linear: Sequence[Element] = ()) -> float:
    """Return the rms of abs(measured - fitted)/abs(measured) over fundamentals, for the best law.

    `linear` are linear elements in parallel, whose free parameters take any sign unless their
    bounds exclude it. A free spring is always included. The bound is exact up to a grid of 48 slip
    displacements a decade. Dahl and Bouc-Wen laws are not such sums: exact tables of them leave 5
    to 15 %.
    """
    friction = MaxwellSlip(1, name="slips")  # a problem needs one
    view = TableProblem(data.select(harmonic=1), Model(*linear, friction)).stiffness_data
    seen = view.stiffness != 0.0
    A, Z, omega = (v[seen] for v in (view.amplitude, view.stiffness, view.omega))
    ratio = _BELOW * A.max() / A.min()
    n = int(np.ceil(_PER_DECADE * np.log10(ratio))) + 1
    slip = np.geomspace(A.min() / _BELOW, A.max(), n)[:-1]
    columns: list[ComplexArray] = [jenkins(slip / A[:, None], 1)[0], np.ones((A.size, 1)) + 0j]
    target = Z.copy()
    for element in linear:
        for i, p in enumerate(element.parameters):
            values = [np.asarray(float(j == i)) for j in range(len(element.parameters))]
            unit = element.stiffness(values, A, omega)
            if p.free:
                columns += [unit[:, None], *[-unit[:, None]] * (p.lower < 0.0)]
            else:
                target -= cast(float, p.value) * unit
    matrix, target = np.concatenate(columns, axis=1) / np.abs(Z)[:, None], target / np.abs(Z)
    matrix /= np.linalg.norm(matrix, axis=0)
    from scipy.optimize import nnls

    rows, values_ = (np.concatenate([part.real, part.imag]) for part in (matrix, target))
    return float(nnls(rows, values_, maxiter=10000)[1] / A.size**0.5)
