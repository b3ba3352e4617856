"""Plain data as TOML text; the standard library reads TOML but does not write it."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from typing import Any

_WIDTH = 50  # columns of a list; a longer one takes several lines


def toml_text(data: Mapping[str, Any], prefix: str = "") -> str:
    """Return nested dicts of strings, numbers, booleans and lists as TOML.

    Parameters
    ----------
    data : mapping
        Plain data without None.
    prefix : str
        Dotted name of the table that `data` is.

    Returns
    -------
    str

    Examples
    --------
    >>> print(toml_text({"seed": 1, "plant": [{"kind": "mass", "mass": 0.3}]}))
    seed = 1
    <BLANKLINE>
    [[plant]]
    kind = "mass"
    mass = 0.3
    <BLANKLINE>
    """
    lines = []
    tables = []
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            tables.append(f"\n[{name}]\n{toml_text(value, f'{name}.')}")
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            tables += [f"\n[[{name}]]\n{toml_text(entry, f'{name}.')}" for entry in value]
        else:
            lines.append(f"{key} = {_scalar(value)}\n")
    return "".join(lines + tables)


def _scalar(value: Any) -> str:
    if isinstance(value, list):
        text = f"[{', '.join(_scalar(v) for v in value)}]"
        return text if len(text) <= _WIDTH else "\n    ".join(textwrap.wrap(text, _WIDTH))
    # JSON writes strings, booleans and finite numbers as TOML does
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
