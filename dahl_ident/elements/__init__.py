"""The model: what acts between displacement and force, and its parameters."""

from __future__ import annotations

from dahl_ident.elements.dahl import Dahl
from dahl_ident.elements.element import Element
from dahl_ident.elements.linear import Damper, Mass, Spring
from dahl_ident.elements.linear_system import LinearSystem
from dahl_ident.elements.model import Model
from dahl_ident.elements.parameter import Parameter

__all__ = ["Dahl", "Damper", "Element", "LinearSystem", "Mass", "Model", "Parameter", "Spring"]
