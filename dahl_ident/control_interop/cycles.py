"""Limit cycles of a linear loop with friction, and their stability.

Friction -F(x) acts on a linear loop with the response H(s) of displacement to force. The
fundamental of a free oscillation x = A cos(omega t) is balanced if

    1 + H(j omega) N(A) = 0,    or    L(omega) + N(A) = 0 with L = 1/H, a dynamic stiffness.

Both curves, -L over frequency and N over amplitude, are computed in logarithmic polar coordinates,
where they are smooth; their crossings are the starts of Newton's method in (ln A, ln omega). From
each crossing the exact periodic motion is found by shooting
(:mod:`dahl_ident.control_interop.free_motion`).

A disturbance dA of the amplitude shifts the root by ds = -N'(A) dA/L'(s), so dA grows
at the rate -A Re(N'/L'(s)), which is negative for a stable cycle (Loeb's criterion).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray, positive_array
from dahl_ident.control_interop.free_motion import free_motion
from dahl_ident.control_interop.linear_part import (
    has_polynomials,
    known_range,
    rational_stiffness,
)
from dahl_ident.control_interop.nonlinearity import friction_alone, friction_and_slope
from dahl_ident.elements.driven_motion import Steady, obstacle
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.elements.linear_system import LinearSystem, check_system
from dahl_ident.errors import ModelError, ValidationError

_AMPLITUDES_PER_DECADE = 60  # 4 % apart; N is smooth, and crossings are interpolated
_FREQUENCIES_PER_DECADE = 400  # 0.6 % apart; sharper resonances get additional ones
_BEYOND_KNEES = (1e-6, 1e8)  # factors beyond which N is at its limits, sigma and a force over A
_BEYOND_ROOTS = 1e3  # beyond all poles and zeros L is a power of the frequency
_AROUND_RESONANCE = np.geomspace(0.01, 300.0, 60)  # times |Re| of a pole, its half width
_PAIRS_AT_ONCE = 2**20  # of segments: 16 MB for each complex array
_FREQUENCY_STEP = 1e-5  # relative, of the frequency: truncation 1e-10, rounding 2e-11
_NEWTON_STEPS = 40  # of at most 0.5 in a logarithm: almost nine decades
_RESIDUAL = 1e-6  # of ln(-L/N); where Newton's method converges, it is far smaller


@dataclass(frozen=True)
class LimitCycle:
    """A free oscillation of a loop with friction.

    Attributes
    ----------
    amplitude : float
        Zero-to-peak amplitude of the displacement's fundamental, m (rad in rotation).
    frequency_hz : float
        Hz.
    growth_rate : float
        Growth rate of the least stable small disturbance, 1/s; negative if all decay. With the
        describing function: that of a disturbance of the amplitude.
    share : float
        Root sum of squares of the displacement's mean and harmonics 2 to 9 over its fundamental;
        0 with the describing function, which assumes a sine.

    Examples
    --------
    >>> cycle = LimitCycle(amplitude=5.8e-6, frequency_hz=16.2, growth_rate=-3.0)
    >>> cycle.stable, round(cycle.omega, 1)
    (True, 101.8)
    """

    amplitude: float
    frequency_hz: float
    growth_rate: float
    share: float = 0.0

    @property
    def omega(self) -> float:
        """Angular frequency, rad/s."""
        return 2.0 * np.pi * self.frequency_hz

    @property
    def stable(self) -> bool:
        """Whether no small disturbance of the oscillation grows."""
        return self.growth_rate <= 0.0


class LimitCycles(tuple[LimitCycle, ...]):
    """Limit cycles by rising amplitude; if there are none, `reason` says why.

    If they are those of the describing function, `approximate` says why.

    Examples
    --------
    >>> from dahl_ident import Dahl, Damper, Mass, Spring
    >>> limit_cycles(Mass(1.0) + Damper(1.0) + Spring(1.0), Dahl(f_max=1.0, sigma=1e4))
    no limit cycle: from ... Hz, -1/H meets friction's N(A) at no amplitude
    """

    reason: str = ""
    approximate: str = ""

    def __repr__(self) -> str:
        return super().__repr__() if self else f"no limit cycle: {self.reason}"


def limit_cycles(
    loop: Any,
    friction: Element,
    *,
    frequency_range_hz: tuple[float, float] | None = None,
    steady: Steady = "exact",
) -> LimitCycles:
    """Return the free oscillations near every solution of 1 + H(j omega) N(A) = 0.

    Parameters
    ----------
    loop : control.TransferFunction, control.StateSpace, control.FRD, or linear Element
        H: displacement over a force that acts where the friction acts, with all controllers closed,
        such as ``control.feedback(plant, controller)``. Elements give 1/H, their dynamic stiffness.
    friction : Element
        Rate-independent friction, such as `Dahl`, or a sum of such elements, with a value for
        every parameter.
    frequency_range_hz : (float, float), optional
        Range of the search, Hz. By default three decades beyond all poles and zeros of H and of the
        loop closed by sigma; for an FRD its own range, for a discrete loop up to half its rate.
    steady : {"exact", "describing function"}, default "exact"
        "exact": the periodic motion with all harmonics, by shooting from each solution. For a
        loop without an equation of motion (an FRD, a discrete or delayed one) the result is that of
        the describing function.

    Returns
    -------
    LimitCycles
        A tuple of LimitCycle, by rising amplitude; if it is empty, its `reason` says why.

    Raises
    ------
    ModelError
        If `friction` is not rate-independent friction alone, `loop` is not linear or has the
        wrong sign, or a parameter has no value.
    ValidationError
        If `loop` is not a system, or the range is not two rising frequencies.

    Notes
    -----
    Describing functions assume that x is nearly a sine about zero; they are accurate if H decreases
    steeply with frequency. Motions with long rests, such as slow stick-slip caused by integrator
    wind-up, are far from a sine: an exact unstable cycle can have less than half the amplitude of
    the describing function, and cycles far from any solution of it are not found.

    Two cycles closer to each other than the grid, 4 % in amplitude and 0.6 % in frequency, may be
    missed, and so may any below 1e-6 of the smallest or above 1e8 of the largest characteristic
    displacement.

    Stability is that of Floquet's multipliers; with the describing function it refers to the
    amplitude of the oscillation alone (Loeb's criterion), and another mode can still be unstable.

    Examples
    --------
    A derivative filter with too low a bandwidth destabilises the mass on the contact stiffness, but
    not the free mass; the result is hunting with a small, definite amplitude:

    >>> import control
    >>> from dahl_ident import Dahl
    >>> from dahl_ident.control_interop import limit_cycles
    >>> s = control.tf("s")
    >>> pid = 100 + 300 / s + 20 * s / (0.02 * s + 1) ** 2
    >>> loop = control.feedback(1 / s**2, pid)
    >>> (cycle,) = limit_cycles(loop, Dahl(f_max=1.0, sigma=1e4))
    >>> print(f"{cycle.amplitude:.2e} m at {cycle.frequency_hz:.1f} Hz, stable: {cycle.stable}")
    5.78e-06 m at 16.2 Hz, stable: True
    """
    linear = as_linear(loop)
    friction = friction_alone(friction)
    low, high = (float(v) for v in friction.knee(friction.known_values()))
    A = _grid(_BEYOND_KNEES[0] * low, _BEYOND_KNEES[1] * high, _AMPLITUDES_PER_DECADE)
    N, _ = friction_and_slope(friction, A)
    omega = _frequencies(linear, float(abs(N[0])), frequency_range_hz)
    L = stiffness_of(linear, omega)
    refined = []
    for i, j in _crossings(-L, N):
        cycle = _refine(linear, friction, A[j], omega[i])
        if cycle is not None and omega[0] <= cycle.omega <= omega[-1]:
            refined.append(cycle)
    crossings = _distinct(refined)
    plant = Model(*linear.elements, *friction.elements)
    approximate = obstacle(plant) if steady == "exact" else "as asked for"
    if not approximate:
        motions = [free_motion(plant, c.amplitude, c.omega) for c in crossings]
        cycles = LimitCycles(
            _distinct(
                LimitCycle(m.amplitude, m.omega / (2.0 * np.pi), m.growth_rate, m.share)
                for m in motions
                if m is not None
            )
        )
        if crossings and not cycles:
            crossing = crossings[0]
            cycles.reason = (
                f"the describing function has one of {crossing.amplitude:.3g} m at "
                f"{crossing.frequency_hz:.3g} Hz, but no periodic motion is near it"
            )
            return cycles
    else:
        cycles = LimitCycles(crossings)
        cycles.approximate = approximate
    if not cycles:
        ends = " to ".join(f"{w / (2.0 * np.pi):.3g}" for w in (omega[0], omega[-1]))
        cycles.reason = f"from {ends} Hz, -1/H meets friction's N(A) at no amplitude"
    return cycles


def as_linear(loop: Any) -> Model:
    """Return a loop, H or elements, as a linear model."""
    if not isinstance(loop, Element):
        check_system(loop, "loop")
        loop = LinearSystem(loop, quantity="receptance")
    model = as_model(loop)
    friction = [element for element in model.elements if not element.is_linear]
    if friction:
        raise ModelError(
            f"loop holds {friction[0]!r}; expected linear elements: pass it as friction"
        )
    model.known_values()
    return model


def stiffness_of(linear: Element, omega: FloatArray) -> ComplexArray:
    """Return L(omega) at checked angular frequencies."""
    return linear.stiffness(linear.known_values(), np.zeros(()), omega)


def stiffness_slope(linear: Element, omega: FloatArray) -> ComplexArray:
    """Return dL/domega by central differences, one-sided at the ends of the known range."""
    low, high = known_range(linear)
    before = np.maximum(omega * (1.0 - _FREQUENCY_STEP), low)
    after = np.minimum(omega * (1.0 + _FREQUENCY_STEP), high)
    values = stiffness_of(linear, np.concatenate([np.ravel(before), np.ravel(after)]))
    first, second = np.split(np.broadcast_to(values, (2 * np.size(omega),)), 2)
    return np.asarray((second - first).reshape(np.shape(omega)) / (after - before))


def _grid(low: float, high: float, per_decade: int) -> FloatArray:
    return np.geomspace(low, high, 2 + int(np.ceil(per_decade * np.log10(high / low))))


def _frequencies(
    linear: Model, contact: float, requested_hz: tuple[float, float] | None
) -> FloatArray:
    """Return angular frequencies to scan, with more of them around sharp resonances."""
    low, high = known_range(linear)
    roots = np.zeros(0, dtype=np.complex128)
    if has_polynomials(linear):
        stiffness = rational_stiffness(linear)
        numerator, denominator = stiffness.numerator, stiffness.denominator
        if numerator.size - denominator.size == 2 and numerator[0] * denominator[0] < 0.0:
            raise ModelError(
                "loop has a negative mass, so its sign is wrong; expected displacement over the "
                "force that acts where the friction acts"
            )
        stuck = np.polyadd(numerator, contact * denominator)
        roots = np.concatenate([np.roots(p) for p in (numerator, denominator, stuck)])
        roots = roots[np.abs(roots) > 0.0]
    if requested_hz is not None:
        requested = 2.0 * np.pi * positive_array(requested_hz, "frequency_range_hz")
        if requested.shape != (2,) or not requested[0] < requested[1]:
            raise ValidationError(
                f"frequency_range_hz is {requested_hz!r}; expected two rising frequencies"
            )
        low, high = max(low, float(requested[0])), min(high, float(requested[1]))
    elif roots.size:
        low = max(low, np.abs(roots).min() / _BEYOND_ROOTS)
        high = min(high, np.abs(roots).max() * _BEYOND_ROOTS)
    if not np.isfinite(high):
        raise ModelError(f"{linear!r} has no frequency of its own; give frequency_range_hz")
    grid = _grid(low or 1e-6 * high, high, _FREQUENCIES_PER_DECADE)
    above = roots[(roots.imag > 0.0) & (roots.real != 0.0)]
    offsets = np.abs(above.real)[:, None] * _AROUND_RESONANCE
    near = np.concatenate([above.imag[:, None] + offsets, above.imag[:, None] - offsets], axis=1)
    near = near[(near > grid[0]) & (near < grid[-1])]
    return np.unique(np.concatenate([grid, near]))


def _crossings(first: ComplexArray, second: ComplexArray) -> list[tuple[int, int]]:
    """Return the pairs of segments of two curves that cross in (ln abs, arg)."""
    with np.errstate(divide="ignore"):
        p = np.log(np.abs(first)) + 1j * np.angle(first)
        q = np.log(np.abs(second)) + 1j * np.angle(second)
    step_p, step_q = np.diff(p), np.diff(q)
    possible = np.isfinite(step_p) & (np.abs(step_p.imag) < np.pi)
    for part in (np.real, np.imag):
        low = np.minimum(part(p[1:]), part(p[:-1]))
        high = np.maximum(part(p[1:]), part(p[:-1]))
        possible &= (high >= part(q).min()) & (low <= part(q).max())
    candidates = np.flatnonzero(possible)
    pairs: list[tuple[int, int]] = []
    size = max(1, _PAIRS_AT_ONCE // q.size)
    for start in range(0, candidates.size, size):
        chunk = candidates[start : start + size]
        a, b = step_p[chunk, None], step_q[None, :]
        between = q[None, :-1] - p[chunk, None]
        area = (a.conj() * b).imag
        with np.errstate(divide="ignore", invalid="ignore"):  # parallel segments do not cross
            s = (between.conj() * b).imag / area
            t = (between.conj() * a).imag / area
        crosses = (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0)
        pairs += [(int(chunk[i]), int(j)) for i, j in np.argwhere(crosses)]
    return pairs


def _refine(linear: Model, friction: Model, amplitude: float, omega: float) -> LimitCycle | None:
    """Return the limit cycle near a crossing, by Newton's method; None if there is none."""
    low, high = known_range(linear)
    point = np.log([amplitude, omega])
    for _ in range(_NEWTON_STEPS):
        A, w = np.exp(point[:1]), np.clip(np.exp(point[1:]), low, high)
        N, slope = (v[0] for v in friction_and_slope(friction, A))
        L, L_slope = stiffness_of(linear, w)[0], stiffness_slope(linear, w)[0]
        residual = np.log(-L / N)
        columns = np.array([-slope / N, w[0] * L_slope / L])
        jacobian = np.array([columns.real, columns.imag])
        if not np.isfinite(jacobian).all() or np.linalg.matrix_rank(jacobian) < 2:
            return None
        step = np.linalg.solve(jacobian, [-residual.real, -residual.imag])
        if np.max(np.abs(step)) < 1e-10:
            break
        point = point + step * min(1.0, 0.5 / np.max(np.abs(step)))
    if abs(residual) > _RESIDUAL:
        return None
    return LimitCycle(float(A[0]), float(w[0] / (2.0 * np.pi)), float((slope / L_slope).imag))


def _distinct(cycles: Iterable[LimitCycle]) -> tuple[LimitCycle, ...]:
    """Return the cycles by rising amplitude, each once."""
    distinct: list[LimitCycle] = []
    for cycle in sorted(cycles, key=lambda c: (c.amplitude, c.frequency_hz)):
        point = cycle.amplitude, cycle.frequency_hz
        others = ((c.amplitude, c.frequency_hz) for c in distinct)
        if not any(np.allclose(point, other, rtol=1e-6, atol=0.0) for other in others):
            distinct.append(cycle)
    return tuple(distinct)
