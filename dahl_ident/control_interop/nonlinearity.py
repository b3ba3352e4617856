"""Dahl friction as a nonlinearity of python-control, with its exact describing function."""

from __future__ import annotations

import control
import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray, finite_number, non_negative_array
from dahl_ident.elements.dahl import Dahl
from dahl_ident.elements.element import Element
from dahl_ident.elements.model import as_model
from dahl_ident.errors import ModelError

_AT_REST = np.zeros(())


class DahlNonlinearity(control.DescribingFunctionNonlinearity):
    """Dahl friction F(x) with N(A) = (a_1 - j b_1)/A, for python-control's describing functions.

    Parameters
    ----------
    friction : Dahl, or a sum of Dahl elements
        With a value for every parameter.

    Raises
    ------
    ModelError
        If an element is no Dahl element, or a parameter has no value.

    Notes
    -----
    Signs. python-control drives a nonlinearity with A sin(theta) and writes its fundamental as
    A abs(N) sin(theta + arg N); this package drives with A cos(theta). Both measure the phase
    of the output against the input in time, so N is the same number: friction leads its
    displacement, Im N > 0, where python-control's relay with hysteresis lags, Im N < 0. In a
    loop, python-control looks for H(j omega) N(A) = -1: H is displacement over a force that acts
    with the drive, and friction acts against it.

    Called with one displacement after the other, it returns Eqn. 2's force and remembers it, as
    python-control's own nonlinearities with memory do. Ask for ``describing_function``, which is
    exact, rather than for python-control's numerical one, which warms up for a single cycle.

    Examples
    --------
    >>> import control
    >>> import numpy as np
    >>> from dahl_ident import Dahl, DahlNonlinearity
    >>> friction = DahlNonlinearity(Dahl(f_max=1.0, sigma=1.0))
    >>> control.describing_function(friction, [0.0, 1.0]).round(4)
    array([1.    +0.j    , 0.7325+0.3035j])
    >>> print(f"{friction(1.0):.4f} {friction(0.5):.4f}")
    0.6321 -0.0101
    """

    def __init__(self, friction: Element) -> None:
        super().__init__()
        self._elements = dahl_elements(friction)
        self._model = as_model(friction)
        self._values = self._model.known_values()
        self._limits = [float(element.known_values()[0]) for element in self._elements]
        self._x = 0.0
        self._forces = [0.0] * len(self._elements)

    @property
    def friction(self) -> Element:
        """The friction as a model of this package."""
        return self._model

    def describing_function(self, A: float) -> complex:
        """Return N(A), N/m, at one amplitude A >= 0, m; sigma at A = 0.

        Raises
        ------
        ValidationError
            If the amplitude is negative, NaN or infinite; it is a ValueError too.

        Examples
        --------
        >>> print(DahlNonlinearity(Dahl(f_max=1.0, sigma=3.0)).describing_function(0.0))
        (3+0j)
        """
        amplitude = non_negative_array(A, "A")
        return complex(self._model.stiffness(self._values, amplitude, _AT_REST))

    def __call__(self, A: float) -> float:
        """Return the force, N, after moving on to the displacement `A`, m, in one stretch."""
        x = finite_number(np.squeeze(A), "displacement")
        self._forces = [
            float(np.clip(element.force([self._x, x], force)[1], -limit, limit))
            for element, force, limit in zip(
                self._elements, self._forces, self._limits, strict=True
            )
        ]
        self._x = x
        return sum(self._forces)

    def reset(self) -> None:
        """Forget the past: displacement and force zero.

        Examples
        --------
        >>> friction = DahlNonlinearity(Dahl(f_max=1.0, sigma=1.0))
        >>> first = friction(1.0)
        >>> friction.reset()
        >>> friction(1.0) == first
        True
        """
        self._x = 0.0
        self._forces = [0.0] * len(self._elements)

    def _isstatic(self) -> bool:
        return False


def dahl_elements(friction: Element) -> tuple[Dahl, ...]:
    """Return the Dahl elements of a friction model, or say what else it holds."""
    elements = as_model(friction).elements
    for element in elements:
        if not isinstance(element, Dahl):
            raise ModelError(
                f"friction holds {element!r}; expected Dahl elements alone: put everything linear "
                "into the loop"
            )
    friction.known_values()
    return tuple(element for element in elements if isinstance(element, Dahl))


def friction_and_slope(
    friction: Element, amplitude: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return N(A) and A dN/dA."""
    Z = friction.stiffness_gradient(friction.known_values(), amplitude, _AT_REST)
    return Z.value, amplitude * Z.by_amplitude
