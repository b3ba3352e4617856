"""Models: elements that relate force to displacement, and their parameters."""

from __future__ import annotations

from dahl_ident.elements.backlash import Backlash
from dahl_ident.elements.bouc_wen import BoucWen
from dahl_ident.elements.dahl import Dahl
from dahl_ident.elements.element import (
    KINDS,
    Element,
    Model,
    describe_model,
    model_from_description,
)
from dahl_ident.elements.equations import Excitation, FirstState, law_equations, plant_equations
from dahl_ident.elements.facts import Asymptote, Combination, UniversalCurve
from dahl_ident.elements.friction import Friction
from dahl_ident.elements.iwan import Iwan
from dahl_ident.elements.linear import Damper, Mass, Spring
from dahl_ident.elements.linear_system import LinearSystem
from dahl_ident.elements.lugre import LuGre
from dahl_ident.elements.maxwell_slip import MaxwellSlip
from dahl_ident.elements.parameter import Parameter
from dahl_ident.elements.power_damper import PowerDamper

__all__ = [
    "KINDS",
    "Asymptote",
    "Backlash",
    "BoucWen",
    "Combination",
    "Dahl",
    "Damper",
    "Element",
    "Excitation",
    "FirstState",
    "Friction",
    "Iwan",
    "LinearSystem",
    "LuGre",
    "Mass",
    "MaxwellSlip",
    "Model",
    "Parameter",
    "PowerDamper",
    "Spring",
    "UniversalCurve",
    "describe_model",
    "law_equations",
    "model_from_description",
    "plant_equations",
]
