"""Trends of the residuals with amplitude, frequency or drive, which show a wrong model.

For each covariate that varies, the response is allowed a smooth relative departure from the
model, R exp(u), where u is a polynomial of the covariate's logarithm, complex, so that gain and
phase each have their own. What the parameters could explain is taken out
(:mod:`dahl_ident.diagnostics.residual_space`); an F or chi-square test shows whether the rest is
more than noise. The departure's size comes with it, in percent and degrees, so that a significant
trend can be distinguished from one that matters. A Wald-Wolfowitz test of the residuals' signs
looks for runs that no low polynomial follows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy import special

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.quantities import COMPLIANCES
from dahl_ident.diagnostics.formatting import percent, with_unit
from dahl_ident.diagnostics.parameters import parameter_values
from dahl_ident.diagnostics.physics import is_spring
from dahl_ident.diagnostics.residual_space import Coefficient, RelativeSpace, ResidualSpace
from dahl_ident.fitting import Optimum
from dahl_ident.units import shown_unit

_DEGREES = {"amplitude": 3, "drive": 3, "frequency": 2}
_SAME = 0.01  # of the covariate's logarithm: values closer than this are one
LEAST_RANGE = np.log(1.05)  # of a covariate that varies
_LEAST_DOF_PER_COLUMN = 3  # for each shape; with fewer, tests find little
_FEWEST_SIGNS = 10  # of each kind on average, for the number of runs to be normal
_STEEPEST = np.log(10.0)  # change of a logarithm that is worth a number
_FARTHEST = 9.0  # departure that is


@dataclass(frozen=True)
class Trend:
    """How the data depart from the fitted model along one covariate."""

    covariate: str  # "amplitude", "frequency" or "drive"
    low: float  # its range, SI units (Hz for frequency)
    high: float
    unit: str
    # change of the data's real and imaginary part of the friction force per displacement, against
    # the model and relative to it, from `low` to `high`; a straight line over the covariate's
    # logarithm. Natural logarithms: -0.36 is a fall by 30 %. The stiffness is that of friction and
    # springs together where the data know only their sum
    stiffness: Coefficient
    loss: Coefficient
    largest: float  # largest relative departure of the response that the smooth curve finds
    p_value: float  # probability of as much departure by noise alone

    def __str__(self) -> str:
        ends = f"from {self.low:.3g} to {self.high:.3g} {self.unit}".rstrip()
        size = "more than tenfold"
        if self.largest < _FARTHEST:
            size = f"by up to {percent(self.largest)}"
        text = f"over {self.covariate}, {ends}, the data depart from the model {size}"
        parts = [
            f"friction's {name} {_change(part)}"
            for name, part in (("stiffness", self.stiffness), ("loss", self.loss))
            if abs(part.value) > 2.0 * part.stderr
        ]
        return f"{text} ({', '.join(parts)} relative to it)" if parts else text


@dataclass(frozen=True)
class Runs:
    """Runs of equal sign in the residuals, in the order of one covariate."""

    covariate: str
    runs: int
    expected: float
    p_value: float

    def __str__(self) -> str:
        return f"{self.runs} runs of sign over {self.covariate}, {self.expected:.0f} expected"


def trends(optimum: Optimum, space: ResidualSpace) -> list[Trend]:
    """Return the departures over each covariate that varies enough."""
    found = []
    friction, relative = _friction_parts(optimum), RelativeSpace(optimum)
    for name, values, unit in covariates(optimum):
        x = np.log(values)
        distinct = _distinct(x)
        degree = min(_DEGREES[name], distinct - 1, space.dof // (2 * _LEAST_DOF_PER_COLUMN))
        if degree < 1:
            continue
        unit_range = 2.0 * (x - x.min()) / np.ptp(x) - 1.0
        shape = legendre.legvander(unit_range, degree)[:, 1:].T
        changes = np.concatenate([shape, 1j * shape])
        p = space.p_value(changes)
        if np.isnan(p):
            continue
        stiffness, loss = (relative.coefficient(0.5 * unit_range * part) for part in friction)
        found.append(
            Trend(
                name,
                float(values.min()),
                float(values.max()),
                unit,
                stiffness,
                loss,
                _largest(relative.fitted(changes)),
                p,
            )
        )
    return found


def runs(optimum: Optimum, space: ResidualSpace) -> list[Runs]:
    """Return the number of runs of the residuals' signs over each covariate."""
    found = []
    for name, values, _ in covariates(optimum):
        order = np.argsort(values, kind="stable")
        count, mean, variance, signs = 0, 0.0, 0.0, 0
        for part in (space.residuals[0::2][order], space.residuals[1::2][order]):
            positive = part > 0.0
            n, up = len(part), int(positive.sum())
            pairs = 2.0 * up * (n - up)
            count += 1 + int((positive[1:] != positive[:-1]).sum())
            mean += 1.0 + pairs / n
            variance += pairs * (pairs - n) / (n**2 * max(n - 1, 1))
            signs += n
        if signs >= 2 * _FEWEST_SIGNS and variance > 0.0:
            z = (count - mean + 0.5) / np.sqrt(variance)
            found.append(Runs(name, count, mean, float(special.ndtr(z))))
    return found


def covariates(optimum: Optimum) -> Iterator[tuple[str, FloatArray, str]]:
    """Yield name, values and unit of whatever varies over the rows."""
    problem = optimum.problem
    data, motion = problem.data, problem.data.motion
    driven = data.drive if (data.controlled == "force").all() else None
    yield from (
        (name, values, unit)
        for name, values, unit in (
            ("amplitude", problem.stiffness_data.amplitude, shown_unit("m", motion)),
            ("frequency", data.frequency_hz, "Hz"),
            ("drive", driven, shown_unit("N", motion)),
        )
        if values is not None and np.ptp(np.log(values)) > LEAST_RANGE
    )


def _friction_parts(optimum: Optimum) -> tuple[ComplexArray, ComplexArray]:
    """Return the relative change of the response with the friction's real and imaginary part.

    Where friction's stiffness and a spring's are known in sum only, the real part is that sum's.
    """
    problem = optimum.problem
    values = parameter_values(optimum)
    view = problem.stiffness_data
    total, stiffness, loss = np.zeros((3, len(view.amplitude)), dtype=np.complex128)
    for element in problem.model.elements:
        own = [np.asarray(values[p.name]) for p in element.parameters]
        part = view.of(element, own)
        total += part
        if not element.is_linear or (optimum.status.at_infinity and is_spring(element)):
            stiffness += part.real
        if not element.is_linear:
            loss += 1j * part.imag
    inverted = problem.data.quantity in COMPLIANCES
    sign = -1.0 if inverted else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = sign * stiffness / total, sign * loss / total
    return np.nan_to_num(parts[0]), np.nan_to_num(parts[1])


def _largest(logarithms: ComplexArray) -> float:
    """Return the largest relative change of a response whose logarithm changes so much."""
    with np.errstate(over="ignore", invalid="ignore"):
        sizes = np.abs(np.expm1(logarithms))
    return float(np.where(np.isnan(sizes), np.inf, sizes).max())


def _distinct(x: FloatArray) -> int:
    return 1 + int((np.diff(np.sort(x)) > _SAME).sum())


def _change(part: Coefficient) -> str:
    """Return "falls by 30 ± 4 %"; a line that steep is not a size, only a direction."""
    word = "rises" if part.value > 0.0 else "falls"
    if abs(part.value) > _STEEPEST:
        return f"{word} more than tenfold"
    size = 100.0 * abs(np.expm1(part.value))
    return f"{word} by {with_unit(size, 100.0 * np.exp(part.value) * part.stderr, '%')}"
