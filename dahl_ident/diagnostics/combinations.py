"""Combinations of parameters that data can determine without determining each parameter.

========================================  =====================================================
combination                               determined in
========================================  =====================================================
products that an element names            microslip, an unknown gain: `Element.combinations`
stiffness of friction + that of a spring  microslip: the stiffness seen at small amplitudes
sums over two elements of one law         all slipping, or none: of force limits or stiffnesses
stiffness seen, of friction and springs   springs that hide all of friction
========================================  =====================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.bands import friction_and_slopes
from dahl_ident.diagnostics.information import parameter_values
from dahl_ident.diagnostics.physics import is_spring
from dahl_ident.elements import Parameter
from dahl_ident.elements.parameter import STIFFNESS
from dahl_ident.fitting import Optimum
from dahl_ident.units import shown_unit

_UNITS = ("N", "m", "s")


@dataclass(frozen=True)
class Candidate:
    """A combination; `direction` are the derivatives of its logarithm with respect to theta."""

    expression: str
    unit: str
    value: float
    direction: FloatArray
    members: frozenset[str]
    is_sum: bool = False


def candidates(optimum: Optimum) -> list[Candidate]:
    """Return every combination of the optimum's free parameters."""
    problem, names = optimum.problem, optimum.names
    theta = dict(zip(names, problem.to_values(optimum.theta), strict=True))
    slopes = dict(zip(names, problem.value_slopes(optimum.theta), strict=True))
    units = {p.name: p.unit for p in problem.parameters}
    elements = problem.model.elements
    friction = [e for e in elements if e.has_memory]
    springs = [p for e in elements if is_spring(e) for p in e.parameters if p.free]
    formed: list[Candidate] = []
    for element in friction:
        for combination in element.combinations():
            powers = {element.parameter(n): power for n, power in combination.powers.items()}
            if not all(p.free for p in powers):
                continue
            by_name = {p.name: power for p, power in powers.items()}
            with np.errstate(over="ignore", under="ignore"):
                value = float(np.exp(sum(c * np.log(theta[n]) for n, c in by_name.items())))
            direction = np.array([by_name.get(name, 0.0) for name in names])
            unit = shown_unit(_unit(powers), problem.data.motion)
            text = element.named(combination.expression)
            formed.append(Candidate(text, unit, value, direction, frozenset(by_name)))
    scale = [{n: e.parameter(n) for n in e.scale_parameters} for e in friction]
    stiff = (p for labels in scale for p in labels.values() if p.dimension == STIFFNESS)
    pairs = [(p, spring) for p in stiff for spring in springs]
    for (first_element, first), (second_element, second) in combinations(
        zip(friction, scale, strict=True), 2
    ):
        if first_element.kind == second_element.kind:
            pairs += [(first[label], second[label]) for label in first if label in second]
    for both in ([p.name for p in pair] for pair in pairs if all(p.free for p in pair)):
        value = sum(theta[name] for name in both)
        direction = np.array([slopes[n] / value if n in both else 0.0 for n in names])
        text, unit = " + ".join(both), units[both[0]]
        formed.append(Candidate(text, unit, value, direction, frozenset(both), is_sum=True))
    return formed


def stiffness_seen(optimum: Optimum) -> Candidate | None:
    """Return the stiffness of friction and free springs together, in the middle of the amplitudes.

    None without friction and a free spring. Stiffness data always determine it, so it is reported
    only if they determine nothing else.
    """
    problem, names = optimum.problem, optimum.names
    elements = problem.model.elements
    springs = [p.name for e in elements if is_spring(e) for p in e.parameters]
    friction = [
        e.parameter(label).name for e in elements if e.has_memory for label in e.scale_parameters
    ]
    free = frozenset(springs) & frozenset(names)
    if not free or not friction:
        return None
    A = float(np.exp(np.log(problem.stiffness_data.amplitude).mean()))
    N, by = friction_and_slopes(problem, optimum.theta, np.array([A]))
    values = parameter_values(optimum)
    slopes = dict(zip(names, problem.value_slopes(optimum.theta), strict=True))
    of_springs = np.array([slopes[name] if name in free else 0.0 for name in names])
    value = float(N[0].real) + sum(values[name] for name in springs)
    motion = problem.data.motion
    name = f"the stiffness seen at {A:.3g} {shown_unit('m', motion)}"
    direction = (by[0].real + of_springs) / value
    members = free | (frozenset(friction) & frozenset(names))
    return Candidate(name, shown_unit("N/m", motion), value, direction, members)


def runaway(optimum: Optimum) -> frozenset[str]:
    """Return the names of parameters whose optimum is infinite, or zero for positive ones."""
    positive, values = optimum.problem.space.positive, optimum.values
    gone = ~np.isfinite(values) | (positive & (values == 0.0))
    return frozenset(np.array(optimum.names)[gone].tolist())


def _unit(powers: Mapping[Parameter, float]) -> str:
    """Return the unit of a product, such as "N/m^2"."""
    above, below = list[str](), list[str]()
    for i, unit in enumerate(_UNITS):
        power = sum(exponent * p.dimension[i] for p, exponent in powers.items())
        if power:
            text = unit if abs(power) == 1 else f"{unit}^{abs(power):g}"
            (above if power > 0 else below).append(text)
    return "/".join([" ".join(above) or "1", *below]) if above or below else ""
