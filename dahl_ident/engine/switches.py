"""Kinks of a law, found in its own expression.

A law in plain arithmetic has kinks where it takes an absolute value, a sign or a comparison. Their
arguments are the switching functions: where one passes through zero, the law changes its branch.
An integration that locates those places, and keeps to one branch in between, sees smooth
functions alone.
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
    """Return an expression with every switch held, its switching functions and their sides.

    `motion` is a switching function that is known already, with its side. What depends on none of
    the `variables`, only on `constants` and on sides, is no switch.

    Examples
    --------
    >>> x = ca.SX.sym("x")
    >>> on_one_branch([x], ca.fabs(x - 1) * x)
    (SX(((side0*(x-1))*x)), [SX((x-1))], [SX(side0)])
    """
    inputs, moving = [*variables, *constants], ca.vertcat(*variables)
    function = ca.Function("f", inputs, [ca.densify(outputs)])
    work: dict[int, ca.SX] = {}
    whole: dict[int, ca.SX] = {}  # with switches that are not held: roots take them beyond one too
    functions, sides = ([motion[0]], [motion[1]]) if motion else ([], [])
    held = [ca.SX(0.0)] * function.nnz_out(0)

    def side_of(argument: ca.SX) -> ca.SX:
        for known, side in zip(functions, sides, strict=True):
            if ca.is_equal(known, argument, 20):
                return side
            if ca.is_equal(known, -argument, 20):
                return -side
        functions.append(argument)
        sides.append(ca.SX.sym(f"side{len(sides)}"))
        return sides[-1]

    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        target, source = function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_CONST:
            work[target[0]] = ca.SX(function.instruction_constant(k))
            whole.pop(target[0], None)
        elif code == ca.OP_INPUT:
            work[target[0]] = inputs[source[0]]
            whole.pop(target[0], None)
        elif code == ca.OP_OUTPUT:
            held[target[1]] = work[source[0]]
        else:
            a = [work[i] for i in source]
            if code in _OF_POSITIVE and source[0] in whole:
                a[0] = whole[source[0]]
            unheld = [whole.get(i, work[i]) for i in source]
            switched = code in (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN) or any(
                i in whole for i in source
            )
            whole.pop(target[0], None)
            if switched and code not in _OF_POSITIVE:
                whole[target[0]] = (ca.SX.unary if len(a) == 1 else ca.SX.binary)(code, *unheld)
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
    known = 1 if motion else 0  # the velocity, which is not a switch of the law
    return _effective(ca.vertcat(*held), functions[known:], sides[known:])


def _effective(
    rows: ca.SX, functions: list[ca.SX], sides: list[ca.SX]
) -> tuple[ca.SX, list[ca.SX], list[ca.SX]]:
    """Return all that without the switches that change nothing, as in sign(x) |x| = x."""
    for i, side in enumerate(sides):
        rest = functions[:i] + functions[i + 1 :]
        whole = ca.vertcat(rows, *rest)
        above, below = (ca.substitute(whole, side, ca.SX(value)) for value in (1.0, -1.0))
        if all(ca.is_equal(above[j], below[j], 20) for j in range(whole.numel())):
            n = rows.numel()
            rest = [above[n + j] for j in range(len(rest))]
            return _effective(above[:n], rest, sides[:i] + sides[i + 1 :])
    return rows, functions, sides
