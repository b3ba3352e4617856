"""Dictionaries that users write in TOML, JSON or Python, checked against dataclasses."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np

from dahl_ident.data.storage import plain_data
from dahl_ident.errors import DataError, choices

_T = TypeVar("_T")
_EXPECTED = {
    "bool_type": "true or false",
    "dataclass_type": "a table of named values",
    "dict_type": "a table of named values",
    "float_type": "a number",
    "int_type": "a whole number",
    "list_type": "a list",
    "string_type": "text",
}


def checked(kind: type[_T], entries: Any, where: str) -> _T:
    """Return the dataclass that `entries` describe; `where` names them in messages.

    Every key is a field, and every value of its type: a number is not text.
    """
    from pydantic import TypeAdapter, ValidationError

    mapping = dict[str, kind]  # type: ignore[valid-type]  # a dataclass itself takes no options
    adapter = TypeAdapter(mapping, config={"extra": "forbid", "strict": True})
    try:
        content = _plain(entries, where)
        # as JSON, because strict types take no mapping of Python for a dataclass
        return adapter.validate_json(json.dumps({"": content}))[""]
    except ValidationError as exc:
        raise DataError(_message(kind, content, where, exc.errors(include_url=False))) from exc
    except RecursionError as exc:
        raise DataError(
            f"{where}: tables or lists are nested too deeply, or hold themselves"
        ) from exc


def _plain(value: Any, place: str, separator: str = ": ") -> Any:
    """Return dictionaries, lists, text and numbers; refuse anything else, such as a date."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v, f"{place}{separator}{k}", ".") for k, v in value.items()}
    if isinstance(value, (np.ndarray, np.generic, complex)):
        return plain_data(value)
    if isinstance(value, (list, tuple)):
        return [_plain(v, f"{place}[{i}]", ".") for i, v in enumerate(value)]
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if value is None or isinstance(value, (str, float, int)):
        return value
    raise DataError(f"{place} is {value!r}; expected text in quotes, a number, a list or a table")


def expecting(description: str, **options: Any) -> Any:
    """Return a field with a description of its values for messages; `options` as its default."""
    return field(metadata={"description": description}, **options)


def _message(kind: Any, value: Any, where: str, faults: Sequence[Any]) -> str:
    """Return where the first fault is, what was found and what was expected."""
    unknown = [fault for fault in faults if fault["type"] == "unexpected_keyword_argument"]
    fault = (unknown or faults)[0]
    path, description, declared = "", None, kind.__dataclass_fields__
    keys = [*fault["loc"][1:]]
    key = keys.pop() if unknown or fault["type"] == "missing" else ""
    for part in keys:
        if isinstance(part, int):
            path, value = f"{path}[{part}]", value[part]
        elif part in declared:  # others are members of a union
            path, value = f"{path}.{part}", value[part]
            description = declared[part].metadata.get("description")
            kind = get_type_hints(kind)[part]
            while args := get_args(kind):  # of X | None and list[X]
                kind = args[0]
            declared = getattr(kind, "__dataclass_fields__", {})
    place = f"{where}: {path.removeprefix('.')}" if path else where
    if unknown:
        return f"{place}: unknown entry {key!r}; expected {choices(declared, key)}"
    if key:
        description = declared[key].metadata.get("description")
        return f"{place} has no {key}; expected {description or choices(declared)}"
    if fault["type"] == "value_error":
        return f"{place}: {fault['ctx']['error']}"
    expected = _EXPECTED.get(fault["type"], fault["msg"].removeprefix("Input should be "))
    if names := re.findall("'(.*?)'", expected):
        expected = f"one of {choices(names, value)}"
    return f"{place} is {value!r}; expected {description or expected}"
