r"""How far the motion of a driven plant is from the sine that a describing function assumes.

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
from dahl_ident.elements import Dahl
from dahl_ident.elements.hysteresis import margin_change
from dahl_ident.fitting import Optimum

_STEPS = 240
_CYCLES = 3
_NEWTON_STEPS = 8
_LONGEST = 0.1  # of one of them
_SMALL = 1e-4  # third harmonic over the amplitude, for the derivative


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
    dahl = []
    for element in problem.model.elements:
        own = [values[p.name] for p in element.parameters]
        if isinstance(element, Dahl):
            dahl.append(own)
        else:
            linear += element.stiffness([np.asarray(v) for v in own], A, 3.0 * omega, 1)
    X = np.zeros(A.shape, dtype=np.complex128)
    for _ in range(_NEWTON_STEPS):
        step = _newton_step(X, A, linear, dahl)
        X += step * np.minimum(1.0, _LONGEST / np.maximum(np.abs(step), 1e-300))
    return np.abs(X)


def _newton_step(
    X: ComplexArray, A: FloatArray, linear: ComplexArray, dahl: Sequence[Sequence[float]]
) -> ComplexArray:
    """Return the change of X_3/A that balances the third harmonic, to first order."""
    trial = X + _SMALL * np.array([[0.0], [1.0], [1.0j]])
    force = np.zeros(trial.shape, dtype=np.complex128)
    for f_max, sigma, alpha in dahl:
        force += _third_of_force(trial, A, f_max, sigma, alpha)
    total = linear * trial + force / A
    by_real, by_imag = (total[1:] - total[0]) / _SMALL
    determinant = by_real.real * by_imag.imag - by_real.imag * by_imag.real
    real = total[0].imag * by_imag.real - total[0].real * by_imag.imag
    imag = total[0].real * by_real.imag - total[0].imag * by_real.real
    return np.asarray((real + 1j * imag) / determinant)


def _third_of_force(
    trial: ComplexArray, A: FloatArray, f_max: float, sigma: float, alpha: float
) -> ComplexArray:
    """Return F_3 under A (cos theta + Re(X_3/A exp(3j theta))), X_3/A of shape (trials, n)."""
    theta = 2.0 * np.pi * np.arange(_STEPS) / _STEPS
    shape = np.cos(theta) + (trial[..., None] * np.exp(3j * theta)).real
    steps = np.diff(shape, append=shape[..., :1], axis=-1)
    beta = sigma * A / f_max
    force = np.broadcast_to(np.tanh(beta), (len(trial), A.size)).copy()
    third = np.zeros(force.shape, dtype=np.complex128)
    turn = np.asarray(np.exp(-3j * theta))
    for cycle in range(_CYCLES):
        for i in range(_STEPS):
            if cycle == _CYCLES - 1:
                third += force * turn[i]
            step = steps[..., i]
            sign = np.sign(step)
            force = force - sign * margin_change(1.0 - sign * force, np.abs(step) * beta, alpha)
    return np.asarray(third * (2.0 * f_max / _STEPS))
