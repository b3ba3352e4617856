"""Separation of a model into friction and linear elements."""

from __future__ import annotations

from typing import NamedTuple

from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.errors import ModelError


class Split(NamedTuple):
    """The friction of a plant, and its linear elements."""

    friction: Model
    linear: Model


def split(plant: Element) -> Split:
    """Return the friction and the linear part of a plant that has both, values included.

    Raises
    ------
    ModelError
        If the plant has no friction or nothing else, or a parameter has no value.
    """
    elements = as_model(plant).elements
    plant.known_values()
    friction = [element for element in elements if not element.is_linear]
    linear = [element for element in elements if element.is_linear]
    for part, what, example in ((friction, "friction", "Dahl"), (linear, "linear part", "Mass")):
        if not part:
            raise ModelError(f"{plant!r} has no {what}; add one, such as {example}(...)")
    return Split(Model(*friction), Model(*linear))
