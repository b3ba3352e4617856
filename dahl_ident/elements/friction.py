"""Friction laws: any relation between displacement and force with memory.

A law is one class: declared parameters and ``slope``, the derivative of the force with respect to
displacement. Everything else is computed from the slope
(:mod:`dahl_ident.elements.slope_law`); a law with closed forms overrides these methods.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    broadcast_shape,
    non_negative_array,
    positive_array,
    positive_number,
    whole_number,
)
from dahl_ident.elements.law_checks import check_declarations, check_slope, scaling_the_force
from dahl_ident.elements.slope_law import SlopeLaw
from dahl_ident.errors import ModelError


class Friction(SlopeLaw):
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

    def __init__(
        self, *values: float | None, name: str | None = None, **named: float | None
    ) -> None:
        check_declarations(type(self))
        labels = [p.name for p in type(self).parameters]
        given = dict(zip(labels, values, strict=False))
        wrong = [label for label in named if label not in labels or label in given]
        if wrong or len(values) > len(labels):
            raise ModelError(
                f"{type(self).__name__} got {len(values)} values and the names {list(named)}; "
                f"expected each at most once of {', '.join(labels)}"
            )
        self._bind(given | named, name)
        check_slope(self)
        if not self.scale_parameters:
            self.scale_parameters = scaling_the_force(self)

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
            If a parameter has no value.
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
        return self.stiffness(self.known_values(), A, np.zeros(()))[()]

    def fourier_coefficients(
        self, amplitude: ArrayLike, harmonic: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return a_k and b_k of F(t) = sum a_k cos(k omega t) + b_k sin(k omega t)  (Eqn. 1).

        Parameters
        ----------
        amplitude : array_like
            Zero-to-peak displacement A >= 0 of x = A cos(omega t), m.
        harmonic : int, default 1
            k >= 1.

        Returns
        -------
        a, b : ndarray, or float for a scalar
            N. Dissipation makes b_1 negative.

        Raises
        ------
        ModelError
            If a parameter has no value.
        ValidationError
            If an amplitude is negative, NaN, infinite or complex, or `harmonic` is not a whole
            number of at least 1.

        Notes
        -----
        Eqns. 36 and 50; for `Dahl` in closed form, a_k = 2 f_max I_k(beta)/cosh(beta) for
        alpha = 1.

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
        c = self._coefficients(self.known_values(), A, k)
        return c.real[()], -c.imag[()]

    def _coefficients(
        self, values: Sequence[FloatArray], amplitude: FloatArray, harmonic: int
    ) -> ComplexArray:
        return amplitude * self.stiffness(values, amplitude, np.zeros(()), harmonic)

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

        W = 4 f_max A (1 - tanh(beta)/beta) for linear Dahl. Arguments and errors as
        `describing_function`; joules.

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

        Notes
        -----
        Eqns. 10 and 11 for linear Dahl.

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
