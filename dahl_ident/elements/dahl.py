"""The Dahl friction element: describing function, harmonics, loop and force, exactly.

dF/dx = sigma |1 - s F/f_max|^alpha sgn(1 - s F/f_max), s = sgn(dx/dt)   (Eqn. 2)

Under x = A cos(omega t) the force settles into a loop that depends on beta = sigma A / f_max
alone, up to scale, and not on the frequency. Its Fourier coefficients a_k, b_k (Eqns. 1-50)
have closed forms for alpha = 1, see :mod:`dahl_ident.elements.linear_dahl`; any other exponent
takes one quadrature, see :mod:`dahl_ident.elements.general_dahl`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    array_between,
    broadcast_shape,
    finite_array,
    finite_number,
    non_negative_array,
    positive_array,
    positive_number,
    whole_number,
)
from dahl_ident.elements import general_dahl, hysteresis, linear_dahl
from dahl_ident.elements.element import Element, StiffnessGradient, prefixed
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ValidationError

_EXPONENTS = (1e-9, 1e3)
_AT_REST = 1e-30
"""Smaller beta are rest, to more digits than a number has."""
_NONE: ComplexArray = np.zeros((), dtype=np.complex128)  # a derivative that nobody asked for


class Dahl(Element):
    """Dahl friction: dF/dx = sigma abs(z)^alpha sgn(z), z = 1 - s F/f_max, s = sgn(dx/dt).

    Parameters
    ----------
    f_max : float, optional
        Friction limit, N (N m in rotation), > 0. Given: fixed; left out: free.
    sigma : float, optional
        Contact stiffness at zero force, N/m (N m/rad), > 0. Given: fixed; left out: free.
    alpha : float or None, default 1
        Exponent, from 1e-9 to 1000: 1 is the linear Dahl model. None: free.
    name : str, optional
        Prefix of the parameters' names, such as "pivot" for ``pivot_f_max``; needed where a
        model has several Dahl elements.

    Raises
    ------
    ValidationError
        If f_max or sigma is not a number from 1e-90 to 1e90, alpha is outside its range, or
        `name` is no identifier.

    Notes
    -----
    Eqn. 2 of Helmick and Messner, *Describing Function Analysis of Dahl Model Friction*.
    ``Im N > 0`` for dissipation, so the phase of N lies between 0 and 90 degrees.

    Examples
    --------
    >>> pivot = Dahl(f_max=0.1, sigma=30.0)
    >>> round(pivot.characteristic_displacement, 6)
    0.003333
    >>> N = pivot.describing_function([1e-6, 1e-3, 1.0])
    >>> abs(N).round(4).tolist()
    [30.0, 29.2562, 0.1272]
    """

    def __init__(
        self,
        f_max: float | None = None,
        sigma: float | None = None,
        alpha: float | None = 1.0,
        *,
        name: str | None = None,
    ) -> None:
        self._name = name
        self._parameters = (
            _positive(prefixed(name, "f_max"), "N", "friction limit", f_max),
            _positive(prefixed(name, "sigma"), "N/m", "contact stiffness", sigma),
            _positive(prefixed(name, "alpha"), "", "exponent of the Dahl model", alpha),
        )
        if alpha is not None:
            array_between(alpha, self._parameters[2].name, *_EXPONENTS)

    @property
    def characteristic_displacement(self) -> float:
        """x_c = f_max/sigma, m: the displacement at which friction turns from spring to slip."""
        f_max, sigma, _ = self.known_values()
        return float(f_max / sigma)

    def describing_function(self, amplitude: ArrayLike) -> ComplexArray:
        """Return N(A) = (a_1 - j b_1)/A, the fundamental of force over displacement.

        Parameters
        ----------
        amplitude : array_like
            Zero-to-peak displacement A >= 0, m. At A = 0 the limit, sigma.

        Returns
        -------
        ndarray of complex, or complex for a scalar
            N/m.

        Raises
        ------
        ModelError
            If a parameter has no value.
        ValidationError
            If an amplitude is negative, NaN, infinite or complex.

        Notes
        -----
        Eqns. 51 and 52. Within 1e-13 of each part for alpha = 1, within 1e-10 of abs(N) for other
        exponents from 0.01 to 100.

        Examples
        --------
        >>> N = Dahl(f_max=1.0, sigma=1.0).describing_function(1.0)
        >>> print(f"{abs(N):.5f} at {np.degrees(np.angle(N)):.2f} degrees")
        0.79291 at 22.51 degrees
        """
        A = non_negative_array(amplitude, "amplitude")
        return self.stiffness(self.known_values(), A, np.zeros(()))[()]

    def gradient(
        self, amplitude: ArrayLike, names: Iterable[str] | None = None
    ) -> dict[str, ComplexArray]:
        """Return dN/dp for each parameter p of the element, and dN/dA as ``"amplitude"``.

        Parameters
        ----------
        amplitude : array_like
            Zero-to-peak displacement A >= 0, m.
        names : iterable of str, optional
            The derivatives wanted; all of them where left out. Without alpha, which takes a
            quadrature, an element with alpha = 1 answers from closed forms, some twenty times
            faster.

        Returns
        -------
        dict of str to ndarray of complex
            Derivatives in N/m per unit of the parameter, by the parameter's name.

        Raises
        ------
        ModelError
            If a parameter has no value.
        ValidationError
            If an amplitude is negative, NaN, infinite or complex, or a name is unknown.

        Examples
        --------
        >>> sorted(Dahl(f_max=1.0, sigma=2.0).gradient(1.0))
        ['alpha', 'amplitude', 'f_max', 'sigma']
        """
        A = non_negative_array(amplitude, "amplitude")
        known = [*(p.name for p in self.parameters), "amplitude"]
        wanted = known if names is None else list(names)
        unknown = [name for name in wanted if name not in known]
        if unknown:
            raise ValidationError(f"names has {unknown[0]!r}; expected some of {', '.join(known)}")
        asked = {"with_alpha": self.parameters[2].name in wanted}
        asked["with_amplitude"] = "amplitude" in wanted
        result = self._gradient(self.known_values(), A, 1, **asked)
        found = dict(zip(known, (*result.by_parameter, result.by_amplitude), strict=True))
        return {name: found[name][()] for name in wanted}

    def fourier_coefficients(
        self, amplitude: ArrayLike, harmonic: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return a_k and b_k of F(t) = sum a_k cos(k omega t) + b_k sin(k omega t)  (Eqn. 1).

        Parameters
        ----------
        amplitude : array_like
            Zero-to-peak displacement A >= 0 of x = A cos(omega t), m.
        harmonic : int, default 1
            k >= 1; even harmonics are exactly zero.

        Returns
        -------
        a, b : ndarray, or float for a scalar
            N. Dissipation makes b_1 negative.

        Raises
        ------
        ModelError
            If a parameter has no value.
        ValidationError
            If an amplitude is negative, NaN, infinite or complex, or `harmonic` is no whole
            number of at least 1.

        Notes
        -----
        Eqns. 36 and 50, in closed form: a_k = 2 f_max I_k(beta)/cosh(beta) for alpha = 1.

        Examples
        --------
        >>> a, b = Dahl(f_max=1.0, sigma=1.0).fourier_coefficients(1.0)
        >>> print(f"{a:.4f} {b:.4f}")
        0.7325 -0.3035
        """
        A = non_negative_array(amplitude, "amplitude")
        k = whole_number(harmonic, "harmonic", 1)
        f_max, sigma, alpha = self.known_values()
        beta = sigma * A / f_max
        if _is_linear(alpha):
            c = f_max * linear_dahl.harmonic(beta, k)
        else:
            c = f_max * general_dahl.harmonic(beta, alpha, k)
        return c.real[()], -c.imag[()]

    def gain(self, amplitude: ArrayLike) -> FloatArray:
        """Return abs(N(A)), N/m (Eqn. 51); arguments and errors as `describing_function`.

        Examples
        --------
        >>> print(f"{Dahl(f_max=1.0, sigma=1.0).gain(2.2):.4f}")
        0.4988
        """
        return np.abs(self.describing_function(amplitude))[()]

    def phase(self, amplitude: ArrayLike) -> FloatArray:
        """Return arg N(A), rad, between 0 and pi/2 (Eqn. 52).

        Arguments and errors as `describing_function`.

        Examples
        --------
        >>> print(f"{np.degrees(Dahl(f_max=1.0, sigma=1.0).phase(2.7)):.2f}")
        44.96
        """
        return np.angle(self.describing_function(amplitude))[()]

    def equivalent_stiffness(self, amplitude: ArrayLike) -> FloatArray:
        """Return a_1/A = Re N(A), N/m; arguments and errors as `describing_function`.

        Examples
        --------
        >>> print(Dahl(f_max=1.0, sigma=3.0).equivalent_stiffness(0.0))
        3.0
        """
        return self.describing_function(amplitude).real[()]

    def equivalent_damping(self, amplitude: ArrayLike, omega: ArrayLike) -> FloatArray:
        """Return -b_1/(A omega) = Im N(A)/omega, the viscous damper with the same loss.

        Parameters
        ----------
        amplitude : array_like
            Zero-to-peak displacement A >= 0, m.
        omega : array_like
            Angular frequency > 0, rad/s; broadcast with `amplitude`.

        Returns
        -------
        ndarray, or float for scalars
            N s/m.

        Raises
        ------
        ModelError
            If a parameter has no value.
        ValidationError
            If an amplitude is negative or a frequency not positive, or shapes do not fit.

        Examples
        --------
        >>> print(f"{Dahl(f_max=1.0, sigma=1.0).equivalent_damping(1.0, 2.0):.4f}")
        0.1518
        """
        A = non_negative_array(amplitude, "amplitude")
        w = positive_array(omega, "omega")
        broadcast_shape(amplitude=A, omega=w)
        return (self.describing_function(A).imag / w)[()]

    def dissipated_energy(self, amplitude: ArrayLike) -> FloatArray:
        """Return W = pi A abs(b_1), the energy lost in one cycle.

        W = 4 f_max A (1 - tanh(beta)/beta) for alpha = 1. Arguments and errors as
        `describing_function`; joules.

        Examples
        --------
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

        Notes
        -----
        Eqns. 10 and 11 for alpha = 1.

        Examples
        --------
        >>> x, F = Dahl(f_max=1.0, sigma=1.0).loop(1.0, points=5)
        >>> F.round(4).tolist()
        [0.7616, -0.3519, -0.7616, 0.3519, 0.7616]
        """
        A = positive_number(amplitude, "amplitude")
        samples = whole_number(points, "points", 3)
        f_max, sigma, alpha = (float(v) for v in self.known_values())
        return hysteresis.steady_loop(A, f_max, sigma, alpha, samples)

    def force(
        self,
        displacement: ArrayLike,
        initial_force: float = 0.0,
        *,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
    ) -> FloatArray:
        """Return the friction force for any displacement history, exactly.

        Parameters
        ----------
        displacement : array_like, shape (n,)
            m; between samples the motion is taken as monotone. The force does not depend on
            how densely a monotone stretch is sampled, nor on time.
        initial_force : float, default 0
            Force at the first sample, N, between -f_max and f_max.
        velocity, acceleration : optional
            Not used by friction; here so that every element has the same call.

        Returns
        -------
        ndarray, shape (n,)
            N; a scalar displacement gives a scalar, the initial force.

        Raises
        ------
        ModelError
            If a parameter has no value.
        ValidationError
            If `displacement` has more than one dimension, is complex, NaN or infinite, or
            abs(initial_force) exceeds f_max.

        Notes
        -----
        Eqn. 3, stretch by stretch.

        Examples
        --------
        >>> Dahl(f_max=1.0, sigma=1.0).force([0.0, 1.0, 0.5]).round(4).tolist()
        [0.0, 0.6321, -0.0101]
        """
        x = finite_array(displacement, "displacement")
        if x.ndim > 1:
            raise ValidationError(
                f"displacement has shape {x.shape}; expected one history, shape (n,)"
            )
        f_max, sigma, alpha = (float(v) for v in self.known_values())
        start = finite_number(initial_force, "initial_force")
        if abs(start) > f_max:
            raise ValidationError(
                f"initial_force is {start!r}; expected a force between -f_max and f_max "
                f"(f_max = {f_max!r})"
            )
        force = hysteresis.force_history(np.atleast_1d(x), f_max, sigma, alpha, start)
        return force if x.ndim else force[0]

    def stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> ComplexArray:
        """Return F_k/X_1 at `values` (f_max, sigma, alpha), unchecked; `omega` does not matter."""
        f_max, sigma, alpha = values
        beta = sigma * amplitude / f_max
        if harmonic == 1:
            if _is_linear(alpha):
                h = linear_dahl.describing_function(beta)
            else:
                h = general_dahl.describing_function(beta, alpha)
            h *= sigma
            return h
        if _is_linear(alpha):
            c = linear_dahl.harmonic(beta, harmonic)
        else:
            c = general_dahl.harmonic(beta, alpha, harmonic)
        return np.asarray(sigma * _per(c, beta))

    def stiffness_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives, unchecked.

        The derivative by alpha costs a quadrature; while alpha is fixed at 1 it is left at zero,
        which no estimate looks at. :meth:`gradient` always computes it.
        """
        return self._gradient(values, amplitude, harmonic, with_alpha=bool(self.parameters[2].free))

    def _gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        harmonic: int,
        *,
        with_alpha: bool,
        with_amplitude: bool = True,
    ) -> StiffnessGradient:
        f_max, sigma, alpha = values
        beta = sigma * amplitude / f_max
        closed = _is_linear(alpha)
        if harmonic == 1 and closed:
            h, by_f_max, by_sigma = linear_dahl.describing_function_gradient(beta)
        elif harmonic == 1:
            h, by_f_max, by_sigma, by_alpha = general_dahl.describing_function_gradient(beta, alpha)
        else:
            if closed:
                c, rise = linear_dahl.harmonic_gradient(beta, harmonic)
            else:
                c, rise, by_alpha = general_dahl.harmonic_gradient(beta, alpha, harmonic)
                by_alpha = _per(by_alpha, beta)
            h, by_f_max, by_sigma = _per(c, beta), _per(c - rise, beta), _per(rise, beta)
        if not with_alpha:
            by_alpha = np.zeros(h.shape, dtype=np.complex128)
        else:
            if closed and harmonic == 1:
                by_alpha = general_dahl.describing_function_gradient(beta, alpha)[3]
            elif closed:
                by_alpha = _per(general_dahl.harmonic_gradient(beta, alpha, harmonic)[2], beta)
            by_alpha = sigma * by_alpha
        slope = _by_amplitude(values, beta, harmonic, by_f_max) if with_amplitude else _NONE
        h *= sigma
        by_f_max *= sigma / f_max
        return StiffnessGradient(h, slope, (by_f_max, by_sigma, by_alpha))


def _positive(name: str, unit: str, description: str, value: float | None) -> Parameter:
    return Parameter(name, unit, description, value, lower=0.0, transform="log")


def _is_linear(alpha: FloatArray) -> bool:
    return bool(np.all(alpha == 1.0))


def _per(c: ComplexArray, beta: FloatArray) -> ComplexArray:
    """Return c/beta, with the limit 0 at beta = 0 that every harmonic k > 1 has."""
    return np.divide(c, beta, out=np.zeros(np.shape(c), dtype=np.complex128), where=beta > 0.0)


def _by_amplitude(
    values: Sequence[FloatArray], beta: FloatArray, harmonic: int, by_ln_f_max: ComplexArray
) -> ComplexArray:
    """Return dN/dA = -(sigma/A) times the derivative of h by ln f_max, also at rest."""
    f_max, sigma, _ = values
    slope = np.asarray(by_ln_f_max * (-sigma / f_max * sigma / np.maximum(beta, _AT_REST)))
    rests = beta < _AT_REST
    if np.any(rests):
        slope = np.where(rests, _slope_at_rest(values, harmonic, slope.shape), slope)
    return slope


def _slope_at_rest(
    values: Sequence[FloatArray], harmonic: int, shape: tuple[int, ...]
) -> ComplexArray:
    """Return dN/dA at A = 0: the loss grows in proportion to A (Rayleigh), the stiffness does not.

    N_k/sigma -> j 4 alpha beta / (pi k (4 - k^2)) for odd k.
    """
    f_max, sigma, alpha = values
    loss = 4.0 * alpha * sigma**2 / f_max / (np.pi * harmonic * (4 - harmonic**2))
    slope = 1j * loss if harmonic % 2 else np.zeros(())
    return np.broadcast_to(slope, shape).astype(np.complex128)
