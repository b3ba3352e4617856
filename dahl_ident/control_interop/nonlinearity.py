"""Friction as a nonlinearity of python-control, with its exact describing function."""

from __future__ import annotations

import control
import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray, finite_number, non_negative_array
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.elements.facts import Sine
from dahl_ident.errors import ModelError

_AT_REST = np.zeros(())


class FrictionNonlinearity(control.DescribingFunctionNonlinearity):
    """Friction F(x) with N(A) = (a_1 - j b_1)/A, for python-control's describing functions.

    Parameters
    ----------
    friction : Element
        A rate-independent friction element, such as `Dahl`, or a sum of them, with a value for
        every parameter.

    Raises
    ------
    ModelError
        If an element is linear or depends on the rate, or a parameter has no value.

    Notes
    -----
    Signs. python-control drives a nonlinearity with A sin(theta) and writes its fundamental as
    A abs(N) sin(theta + arg N); this package drives with A cos(theta). Both measure the phase
    of the output against the input in time, so N is the same number: friction leads its
    displacement, Im N > 0, where python-control's relay with hysteresis lags, Im N < 0. In a
    loop, python-control solves H(j omega) N(A) = -1: H is displacement over a force in the
    direction of the drive, and friction acts in the opposite direction.

    Called with successive displacements, it returns the law's force and stores the history of the
    motion, like python-control's nonlinearities with memory. Use ``describing_function``, which is
    exact, rather than python-control's numerical one, whose warm-up is only a single cycle.

    Examples
    --------
    >>> import control
    >>> import numpy as np
    >>> from dahl_ident import Dahl
    >>> from dahl_ident.control_interop import FrictionNonlinearity
    >>> friction = FrictionNonlinearity(Dahl(f_max=1.0, sigma=1.0))
    >>> control.describing_function(friction, [0.0, 1.0]).round(4)
    array([1.    +0.j    , 0.7325+0.3035j])
    >>> print(f"{friction(1.0):.4f} {friction(0.5):.4f}")
    0.6321 -0.0101
    """

    def __init__(self, friction: Element) -> None:
        super().__init__()
        self._model = friction_alone(friction)
        self._values = self._model.known_values()
        self._turns = [0.0]

    @property
    def friction(self) -> Element:
        """The friction as a model of this package."""
        return self._model

    def describing_function(self, A: float) -> complex:
        """Return N(A), N/m, at one amplitude A >= 0, m; its limit at A = 0.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> print(FrictionNonlinearity(Dahl(f_max=1.0, sigma=3.0)).describing_function(0.0))
        (3+0j)
        """
        amplitude = non_negative_array(A, "A")
        return complex(self._model.stiffness(self._values, amplitude, _AT_REST))

    def __call__(self, A: float) -> float:
        """Return the force, N, after a monotonic move to the displacement `A`, m."""
        x = finite_number(np.squeeze(A), "displacement")
        if len(self._turns) > 1 and (x - self._turns[-1]) * (self._turns[-1] - self._turns[-2]) > 0:
            self._turns[-1] = x  # the force depends only on the turning points
        else:
            self._turns.append(x)
        return float(self._model.force(self._turns)[-1])

    def reset(self) -> None:
        """Reset the history: displacement and force are zero.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> friction = FrictionNonlinearity(Dahl(f_max=1.0, sigma=1.0))
        >>> first = friction(1.0)
        >>> friction.reset()
        >>> friction(1.0) == first
        True
        """
        self._turns = [0.0]

    def _isstatic(self) -> bool:
        return False


def friction_alone(friction: Element) -> Model:
    """Return a model of rate-independent friction; raise an error if it has any other element."""
    model = as_model(friction)
    for element in model.elements:
        if element.is_linear:
            raise ModelError(
                f"friction holds {element!r}; expected friction alone, such as Dahl: put "
                "the linear elements into the loop"
            )
        if not element.rate_independent:
            raise ModelError(
                f"{element!r} depends on the rate, so its describing function is not a function of "
                "the amplitude alone; expected rate-independent friction, such as Dahl"
            )
    model.known_values()
    return model


def friction_and_slope(
    friction: Element, amplitude: FloatArray, omega: FloatArray = _AT_REST
) -> tuple[ComplexArray, ComplexArray]:
    """Return N(A) and A dN/dA."""
    values = friction.known_values()
    N, by_amplitude, _ = friction.settled(values, Sine(amplitude, omega), 1)
    return N, amplitude * by_amplitude
