r"""Third harmonic in the motion of a driven plant, which describing functions neglect.

Friction under x = A cos(theta) has a third harmonic F_3, which a sine drive does not balance, so
the displacement gets one as well:

    Z_lin(3 omega) X_3 + F_3(A, X_3) = 0,

Z_lin the dynamic stiffness of everything but friction. F_3 follows from the force over a cycle,
stepped exactly along the path; the equation is solved by Newton's method in the two quadratures,
which friction answers differently (in full slip it hardly resists one of them).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.diagnostics.parameters import parameter_values
from dahl_ident.elements import Element
from dahl_ident.fitting import Optimum

_STEPS = 240  # samples of a cycle: 80 of its third harmonic
_THETA = 2.0 * np.pi * np.arange(_STEPS) / _STEPS  # their phases
_CYCLES = 3  # that a path is run through, until memory has faded
_NEWTON_STEPS = 8  # of at most _LONGEST: up to 0.8 of the fundamental
_SETTLED = 1e-4  # change of X_3/A that ends the search
_LONGEST = 0.1  # of one of them
_SMALL = 1e-4  # third harmonic over the amplitude, for the derivative

Law = tuple[Element, Sequence[FloatArray]]
"""An element with memory and the values of its parameters."""


def third_harmonic_share(optimum: Optimum) -> FloatArray:
    """Return the predicted third harmonic of the displacement over its fundamental.

    One number for each force-controlled row. Where the laboratory controls the displacement
    there is none.
    """
    problem = optimum.problem
    forced = problem.data.controlled == "force"
    if not forced.any() or not np.isfinite(optimum.values).all():
        return np.zeros(0)
    values = parameter_values(optimum)
    A = problem.stiffness_data.amplitude[forced]
    omega = problem.stiffness_data.omega[forced]
    linear = np.zeros(A.shape, dtype=np.complex128)
    friction = []
    for element in problem.model.elements:
        own = [np.asarray(values[p.name]) for p in element.parameters]
        if element.has_memory:
            friction.append((element, own))
        else:
            linear += element.stiffness(own, A, 3.0 * omega, 1)
    X = np.zeros(A.shape, dtype=np.complex128)
    for _ in range(_NEWTON_STEPS):
        step = _newton_step(X, A, linear, friction)
        X += step * np.minimum(1.0, _LONGEST / np.maximum(np.abs(step), 1e-300))
        if not (np.abs(step) > _SETTLED).any():
            break
    return np.abs(X)


def _newton_step(
    X: ComplexArray, A: FloatArray, linear: ComplexArray, friction: Sequence[Law]
) -> ComplexArray:
    """Return the change of X_3/A that balances the third harmonic, to first order."""
    trial = X + _SMALL * np.array([[0.0], [1.0], [1.0j]])
    force = np.zeros(trial.shape, dtype=np.complex128)
    path = _path(trial, A)
    for element, values in friction:
        force += 2.0 / _STEPS * element.steady_force(values, path, _CYCLES) @ np.exp(-3j * _THETA)
    total = linear * trial + force / A
    by_real, by_imag = (total[1:] - total[0]) / _SMALL
    determinant = by_real.real * by_imag.imag - by_real.imag * by_imag.real
    real = total[0].imag * by_imag.real - total[0].real * by_imag.imag
    imag = total[0].real * by_real.imag - total[0].imag * by_real.real
    return np.asarray((real + 1j * imag) / determinant)


def _path(trial: ComplexArray, A: FloatArray) -> FloatArray:
    """Return A (cos theta + Re(X_3/A exp(3j theta))) over a cycle, for X_3/A (trials, n)."""
    third = (trial[..., None] * np.exp(3j * _THETA)).real
    return np.asarray(A[:, None] * (np.cos(_THETA) + third))
