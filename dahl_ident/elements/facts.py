"""What elements take and return: motions, stiffnesses and forces with derivatives, limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray

Values = Sequence[FloatArray]
"""Values of an element's parameters, in their order."""

Orders = int | NDArray[np.int64]
"""One harmonic, or that of each row along the last axis."""

Settled = Callable[[Any, Values, "Sine", int], "StiffnessGradient"]
"""A law's method that returns the stiffness of settled loops."""

STEP = 1e-3  # relative; truncation (fourth order) and rounding are then both below 1e-12
STENCIL = ((-2.0, 1.0 / 12.0), (-1.0, -2.0 / 3.0), (1.0, 2.0 / 3.0), (2.0, -1.0 / 12.0))
"""Central difference of fourth order: offsets in steps, and weights."""

SOFTENED = 0.01  # relative loss of stiffness at the lower knee: visible in data of 1 % noise


def clipped(value: Any, limit: Any) -> Any:
    """Return a value clipped to -limit and limit, in arithmetic that works on symbols too."""
    return 0.5 * (np.fabs(value + limit) - np.fabs(value - limit))


class Sine(NamedTuple):
    """A sine of displacement, and the harmonic of the force to compute; arrays broadcast.

    Attributes
    ----------
    amplitude : ndarray
        A, m.
    omega : ndarray
        rad/s; 0 for a law that does not depend on the rate.
    harmonic : int or ndarray of int, shape (n,)
        1 is the fundamental; 0 the mean force over the amplitude. An array holds that of each row,
        along the last axis.
    """

    amplitude: FloatArray
    omega: FloatArray
    harmonic: Orders = 1


class Path(NamedTuple):
    """A history of displacement, with velocity, acceleration and rising times where known."""

    displacement: FloatArray
    velocity: FloatArray | None = None
    acceleration: FloatArray | None = None
    time: FloatArray | None = None

    def polynomials(self, intervals: FloatArray) -> FloatArray:
        """Return coefficients of x between samples, (4 or 6, n - 1).

        They belong to powers of the fraction of an interval; `intervals` are in s. The polynomials
        have the velocities, and the accelerations where known, of both ends (Hermite).
        """
        from dahl_ident.engine.sampled import hermite  # the engine is slow to import

        known = [v for v in self[:3] if v is not None]
        return hermite(np.array(known), intervals)


class StiffnessGradient(NamedTuple):
    """A dynamic stiffness with its first derivatives; all of one broadcast shape.

    Attributes
    ----------
    value : ndarray of complex
        Z(A, omega), N/m (N m/rad in rotation).
    by_amplitude : ndarray of complex
        dZ/dA.
    by_parameter : tuple of ndarray of complex
        dZ/dp for each parameter p of the element, in the order of its `parameters`; empty if not
        requested, and 0 for a fixed parameter whose derivative would take long.
    """

    value: ComplexArray
    by_amplitude: ComplexArray
    by_parameter: tuple[ComplexArray, ...]


def each_harmonic(settled: Settled) -> Settled:
    """Return a law's `settled` extended from one harmonic to rows of several."""

    @wraps(settled)
    def of_rows(law: Any, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        orders = sine.harmonic
        if isinstance(orders, int):
            return settled(law, values, sine, derivatives)
        arguments = [np.asarray(v) for v in (*values, sine.amplitude, sine.omega)]
        shape = np.broadcast_shapes(orders.shape, *(v.shape for v in arguments))
        count = 1 + min(derivatives, 1) + len(values) * (derivatives > 1)
        results = [np.empty(shape, dtype=np.complex128) for _ in range(count)]
        for k in np.unique(orders).tolist():
            rows = np.flatnonzero(orders == k)
            row_arguments = [v[..., rows] if v.shape[-1:] == orders.shape else v for v in arguments]
            part = settled(
                law, row_arguments[:-2], Sine(row_arguments[-2], row_arguments[-1], k), derivatives
            )
            pieces = (part.value, part.by_amplitude, *part.by_parameter)
            for target, piece in zip(results, pieces, strict=False):
                target[..., rows] = piece
        return StiffnessGradient(results[0], results[min(derivatives, 1)], tuple(results[2:]))

    return of_rows


class HistoryGradient(NamedTuple):
    """A force over time with its first derivatives; all of one shape.

    Attributes
    ----------
    value : ndarray
        Force, N.
    by_state : ndarray
        Derivative with respect to the force at the first sample; zero without memory.
    by_parameter : tuple of ndarray
        Derivative with respect to each parameter of the element, in the order of its `parameters`.
    """

    value: FloatArray
    by_state: FloatArray
    by_parameter: tuple[FloatArray, ...]


class Mechanics(NamedTuple):
    """An element's part in an equation of motion: numbers, arrays or casadi symbols.

    Attributes
    ----------
    inertia
        Factor of the acceleration, kg.
    force
        The remaining force, N.
    rates
        Time derivatives of the element's states.
    """

    inertia: Any
    force: Any
    rates: Sequence[Any] = ()


@dataclass(frozen=True)
class Asymptote:
    """A limit of an element in which some parameters run away and fewer numbers remain.

    Parameters
    ----------
    name : str
        Such as "gross_slip".
    meaning : str
        What the element is in this limit, in a few words.
    pinned : mapping of str to float
        Values, by label, so extreme that the element is at its limit.
    follows : (str, str, float) or None
        ``label = factor * other``: a parameter that stays at a fixed ratio to another one.
    runs_away : mapping of str to float
        The parameters that the data no longer determine, and where they tend: 0 or inf.
    kept : tuple of (str, mapping of str to float)
        Combinations that stay determined: expression, and the power of each label in it.
    adds_to_spring : str or None
        A label whose value shows only in the sum with the stiffness of a free spring in parallel;
        the limit exists only with such a spring.
    """

    name: str
    meaning: str
    pinned: Mapping[str, float]
    follows: tuple[str, str, float] | None
    runs_away: Mapping[str, float]
    kept: tuple[tuple[str, Mapping[str, float]], ...] = ()
    adds_to_spring: str | None = None


class Combination(NamedTuple):
    """A product of powers of parameters that data may determine although its factors are not."""

    expression: str
    powers: Mapping[str, float]
    meaning: str


class UniversalCurve(NamedTuple):
    """N over a stiffness as a function of beta only, independent of the scale parameters.

    Parameters
    ----------
    stiffness : float
        The divisor of N, N/m.
    response : callable
        h(beta), for an array of beta.
    """

    stiffness: float
    response: Callable[[FloatArray], ComplexArray]


def difference(function: Callable[[Any], Any], at: Any, step: Any) -> Any:
    """Return the derivative of a function of one number, or of each of an array, to fourth order.

    Examples
    --------
    >>> print(difference(np.exp, 0.0, STEP).round(12))
    1.0
    """
    return sum(weight * function(at + offset * step) for offset, weight in STENCIL) / step
