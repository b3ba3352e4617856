"""Combinations of parameters that data can determine without determining each parameter.

========================================  =====================================================
combination                               left by
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
from dahl_ident.fitting import Optimum
from dahl_ident.units import shown_unit

_UNITS = ("N", "m", "s")
_STIFFNESS = (1, -1, 0)  # powers of force, displacement and time


@dataclass(frozen=True)
class Candidate:
    """A combination: what it is called, its value, and its logarithm's slope by theta."""

    expression: str
    unit: str
    value: float
    direction: FloatArray
    members: frozenset[str]
    is_sum: bool = False


def candidates(optimum: Optimum) -> list[Candidate]:
    """Return every combination that the optimum's free parameters could form."""
    free = {p.name: p for p in optimum.problem.parameters}
    theta = dict(zip(optimum.names, optimum.problem.to_values(optimum.theta), strict=True))
    elements = optimum.problem.model.elements
    friction = [e for e in elements if e.has_memory]
    springs = [p.name for e in elements if is_spring(e) for p in e.parameters if p.free]
    found: list[Candidate] = []
    for element in friction:
        for combination in element.combinations():
            powers = {element.parameter(n): power for n, power in combination.powers.items()}
            if all(p.free for p in powers):
                text = element.named(combination.expression)
                found.append(_product(optimum, theta, powers, text))
    scale = [{n: e.parameter(n) for n in e.scale_parameters} for e in friction]
    pairs = [
        (p.name, k)
        for own in scale
        for p in own.values()
        if p.free and p.dimension == _STIFFNESS
        for k in springs
    ]
    for (one, own), (other, its) in combinations(zip(friction, scale, strict=True), 2):
        if one.kind == other.kind:
            both = ((own[label], its[label]) for label in own if label in its)
            pairs += [(a.name, b.name) for a, b in both if a.free and b.free]
    found += [_sum(optimum, theta, free, pair) for pair in pairs]
    return found


def stiffness_seen(optimum: Optimum) -> Candidate | None:
    """Return the stiffness of friction and free springs together, in the middle of the amplitudes.

    None without friction and a free spring. Stiffness data always determine it; it is reported only
    if they determine nothing else.
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
    own = np.array([slopes[name] if name in free else 0.0 for name in names])
    value = float(N[0].real) + sum(values[name] for name in springs)
    motion = problem.data.motion
    where = f"the stiffness seen at {A:.3g} {shown_unit('m', motion)}"
    direction = (by[0].real + own) / value
    members = free | (frozenset(friction) & frozenset(names))
    return Candidate(where, shown_unit("N/m", motion), value, direction, members)


def runaway(optimum: Optimum) -> frozenset[str]:
    """Return the names of the parameters whose optimum lies at infinity, or at a positive zero."""
    positive = np.array([p.positive for p in optimum.problem.parameters])
    gone = ~np.isfinite(optimum.values) | (positive & (optimum.values == 0.0))
    return frozenset(np.array(optimum.names)[gone].tolist())


def _product(
    optimum: Optimum, theta: Mapping[str, float], powers: Mapping[Parameter, float], text: str
) -> Candidate:
    by_name = {p.name: power for p, power in powers.items()}
    direction = np.array([by_name.get(name, 0.0) for name in optimum.names])
    with np.errstate(over="ignore", under="ignore"):
        value = float(np.exp(sum(power * np.log(theta[n]) for n, power in by_name.items())))
    unit = shown_unit(_unit(powers), optimum.problem.data.motion)
    return Candidate(text, unit, value, direction, frozenset(by_name))


def _unit(powers: Mapping[Parameter, float]) -> str:
    """Return the unit of a product, such as "N/m^2"."""
    above: list[str] = []
    below: list[str] = []
    for place, unit in enumerate(_UNITS):
        power = sum(by * p.dimension[place] for p, by in powers.items())
        text = unit if abs(power) == 1 else f"{unit}^{abs(power):g}"
        if power:
            (above if power > 0 else below).append(text)
    return "/".join([" ".join(above) or "1", *below]) if above or below else ""


def _sum(
    optimum: Optimum,
    theta: Mapping[str, float],
    free: Mapping[str, Parameter],
    pair: tuple[str, str],
) -> Candidate:
    slopes = dict(zip(optimum.names, optimum.problem.value_slopes(optimum.theta), strict=True))
    value = sum(theta[name] for name in pair)
    direction = np.array([slopes[n] / value if n in pair else 0.0 for n in optimum.names])
    return Candidate(
        " + ".join(pair), free[pair[0]].unit, value, direction, frozenset(pair), is_sum=True
    )
