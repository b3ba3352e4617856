"""Models for very many evaluations: friction of any exponent from tables, not by quadrature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeGuard

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.dahl import Dahl
from dahl_ident.elements.element import Element
from dahl_ident.elements.general_dahl_table import describing_function
from dahl_ident.elements.model import Model


class TabulatedDahl(Dahl):
    """The same element with N from tables, to 1e-10; made by `tabulated`."""

    def __init__(self, element: Dahl) -> None:
        self._name, self._parameters = element.name, element.parameters

    def stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> ComplexArray:
        """Return F_k/X_1 at `values`, unchecked; harmonics k > 1 by quadrature."""
        if harmonic != 1:
            return super().stiffness(values, amplitude, omega, harmonic)
        f_max, sigma, alpha = values
        return np.asarray(sigma * describing_function(sigma * amplitude / f_max, alpha))


def tabulated(model: Model) -> Model:
    """Return the model with tables in place of quadratures; itself where it needs none.

    Examples
    --------
    >>> tabulated(Model(Dahl(alpha=2.0)))
    TabulatedDahl(f_max=free, sigma=free, alpha=2)
    >>> tabulated(Model(Dahl()))
    Dahl(f_max=free, sigma=free, alpha=1)
    """
    if not any(_needs_quadrature(element) for element in model.elements):
        return model
    return Model(*(TabulatedDahl(e) if _needs_quadrature(e) else e for e in model.elements))


def _needs_quadrature(element: Element) -> TypeGuard[Dahl]:
    if not isinstance(element, Dahl):
        return False
    alpha = element.parameters[2]
    return bool(alpha.free) or alpha.value != 1.0
