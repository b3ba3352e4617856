"""Kinks of a law, found in its expression.

A law in plain arithmetic has kinks where it takes an absolute value, a sign or a comparison. Their
arguments are the switching functions: where one crosses zero, the law changes its branch. An
integration that locates these crossings, and keeps to one branch in between, sees smooth functions
only.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

_SIGNED = (ca.OP_FABS, ca.OP_SIGN)
_COMPARED = (ca.OP_FMIN, ca.OP_FMAX, ca.OP_LT, ca.OP_LE)
_OF_POSITIVE = (ca.OP_POW, ca.OP_CONSTPOW, ca.OP_SQRT, ca.OP_LOG)


def on_one_branch(
    variables: Sequence[ca.SX],
    outputs: ca.SX,
    motion: tuple[ca.SX, ca.SX] | None = None,
    constants: Sequence[ca.SX] = (),
) -> tuple[ca.SX, list[ca.SX], list[ca.SX]]:
    """Return an expression with every switch fixed to a side, the switching functions and sides.

    `motion` is a switching function that exists already, with its side. An expression that depends
    on none of the `variables`, only on `constants` and on sides, is not a switch.

    Examples
    --------
    >>> x = ca.SX.sym("x")
    >>> on_one_branch([x], ca.fabs(x - 1) * x)
    (SX(((side0*(x-1))*x)), [SX((x-1))], [SX(side0)])
    """
    inputs, moving = [*variables, *constants], ca.vertcat(*variables)
    function = ca.Function("f", inputs, [ca.densify(outputs)])
    work: dict[int, ca.SX] = {}
    # the same with switches that switch: roots and logarithms take these, which beyond a crossing
    # stay in their domain
    switching: dict[int, ca.SX] = {}
    functions, sides = ([motion[0]], [motion[1]]) if motion else ([], [])
    fixed = [ca.SX(0.0)] * function.nnz_out(0)

    def side_of(argument: ca.SX) -> ca.SX:
        for existing, side in zip(functions, sides, strict=True):
            if ca.is_equal(existing, argument, 20):
                return side
            if ca.is_equal(existing, -argument, 20):
                return -side
        functions.append(argument)
        sides.append(ca.SX.sym(f"side{len(sides)}"))
        return sides[-1]

    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        target, source = function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_CONST:
            work[target[0]] = ca.SX(function.instruction_constant(k))
            switching.pop(target[0], None)
        elif code == ca.OP_INPUT:
            work[target[0]] = inputs[source[0]]
            switching.pop(target[0], None)
        elif code == ca.OP_OUTPUT:
            fixed[target[1]] = work[source[0]]
        else:
            a = [work[i] for i in source]
            if code in _OF_POSITIVE and source[0] in switching:
                a[0] = switching[source[0]]
            arguments = [switching.get(i, work[i]) for i in source]
            switches = code in (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN) or any(
                i in switching for i in source
            )
            switching.pop(target[0], None)
            if switches and code not in _OF_POSITIVE:
                form = ca.SX.unary if len(a) == 1 else ca.SX.binary
                switching[target[0]] = form(code, *arguments)
            kink = code in (*_SIGNED, *_COMPARED) and ca.depends_on(ca.vertcat(*a), moving)
            if kink and code in _SIGNED:
                side = side_of(a[0])
                work[target[0]] = side * a[0] if code == ca.OP_FABS else side
            elif kink:
                side = side_of(a[0] - a[1])
                larger, smaller = (1.0 + side) / 2.0, (1.0 - side) / 2.0
                if code in (ca.OP_LT, ca.OP_LE):
                    work[target[0]] = smaller
                else:
                    first, second = (larger, smaller) if code == ca.OP_FMAX else (smaller, larger)
                    work[target[0]] = first * a[0] + second * a[1]
            elif code == ca.OP_IF_ELSE_ZERO:
                work[target[0]] = a[0] * a[1]
            elif code == ca.OP_NOT:
                work[target[0]] = 1.0 - a[0]
            elif len(a) == 1:
                work[target[0]] = ca.SX.unary(code, a[0])
            else:
                work[target[0]] = ca.SX.binary(code, a[0], a[1])
    skip = 1 if motion else 0  # the velocity is not a switch of the law
    return _effective(ca.vertcat(*fixed), functions[skip:], sides[skip:])


def _effective(
    rows: ca.SX, functions: list[ca.SX], sides: list[ca.SX]
) -> tuple[ca.SX, list[ca.SX], list[ca.SX]]:
    """Return the arguments without the switches that change nothing, as in sign(x) |x| = x."""
    for i, side in enumerate(sides):
        others = functions[:i] + functions[i + 1 :]
        stacked = ca.vertcat(rows, *others)
        above, below = (ca.substitute(stacked, side, ca.SX(value)) for value in (1.0, -1.0))
        if all(ca.is_equal(above[j], below[j], 20) for j in range(stacked.numel())):
            n = rows.numel()
            others = [above[n + j] for j in range(len(others))]
            return _effective(above[:n], others, sides[:i] + sides[i + 1 :])
    return rows, functions, sides
