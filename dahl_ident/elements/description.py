"""Conversion of models to plain data and back, for files of results and experiments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dahl_ident.elements.element import Element
from dahl_ident.elements.law_files import KINDS, class_named
from dahl_ident.elements.model import Model, as_model
from dahl_ident.errors import ModelError, choices


def describe_model(model: Element) -> list[dict[str, Any]]:
    """Return a model as a list of plain dicts, ready for JSON or TOML.

    A number is a fixed value, {"assumed": number} a default that nobody gave, "free" a parameter
    to estimate, a table a free one with its start.

    Examples
    --------
    >>> from dahl_ident import Dahl, Mass
    >>> describe_model(Dahl(sigma=30.0) + Mass(0.3))
    [{'kind': 'dahl', 'f_max': 'free', 'sigma': 30.0, 'alpha': {'assumed': 1.0}},
     {'kind': 'mass', 'mass': 0.3}]
    """
    return [_describe(element) for element in as_model(model).elements]


def model_from_description(description: list[Mapping[str, Any]]) -> Model:
    """Return the model that :func:`describe_model` described.

    Examples
    --------
    >>> model_from_description([{"kind": "spring", "stiffness": "free"}])
    Spring(stiffness=free)
    """
    return Model(*(_build(entry) for entry in description))


def _describe(element: Element) -> dict[str, Any]:
    if element.kind not in KINDS:
        raise ModelError(
            f"{element!r} cannot be written to a file; give its class a kind, such as "
            'kind = "my_law"'
        )
    return element.describe()


def _build(entry: Mapping[str, Any]) -> Element:
    content = dict(entry)
    kind = content.pop("kind", None)
    cls = class_named(str(kind))
    if cls is None:
        raise ModelError(
            f"the element {dict(entry)} has the kind {kind!r}; expected a law of your own, "
            "whose file was imported or given as laws (on the command line --laws), or one of "
            f"{choices(KINDS, str(kind))}"
        )
    name = content.pop("name", None)
    return cls.from_description(content, name)
