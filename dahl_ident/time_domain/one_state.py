"""Casadi expressions evaluated at one place at a time, without converting what goes in and out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray

Inputs = Sequence[Sequence[ca.SX]]
"""Scalar symbols in groups: such as state, drive, signs and free values."""
OneState = Callable[..., FloatArray]
"""Takes an array for each group of symbols, and returns a new array."""


def one_state(inputs: Inputs, outputs: ca.SX) -> OneState:
    """Return a function of some arrays for an expression.

    Parameters
    ----------
    inputs : sequence of sequence of SX
        The symbols of each array.
    outputs : SX
        A vector.

    Returns
    -------
    callable
        Takes an array for each group of symbols and returns the vector.

    Examples
    --------
    >>> x, y, p = (ca.SX.sym(name) for name in "xyp")
    >>> one_state([[x, y], [p]], ca.vertcat(x + p, x * y))([2.0, 3.0], [1.0])
    array([3., 6.])
    """
    function = ca.Function(
        "f", [ca.vertcat(*group) for group in inputs], [ca.densify(ca.vec(outputs))]
    )
    buffer, evaluate = function.buffer()
    places = [np.zeros(max(1, len(group))) for group in inputs]
    found = np.zeros(function.nnz_out(0))
    for i, place in enumerate(places):
        buffer.set_arg(i, memoryview(place))  # type: ignore[call-arg, arg-type]  # stubs are wrong
    buffer.set_res(0, memoryview(found))  # type: ignore[call-arg, arg-type]  # likewise

    def at(*arrays: ArrayLike) -> FloatArray:
        for place, group, array in zip(places, inputs, arrays, strict=True):
            if len(group):
                place[:] = array
        evaluate()
        return found.copy()

    at.buffer = buffer  # type: ignore[attr-defined]  # which casadi forgets otherwise
    return at
