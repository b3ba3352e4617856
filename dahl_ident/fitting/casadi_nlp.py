r"""An optimisation problem over many similar rows, with exact sparse derivatives for IPOPT.

    minimise  f_0(xi) + sum_i f(xi, w_i; d_i)
    subject   g(xi, w_i; d_i) = 0 for every row i,    c(xi) between bounds,

with shared variables xi, and unknowns w_i and numbers d_i of each row. A row depends on xi and
on its own unknowns alone, so the Hessian has the shape of an arrowhead. casadi differentiates
one row of each kind; one mapped call evaluates that for all rows, and the results are, in their
order, the nonzeros of the sparse matrices. By default casadi would use graph colouring on the whole
problem, which takes several times as long to build and to evaluate.

What is long-winded in a row, the quadrature of a general exponent, enters as its expansion about
the row's own numbers (:class:`dahl_ident.fitting.casadi_expansion.Expansion`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.fitting.casadi_rows import RowBlock

if TYPE_CHECKING:
    import casadi as ca

IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class SharedTerms:
    """What depends on the shared variables alone.

    Attributes
    ----------
    variables : casadi.SX, shape (P,)
        xi.
    cost : casadi.SX
        f_0.
    constraints : casadi.SX, shape (C,)
        c.
    """

    variables: ca.SX
    cost: ca.SX
    constraints: ca.SX


class RowwiseProblem:
    """The functions that IPOPT asks for.

    Parameters
    ----------
    shared : SharedTerms
        Expressions of xi.
    blocks : sequence of RowBlock
        Rows kind by kind.
    weight : float
        What a row's loss is multiplied by.
    """

    def __init__(self, shared: SharedTerms, blocks: Sequence[RowBlock], weight: float) -> None:
        import casadi as ca

        self._shared = shared
        self._rows = [_Rows(block, shared.variables, weight) for block in blocks]
        self.n_shared = int(shared.variables.numel())
        self.n_variables = self.n_shared + sum(rows.n * rows.n_own for rows in self._rows)
        self.n_balances = sum(rows.n * rows.n_balance for rows in self._rows)
        self.n_constraints = int(shared.constraints.numel())
        self._x = ca.MX.sym("x", self.n_variables)
        self._p = ca.MX.sym("p", 0)
        start = self.n_shared
        for rows in self._rows:
            stop = start + rows.n * rows.n_own
            rows.arguments = [
                ca.repmat(self._x[: self.n_shared], 1, rows.n),
                ca.reshape(self._x[start:stop], rows.n_own, rows.n),
                ca.DM(rows.block.numbers),
            ]
            start = stop

    def values(self) -> ca.Function:
        """Return (x, p) -> objective, constraints: balances row by row, then c."""
        import casadi as ca

        cost, constraints = self._of_shared([self._shared.cost, self._shared.constraints])
        balances = []
        for rows in self._rows:
            (f,), (g,) = (rows.evaluated([part], 0) for part in (rows.cost, rows.block.balance))
            cost += ca.sum2(f)
            balances.append(ca.vec(g))
        return self._function("nlp", ["f", "g"], [cost, ca.vertcat(*balances, constraints)])

    def gradient(self) -> ca.Function:
        """Return (x, p) -> objective, its gradient."""
        import casadi as ca

        shared = self._shared
        cost, by_shared = self._of_shared([shared.cost, ca.gradient(shared.cost, shared.variables)])
        by_own = []
        for rows in self._rows:
            f, d = rows.evaluated([rows.cost, ca.gradient(rows.cost, rows.variables)], 1)
            cost += ca.sum2(f)
            by_shared += ca.sum2(d[: self.n_shared, :])
            by_own.append(ca.vec(d[self.n_shared :, :]))
        return self._function(
            "nlp_grad_f", ["f", "grad_f_x"], [cost, ca.vertcat(by_shared, *by_own)]
        )

    def jacobian(self) -> ca.Function:
        """Return (x, p) -> constraints, their sparse Jacobian."""
        import casadi as ca

        shared = self._shared
        c, dc = self._of_shared(
            [shared.constraints, _dense_jacobian(shared.constraints, shared.variables)]
        )
        parts = [
            rows.evaluated([rows.block.balance, rows.balance_slopes()], 1) for rows in self._rows
        ]
        columns = []
        for j in range(self.n_shared):
            for rows, (_, d) in zip(self._rows, parts, strict=True):
                m = rows.n_balance
                columns.append(ca.vec(d[m * j : m * (j + 1), :]))
            columns.append(dc[:, j])
        for rows, (_, d) in zip(self._rows, parts, strict=True):
            columns.append(ca.vec(d[rows.n_balance * self.n_shared :, :]))
        g = ca.vertcat(*(ca.vec(g) for g, _ in parts), c)
        matrix = ca.MX(self._jacobian_sparsity(), ca.vertcat(*columns))
        return self._function("nlp_jac_g", ["g", "jac_g_x"], [g, matrix])

    def hessian(self) -> ca.Function:
        """Return (x, p, lam_f, lam_g) -> upper triangle of the Lagrangian's sparse Hessian."""
        import casadi as ca

        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", self.n_balances + self.n_constraints)
        factor = ca.SX.sym("lam_f")
        shared = self._shared
        multipliers = ca.SX.sym("lam_c", self.n_constraints)
        lagrangian = factor * shared.cost + ca.dot(multipliers, shared.constraints)
        by_shared = ca.Function(
            "shared_hess",
            [shared.variables, factor, multipliers],
            [_upper(_dense_hessian(lagrangian, shared.variables), 0)],
        )(self._x[: self.n_shared], lam_f, lam_g[self.n_balances :])
        by_own, start = [], 0
        for rows in self._rows:
            stop = start + rows.n * rows.n_balance
            weights = ca.reshape(lam_g[start:stop], rows.n_balance, rows.n)
            both, own = rows.curvature(factor, lam_f, weights)
            by_shared += ca.sum2(both)
            by_own.append(ca.vec(own))
            start = stop
        matrix = ca.MX(self._hessian_sparsity(), ca.vertcat(by_shared, *by_own))
        return self._function(
            "nlp_hess_l", ["triu_hess_gamma_x_x"], [matrix], {"lam_f": lam_f, "lam_g": lam_g}
        )

    def _of_shared(self, expressions: list[ca.SX]) -> list[ca.MX]:
        import casadi as ca

        function = ca.Function("shared", [self._shared.variables], expressions)
        return list(function.call([self._x[: self.n_shared]]))

    def _function(
        self,
        name: str,
        outputs: list[str],
        results: list[ca.MX],
        more: dict[str, ca.MX] | None = None,
    ) -> ca.Function:
        import casadi as ca

        inputs = {"x": self._x, "p": self._p, **(more or {})}
        return ca.Function(name, list(inputs.values()), results, list(inputs), outputs)

    def _jacobian_sparsity(self) -> ca.Sparsity:
        height = self.n_balances + self.n_constraints
        columns = [np.arange(height)] * self.n_shared
        first = 0
        for rows in self._rows:
            for _ in range(rows.n):
                columns += [first + np.arange(rows.n_balance)] * rows.n_own
                first += rows.n_balance
        return _sparsity(height, columns)

    def _hessian_sparsity(self) -> ca.Sparsity:
        P = self.n_shared
        columns = [np.arange(j + 1) for j in range(P)]
        first = P
        for rows in self._rows:
            for _ in range(rows.n):
                columns += [
                    np.concatenate((np.arange(P), np.arange(first, first + j + 1)))
                    for j in range(rows.n_own)
                ]
                first += rows.n_own
        return _sparsity(self.n_variables, columns)


class _Rows:
    """The derivatives of one kind of rows."""

    arguments: list[ca.MX | ca.DM]

    def __init__(self, block: RowBlock, shared: ca.SX, weight: float) -> None:
        import casadi as ca

        self.block, self._shared = block, shared
        self.n = block.rows.size
        self.n_own, self.n_balance = int(block.unknowns.numel()), int(block.balance.numel())
        self.cost = weight * block.loss
        self.variables = ca.vertcat(shared, block.unknowns)

    @cached_property
    def _inputs(self) -> list[ca.SX]:
        import casadi as ca

        block = self.block
        expansions = ca.vertcat(ca.SX(0, 1), *(e.symbols for e in block.expansions))
        return [self._shared, block.unknowns, block.columns, expansions]

    def _inputs_at(self, arguments: list[Any], order: int) -> list[Any]:
        """Return arguments and the expansions' coefficients up to derivatives of `order`."""
        import casadi as ca

        points = [e.point for e in self.block.expansions]
        if not points:
            return [*arguments, ca.DM(0, self.n)]
        at = ca.Function("points", self._inputs[:3], points).map(self.n).call(arguments)
        coefficients = [
            e.at(order, self.n)(point) for e, point in zip(self.block.expansions, at, strict=True)
        ]
        return [*arguments, ca.vertcat(*coefficients)]

    def evaluated(self, expressions: list[ca.SX], order: int) -> list[ca.MX]:
        """Return expressions of one row, derivatives of `order`, for all rows, side by side."""
        import casadi as ca

        inputs = self._inputs
        if not ca.depends_on(ca.vertcat(*map(ca.vec, expressions)), inputs[-1]):
            row = ca.Function("row", inputs[:-1], expressions)
            return list(row.map(self.n).call(self.arguments))
        row = ca.Function("row", inputs, expressions)
        return list(row.map(self.n).call(self._inputs_at(self.arguments, order)))

    def balance_slopes(self) -> ca.SX:
        """Return the Jacobian of the balance, column after column."""
        import casadi as ca

        return ca.vec(_dense_jacobian(self.block.balance, self.variables))

    def curvature(self, factor: ca.SX, lam_f: ca.MX, lam_g: ca.MX) -> list[ca.MX]:
        """Return upper triangles of the Hessian: shared with shared, then all with own."""
        import casadi as ca

        multipliers = ca.SX.sym("lam", self.n_balance)
        lagrangian = factor * self.cost + ca.dot(multipliers, self.block.balance)
        H = _dense_hessian(lagrangian, self.variables)
        P = int(self._shared.numel())
        row = ca.Function(
            "row", [*self._inputs, factor, multipliers], [_upper(H[:, :P], 0), _upper(H[:, P:], P)]
        )
        inputs = self._inputs_at(self.arguments, 2)
        return list(row.map(self.n).call([*inputs, ca.repmat(lam_f, 1, self.n), lam_g]))


def _dense_jacobian(parts: ca.SX, variables: ca.SX) -> ca.SX:
    import casadi as ca

    return ca.densify(ca.jacobian(parts, variables))


def _dense_hessian(scalar: ca.SX, variables: ca.SX) -> ca.SX:
    import casadi as ca

    return ca.densify(ca.hessian(scalar, variables)[0])


def _upper(columns: ca.SX, first: int) -> ca.SX:
    """Return what stands on or above the diagonal, column after column from column `first`."""
    import casadi as ca

    return ca.vertcat(*(columns[: first + j + 1, j] for j in range(columns.shape[1])))


def _sparsity(height: int, columns: list[IntArray]) -> ca.Sparsity:
    """Return the pattern with the given rows in each column."""
    import casadi as ca

    ends = np.cumsum([0, *(len(column) for column in columns)])
    return ca.Sparsity(height, len(columns), ends.tolist(), np.concatenate(columns).tolist())
