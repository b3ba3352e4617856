"""Linear elements: mass, viscous damper, spring, and any python-control system."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.quantities import power_of_s
from dahl_ident.elements.element import Element, StiffnessGradient, motion, prefixed
from dahl_ident.elements.parameter import Parameter


class Lumped(Element):
    """One parameter p that enters as Z = p (j omega)^order; a sine answers no harmonic."""

    order: int
    _label: str
    _unit: str
    _description: str

    def _set_up(self, value: float | None, name: str | None) -> None:
        self._name = name
        self._parameters = (
            Parameter(prefixed(name, self._label), self._unit, self._description, value),
        )

    def _unit_stiffness(self, omega: FloatArray, harmonic: int) -> ComplexArray:
        if harmonic != 1:
            # a pure sine of displacement moves a linear element at its own frequency alone
            return np.zeros(np.shape(omega), dtype=np.complex128)
        return power_of_s(omega, self.order)

    def stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> ComplexArray:
        """Return p (j omega)^n, unchecked; the amplitude does not matter."""
        return np.asarray(values[0] * self._unit_stiffness(omega, harmonic) + 0.0 * amplitude)

    def stiffness_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> StiffnessGradient:
        """Return p (j omega)^n with its derivatives, unchecked."""
        value = self.stiffness(values, amplitude, omega, harmonic)
        unit = np.broadcast_to(self._unit_stiffness(omega, harmonic), value.shape)
        return StiffnessGradient(value, np.zeros_like(value), (unit,))

    def force(
        self,
        displacement: ArrayLike,
        *,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
    ) -> FloatArray:
        """Return p times the displacement, velocity or acceleration that the element answers.

        Parameters
        ----------
        displacement, velocity, acceleration : array_like, shape (n,)
            m, m/s and m/s^2; a spring needs the first, a damper the second, a mass the third.

        Returns
        -------
        ndarray, shape (n,)
            N.

        Raises
        ------
        ModelError
            If the parameter has no value.
        ValidationError
            If the needed history is missing or not as long as the displacement, or a value is
            NaN, infinite or complex.

        Examples
        --------
        >>> Mass(2.0).force([0.0], acceleration=[3.0])
        array([6.])
        """
        histories = (
            ("displacement", displacement),
            ("velocity", velocity),
            ("acceleration", acceleration),
        )
        name, history = histories[self.order]
        return np.asarray(self.known_values()[0] * motion(history, name, displacement, self))


class Mass(Lumped):
    """Inertia: Z = -m omega^2 (Eqn. 53).

    Parameters
    ----------
    mass : float, optional
        m, kg (kg m^2 in rotation). Given: fixed; left out: free.
    name : str, optional
        Prefix of the parameter's name, where a model has several masses.

    Raises
    ------
    ValidationError
        If `mass` is not a finite number.

    Examples
    --------
    >>> print(Mass(0.3).dynamic_stiffness(1e-3, 10.0))
    (-30+0j)
    """

    order = 2
    _label, _unit, _description = "mass", "kg", "mass"

    def __init__(self, mass: float | None = None, *, name: str | None = None) -> None:
        self._set_up(mass, name)


class Damper(Lumped):
    """Viscous damping: Z = j omega c (Eqn. 53, where c is called b).

    Parameters
    ----------
    damping : float, optional
        c, N s/m (N m s/rad in rotation). Given: fixed; left out: free.
    name : str, optional
        Prefix of the parameter's name, where a model has several dampers.

    Raises
    ------
    ValidationError
        If `damping` is not a finite number.

    Examples
    --------
    >>> print(Damper(0.24).dynamic_stiffness(1e-3, 10.0))
    2.4j
    """

    order = 1
    _label, _unit, _description = "damping", "N s/m", "viscous damping"

    def __init__(self, damping: float | None = None, *, name: str | None = None) -> None:
        self._set_up(damping, name)


class Spring(Lumped):
    """Linear spring: Z = k (Eqn. 53).

    Parameters
    ----------
    stiffness : float, optional
        k, N/m (N m/rad in rotation). Given: fixed; left out: free.
    name : str, optional
        Prefix of the parameter's name, where a model has several springs.

    Raises
    ------
    ValidationError
        If `stiffness` is not a finite number.

    Examples
    --------
    >>> print(Spring(0.3).dynamic_stiffness(1e-3, 10.0))
    (0.3+0j)
    """

    order = 0
    _label, _unit, _description = "stiffness", "N/m", "spring stiffness"

    def __init__(self, stiffness: float | None = None, *, name: str | None = None) -> None:
        self._set_up(stiffness, name)
