"""Formatting of numbers, rounded according to their uncertainty, and tables as LaTeX and HTML."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterable, Sequence

_DIGITS = 12  # significant digits of a number with a very small uncertainty
_MANY_DOF = 999.5  # degrees of freedom from which k is that of a normal distribution to 0.1 %
_LEAST_P = 1e-12  # smaller values depend on unknown tails of distributions
_SYMBOLS = {"f_max": r"f_\mathrm{max}", "sigma": r"\sigma", "alpha": r"\alpha"}


def rounded(value: float, uncertainty: float | None) -> tuple[str, str]:
    """Return value and uncertainty as text, the uncertainty with two significant digits.

    Examples
    --------
    >>> rounded(0.0999123, 0.00101)
    ('0.0999', '0.0010')
    >>> rounded(2.4e6, 31234.0)
    ('2.400e+06', '0.031e+06')
    >>> rounded(1.5, None)
    ('1.5', '?')
    >>> rounded(0.1, 3e-16)
    ('0.1', '3e-16')
    >>> rounded(51310.0, 17598.0)
    ('51000', '18000')
    >>> rounded(31.4, 8.2e5)
    ('31', '8.2e+05')
    """
    if uncertainty is None or not math.isfinite(uncertainty) or not math.isfinite(value):
        return f"{value:.6g}", "?"
    if uncertainty == 0.0:
        return f"{value:.6g}", "0"
    if uncertainty < 10.0**-_DIGITS * abs(value):
        return f"{value:.{_DIGITS}g}", f"{uncertainty:.1g}"
    if abs(value) < 0.1 * uncertainty:  # its digits would all be rounded away
        return f"{value:.2g}", f"{uncertainty:.2g}"
    # rounding 0.0996 to two digits gives 0.10, so the digits follow the rounded uncertainty
    last = math.floor(math.log10(float(f"{uncertainty:.1e}"))) - 1
    number, error = _with_last_digit((value, uncertainty), last)
    return number, error


def _with_last_digit(numbers: Sequence[float], last: int) -> list[str]:
    """Return numbers with the same exponent, whose last digit is that of 10^last."""
    power = math.floor(math.log10(max(abs(number) for number in numbers)))
    exponent = power if power >= 5 or power < -3 else 0
    digits = exponent - last  # negative where the last digit is left of the decimal point
    texts = [f"{round(number / 10.0**exponent, digits):.{max(0, digits)}f}" for number in numbers]
    return [f"{text}e{exponent:+03d}" for text in texts] if exponent else texts


def with_unit(value: float, uncertainty: float | None, unit: str) -> str:
    """Return ``"0.0999 ± 0.0010 N"``."""
    number, error = rounded(value, uncertainty)
    return f"{number} ± {error} {unit}".rstrip()


def p_text(p: float) -> str:
    """Return ``"p = 0.012"``, or ``"p < 1e-12"``."""
    return f"p = {p:.2g}" if p >= _LEAST_P else f"p < {_LEAST_P:.0e}"


def degrees_text(dof: Iterable[float]) -> str:
    """Return degrees of freedom as text, or the range of several.

    Examples
    --------
    >>> degrees_text([24.08]), degrees_text([math.inf]), degrees_text([57.0, 6250.0])
    ('24.1', 'infinite', '57 to more than 1000')
    >>> degrees_text([24.0, 24.1])
    '24'
    """
    values = list(dof) or [math.inf]
    least, most = min(values), max(values)
    if least >= _MANY_DOF:
        return "more than 1000" if math.isfinite(least) else "infinite"
    text = f"{least:.3g}"
    last = degrees_text([most]) if most >= _MANY_DOF else f"{most:.3g}"
    return text if f"{least:.2g}" == f"{most:.2g}" else f"{text} to {last}"


def listed(words: Sequence[str]) -> str:
    """Return ``"a, b and c"``."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def interval(lower: float, upper: float, unit: str) -> str:
    """Return ``"0.098 to 0.102 N"``; an open end is written in words.

    Examples
    --------
    >>> interval(0.0981, 0.1019, "N")
    '0.0981 to 0.1019 N'
    >>> interval(0.31, math.inf, "N")
    'at least 0.31 N'
    >>> interval(3.9e5, 1.52e7, "N/m")
    '3.9e+05 to 1.5e+07 N/m'
    >>> interval(0.1, 0.1 + 1e-15, "N")
    '0.1 N'
    """
    low_open, high_open = not math.isfinite(lower), not math.isfinite(upper)
    if low_open and high_open:
        return "anything"
    if high_open:
        return f"at least {lower:.3g} {unit}".rstrip()
    if low_open:
        return f"at most {upper:.3g} {unit}".rstrip()
    if upper - lower <= 10.0**-_DIGITS * max(abs(lower), abs(upper)):
        return f"{lower:.{_DIGITS}g} {unit}".rstrip()
    if 0.0 < lower < 0.1 * upper:  # its digits would be rounded away
        return f"{lower:.2g} to {upper:.2g} {unit}".rstrip()
    low, high = _with_last_digit((lower, upper), math.floor(math.log10(upper - lower)) - 1)
    return f"{low} to {high} {unit}".rstrip()


def table(rows: Sequence[Sequence[str]], left: Sequence[int] = (0,)) -> str:
    """Return rows of text as aligned columns; those numbered in `left` are left-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    columns = [f"{'<' if i in left else '>'}{width}" for i, width in enumerate(widths)]
    lines = (map(format, row, columns) for row in rows)
    return "\n".join("  ".join(line).rstrip() for line in lines)


def html_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return an HTML table without style."""

    def row(cells: Sequence[str], tag: str) -> str:
        return f"<tr>{''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"

    body = "".join(row(cells, "td") for cells in rows)
    return f"<table><thead>{row(header, 'th')}</thead><tbody>{body}</tbody></table>"


def tabular(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a LaTeX table that requires no package."""
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
    """Return a value and its uncertainty as LaTeX, rounded to the same digit."""
    if uncertainty is None or not math.isfinite(uncertainty):
        return f"${_power(f'{value:g}')}$", ""
    first, second = rounded(value, uncertainty)
    return f"${_power(first)}$", f"${_power(second)}$"


def _power(text: str) -> str:
    mantissa, _, exponent = text.partition("e")
    return rf"{mantissa} \times 10^{{{int(exponent)}}}" if exponent else mantissa
