"""Combinations of parameters that data can determine although they do not determine the parts.

========================================  =====================================================
combination                               left by
========================================  =====================================================
alpha sigma^2/f_max                       microslip beside a free spring: the loss per amplitude
sigma + stiffness                         the same: the stiffness seen at small amplitudes
f_max/sigma = x_c                         an unknown force gain
sums of f_max or sigma of two elements    all slipping, or none
stiffness seen, of friction and springs   springs that hide all of friction
========================================  =====================================================
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.bands import friction_and_slopes
from dahl_ident.diagnostics.parameters import parameter_values
from dahl_ident.elements import Dahl, Parameter, Spring
from dahl_ident.fitting import Optimum
from dahl_ident.units import shown_unit


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
    dahl = [
        tuple(free.get(p.name) for p in e.parameters)
        for e in optimum.problem.model.elements
        if isinstance(e, Dahl)
    ]
    springs = [
        e.parameters[0].name
        for e in optimum.problem.model.elements
        if isinstance(e, Spring) and e.parameters[0].free
    ]
    found: list[Candidate] = []
    for powers, text, unit in _products(dahl):
        found.append(_product(optimum, theta, powers, text, unit))
    pairs = [(s.name, k) for _, s, _ in dahl if s for k in springs]
    for one, other in combinations(dahl, 2):
        pairs += [(a.name, b.name) for a, b in zip(one[:2], other[:2], strict=True) if a and b]
    found += [_sum(optimum, theta, free, pair) for pair in pairs]
    return found


def stiffness_seen(optimum: Optimum) -> Candidate | None:
    """Return the stiffness of friction and free springs together, in the middle of the amplitudes.

    None without friction and a free spring. Data of a stiffness always know it; it is worth
    telling where they know nothing else.
    """
    problem, names = optimum.problem, optimum.names
    springs = [
        p.name for e in problem.model.elements if isinstance(e, Spring) for p in e.parameters
    ]
    friction = [
        p.name for e in problem.model.elements if isinstance(e, Dahl) for p in e.parameters[:2]
    ]
    free = frozenset(springs) & frozenset(names)
    if not free or not friction:
        return None
    A = float(np.exp(np.log(problem.stiffness_data.amplitude).mean()))
    N, by = friction_and_slopes(optimum, np.array([A]))
    values = parameter_values(optimum)
    slopes = dict(zip(names, problem.value_slopes(optimum.theta), strict=True))
    own = np.array([slopes[name] if name in free else 0.0 for name in names])
    value = float(N[0].real) + sum(values[name] for name in springs)
    motion = problem.data.motion
    where = f"the stiffness seen at {A:.3g} {shown_unit('m', motion)}"
    direction = (by[0].real + own) / value
    members = free | (frozenset(friction) & frozenset(names))
    return Candidate(where, shown_unit("N/m", motion), value, direction, members)


def _products(
    dahl: list[tuple[Parameter | None, ...]],
) -> Iterator[tuple[dict[str, float], str, str]]:
    """Yield powers of parameters, the expression, and its unit."""
    for f, s, a in dahl:
        if f is None or s is None:
            continue
        exponent = {a.name: 1.0} if a else {}
        text = " ".join([*exponent, f"{s.name}^2/{f.name}"])
        yield {**exponent, s.name: 2.0, f.name: -1.0}, text, "N/m^2"
        yield {f.name: 1.0, s.name: -1.0}, f"{f.name}/{s.name}", "m"


def _product(
    optimum: Optimum, theta: Mapping[str, float], powers: dict[str, float], text: str, unit: str
) -> Candidate:
    direction = np.array([powers.get(name, 0.0) for name in optimum.names])
    with np.errstate(over="ignore", under="ignore"):
        value = float(np.exp(sum(power * np.log(theta[name]) for name, power in powers.items())))
    unit = shown_unit(unit, optimum.problem.data.motion)
    return Candidate(text, unit, value, direction, frozenset(powers))


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
