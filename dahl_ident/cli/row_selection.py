"""Selection of rows on the command line: ``--where "level > 3 and harmonic == 1"``."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from dahl_ident.errors import ValidationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dahl_ident.data import FrequencyResponse

_COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}


def selected(
    data: FrequencyResponse, where: str | None, levels: str | None, runs: str | None
) -> FrequencyResponse:
    """Return the rows selected by the options --where, --levels and --runs."""
    for option, column, text in (("--levels", "level", levels), ("--runs", "run", runs)):
        if text is not None:
            data = _labelled(data, option, column, [part.strip() for part in text.split(",")])
    if where is None:
        return data
    rows = _Condition(data, where).rows()
    if not rows.any():
        raise ValidationError(f"--where {where!r} selects none of {data.n} rows")
    return data.select(rows=rows)


def _labelled(
    data: FrequencyResponse, option: str, column: str, wanted: list[str]
) -> FrequencyResponse:
    import numpy as np

    labels = getattr(data, column)
    known = [] if labels is None else list(dict.fromkeys(str(label) for label in labels))
    missing = [label for label in wanted if label not in known]
    if missing:
        there = ", ".join(known) if known else f"no {column}s"
        raise ValidationError(f"{option} names {', '.join(missing)}; the data have {there}")
    return data.select(rows=np.array([str(label) in wanted for label in labels]))


class _Condition:
    """A condition on the columns of a table; only comparisons, and, or, not."""

    def __init__(self, data: FrequencyResponse, text: str) -> None:
        import numpy as np

        self._text, self._n = text, data.n
        columns: dict[str, Any] = {
            "frequency_hz": data.frequency_hz,
            "amplitude": data.amplitude,
            "drive": data.drive,
            "gain": data.gain,
            "phase_deg": np.degrees(data.phase),
            "harmonic": data.harmonic,
            "level": data.level,
            "run": data.run,
            **data.quality,
        }
        self._columns = {name: values for name, values in columns.items() if values is not None}

    def rows(self) -> NDArray[np.bool_]:
        """Return which rows meet it."""
        import numpy as np

        try:
            value = self._value(ast.parse(self._text, mode="eval").body)
        except SyntaxError as exc:
            raise self._refused(str(exc.msg)) from exc
        rows = np.asarray(value)
        if rows.dtype != np.bool_ or rows.shape != (self._n,):
            raise self._refused("it contains no comparison")
        return rows

    def _refused(self, why: str) -> ValidationError:
        return ValidationError(
            f"--where is {self._text!r}: {why}; expected comparisons of "
            f"{', '.join(self._columns)}, such as 'level > 3 and harmonic == 1'"
        )

    def _value(self, node: ast.expr) -> Any:
        import numpy as np

        match node:
            case ast.Constant(value=int() | float() | str() as value):
                return value
            case ast.Name(id=name):
                if name not in self._columns:
                    raise self._refused(f"there is no column {name}")
                return self._columns[name]
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return np.logical_not(self._value(operand))
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
                return -value
            case ast.BoolOp(op=op, values=parts):
                join = np.logical_and if isinstance(op, ast.And) else np.logical_or
                return join.reduce([self._value(part) for part in parts])
            case ast.Compare(left=left, ops=ops, comparators=others):
                sides = [self._value(side) for side in (left, *others)]
                pairs = zip(ops, sides, sides[1:], strict=False)
                return np.logical_and.reduce([self._compared(*pair) for pair in pairs])
            case _:
                raise self._refused(f"{ast.unparse(node)} is not understood")

    def _compared(self, op: ast.cmpop, left: Any, right: Any) -> Any:
        import numpy as np

        if type(op) not in _COMPARE:
            raise self._refused("in, is and the like are not understood")
        sides = [np.asarray(side) for side in (left, right)]
        if any(side.dtype.kind in "fiu" for side in sides):
            try:
                sides = [side.astype(float) for side in sides]
            except ValueError as exc:
                raise self._refused(
                    "a label that is not a number is compared with a number"
                ) from exc
        else:
            sides = [side.astype(str) for side in sides]
        return _COMPARE[type(op)](*sides)
