"""Tables of parameters as LaTeX and HTML."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterable, Sequence

from dahl_ident.diagnostics.formatting import rounded

_SYMBOLS = {"f_max": r"f_\mathrm{max}", "sigma": r"\sigma", "alpha": r"\alpha"}


def html_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return an HTML table, without any style."""

    def row(cells: Sequence[str], tag: str) -> str:
        return f"<tr>{''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"

    body = "".join(row(cells, "td") for cells in rows)
    return f"<table><thead>{row(header, 'th')}</thead><tbody>{body}</tbody></table>"


def tabular(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a LaTeX table that needs no package."""
    lines = [" & ".join(row) + r" \\" for row in (header, *rows)]
    body = "\n".join([r"\hline", lines[0], r"\hline", *lines[1:], r"\hline"])
    return f"\\begin{{tabular}}{{l{'r' * (len(header) - 2)}l}}\n{body}\n\\end{{tabular}}\n"


def symbol(name: str) -> str:
    """Return the name of a parameter as LaTeX."""
    return f"${_SYMBOLS[name]}$" if name in _SYMBOLS else name.replace("_", r"\_")


def unit(text: str) -> str:
    """Return a unit as LaTeX."""
    return re.sub(r"\^(-?\d+)", r"$^{\1}$", text.replace(" ", r"\,"))


def pair(value: float, uncertainty: float | None) -> tuple[str, str]:
    """Return a value and its uncertainty as LaTeX, to the same place."""
    if uncertainty is None or not math.isfinite(uncertainty):
        return f"${_power(f'{value:g}')}$", ""
    first, second = rounded(value, uncertainty)
    return f"${_power(first)}$", f"${_power(second)}$"


def _power(text: str) -> str:
    mantissa, _, exponent = text.partition("e")
    return rf"{mantissa} \times 10^{{{int(exponent)}}}" if exponent else mantissa
