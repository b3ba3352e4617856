"""Friction laws: any relation between displacement and force with memory.

A law is one class: declared parameters and ``slope``, the derivative of the force with respect to
displacement. Everything else follows from the slope: settled loops and forces along histories are
the engine's (:mod:`dahl_ident.elements.held_motion`). A law with closed forms overrides these
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
from dahl_ident.elements.element import Element, motion
from dahl_ident.elements.facts import (
    SOFTENED,
    HistoryGradient,
    Mechanics,
    Path,
    Sine,
    StiffnessGradient,
    Values,
)
from dahl_ident.elements.held_motion import force_along, loops_of, same_both_ways
from dahl_ident.elements.law_checks import check_declarations, check_slope, scaling_the_force
from dahl_ident.errors import ModelError, ValidationError

if TYPE_CHECKING:
    from dahl_ident.engine import Loops

_SMALLEST = 1e-100  # m; smaller amplitudes are rest
_FARTHEST = 1e9  # m; a law that has not slipped fully there never does
_SECTIONS = 16  # of a bracket, when the force is sought at which the slope vanishes


class Friction(Element):
    """A law with memory: dF/dx = slope(F, direction of motion, velocity).

    Parameters
    ----------
    *values : float or None, optional
        The declared parameters, in their order: a number fixes one, None frees it. One left out
        has its declared value, or is free.
    name : str, optional
        Prefix of the parameters' names.
    **named : float or None, optional
        The same by label.

    Raises
    ------
    ModelError
        If there are more values than parameters, a label is unknown or given twice, or, when the
        law is first used, its slope cannot be that of a friction law.
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
            declares ``rate_independent = False``; where only its quasi-static behaviour is asked
            for, the velocity is 0.
        values : sequence of array
            The parameters in their declared order.
        """

    def output(self, force: Any, slope: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return the whole force from the state `force`, its slope dF/dx and the velocity.

        The state itself, except in a velocity-dependent law that damps in addition.
        """
        return force

    def quasi_static_slope(self, force: Any, direction: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx at vanishing speed; ModelError if the law needs an undeclared velocity."""
        if not self.rate_independent:
            return self.slope(force, direction, 0.0, values)
        try:
            return self.slope(force, direction, None, values)
        except TypeError as error:
            raise ModelError(
                f"{type(self).__name__}.slope failed without a velocity ({error}); a law that "
                "uses the velocity must declare rate_independent = False"
            ) from error

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return the present force, and its change over time: slope times velocity."""
        (force,) = states
        slope = self.slope(force, direction, velocity, values)
        return Mechanics(0.0, self.output(force, slope, velocity, values), (slope * velocity,))

    def start_bounds(self, values: Values) -> tuple[float, float]:
        """Return between which numbers the unknowns at the first sample are: forces of full slip.

        Friction that begins beyond them falls back within a small part of x_c.
        """
        up, down = (float(force) for force in self.force_limits(values))
        return self.start_with(values, -down), self.start_with(values, up)

    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return F_k/X_1 of the settled loop; derivatives are 0 where a parameter is fixed.

        NaN where nothing settles.
        """
        chosen = [i for i, p in enumerate(self.parameters) if p.free and derivatives > 1]
        at, rows = self._rows(values, sine.amplitude, sine.omega)
        orders, place = np.unique(sine.harmonic, return_inverse=True)
        place = place.reshape(np.shape(sine.harmonic))
        loops = self._loops(at, orders.tolist(), chosen)
        A = at[:, :1]
        value = loops.coefficients / A
        rests = A[:, 0] <= _SMALLEST
        if self.rate_independent and rests.any():
            law_values = [np.asarray(v) for v in at[rests, 2:].T]
            value[rests] = self.rest_stiffness(law_values)[:, None] * (orders == 1)
        by = np.zeros((len(values) if derivatives > 1 else 0, *value.shape), dtype=np.complex128)
        by[chosen] = np.moveaxis(loops.by_parameter, 2, 0) / A
        by_amplitude = (loops.by_amplitude - value) / A
        return StiffnessGradient(
            value[rows, place], by_amplitude[rows, place], tuple(d[rows, place] for d in by)
        )

    def _loops(
        self, at: FloatArray, orders: Sequence[int] = (1,), chosen: Sequence[int] = ()
    ) -> Loops:
        """Return settled loops at rows of amplitude, frequency and values, with their harmonics."""
        return loops_of(self, at, orders, chosen)

    def _rows(
        self, values: Values, amplitude: FloatArray, omega: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Return rows of amplitude, frequency and values without repetition, and each point's row.

        Amplitudes of the same parameters rise from row to row.
        """
        speed = np.ones(()) if self.rate_independent else np.maximum(omega, _SMALLEST)
        amplitude = np.maximum(amplitude, _SMALLEST)
        *columns, _ = np.broadcast_arrays(*values, speed, amplitude, omega)
        every = np.column_stack([column.ravel() for column in columns]).astype(np.float64)
        at, rows = np.unique(every, axis=0, return_inverse=True)
        n = len(values)
        return at[:, [n + 1, n, *range(n)]], rows.reshape(columns[0].shape)

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample with its derivatives; 0 by parameters that are fixed.

        Between samples the displacement of a law that depends on the rate has the velocity, and the
        acceleration where it is known, of both.
        """
        if not self.rate_independent:
            motion(path.velocity, "velocity", path.displacement, self)
        free = [i for i, p in enumerate(self.parameters) if p.free]
        return force_along(self, values, path, state, free if slopes else None)

    def force_limits(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the forces of full slip in both directions, N; inf if there is none."""
        shape = np.broadcast_shapes(*(np.shape(v) for v in values))
        start = np.broadcast_to(self.rest_stiffness(values) * _FARTHEST, shape)
        return self._limit(values, 1.0, start), self._limit(values, -1.0, start)

    def _limit(self, values: Values, direction: float, start: FloatArray) -> FloatArray:
        """Return the least force at which the slope vanishes; inf if there is none to `start`."""
        columns = [np.asarray(v)[..., None] for v in values]
        fractions = np.arange(1, _SECTIONS + 1) / _SECTIONS
        low, width = np.zeros(start.shape), start.copy()
        ends: BoolArray = np.ones(start.shape, dtype=bool)
        for step in range(60):
            force = low[..., None] + width[..., None] * fractions
            with np.errstate(all="ignore"):
                slope = self.quasi_static_slope(direction * force, direction, columns)
                stuck = ~(slope + 0.0 * force > 0.0)
            if step == 0:
                ends = np.asarray(stuck.any(axis=-1))
            stuck[..., -1] = True
            width = width / _SECTIONS
            low = low + width * stuck.argmax(axis=-1)
            if np.all((width <= 1e-16 * low) | ~ends):
                break
        return np.where(ends, low, np.inf)

    def rest_stiffness(self, values: Values) -> FloatArray:
        """Return dF/dx at zero force, which N tends to at small amplitudes, N/m."""
        return np.asarray(self.quasi_static_slope(np.zeros(()), 1.0, values), dtype=np.float64)

    def force_bounds(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds of abs(N) and A abs(N), from the slopes and the forces of slip.

        The fundamental of a wave of height 1 is at most 4/pi, that of the square wave.
        """
        limits = self.force_limits(values)
        highest = np.maximum(*limits)
        force = np.where(np.isfinite(highest), highest, 0.0)[..., None] * np.linspace(-1, 1, 101)
        columns = [np.asarray(v)[..., None] for v in values]
        steepest = self.quasi_static_slope(force, 1.0, columns).max(axis=-1)
        steepest = np.maximum(steepest, self.quasi_static_slope(force, -1.0, columns).max(axis=-1))
        steepest = np.where(np.isfinite(highest), 1.02 * steepest, np.inf)
        return 4.0 / np.pi * steepest, 4.0 / np.pi * highest

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return where N begins to change and where full slip sets in, m.

        Twice the force limit over the stiffness at zero force; for a law that never slips fully,
        where 1 % and all but 1 % of the stiffness are gone, as far as that happens.
        """
        ratio = np.asarray(np.maximum(*self.force_limits(values)) / self.rest_stiffness(values))
        if np.all(np.isfinite(ratio)):
            return ratio, ratio
        A = np.geomspace(1e-12, 1e6, 109)
        columns = [np.asarray(v)[..., None] for v in values]
        with np.errstate(all="ignore"):
            N = np.abs(self.stiffness(columns, A, np.zeros(())))
            lost = np.abs(N / N[..., :1] - 1.0)
        known = np.isfinite(lost) & (lost < 1.0)
        low = A[np.argmax(lost > SOFTENED, axis=-1)]
        high = A[known.shape[-1] - 1 - np.argmax(known[..., ::-1], axis=-1)]
        return np.asarray(low), np.asarray(high)

    def answers(self, harmonic: int) -> bool:
        """Return whether the force may have this harmonic: even ones where directions differ."""
        return harmonic % 2 == 1 or not same_both_ways(self)

    def transient_decay(
        self, values: Values, amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return the factor by which a deviation from the settled loop shrinks in one cycle."""
        at, rows = self._rows(values, amplitude, omega)
        return np.asarray(np.abs(self._loops(at).decays)[rows])

    def _check_start(self, values: Sequence[float], initial_force: float) -> None:
        up, down = (float(v) for v in self.force_limits([np.asarray(v) for v in values]))
        if not -down <= initial_force <= up:
            raise ValidationError(
                f"initial_force is {initial_force!r}; expected a force between those of full "
                f"slip, {-down:g} and {up:g}"
            )

    def _loop(self, values: Sequence[float], amplitude: float, theta: FloatArray) -> FloatArray:
        """Return the force on the settled loop at rising angles from 0 to 2 pi."""
        angle = np.union1d(theta, np.pi)  # where the motion turns
        x, v = amplitude * np.cos(angle), -amplitude * np.sin(angle)
        start = self.start_with(values, self._top(values, amplitude))
        force = self.force_history(values, x, v, start)
        return force[np.searchsorted(angle, theta)]

    def _top(self, values: Sequence[float], amplitude: float) -> float:
        """Return the force of the settled loop at the largest displacement."""
        return float(self._loops(np.array([[amplitude, 1.0, *values]])).tops[0])

    def _coefficients(self, amplitude: FloatArray, harmonic: int) -> ComplexArray:
        """Return F_k/X_1, refused where no loop settles."""
        N = self.stiffness(self.known_values(), amplitude, np.zeros(()), harmonic)
        lost = ~np.isfinite(N)
        if lost.any():
            raise ModelError(
                f"{self!r} has no steady loop at the amplitude {amplitude[lost].min():g} m, where "
                "its force or its slope grows too large; expected a smaller amplitude"
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
            Zero-to-peak displacement A >= 0, m. At A = 0 its limit.

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
        """Return -b_1/(A omega) = Im N(A)/omega, the viscous damper with the same loss.

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
        return A * np.cos(theta), self._loop(values, A, theta)
