"""From equations in casadi symbols to one compiled function with exact derivatives.

A system has states y, of which the first two are displacement and velocity, a drive u, a direction
s = sgn(v), parameters p, and

    dy/dt = rates(y, u, s, p),    output(y, u, s, p).

casadi differentiates both. Comparisons, signs and absolute values in the expression are switching
functions, whose sides are constant between two events (:mod:`dahl_ident.engine.switches`). The
expression graph is then compiled as a C function with a fixed signature
(:mod:`dahl_ident.engine.emit`), so that the kernels are compiled once for all systems.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dahl_ident.engine.emit import compiled, prepared, steps_of
from dahl_ident.engine.switches import on_one_branch


class Equations(NamedTuple):
    """The equations of a system in casadi symbols.

    Attributes
    ----------
    states : sequence of SX
        Displacement, velocity, then any others.
    drive : SX
        The force or acceleration on the system; unused if the displacement is held.
    direction : SX
        Sign of the velocity.
    parameters : sequence of SX
    rates : SX
        Derivatives of the states with respect to time. Those of displacement and velocity are not
        used if the displacement is held.
    output : SX
        The measured quantity.
    held : bool
        Whether the displacement is prescribed, not a response to the drive.
    """

    states: Sequence[ca.SX]
    drive: ca.SX
    direction: ca.SX
    parameters: Sequence[ca.SX]
    rates: ca.SX
    output: ca.SX
    held: bool


@dataclass(frozen=True)
class System:
    """Compiled equations for the kernels.

    Attributes
    ----------
    function : callable
        ``f(numbers)``, a numba C function of one array: inputs, then outputs. Inputs: the level (0
        for values, 1 also for derivatives with respect to the states, 2 also with respect to drive
        and parameters), states, drive, direction, sides of the switches, parameters. A call with
        level -1 is needed once for every set of parameters: it computes the quantities that depend
        only on them, and stores these after the inputs. Outputs: rates, output and switching
        functions; their derivatives with respect to the states, row by row; those with respect to
        drive and parameters, row by row. Zeros are not written.
    sizes : ndarray of int, shape (6,)
        Numbers of states, switches, parameters; 1 if the displacement is held, otherwise 0; 1 if
        the output for a held displacement depends on its speed, otherwise 0; number of stored
        quantities that depend on parameters only.
    solved : ndarray of int
        States for which the equations of an implicit step are solved.
    followers : ndarray of int
        States that change in proportion to the displacement while no switch changes its side, such
        as the forces of Jenkins elements. They need no integration.
    odd : bool
        Whether the equations stay the same if states, drive and direction change sign.
    """

    function: Any
    sizes: NDArray[np.int64]
    solved: NDArray[np.int64]
    followers: NDArray[np.int64]
    odd: bool

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.sizes[0])

    @property
    def held(self) -> bool:
        """Whether the displacement is prescribed."""
        return bool(self.sizes[3])


def translate(equations: Equations) -> System:
    """Return the compiled system of some equations; the same equations are compiled once.

    Examples
    --------
    >>> x, v, F, u, s, k = (ca.SX.sym(name) for name in "xvFusk")
    >>> system = translate(Equations([x, v, F], u, s, [k], ca.vertcat(v, u - F, k * v), x, False))
    >>> system.order, system.followers.tolist(), system.odd
    (3, [2], True)
    """
    states, drive, parameters = equations.states, equations.drive, equations.parameters
    outputs = ca.vertcat(equations.rates, equations.output)
    smooth, switches, sides = on_one_branch(
        [*states, drive, equations.direction], outputs, (states[1], equations.direction), parameters
    )
    rows = ca.vertcat(smooth, *switches)
    y = ca.vertcat(*states)
    by_state = ca.jacobian(rows, y)
    by_parameter = ca.jacobian(rows, ca.vertcat(drive, *parameters))
    numbers = ca.vertcat(*states, drive, equations.direction, *sides, *parameters)
    graph = ca.Function("f", [numbers], [ca.densify(rows), by_state, by_parameter])
    last = 1 + numbers.numel()
    indices = _output_indices(numbers.numel(), rows.numel(), graph)
    steps, stored = prepared(steps_of(graph, indices), last - len(parameters), last)
    order = len(states)
    followers = _followers(by_state, rows, states, drive)
    solved = [i for i in range(1 + equations.held, order) if i not in followers]
    rated = equations.held and not _is_rate_independent(equations)
    return System(
        compiled(steps),
        np.array(
            [order, len(switches), len(parameters), equations.held, rated, stored], dtype=np.int64
        ),
        np.array(solved, dtype=np.int64),
        np.array(followers, dtype=np.int64),
        is_odd(equations),
    )


def _followers(by_state: ca.SX, rows: ca.SX, states: Sequence[ca.SX], drive: ca.SX) -> list[int]:
    """Return the states whose rate is the velocity times a constant of the branch."""
    variables = ca.vertcat(*states, drive)
    followers = []
    for i in range(2, len(states)):
        at_rest = ca.substitute(rows[i], states[1], ca.SX(0.0))
        if not ca.depends_on(ca.vertcat(at_rest, by_state[i, 1]), variables):
            followers.append(i)
    return followers


_ODD = (
    ca.OP_SIN,
    ca.OP_TAN,
    ca.OP_SINH,
    ca.OP_TANH,
    ca.OP_ASIN,
    ca.OP_ATAN,
    ca.OP_ASINH,
    ca.OP_ATANH,
    ca.OP_ERF,
)
_EVEN_FUNCTIONS = (ca.OP_COS, ca.OP_COSH)


def _factors(equations: Equations, states: Sequence[float], others: float) -> list[float]:
    """Return the factors by which rates and output change if their arguments are multiplied.

    The states are multiplied by `states`, drive and direction by `others`. The factors hold for all
    numbers, as they follow from the expression: NaN if there is no such factor or the expression
    does not show it; 0 if the result is zero.
    """
    symbols = [*equations.states, equations.drive, equations.direction, *equations.parameters]
    outputs = ca.vertcat(equations.rates, equations.output)
    function = ca.Function("f", symbols, [outputs])
    inputs = [*states, others, others, *[1.0] * len(equations.parameters)]
    work: dict[int, float] = {}
    constants: dict[int, float] = {}
    result = [0.0] * function.nnz_out(0)
    for k in range(function.n_instructions()):
        code, source = function.instruction_id(k), function.instruction_input(k)
        (*_, target), factor = function.instruction_output(k), np.nan
        if code == ca.OP_OUTPUT:
            result[target] = work[source[0]]
            continue
        exponent = constants.get(source[-1], np.nan) if source else np.nan
        constants.pop(target, None)
        if code == ca.OP_CONST:
            constants[target] = function.instruction_constant(k)
            factor = float(constants[target] != 0.0)
        elif code == ca.OP_INPUT:
            factor = inputs[source[0]]
        else:
            factors = [work[i] for i in source]
            a, b = factors[0], factors[-1]
            common = a if a == b else np.nan
            if code in (ca.OP_ADD, ca.OP_SUB):
                factor = a + b if 0.0 in factors else common
            elif code == ca.OP_MUL:
                factor = 0.0 if 0.0 in factors else a * b
            elif code == ca.OP_DIV and b:
                factor = a / b
            elif code == ca.OP_INV and a:
                factor = 1.0 / a
            elif code in (ca.OP_NEG, ca.OP_TWICE):
                factor = a
            elif code == ca.OP_SQ:
                factor = a**2
            elif code == ca.OP_FABS:
                factor = abs(a)
            elif code == ca.OP_SIGN:
                factor = np.sign(a)
            elif code in (ca.OP_FMIN, ca.OP_FMAX) and common > 0.0:
                factor = a
            elif code in (ca.OP_POW, ca.OP_CONSTPOW) and a and exponent.is_integer():
                factor = a**exponent
            elif code in _ODD and abs(a) == 1.0:
                factor = a
            elif (
                (code in (ca.OP_LT, ca.OP_LE) and common > 0.0)
                or (code in _EVEN_FUNCTIONS and a == -1.0)
                or all(factor in (0.0, 1.0) for factor in factors)
            ):
                factor = 1.0
        work[target] = factor
    return result


def is_odd(equations: Equations) -> bool:
    """Return whether rates and output change sign with states, drive and direction."""
    factors = _factors(equations, [-1.0] * len(equations.states), -1.0)
    return all(factor in (-1.0, 0.0) for factor in factors)


def _is_rate_independent(equations: Equations) -> bool:
    """Return whether rates are proportional to the speed, and the output does not depend on it."""
    *rates, output = _factors(equations, [1.0, 2.0] + [1.0] * (len(equations.states) - 2), 1.0)
    return output in (0.0, 1.0) and all(rate in (2.0, 0.0) for rate in rates)


def _output_indices(n_inputs: int, n_rows: int, graph: ca.Function) -> list[list[int]]:
    """Return the indices of each level's nonzeros in the array, after the level and the inputs."""
    indices, start = [], 1 + n_inputs
    for level in range(3):
        sparsity = graph.sparsity_out(level)
        columns = sparsity.size2()
        row, column = sparsity.get_triplet()
        indices.append([start + r * columns + c for r, c in zip(row, column, strict=True)])
        start += n_rows * columns
    return indices
