"""From an expression graph to machine code: every operation becomes one LLVM instruction.

numba links the result and gives it the type of a C function. Its compiler is not used for the
operations, because it would infer the types of thousands of lines, all of which are numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from dahl_ident.errors import ModelError

_BINARY = {"ADD": "fadd", "SUB": "fsub", "MUL": "fmul", "DIV": "fdiv"}
_COMPARISONS = {"LT": "<", "LE": "<=", "EQ": "==", "NE": "!="}
_INTRINSIC = ("sqrt", "exp", "log", "sin", "cos", "fabs", "floor", "ceil")
_LIBRARY = (
    *("tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
    *("erf", "expm1", "log1p", "atan2", "hypot", "copysign", "fmod"),
)
_NAMES = {
    code: name
    for name in (
        *(*_BINARY, *_COMPARISONS, *(n.upper() for n in (*_INTRINSIC, *_LIBRARY))),
        *("ASSIGN", "NEG", "SQ", "TWICE", "INV", "FMIN", "FMAX", "SIGN"),
        *("NOT", "AND", "OR", "IF_ELSE_ZERO", "POW", "CONSTPOW"),
    )
    if (code := getattr(ca, f"OP_{name}", None)) is not None
}


class Step(NamedTuple):
    """One operation: its name and its arguments.

    - "CONST": a number.
    - "INPUT": an index of the array.
    - "OUTPUT": an index of the array, and the number of the step whose result is written there.
    - "LEVEL": the level below which the function returns.
    - "BEGIN": no arguments; ends the operations of level -1.
    - An operation of casadi: the numbers of the steps whose results it uses.
    """

    name: str
    arguments: tuple[float, ...]


def steps_of(graph: ca.Function, indices: Sequence[Sequence[int]]) -> tuple[Step, ...]:
    """Return the operations of a function of one vector; each output is one level.

    `indices` has, for each output, the indices of the array at which its nonzeros are written.
    """
    steps: list[Step] = []
    latest: dict[int, int] = {}  # the last step that wrote to an element of casadi's memory
    level = 0
    for k in range(graph.n_instructions()):
        code, target = graph.instruction_id(k), graph.instruction_output(k)
        source = graph.instruction_input(k)
        if code == ca.OP_OUTPUT:
            while level < target[0]:
                level += 1
                steps.append(Step("LEVEL", (level,)))
            steps.append(Step("OUTPUT", (indices[level][target[1]], latest[source[0]])))
            continue
        if code == ca.OP_CONST:
            step = Step("CONST", (graph.instruction_constant(k),))
        elif code == ca.OP_INPUT:
            step = Step("INPUT", (1 + source[1],))
        elif code in _NAMES:
            step = Step(_NAMES[code], tuple(latest[i] for i in source))
        else:
            raise ModelError(
                f"the equations use the casadi operation {code}, which has no translation; use "
                f"arithmetic, comparisons, {', '.join((*_INTRINSIC, *_LIBRARY))}"
            )
        latest[target[0]] = len(steps)
        steps.append(step)
    return tuple(steps)


def prepared(steps: Sequence[Step], first: int, last: int) -> tuple[tuple[Step, ...], int]:
    """Return the steps in another order, and the number of results that are stored.

    Steps that depend only on constants and on inputs `first` to `last` come first. They are
    executed once for many calls, at level -1, and their results are stored in the array from index
    `last` on, before the outputs.
    """
    fixed = [False] * len(steps)
    for i, (name, values) in enumerate(steps):
        if name == "INPUT":
            fixed[i] = first <= values[0] < last
        elif name not in ("OUTPUT", "LEVEL"):
            fixed[i] = name == "CONST" or all(fixed[int(j)] for j in values)
    needed = {
        int(j)
        for i, (name, values) in enumerate(steps)
        if not fixed[i] and name not in ("INPUT", "LEVEL")
        for j in (values[1:] if name == "OUTPUT" else values)
    }
    stored = [i for i in sorted(needed) if fixed[i] and steps[i].name not in ("CONST", "INPUT")]
    new_number: dict[int, int] = {}
    result: list[Step] = []

    def add(i: int) -> None:
        name, values = steps[i]
        if name == "OUTPUT":
            values = (values[0] + len(stored), new_number[int(values[1])])
        elif name not in ("CONST", "INPUT", "LEVEL"):
            values = tuple(new_number[int(j)] for j in values)
        new_number[i] = len(result)
        result.append(Step(name, values))

    for i in range(len(steps) if stored else 0):
        if fixed[i]:
            add(i)
    result += [Step("OUTPUT", (last + slot, new_number[i])) for slot, i in enumerate(stored)]
    result.append(Step("BEGIN", ()))
    for slot, i in enumerate(stored):
        new_number[i] = len(result)
        result.append(Step("INPUT", (last + slot,)))
    for i in range(len(steps)):
        if not fixed[i] or steps[i].name in ("CONST", "INPUT"):
            add(i)
    return tuple(result), len(stored)


@cache
def compiled(steps: tuple[Step, ...]) -> Any:
    """Return the C function ``f(numbers)`` of some steps; the same steps are compiled once."""
    from llvmlite import ir
    from numba import cfunc, types
    from numba.extending import intrinsic

    @intrinsic  # type: ignore[untyped-decorator]  # numba's decorator has no type
    def write(_context: Any, _array: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            _write(steps, builder, arguments[0])
            return ir.Constant(ir.IntType(64), 0)

        return types.int64(types.CPointer(types.float64)), generate

    def equations(numbers: Any) -> None:
        write(numbers)

    return cfunc(types.void(types.CPointer(types.float64)))(equations)


def _write(steps: Sequence[Step], builder: Any, array: Any) -> None:
    """Write the instructions of all steps with a builder of numba."""
    from llvmlite import ir

    number, whole = ir.DoubleType(), ir.IntType(32)
    zero, one, two = (ir.Constant(number, v) for v in (0.0, 1.0, 2.0))
    results: list[Any] = []
    end, begin = (builder.append_basic_block(name) for name in ("end", "begin"))
    prepare = builder.append_basic_block("prepare")

    def address(i: float) -> Any:
        return builder.gep(array, [ir.Constant(whole, int(i))])

    def call(name: str, *arguments: Any) -> Any:
        kind = ir.FunctionType(number, [number] * len(arguments))
        function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
        return builder.call(function, arguments)

    def as_number(truth: Any) -> Any:
        return builder.select(truth, one, zero)

    def holds(a: Any) -> Any:
        return builder.fcmp_unordered("!=", a, zero)

    def power(
        a: Any, b: Any
    ) -> Any:  # 0^b is 0 for any b but 0, so that slopes at kinks are finite
        at_zero = as_number(builder.fcmp_ordered("==", b, zero))
        positive = call("llvm.exp.f64", builder.fmul(b, logarithm(a)))  # shares the logarithm
        before = builder.block
        with builder.if_then(builder.fcmp_ordered("<", a, zero), likely=False):
            negative, inside = call("llvm.pow.f64", a, b), builder.block
        result = builder.phi(number)
        result.add_incoming(positive, before)
        result.add_incoming(negative, inside)
        return builder.select(builder.fcmp_ordered("==", a, zero), at_zero, result)

    def not_zero(a: Any) -> Any:  # logarithms and the slopes of roots are then finite at 0
        tiny = ir.Constant(number, float(np.finfo(np.float64).tiny))
        return builder.select(builder.fcmp_ordered("==", a, zero), tiny, a)

    def logarithm(a: Any) -> Any:
        return call("llvm.log.f64", not_zero(a))

    operations: Mapping[str, Callable[..., Any]] = {
        "LOG": logarithm,
        "SQRT": lambda a: call("llvm.sqrt.f64", not_zero(a)),
        "ASSIGN": lambda a: a,
        "NEG": lambda a: builder.fsub(ir.Constant(number, -0.0), a),
        "SQ": lambda a: builder.fmul(a, a),
        "TWICE": lambda a: builder.fmul(two, a),
        "INV": lambda a: builder.fdiv(one, a),
        "FMIN": lambda a, b: builder.select(builder.fcmp_ordered("<", b, a), b, a),
        "FMAX": lambda a, b: builder.select(builder.fcmp_ordered(">", b, a), b, a),
        "SIGN": lambda a: builder.fsub(
            as_number(builder.fcmp_ordered(">", a, zero)),
            as_number(builder.fcmp_ordered("<", a, zero)),
        ),
        "NOT": lambda a: as_number(builder.fcmp_ordered("==", a, zero)),
        "AND": lambda a, b: as_number(builder.and_(holds(a), holds(b))),
        "OR": lambda a, b: as_number(builder.or_(holds(a), holds(b))),
        "IF_ELSE_ZERO": lambda a, b: builder.select(holds(a), b, zero),
        "POW": power,
        "CONSTPOW": power,
    }
    is_preparation = builder.fcmp_ordered("<", builder.load(address(0)), zero)
    builder.cbranch(is_preparation, prepare, begin)
    builder.position_at_end(prepare)
    for name, values in steps:
        result = None
        if name == "BEGIN":
            builder.branch(end)
            builder.position_at_end(begin)
        elif name == "CONST":
            result = ir.Constant(number, values[0])
        elif name == "INPUT":
            result = builder.load(address(values[0]))
        elif name == "OUTPUT":
            builder.store(results[int(values[1])], address(values[0]))
        elif name == "LEVEL":
            is_enough = builder.fcmp_ordered(
                "<", builder.load(address(0)), ir.Constant(number, values[0])
            )
            more = builder.append_basic_block("more")
            builder.cbranch(is_enough, end, more)
            builder.position_at_end(more)
        else:
            operands = [results[int(i)] for i in values]
            if name in operations:
                result = operations[name](*operands)
            elif name in _BINARY:
                result = getattr(builder, _BINARY[name])(*operands)
            elif name in _COMPARISONS:
                result = as_number(builder.fcmp_ordered(_COMPARISONS[name], *operands))
            else:
                function = name.lower()
                is_intrinsic = function in _INTRINSIC
                result = call(f"llvm.{function}.f64" if is_intrinsic else function, *operands)
        results.append(result)
    builder.branch(end)
    builder.position_at_end(end)
