"""Casadi expressions evaluated on whole arrays.

Casadi's own virtual machine takes some nanoseconds for every operation and sample. Written out
as array operations, in blocks that stay in cache, the same expression takes a fraction of one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import ModelError

BLOCK = 2048
"""Samples that are evaluated together: the arrays of one block stay in cache."""

_BINARY = {
    ca.OP_ADD: "{} + {}",
    ca.OP_SUB: "{} - {}",
    ca.OP_MUL: "{} * {}",
    ca.OP_DIV: "{} / {}",
    ca.OP_POW: "np.power({}, {})",
    ca.OP_CONSTPOW: "np.power({}, {})",
    ca.OP_FMIN: "np.minimum({}, {})",
    ca.OP_FMAX: "np.maximum({}, {})",
    ca.OP_COPYSIGN: "np.copysign({}, {})",
    ca.OP_LT: "np.less({}, {}) * 1.0",
    ca.OP_LE: "np.less_equal({}, {}) * 1.0",
    ca.OP_EQ: "np.equal({}, {}) * 1.0",
    ca.OP_NE: "np.not_equal({}, {}) * 1.0",
    ca.OP_AND: "np.logical_and({}, {}) * 1.0",
    ca.OP_OR: "np.logical_or({}, {}) * 1.0",
    ca.OP_IF_ELSE_ZERO: "np.where({}, {}, 0.0)",
    ca.OP_ATAN2: "np.arctan2({}, {})",
    ca.OP_HYPOT: "np.hypot({}, {})",
}
_UNARY = {
    ca.OP_ASSIGN: "{}",
    ca.OP_NEG: "-{}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "1.0 / {}",
    ca.OP_SQRT: "np.sqrt({})",
    ca.OP_EXP: "np.exp({})",
    ca.OP_LOG: "np.log({})",
    ca.OP_EXPM1: "np.expm1({})",
    ca.OP_LOG1P: "np.log1p({})",
    ca.OP_FABS: "np.abs({})",
    ca.OP_SIGN: "np.sign({})",
    ca.OP_NOT: "np.logical_not({}) * 1.0",
    ca.OP_SIN: "np.sin({})",
    ca.OP_COS: "np.cos({})",
    ca.OP_TAN: "np.tan({})",
    ca.OP_ATAN: "np.arctan({})",
    ca.OP_TANH: "np.tanh({})",
    ca.OP_SINH: "np.sinh({})",
    ca.OP_COSH: "np.cosh({})",
}

Evaluator = Callable[..., list[FloatArray | float]]
"""Takes the function's inputs, one after the other, and returns the entries of its output."""


def vectorised(inputs: Sequence[ca.SX], outputs: ca.SX) -> Evaluator:
    """Return a numpy function for an expression.

    Parameters
    ----------
    inputs : sequence of SX
        Scalar symbols.
    outputs : SX
        A vector.

    Returns
    -------
    callable
        Takes an array or a number for each symbol and returns a list of the vector's entries,
        each of the shape to which those of its symbols broadcast.

    Raises
    ------
    ModelError
        If the expression has an operation that is not known here.

    Examples
    --------
    >>> x = ca.SX.sym("x")
    >>> vectorised([x], ca.vertcat(x**2, 1 + x))(np.array([1.0, 2.0]))
    [array([1., 4.]), array([2., 3.])]
    """
    function = ca.Function("f", list(inputs), [ca.densify(ca.vec(outputs))])
    names = [f"i{k}" for k in range(len(inputs))]
    lines = [f"def evaluate({', '.join(names)}):", f"    out = [0.0] * {function.nnz_out(0)}"]
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        target = function.instruction_output(k)
        source = function.instruction_input(k)
        if code == ca.OP_CONST:
            lines.append(f"    w{target[0]} = {function.instruction_constant(k)!r}")
        elif code == ca.OP_INPUT:
            lines.append(f"    w{target[0]} = i{source[0]}")
        elif code == ca.OP_OUTPUT:
            lines.append(f"    out[{target[1]}] = w{source[0]}")
        else:
            form = _BINARY.get(code) or _UNARY.get(code)
            if form is None:
                raise ModelError(
                    f"the law has casadi's operation {code}, which cannot be "
                    "evaluated on arrays; use arithmetic, exp, log, sqrt, abs, sign or tanh"
                )
            lines.append(f"    w{target[0]} = " + form.format(*(f"w{i}" for i in source)))
    lines.append("    return out")
    space: dict[str, Any] = {"np": np}
    exec(compile("\n".join(lines), "<vectorised expression>", "exec"), space)
    found: Evaluator = space["evaluate"]
    return found
