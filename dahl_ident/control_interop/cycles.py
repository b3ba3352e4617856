"""Limit cycles of a linear loop with friction, and their stability.

Friction -F(x) acts on a linear loop with the response H(s) of displacement to force. The
fundamental of a free oscillation x = A cos(omega t) is balanced if

    1 + H(j omega) N(A) = 0,    or    L(omega) + N(A) = 0 with L = 1/H, a dynamic stiffness.

Both curves, -L over frequency and N over amplitude, are computed in logarithmic polar coordinates,
where they are smooth; their crossings are the starts of Newton's method in (ln A, ln omega). From
each crossing the exact periodic motion is found by shooting. It returns to its state after a
period that is unknown as well:

    y(T; y_0) = y_0,    v(0) = 0.

These equations are solved for y_0 and T with the derivatives of the motion. If the system is the
same in both directions, half a period leads to -y_0. Of Floquet's multipliers, the eigenvalues of
the derivative of this map, one is 1 (the motion may be shifted in time); the largest of the others
gives the growth of a disturbance.

A disturbance dA of the amplitude shifts the root by ds = -N'(A) dA/L'(s), so dA grows
at the rate -A Re(N'/L'(s)), which is negative for a stable cycle (Loeb's criterion).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import root

from dahl_ident.arrays import ComplexArray, FloatArray, positive_array
from dahl_ident.control_interop.linearization import (
    friction_alone,
    friction_and_slope,
    has_polynomials,
    known_range,
    rational_stiffness,
)
from dahl_ident.elements.driven_motion import NEUTRAL, Steady, obstacle
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.elements.equations import law_equations, plant_equations
from dahl_ident.elements.linear_system import LinearSystem, check_system
from dahl_ident.engine import System, march, settled, translate
from dahl_ident.errors import FitError, ModelError, ValidationError

_AMPLITUDES_PER_DECADE = 60  # 4 % apart; N is smooth, and crossings are interpolated
_FREQUENCIES_PER_DECADE = 400  # 0.6 % apart; sharper resonances get additional ones
_BEYOND_KNEES = (1e-6, 1e8)  # factors beyond which N is at its limits, sigma and a force over A
_BEYOND_ROOTS = 1e3  # beyond all poles and zeros L is a power of the frequency
_AROUND_RESONANCE = np.geomspace(0.01, 300.0, 60)  # times |Re| of a pole, its half width
_PAIRS_AT_ONCE = 2**20  # of segments: 16 MB for each complex array
_FREQUENCY_STEP = 1e-5  # relative, of the frequency: truncation 1e-10, rounding 2e-11
_RESIDUAL = 1e-6  # of ln(-L/N); where Newton's method converges, it is far smaller
_STARTS = (1.0, 0.7, 1.4, 0.5, 0.35, 0.25)  # starts over the estimate, tried until one converges
_EVALUATIONS = 60  # at most from each start; usually ten are needed
_CLOSED_CYCLE = 1e-7  # largest difference of first and last state, relative to the states' sizes
_DIVERGED = 1e3  # the same for a motion that grows without bound
_ANOTHER_MOTION = np.log(5.0)  # largest log ratio of amplitude or period to the estimate
_SAMPLES = 256  # per period, for the harmonics
_HIGHEST = 9  # harmonic


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
        motions = [_free_motion(plant, crossing) for crossing in crossings]
        cycles = LimitCycles(_distinct(motion for motion in motions if motion is not None))
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

    def balance(point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ln(-L/N) and its slopes, real over imaginary parts."""
        A, w = np.exp(point[:1]), np.clip(np.exp(point[1:]), low, high)
        N, slope = friction_and_slope(friction, A)
        L, L_slope = stiffness_of(linear, w), stiffness_slope(linear, w)
        parts = np.array([np.log(-L / N), -slope / N, w * L_slope / L])[..., 0]
        return np.array([parts[0].real, parts[0].imag]), np.array([parts[1:].real, parts[1:].imag])

    solution = root(balance, np.log([amplitude, omega]), jac=True, tol=1e-12)
    if not np.abs(solution.fun).max() < _RESIDUAL:
        return None
    A, w = np.exp(solution.x[:1]), np.clip(np.exp(solution.x[1:]), low, high)
    rate = friction_and_slope(friction, A)[1] / stiffness_slope(linear, w)
    return LimitCycle(float(A[0]), float(w[0] / (2.0 * np.pi)), float(rate[0].imag))


def _distinct(cycles: Iterable[LimitCycle]) -> tuple[LimitCycle, ...]:
    """Return the cycles by rising amplitude, each once."""
    distinct: list[LimitCycle] = []
    for cycle in sorted(cycles, key=lambda c: (c.amplitude, c.frequency_hz)):
        point = cycle.amplitude, cycle.frequency_hz
        others = ((c.amplitude, c.frequency_hz) for c in distinct)
        if not any(np.allclose(point, other, rtol=1e-6, atol=0.0) for other in others):
            distinct.append(cycle)
    return tuple(distinct)


def _free_motion(plant: Model, estimate: LimitCycle) -> LimitCycle | None:
    """Return the periodic motion of a whole loop near that of the describing function, if any."""
    loop = _Loop(plant)
    y, period = loop.start(estimate), loop.half_periods * np.pi / estimate.omega
    for scale in _STARTS:
        orbit = loop.closed(y * scale, period)
        if orbit is not None:
            return loop.described(*orbit, near=estimate)
    return None


class _Loop:
    """The compiled equations of a loop, and the map of its state over a period."""

    def __init__(self, plant: Model) -> None:
        import casadi as ca

        equations = plant_equations(plant)
        self.system: System = translate(equations)
        self.half_periods = 1 if self.system.odd else 2  # covered by the map
        self._sign = -1.0 if self.system.odd else 1.0
        self._plant = plant
        self._values = np.array([float(v) for v in plant.known_values()])
        states, names = ca.vertcat(*equations.states), ca.vertcat(*equations.parameters)
        arguments = [states, equations.drive, equations.direction, names]
        self._rates = ca.Function("rates", arguments, [equations.rates])

    def start(self, estimate: LimitCycle) -> FloatArray:
        """Return the state at the peak of a steady sinusoidal motion."""
        y = [np.array([estimate.amplitude, 0.0])]
        for element in self._plant.elements:
            if element.n_states:
                values = np.array([[float(v) for v in element.known_values()]])
                sine = np.array([estimate.amplitude]), np.array([estimate.omega])
                y.append(settled(translate(law_equations(element)), *sine, values).starts[0, 2:])
        return np.concatenate(y)

    def closed(self, y: FloatArray, period: float) -> tuple[FloatArray, float] | None:
        """Return state and period of the periodic motion found from a start."""
        size = np.maximum(np.abs(y), 1e-3 * np.abs(y).max())
        at_rest = np.arange(y.size) == 1

        def state(z: FloatArray) -> FloatArray:
            return np.asarray(np.insert(z[:-1], 1, 0.0) * size)

        def mismatch(z: FloatArray) -> tuple[FloatArray, FloatArray]:
            """Return what the motion does not close by, relative to the sizes, and its slopes."""
            try:
                end, slope, rates = self.after(state(z), float(z[-1]) * period)
            except FitError:
                return np.full(y.size, _DIVERGED), np.zeros((y.size, y.size))
            columns = [((slope - np.eye(y.size)) * size)[:, ~at_rest], period * rates]
            return (end - state(z)) / size, np.column_stack(columns) / size[:, None]

        start = np.append((y / size)[~at_rest], 1.0)
        solution = root(
            mismatch,
            start,
            jac=True,
            method="lm",
            options={"xtol": 1e-14, "ftol": 1e-14, "maxiter": _EVALUATIONS},
        )
        if not np.abs(solution.fun).max() < _CLOSED_CYCLE or solution.x[-1] <= 0.0:
            return None
        return state(solution.x), float(solution.x[-1]) * period

    def after(self, y: FloatArray, period: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return state, map derivative and rates after a period; after half of one, negated."""
        ends, undriven = np.array([0.0, period]), np.zeros((1, 1))
        motion = march(self.system, ends, undriven, ends, y, self._values, derivatives=True)
        end = motion.states[-1]
        rates = self._rates(end, 0.0, np.sign(end[1]) or -self._sign, self._values).full()[:, 0]
        return self._sign * end, self._sign * motion.map, self._sign * rates

    def described(self, y: FloatArray, period: float, near: LimitCycle) -> LimitCycle | None:
        """Return size, frequency and stability of a motion; None if it is far from `near`."""
        full_period = period * 2 / self.half_periods
        times = np.linspace(0.0, full_period, _SAMPLES + 1)
        x = march(self.system, times[[0, -1]], np.zeros((1, 1)), times, y, self._values).output
        X = 2.0 * np.fft.rfft(x[:-1])[: _HIGHEST + 1] / _SAMPLES
        amplitude, frequency_hz = float(abs(X[1])), 1.0 / full_period
        ratios = [max(amplitude, 1e-300) / near.amplitude, frequency_hz / near.frequency_hz]
        if np.abs(np.log(ratios)).max() > _ANOTHER_MOTION:
            return None
        others = np.append(0.5 * X[0], X[2:])
        multipliers = np.linalg.eigvals(self.after(y, period)[1])
        multipliers = np.delete(multipliers, np.argmin(np.abs(multipliers - 1.0)))
        largest = float(np.abs(multipliers).max())
        growth = 0.0 if abs(largest - 1.0) < NEUTRAL else float(np.log(largest)) / period
        share = float(np.linalg.norm(others)) / amplitude
        return LimitCycle(amplitude, frequency_hz, growth, share)
