"""Friction laws: any relation between displacement and force with memory.

A law is one class: declared parameters and ``slope``, the derivative of the force with respect to
displacement. Everything else follows from the slope: the engine computes settled loops and forces
along histories (:mod:`dahl_ident.elements.held_motion`). A law with closed forms overrides these
methods.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    broadcast_shape,
    non_negative_array,
    positive_array,
    positive_number,
    whole_number,
)
from dahl_ident.elements.element import Element
from dahl_ident.elements.facts import (
    SOFTENED,
    HistoryGradient,
    Mechanics,
    Path,
    Sine,
    StiffnessGradient,
    Values,
)
from dahl_ident.elements.force_law import required_history
from dahl_ident.elements.held_motion import force_along, loops_of, same_both_ways
from dahl_ident.elements.law_checks import check_declarations, check_slope, scaling_the_force
from dahl_ident.errors import ModelError, ValidationError

if TYPE_CHECKING:
    from dahl_ident.engine import Settled

_SMALLEST = 1e-100  # m; smaller amplitudes count as rest
_FARTHEST_SLIP = 1e9  # m; a law that has not slipped fully there never does
_SECTIONS = 16  # of a bracket, in the search for the force at which the slope vanishes


class Friction(Element):
    """A law with memory: dF/dx = slope(F, direction of motion, velocity).

    Parameters
    ----------
    *values : float or None, optional
        The declared parameters, in their order: a number fixes one, None frees it. One left out
        has its declared value, or is free if it has none.
    name : str, optional
        Prefix of the parameters' names.
    **named : float or None, optional
        The same by label.

    Raises
    ------
    ModelError
        If there are more values than parameters, a label is unknown or given twice, or the slope
        cannot be that of a friction law (checked when the law is first used).
    ValidationError
        If a value is outside its parameter's bounds, or the parameters are not declared as they
        should be.

    Examples
    --------
    >>> import dahl_ident as di
    >>> class Jenkins(di.Friction):
    ...     parameters = (
    ...         di.Parameter("stiffness", "N/m", "elastic stiffness", lower=0.0, transform="log"),
    ...         di.Parameter("f_max", "N", "friction limit", lower=0.0, transform="log"),
    ...     )
    ...     def slope(self, force, direction, velocity, values):
    ...         stiffness, f_max = values
    ...         return stiffness * (direction * force < f_max)
    >>> print(f"{Jenkins(3.0, 3.0).describing_function(1.3):.6f}")
    2.476268+0.678057j
    """

    has_memory = True
    one_state: bool = True
    """Whether the present force is the only state of the law."""

    def __init__(
        self, *values: float | None, name: str | None = None, **named: float | None
    ) -> None:
        check_declarations(type(self))
        labels = [p.name for p in type(self).parameters]
        by_position = dict(zip(labels, values, strict=False))
        wrong = [label for label in named if label not in labels or label in by_position]
        if wrong or len(values) > len(labels):
            raise ModelError(
                f"{type(self).__name__} got {len(values)} values and the names {list(named)}; "
                f"expected each at most once of {', '.join(labels)}"
            )
        self._bind(by_position | named, name)
        check_slope(self)
        if not self.scale_parameters:
            self.scale_parameters = scaling_the_force(self)

    @abstractmethod
    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx, N/m, in plain arithmetic.

        Parameters
        ----------
        force : array
            F, N.
        direction : array
            Sign of the velocity, +1 or -1.
        velocity : array or None
            dx/dt, m/s; None for a law that is declared rate-independent. A law that uses it
            declares ``rate_independent = False``; for its quasi-static behaviour the velocity is 0.
        values : sequence of array
            The parameters in their declared order.
        """

    def output(self, force: Any, slope: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return the total force from the state `force`, its slope dF/dx and the velocity.

        The state itself, except in a velocity-dependent law that damps in addition.
        """
        return force

    def quasi_static_slope(self, force: Any, direction: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx at vanishing speed."""
        return self.slope(force, direction, None if self.rate_independent else 0.0, values)

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return the present force, and its rate: slope times velocity."""
        (force,) = states
        slope = self.slope(force, direction, velocity, values)
        return Mechanics(0.0, self.output(force, slope, velocity, values), (slope * velocity,))

    def start_bounds(self, values: Values) -> tuple[float, float]:
        """Return the bounds of the unknown at the first sample: those of forces of full slip.

        A force beyond them would fall back within a small part of x_c.
        """
        up, down = (float(force) for force in self.force_limits(values))
        return self.start_with(values, -down), self.start_with(values, up)

    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return F_k/X_1 of the settled loop; derivatives are 0 where a parameter is fixed.

        NaN where no loop settles.
        """
        chosen = [i for i, p in enumerate(self.parameters) if p.free and derivatives > 1]
        table, rows = self._table(values, sine.amplitude, sine.omega)
        orders, columns = np.unique(sine.harmonic, return_inverse=True)
        columns = columns.reshape(np.shape(sine.harmonic))
        loops = self._loops(table, orders.tolist(), chosen)
        A = table[:, :1]
        value = loops.harmonics / A
        at_rest = A[:, 0] <= _SMALLEST
        if self.rate_independent and at_rest.any():
            stiffness = self.rest_stiffness(list(table[at_rest, 2:].T))
            value[at_rest] = stiffness[:, None] * (orders == 1)
        count = len(values) if derivatives > 1 else 0
        slopes = np.zeros((count, *value.shape), dtype=np.complex128)
        slopes[chosen] = np.moveaxis(loops.by_parameter, 2, 0) / A
        by_amplitude = (loops.by_amplitude - value) / A
        return StiffnessGradient(
            value[rows, columns], by_amplitude[rows, columns], tuple(slopes[:, rows, columns])
        )

    def _loops(
        self, table: FloatArray, orders: Sequence[int] = (1,), chosen: Sequence[int] = ()
    ) -> Settled:
        """Return the settled loops at rows of amplitude, frequency and values."""
        return loops_of(self, table, orders, chosen)

    def _table(
        self, values: Values, amplitude: FloatArray, omega: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Return rows of amplitude, frequency and values without repetition, and each point's row.

        Amplitudes of the same values rise from row to row.
        """
        frequency = np.ones(()) if self.rate_independent else np.maximum(omega, _SMALLEST)
        amplitude = np.maximum(amplitude, _SMALLEST)
        *columns, _ = np.broadcast_arrays(*values, frequency, amplitude, omega)
        points = np.column_stack([column.ravel() for column in columns]).astype(np.float64)
        table, rows = np.unique(points, axis=0, return_inverse=True)
        n = len(values)
        return table[:, [n + 1, n, *range(n)]], rows.reshape(columns[0].shape)

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample; derivatives are 0 where a parameter is fixed.

        Between samples the displacement of a law that depends on the rate has the velocities, and
        the accelerations where known, of both samples.
        """
        if not self.rate_independent:
            required_history(path.velocity, "velocity", path.displacement, self)
        free = [i for i, p in enumerate(self.parameters) if p.free]
        return force_along(self, values, path, state, free if slopes else None)

    def force_limits(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the forces of full slip in both directions, N; inf if there is none."""
        shape = np.broadcast_shapes(*(np.shape(v) for v in values))
        largest = np.broadcast_to(self.rest_stiffness(values) * _FARTHEST_SLIP, shape)
        return self._limit(values, 1.0, largest), self._limit(values, -1.0, largest)

    def _limit(self, values: Values, direction: float, largest: FloatArray) -> FloatArray:
        """Return the smallest force at which the slope vanishes; inf if it exceeds `largest`."""
        columns = [np.asarray(v)[..., None] for v in values]
        fractions = np.arange(1, _SECTIONS + 1) / _SECTIONS
        low, width = np.zeros(largest.shape), largest
        exists: BoolArray = np.ones(largest.shape, dtype=bool)
        for step in range(60):
            force = low[..., None] + width[..., None] * fractions
            with np.errstate(all="ignore"):
                slope = self.quasi_static_slope(direction * force, direction, columns)
                vanished = ~(slope + 0.0 * force > 0.0)
            if step == 0:
                exists = np.asarray(vanished.any(axis=-1))
            vanished[..., -1] = True
            width = width / _SECTIONS
            low = low + width * vanished.argmax(axis=-1)
            if np.all((width <= 1e-16 * low) | ~exists):
                break
        return np.where(exists, low, np.inf)

    def rest_stiffness(self, values: Values) -> FloatArray:
        """Return dF/dx at zero force, the limit of N at small amplitudes, N/m."""
        return np.asarray(self.quasi_static_slope(np.zeros(()), 1.0, values), dtype=np.float64)

    def force_bounds(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds of abs(N) and A abs(N), from the slopes and the forces of slip.

        The fundamental of a wave of height 1 is at most 4/pi, that of the square wave. Infinite for
        a law that depends on the rate: its slopes and forces are only known near rest.
        """
        highest = np.maximum(*self.force_limits(values))
        if not self.rate_independent:
            highest = np.full_like(highest, np.inf)
        force = np.where(np.isfinite(highest), highest, 0.0)[..., None] * np.linspace(-1, 1, 101)
        columns = [np.asarray(v)[..., None] for v in values]
        slopes = [self.quasi_static_slope(force, s, columns).max(axis=-1) for s in (1.0, -1.0)]
        steepest = np.where(np.isfinite(highest), 1.02 * np.maximum(*slopes), np.inf)
        return 4.0 / np.pi * steepest, 4.0 / np.pi * highest

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the amplitudes at which N begins to change and at which full slip sets in, m.

        Both are the force limit over the stiffness at zero force. For a law that never slips fully,
        N has changed by 1 % at the first, and by less than 100 % up to the second.
        """
        ratio = np.asarray(np.maximum(*self.force_limits(values)) / self.rest_stiffness(values))
        if np.all(np.isfinite(ratio)):
            return ratio, ratio
        A = np.geomspace(1e-12, 1e6, 109)
        columns = [np.asarray(v)[..., None] for v in values]
        with np.errstate(all="ignore"):
            N = np.abs(self.stiffness(columns, A, np.zeros(())))
            change = np.abs(N / N[..., :1] - 1.0)
        low = A[np.argmax(change > SOFTENED, axis=-1)]
        high = A[A.size - 1 - np.argmax(change[..., ::-1] < 1.0, axis=-1)]
        return np.asarray(low), np.asarray(high)

    def has_harmonic(self, harmonic: int) -> bool:
        """Return whether the force may have this harmonic: an even one if the directions differ."""
        return harmonic % 2 == 1 or not same_both_ways(self)

    def transient_decay(
        self, values: Values, amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return the factor by which a deviation from the settled loop shrinks in one cycle."""
        table, rows = self._table(values, amplitude, omega)
        return np.asarray(np.abs(self._loops(table).multiplier)[rows])

    def _check_start(self, values: Sequence[float], initial_force: float) -> None:
        up, down = (float(v) for v in self.force_limits([np.asarray(v) for v in values]))
        if not -down <= initial_force <= up:
            raise ValidationError(
                f"initial_force is {initial_force!r}; expected a force between those of full "
                f"slip, {-down:g} and {up:g}"
            )

    def _top(self, values: Sequence[float], amplitude: float) -> float:
        """Return the force of the settled loop at the largest displacement."""
        return float(self._loops(np.array([[amplitude, 1.0, *values]])).starts[0, 0])

    def _coefficients(self, amplitude: FloatArray, harmonic: int) -> ComplexArray:
        """Return F_k/X_1; refuse amplitudes at which no loop settles."""
        N = self.stiffness(self.known_values(), amplitude, np.zeros(()), harmonic)
        unsettled = ~np.isfinite(N)
        if unsettled.any():
            raise ModelError(
                f"{self!r} has no steady loop at the amplitude {amplitude[unsettled].min():g} m, "
                "where its force or its slope grows too large; expected a smaller amplitude"
            )
        return N

    def _check_rate(self, method: str) -> None:
        if not self.rate_independent:
            raise ModelError(
                f"{self!r} depends on the rate, so {method}() is not enough; give the frequency: "
                "dynamic_stiffness(amplitude, omega), or force(displacement, velocity=...)"
            )

    def describing_function(self, amplitude: ArrayLike) -> ComplexArray:
        """Return N(A) = (a_1 - j b_1)/A, the fundamental of force over displacement.

        Parameters
        ----------
        amplitude : array_like
            Zero-to-peak displacement A >= 0, m. At A = 0 the result is the limit.

        Returns
        -------
        ndarray of complex, or complex for a scalar
            N/m.

        Raises
        ------
        ModelError
            If a parameter has no value, or no loop is steady at an amplitude.
        ValidationError
            If an amplitude is negative, NaN, infinite or complex.

        Notes
        -----
        Eqns. 51 and 52. `Dahl`: within 1e-13 of each part for alpha = 1, within 1e-10 of abs(N)
        for other exponents from 0.01 to 100.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> N = Dahl(f_max=1.0, sigma=1.0).describing_function(1.0)
        >>> print(f"{abs(N):.5f} at {np.degrees(np.angle(N)):.2f} degrees")
        0.79291 at 22.51 degrees
        """
        self._check_rate("describing_function")
        A = non_negative_array(amplitude, "amplitude")
        return self._coefficients(A, 1)[()]

    def fourier_coefficients(
        self, amplitude: ArrayLike, harmonic: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return a_k and b_k of F(t) = sum a_k cos(k omega t) + b_k sin(k omega t)  (Eqn. 1).

        Amplitude and errors as `describing_function`; `harmonic` is k >= 1. N; dissipation makes
        b_1 negative. Eqns. 36 and 50.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> a, b = Dahl(f_max=1.0, sigma=1.0).fourier_coefficients(1.0)
        >>> print(f"{a:.4f} {b:.4f}")
        0.7325 -0.3035
        """
        self._check_rate("fourier_coefficients")
        A = non_negative_array(amplitude, "amplitude")
        k = whole_number(harmonic, "harmonic", 1)
        c = A * self._coefficients(A, k)
        return c.real[()], -c.imag[()]

    def gain(self, amplitude: ArrayLike) -> FloatArray:
        """Return abs(N(A)), N/m (Eqn. 51); arguments and errors as `describing_function`.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> print(f"{Dahl(f_max=1.0, sigma=1.0).gain(2.2):.4f}")
        0.4988
        """
        return np.abs(self.describing_function(amplitude))[()]

    def phase(self, amplitude: ArrayLike) -> FloatArray:
        """Return arg N(A), rad, between 0 and pi/2 (Eqn. 52).

        Arguments and errors as `describing_function`.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> print(f"{np.degrees(Dahl(f_max=1.0, sigma=1.0).phase(2.7)):.2f}")
        44.96
        """
        return np.angle(self.describing_function(amplitude))[()]

    def equivalent_stiffness(self, amplitude: ArrayLike) -> FloatArray:
        """Return a_1/A = Re N(A), N/m; arguments and errors as `describing_function`.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> print(Dahl(f_max=1.0, sigma=3.0).equivalent_stiffness(0.0))
        3.0
        """
        return self.describing_function(amplitude).real[()]

    def equivalent_damping(self, amplitude: ArrayLike, omega: ArrayLike) -> FloatArray:
        """Return -b_1/(A omega) = Im N(A)/omega, the viscous damping with the same loss.

        `omega` > 0 is in rad/s and broadcast with `amplitude`, N s/m; errors as
        `describing_function`.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> print(f"{Dahl(f_max=1.0, sigma=1.0).equivalent_damping(1.0, 2.0):.4f}")
        0.1518
        """
        A = non_negative_array(amplitude, "amplitude")
        w = positive_array(omega, "omega")
        broadcast_shape(amplitude=A, omega=w)
        return (self.describing_function(A).imag / w)[()]

    def dissipated_energy(self, amplitude: ArrayLike) -> FloatArray:
        """Return W = pi A abs(b_1), the energy lost in one cycle.

        Arguments and errors as `describing_function`; joules.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> print(f"{Dahl(f_max=1.0, sigma=1.0).dissipated_energy(1.0):.4f}")
        0.9536
        """
        _, b = self.fourier_coefficients(amplitude)
        return (np.pi * non_negative_array(amplitude, "amplitude") * -b)[()]

    def loop(self, amplitude: float, points: int = 401) -> tuple[FloatArray, FloatArray]:
        """Return one closed hysteresis loop, force against displacement.

        Parameters
        ----------
        amplitude : float
            Zero-to-peak displacement A > 0, m.
        points : int, default 401
            Samples of one cycle of x = A cos(theta), theta from 0 to 2 pi, both ends included.

        Returns
        -------
        displacement, force : ndarray, shape (points,)
            m and N.

        Raises
        ------
        ModelError
            If a parameter has no value.
        ValidationError
            If `amplitude` is not one finite number above zero, or `points` is below 3.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> x, F = Dahl(f_max=1.0, sigma=1.0).loop(1.0, points=5)
        >>> F.round(4).tolist()
        [0.7616, -0.3519, -0.7616, 0.3519, 0.7616]
        """
        self._check_rate("loop")
        A = positive_number(amplitude, "amplitude")
        theta = np.linspace(0.0, 2.0 * np.pi, whole_number(points, "points", 3))
        values = [float(v) for v in self.known_values()]
        angle = np.union1d(theta, np.pi)  # where the motion turns
        start = self.start_with(values, self._top(values, A))
        force = self.force_history(values, A * np.cos(angle), -A * np.sin(angle), start)
        return A * np.cos(theta), force[np.searchsorted(angle, theta)]
