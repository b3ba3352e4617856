r"""Constraints between parameters, as the user writes them: comparisons by name.

A function takes a mapping of every parameter's name to its casadi symbol, in SI units, and
returns comparisons::

    lambda p: [
        p["f_max"] <= 1e-3 * p["sigma"],         # x_c of at most 1 mm
        p["pivot_sigma"] == p["seal_sigma"],
    ]

Fixed parameters stand there as well, as the numbers they are held at. ``<`` means ``<=``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.problem import Problem

if TYPE_CHECKING:
    import casadi as ca

Constraints = Callable[[Mapping[str, "ca.SX"]], Iterable["ca.SX"]]
"""What a user gives; see the head of this module."""


_EXAMPLE = "lambda p: [p['f_max'] <= 1e-3 * p['sigma']]"


@dataclass(frozen=True)
class Relations:
    """The user's constraints: text, and lhs - rhs of all parameters' values."""

    texts: tuple[str, ...]
    equal: tuple[bool, ...]
    differences: ca.Function | None

    @property
    def freedom_lost(self) -> int:
        """Number of equalities."""
        return sum(self.equal)

    @classmethod
    def of(cls, problem: Problem, constraints: Constraints | None) -> Relations:
        """Read the user's comparisons, or say what they are instead."""
        import casadi as ca

        if constraints is None:
            return cls((), (), None)
        symbols = _Symbols((p.name, ca.SX.sym(p.name)) for p in problem.every_parameter)
        free = ca.vertcat(*(symbols[name] for name in problem.names))
        texts, equal, differences = [], [], []
        for index, item in enumerate(_called(constraints, symbols)):
            relation = _is_comparison(item)
            if relation is None:
                raise ValidationError(
                    f"constraints[{index}] is {item!r}; expected a comparison with <=, >= or == "
                    "such as p['f_max'] <= 1e-3 * p['sigma']"
                )
            difference = item.dep(0) - item.dep(1)
            if not ca.depends_on(difference, free):
                raise ValidationError(
                    f"constraints[{index}], {item}, holds no free parameter; free are "
                    f"{', '.join(problem.names)}"
                )
            texts.append(str(item).removeprefix("(").removesuffix(")"))
            equal.append(relation == ca.OP_EQ)
            differences.append(difference)
        if not differences:
            return cls((), (), None)
        function = ca.Function("differences", list(symbols.values()), [ca.vertcat(*differences)])
        return cls(tuple(texts), tuple(equal), function)

    def at(self, problem: Problem, theta: ca.SX) -> ca.SX:
        """Return lhs - rhs as expressions of the search coordinates theta."""
        import casadi as ca

        if self.differences is None:
            return ca.SX(0, 1)
        values = []
        for parameter in problem.every_parameter:
            if parameter.name in problem.names:
                index = problem.names.index(parameter.name)
                values.append(problem.space.value(index, theta[index], ca))
            else:
                values.append(ca.SX(float(parameter.value or 0.0)))
        differences: ca.SX = self.differences.call(values)[0]
        return differences


class _Symbols(dict[str, "ca.SX"]):
    """Symbols by name; an unknown name is an error that lists the known ones."""

    def __missing__(self, name: str) -> ca.SX:
        raise ModelError(f"a constraint names {name!r}; the parameters are {', '.join(self)}")


def _called(constraints: Constraints, symbols: _Symbols) -> list[Any]:
    import casadi as ca

    if not callable(constraints):
        raise ValidationError(f"constraints is {constraints!r}; expected a function: {_EXAMPLE}")
    try:
        relations = constraints(symbols)
    except RuntimeError as exc:  # casadi's, for the truth value that 0 <= x <= 1 asks for
        if "truth value" not in str(exc):
            raise
        raise ValidationError(
            "a constraint chains comparisons or joins them with 'and'; write each as one item, "
            "such as [p['sigma'] >= 1, p['sigma'] <= 2]"
        ) from None
    if isinstance(relations, ca.SX) or not isinstance(relations, Iterable):
        raise ValidationError(
            f"constraints returned {relations!r}; expected a list of comparisons: {_EXAMPLE}"
        )
    return list(relations)


def _is_comparison(item: Any) -> int | None:
    """Return casadi's code of the comparison of two scalars that `item` is, else None."""
    import casadi as ca

    if not isinstance(item, ca.SX) or not item.is_scalar():
        return None
    return next((op for op in (ca.OP_LE, ca.OP_LT, ca.OP_EQ) if item.is_op(op)), None)
