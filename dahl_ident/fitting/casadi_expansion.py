"""Elements within casadi expressions: written out if they are short, else expanded.

Written into a larger expression, a quadrature would be differentiated by all of that expression's
variables. A quadratic polynomial about where the element's own variables are has the same value
and derivatives there; its coefficients are mere symbols, whose numbers follow from the element
alone. That also takes elements that cannot be written as expressions at all: their coefficients
are computed by numpy, without second derivatives, which leaves the Gauss-Newton Hessian.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Element
from dahl_ident.elements.casadi_dahl import Phasor
from dahl_ident.errors import ModelError

if TYPE_CHECKING:
    import casadi as ca

_SHORT = 1500  # instructions up to which an element is written out


def is_short(element: Element, harmonic: int) -> bool:
    """Return whether an element is better written out than expanded."""
    written = _written(element, harmonic)
    return written is not None and written.n_instructions() <= _SHORT


class Expansion:
    """F_k/X_1 of an element about its own variables: amplitude, omega and its free parameters.

    Attributes
    ----------
    point : casadi.SX, shape (d,)
        Expressions of the variables.
    symbols : casadi.SX
        What `at` returns at `point`.

    Parameters
    ----------
    element : Element
    values : sequence of casadi.SX
        Its parameters.
    amplitude, omega : casadi.SX
    harmonic : int

    Examples
    --------
    >>> import casadi as ca
    >>> import dahl_ident as di
    >>> x = ca.SX.sym("x")
    >>> element = di.Dahl(1.0, 1.0, 2.0)
    >>> h = Expansion(element, [ca.SX(1.0), ca.SX(1.0), ca.SX(2.0)], x**2, ca.SX(0.0), 1)
    >>> at_one = h.at(1, 1)([1.0, 0.0])
    >>> slope = ca.Function("slope", [x, h.symbols], [ca.jacobian(h.value.real, x)])
    >>> slope(1.0, at_one)
    DM(-0.769847)
    """

    def __init__(
        self,
        element: Element,
        values: Sequence[ca.SX],
        amplitude: ca.SX,
        omega: ca.SX,
        harmonic: int,
    ) -> None:
        import casadi as ca

        free = [v for p, v in zip(element.parameters, values, strict=True) if p.free]
        self.point = ca.vertcat(amplitude, omega, *free)
        self._element, self._harmonic, self._d = element, harmonic, 2 + len(free)
        self.symbols = ca.SX.sym("expansion", _count(self._d))
        self._functions: list[ca.Function] = []  # casadi does not keep what numpy computes

    @property
    def value(self) -> Phasor:
        """F_k/X_1, as an expression of `point` and `symbols`."""
        import casadi as ca

        d = self._d
        x = self.point - self.symbols[:d]
        parts = ca.reshape(self.symbols[d:], 2, -1)
        powers = [ca.SX(1.0), *(x[i] for i in range(d))]
        powers += [x[i] * x[j] * (0.5 if i == j else 1.0) for i in range(d) for j in range(i + 1)]
        h = parts @ ca.vertcat(*powers)
        return Phasor(h[0], h[1])

    def at(self, order: int, n: int) -> ca.Function:
        """Return points, (d, n), -> coefficients in n rows, derivatives up to `order`."""
        written = _written(self._element, self._harmonic)
        if written is not None:
            return _coefficients(self._element, self._harmonic, order).map(n)
        self._functions.append(_computed(self._element, self._harmonic, order, n))
        return self._functions[-1]


def _count(d: int) -> int:
    return d + 2 * (1 + d + d * (d + 1) // 2)


@lru_cache(maxsize=64)
def _written(element: Element, harmonic: int) -> ca.Function | None:
    """Return variables -> real and imaginary part, if the element can be written out."""
    import casadi as ca

    x = ca.SX.sym("x", 2 + sum(bool(p.free) for p in element.parameters))
    free = iter(range(2, x.numel()))
    values = [x[next(free)] if p.free else ca.SX(float(p.value or 0.0)) for p in element.parameters]
    try:
        h = element.casadi_stiffness(values, x[0], x[1], harmonic)
    except ModelError:
        return None
    return ca.Function("written", [x], [ca.densify(ca.vertcat(*h))])


@lru_cache(maxsize=64)
def _coefficients(element: Element, harmonic: int, order: int) -> ca.Function:
    import casadi as ca

    written = _written(element, harmonic)
    assert written is not None
    d = written.numel_in(0)
    at = ca.SX.sym("at", d)
    value = written(at)
    parts = [at, value]
    if order > 0:
        slopes = ca.jacobian(value, at)
        parts.append(ca.vec(slopes))
        if order > 1:
            parts += [ca.vec(ca.jacobian(slopes[:, i], at[: i + 1])) for i in range(d)]
    coefficients = ca.vertcat(*parts)
    rest = ca.DM.zeros(_count(d) - coefficients.numel())
    return ca.Function("expansion", [at], [ca.densify(ca.vertcat(coefficients, rest))])


def _computed(element: Element, harmonic: int, order: int, n: int) -> ca.Function:
    """Return the same for an element that only numpy can compute, all n rows at once."""
    free = [bool(p.free) for p in element.parameters]
    d = 2 + sum(free)

    def coefficients(at: FloatArray) -> FloatArray:
        own = iter(at[2:])
        values = [
            next(own) if is_free else np.asarray(p.value)
            for p, is_free in zip(element.parameters, free, strict=True)
        ]
        found = np.zeros((_count(d), n))
        found[:d] = at
        if order == 0:
            Z = element.stiffness(values, at[0], at[1], harmonic)
            slopes = []
        else:
            Z, by_amplitude, by_parameter = element.stiffness_gradient(
                values, at[0], at[1], harmonic
            )
            wanted = [g for g, is_free in zip(by_parameter, free, strict=True) if is_free]
            slopes = [by_amplitude, np.zeros_like(Z), *wanted]  # omega is a number in every row
        for place, column in enumerate((Z, *slopes)):
            found[d + 2 * place], found[d + 2 * place + 1] = column.real, column.imag
        return found

    computed: ca.Function = _callback()(coefficients, d, n)
    return computed


@cache
def _callback() -> Any:
    import casadi as ca

    class Computed(ca.Callback):
        """A casadi function that numpy computes."""

        def __init__(self, work: Any, d: int, n: int) -> None:
            ca.Callback.__init__(self)
            self._work, self._d, self._n = work, d, n
            self.construct("computed", {})

        def get_sparsity_in(self, _: int) -> Any:
            return ca.Sparsity.dense(self._d, self._n)

        def get_sparsity_out(self, _: int) -> Any:
            return ca.Sparsity.dense(_count(self._d), self._n)

        def eval(self, arguments: Any) -> Any:
            with np.errstate(all="ignore"):
                return [ca.DM(self._work(np.asarray(arguments[0])))]

    return Computed
