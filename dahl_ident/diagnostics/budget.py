"""The uncertainty budget of a fit: the contribution of each source, after JCGM 100 (GUM).

Combined standard uncertainty u, effective degrees of freedom (Welch and Satterthwaite), coverage
factor k of Student's t for a confidence of 95.45 %, expanded uncertainty U = k u.

It includes combinations of parameters that data can determine without determining each parameter:

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

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.storage import library as data_library
from dahl_ident.diagnostics.bands import friction_and_slopes
from dahl_ident.diagnostics.confidence_levels import CONFIDENCE, MANY, coverage_factor
from dahl_ident.diagnostics.contributions import CHANNELS, TYPE_A, ErrorContributions, variances
from dahl_ident.diagnostics.error_model import ErrorModel, error_model
from dahl_ident.diagnostics.formatting import (
    degrees_text,
    html_table,
    interval,
    listed,
    pair,
    rounded,
    symbol,
    table,
    tabular,
    unit,
)
from dahl_ident.diagnostics.information import Information, parameter_values
from dahl_ident.diagnostics.physics import is_spring
from dahl_ident.elements import Parameter
from dahl_ident.elements.parameter import STIFFNESS
from dahl_ident.errors import FitError
from dahl_ident.fitting import Optimum
from dahl_ident.units import shown_unit

_UNITS = ("N", "m", "s")
_DETERMINED, _HARDLY = 0.25, 1.0  # u of a logarithm
_VARIANCE_ROUNDING = 1e-12  # variance over the combined one that is a rounding error
_SAME = 1e-6  # relative tolerance of equal limits
_COLUMNS = ("source", "type", "u", "dof", "share", "k", "U")


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
            shown = shown_unit(_unit(powers), problem.data.motion)
            text = element.named(combination.expression)
            formed.append(Candidate(text, shown, value, direction, frozenset(by_name)))
    scale = [{n: e.parameter(n) for n in e.scale_parameters} for e in friction]
    stiff = (p for labels in scale for p in labels.values() if p.dimension == STIFFNESS)
    pairs = [(p, spring) for p in stiff for spring in springs]
    for (first_element, first), (second_element, second) in combinations(
        zip(friction, scale, strict=True), 2
    ):
        if first_element.kind == second_element.kind:
            pairs += [(first[label], second[label]) for label in first if label in second]
    for both in ([p.name for p in two] for two in pairs if all(p.free for p in two)):
        value = sum(theta[name] for name in both)
        direction = np.array([slopes[n] / value if n in both else 0.0 for n in names])
        text, members = " + ".join(both), frozenset(both)
        formed.append(Candidate(text, units[both[0]], value, direction, members, is_sum=True))
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


def _unit(powers: Mapping[Parameter, float]) -> str:
    """Return the unit of a product, such as "N/m^2"."""
    above, below = list[str](), list[str]()
    for i, name in enumerate(_UNITS):
        power = sum(exponent * p.dimension[i] for p, exponent in powers.items())
        if power:
            text = name if abs(power) == 1 else f"{name}^{abs(power):g}"
            (above if power > 0 else below).append(text)
    return "/".join([" ".join(above) or "1", *below]) if above or below else ""


@dataclass(frozen=True)
class BudgetRow:
    """Contribution of one source to the uncertainty of one parameter."""

    source: str  # such as "noise" or "exponent"
    kind: Literal["A", "B"]  # evaluated from the data's scatter, or from knowledge beforehand
    u: float  # standard uncertainty that it contributes, in the parameter's unit
    dof: float  # degrees of freedom of `u`
    share: float  # part of the squared combined uncertainty, 0 to 1


@dataclass(frozen=True)
class ParameterBudget:
    """The budget of one parameter."""

    name: str
    unit: str
    value: float
    rows: tuple[BudgetRow, ...]  # one a source, the largest first
    u: float  # combined standard uncertainty
    dof: float  # its effective degrees of freedom
    k: float  # coverage factor for 95.45 %
    # the interval if it is not value ± U; it is printed instead of U
    limits: tuple[float, float] | None = None

    @property
    def U(self) -> float:
        """Expanded uncertainty, k u."""
        return self.k * self.u

    def k_without(self, *sources: str) -> float:
        """Return the coverage factor if what these sources contribute were known exactly."""
        spread = sum(r.share**2 / r.dof for r in self.rows if r.source not in sources)
        return coverage_factor(1.0 / spread if spread > 0.0 else np.inf)

    @property
    def expanded(self) -> str:
        """U as it is printed, or the interval."""
        return rounded(self.value, self.U)[1] if self.limits is None else interval(*self.limits, "")


@dataclass(frozen=True)
class Budget(Mapping[str, ParameterBudget]):
    """Uncertainty budgets of every free parameter, by name; printed, a table.

    Examples
    --------
    >>> import dahl_ident as di
    >>> of_fit = budget(di.fit(di.load_dataset("noisy"), di.Dahl()).optimum)
    >>> [row.source for row in of_fit["f_max"].rows][:2]
    ['jackknife over tests', 'noise']
    >>> round(sum(row.share for row in of_fit["f_max"].rows), 9)
    1.0
    """

    parameters: tuple[ParameterBudget, ...]  # in the order of the fit
    covariance: FloatArray  # (P, P): combined, of the values
    exact: tuple[str, ...]  # inputs without a stated uncertainty, which are taken as exact

    def __getitem__(self, name: str) -> ParameterBudget:
        by_name = {parameter.name: parameter for parameter in self.parameters}
        if name not in by_name:
            raise KeyError(f"{name} has no budget; there are {', '.join(by_name)}")
        return by_name[name]

    def __iter__(self) -> Iterator[str]:
        return (p.name for p in self.parameters)

    def __len__(self) -> int:
        return len(self.parameters)

    def within(self, limits: Mapping[str, tuple[float, float]]) -> Budget:
        """Return the budget with given intervals of its parameters, if they are not value ± U."""

        def stated(p: ParameterBudget) -> ParameterBudget:
            ends = limits.get(p.name, (p.value - p.U, p.value + p.U))
            if not np.isfinite(p.U):
                return p
            plain = np.allclose(ends, (p.value - p.U, p.value + p.U), rtol=_SAME, atol=_SAME * p.U)
            return p if plain else replace(p, limits=ends)

        return replace(self, parameters=tuple(map(stated, self.parameters)))

    @property
    def _cells(self) -> Iterator[tuple[str, ...]]:
        """Yield rows of name, value and `_COLUMNS`: for each parameter first the total."""
        for p in self.parameters:
            value, u = rounded(p.value, p.u)
            yield (p.name, value, "combined", "", u, _dof(p.dof), "100 %", f"{p.k:.2f}", p.expanded)
            for r in p.rows:
                share = f"{100.0 * r.share:.0f} %"
                u = rounded(p.value, r.u)[1]
                yield ("", "", r.source, r.kind, u, _dof(r.dof), share, "", "")

    def __str__(self) -> str:
        lines: list[tuple[str, ...]] = [("", *_COLUMNS)]
        lines += [
            (f"{name} = {value} {self[name].unit}".rstrip() if name else "", *cells)
            for name, value, *cells in self._cells
        ]
        text = table(lines, left=(0, 1, 2))
        return f"{text}\ntaken as exact: {listed(self.exact)}" if self.exact else text

    def _repr_html_(self) -> str:
        rows = ((f"{n} [{self[n].unit}]" if n else "", *cells) for n, *cells in self._cells)
        return html_table(("", "value", *_COLUMNS), rows)

    def to_latex(self) -> str:
        """Return a LaTeX table of values with expanded uncertainties; it requires no package."""
        rows = [
            (symbol(p.name), *pair(p.value, p.U), f"{p.k:.2f}", unit(p.unit))
            for p in self.parameters
        ]
        return tabular(("", "value", "$U$", "$k$", "unit"), rows)

    def to_frame(self) -> Any:
        """Return a pandas table: one row a parameter and source, the combined one last."""
        import pandas as pd

        rows = []
        for p in self.parameters:
            combined = vars(BudgetRow("combined", "A", p.u, p.dof, 1.0))
            parts = (*map(vars, p.rows), combined | {"kind": "", "k": p.k, "U": p.U})
            rows += [{"parameter": p.name, "unit": p.unit, **part} for part in parts]
        return pd.DataFrame(rows)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON; infinite degrees of freedom are None."""
        return {
            "confidence": CONFIDENCE,
            "taken_as_exact": list(self.exact),
            "parameters": {
                p.name: {
                    "value": p.value,
                    "unit": p.unit,
                    "u": p.u,
                    "dof": _finite(p.dof),
                    "k": p.k,
                    "U": p.U if p.limits is None else None,
                    "interval": p.limits,
                    "sources": [{**vars(row), "dof": _finite(row.dof)} for row in p.rows],
                }
                for p in self.parameters
            },
        }

    def numbers(self, library: Literal["uncertainties", "GTC"] = "uncertainties") -> dict[str, Any]:
        """Return the parameters as correlated numbers of a library for uncertain numbers.

        Parameters
        ----------
        library : {"uncertainties", "GTC"}, default "uncertainties"
            Which must be installed.

        Returns
        -------
        dict of str to number

        Raises
        ------
        ValueError
            If the library is unknown.
        """
        values = [p.value for p in self.parameters]
        if library == "uncertainties":
            from uncertainties import correlated_values  # type: ignore[import-untyped]  # no types

            return dict(zip(self, correlated_values(values, self.covariance), strict=True))
        if library != "GTC":
            raise ValueError(f"library is {library!r}; expected uncertainties or GTC")
        gtc = data_library("GTC", "exports")
        u = np.sqrt(np.diagonal(self.covariance))
        dof = min(p.dof for p in self.parameters)  # one for an ensemble of correlated numbers
        numbers = gtc.multiple_ureal(values, u.tolist(), dof, list(self))
        for i, first in enumerate(numbers):
            for j, second in enumerate(numbers[:i]):
                gtc.set_correlation(float(self.covariance[i, j] / (u[i] * u[j])), first, second)
        return dict(zip(self, numbers, strict=True))


@np.errstate(over="ignore", invalid="ignore")  # where nothing bounds a variance
def budget(optimum: Optimum, errors: ErrorModel | None = None) -> Budget:
    """Return the uncertainty budget of what a fit determines.

    It has every free parameter, and the determined combinations of those that are not determined;
    at infinity, these combinations alone.
    """
    errors = errors or error_model(optimum, of_combinations=True)
    entries = [] if errors is None else list(_determined(optimum, errors))
    if errors is None or not entries:
        raise FitError(
            "no uncertainty budget: a parameter is undetermined, or nothing is left to estimate "
            f"the errors from ({optimum.message}); fix a parameter or measure more points"
        )
    parameters = [parameter_budget(errors, *entry) for entry in entries]
    D = np.array([direction for *_, direction in entries])
    return Budget(tuple(parameters), D @ errors.covariance @ D.T, taken_as_exact(optimum))


_Entry = tuple[str, str, float, FloatArray]  # name, unit, value, d value/d theta


def _determined(optimum: Optimum, errors: ErrorModel) -> Iterator[_Entry]:
    """Yield the determined parameters, then determined combinations of the others."""
    problem, names = errors.problem, errors.names
    slopes = problem.value_slopes(errors.theta)
    units = {p.name: p.unit for p in problem.parameters}
    positive = {p.name: p.positive for p in problem.parameters}
    space, values = optimum.problem.space, optimum.values
    gone = ~np.isfinite(values) | (space.positive & (values == 0.0))
    lost = {name for name, is_gone in zip(optimum.names, gone, strict=True) if is_gone}
    for name, direction, slope in zip(names, np.eye(len(names)), slopes, strict=True):
        if name in errors.assumed or name in lost:
            continue
        finite, u = errors.estimate.basis.holds(direction), float(errors.std(direction))
        if finite:
            yield name, units[name], errors.values[name], direction * abs(float(slope))
        if not finite or (positive[name] and u > _DETERMINED):
            lost |= {name}
    # combinations may contain assumed exponents
    freed = replace(optimum, source=problem, theta=errors.theta)
    of_optimum = [names.index(name) for name in optimum.names]
    kept = {c.expression for c in optimum.combinations}
    old_names = {
        tuple(c.direction): c.expression for c in candidates(optimum) if c.expression in kept
    }
    information = Information(optimum)
    by_noise = information.std(np.eye(len(of_optimum)))
    vague = {n for n, std in zip(optimum.names, by_noise, strict=True) if std > _DETERMINED}
    for candidate in candidates(freed):
        direction, value = candidate.direction, candidate.value
        if not (candidate.members & lost and errors.estimate.basis.holds(direction)):
            continue
        # a combination on which the limit depends keeps the name that the fit gave it
        name = old_names.get(tuple(direction[of_optimum]), candidate.expression)
        u = float(errors.std(direction))
        # the verdict names combinations of parameters that are undetermined by noise alone
        is_named = (name in kept and u < _HARDLY) or (
            candidate.members & vague
            and not candidate.is_sum
            and information.std(direction[of_optimum]) < _DETERMINED
        )
        if u < _DETERMINED or is_named:
            yield name, candidate.unit, float(value), direction * abs(value)


def taken_as_exact(optimum: Optimum) -> tuple[str, ...]:
    """Return the calibrations without a stated uncertainty."""
    sensors, priors = optimum.problem.sensors, optimum.problem.priors
    free = {p.name for p in sensors.parameters if p.free}
    return tuple(text for name, text in CHANNELS.items() if name not in priors and name not in free)


def parameter_budget(
    errors: ErrorContributions, name: str, unit: str, value: float, direction: FloatArray
) -> ParameterBudget:
    """Return the budget of a value whose derivatives with respect to theta are `direction`."""
    u2 = float(errors.std(direction)) ** 2
    rows = []
    for source, covariance in errors.contributions.items():
        part = float(variances(direction, covariance))
        if np.isinf(u2):
            share = float(np.isinf(part))
        else:
            part = part if part > _VARIANCE_ROUNDING * u2 else 0.0
            share = part / u2 if u2 > 0.0 else 0.0
        kind: Literal["A", "B"] = "A" if source in TYPE_A else "B"
        dof = errors.dof(direction, source) if part else np.inf
        rows.append(BudgetRow(source, kind, part**0.5, dof, share))
    rows.sort(key=lambda row: -row.u)
    dof = errors.dof(direction)
    dof = dof if dof < MANY else np.inf
    return ParameterBudget(name, unit, value, tuple(rows), u2**0.5, dof, coverage_factor(dof))


def _dof(dof: float) -> str:
    return "inf" if np.isinf(dof) else degrees_text([dof]).replace("more than ", "> ")


def _finite(dof: float) -> float | None:
    return float(dof) if np.isfinite(dof) else None
