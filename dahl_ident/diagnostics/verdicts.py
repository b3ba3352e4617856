"""Identifiability: which parameters or combinations the data determine, and what to do.

A parameter is **identified** where the standard deviation of its logarithm is below 0.25,
**not identified** above 1, and **weakly identified** between. The standard deviation is the larger
of two: the first-order one (Fisher information), and that of the profile (width of its 95.45 %
interval over that of a normal distribution with unit standard deviation). A weakly identified
parameter whose profile is still open at 99.73 % is not identified. Where every first-order value is
below 0.15, profiles are not computed: they would differ in the second digit. Parameters that may be
zero or negative have no logarithm; for them it is the standard deviation over their size, or over a
tenth of the size at which they would make up the whole response, whichever size is larger. The
parameters of records are judged to first order, and are not identified above 0.3.

Where parameters are not identified, combinations of them may be
(:mod:`dahl_ident.diagnostics.budget`); where no known combination fits, the least
determined direction is given as a vector.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from itertools import combinations
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, IntArray
from dahl_ident.diagnostics.advice import advice
from dahl_ident.diagnostics.bands import DerivedQuantity
from dahl_ident.diagnostics.budget import ParameterBudget, candidates, stiffness_seen
from dahl_ident.diagnostics.confidence_levels import LEVELS, coverage_factor, level_text, thresholds
from dahl_ident.diagnostics.contributions import EXPONENT, MODEL_ERROR, RUNS
from dahl_ident.diagnostics.error_model import ErrorModel
from dahl_ident.diagnostics.formatting import interval as interval_text
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.information import Information
from dahl_ident.diagnostics.intervals import (
    ConfidenceIntervals,
    Interval,
    natural_sizes,
    search_coordinates,
    wald_intervals,
)
from dahl_ident.diagnostics.judgement import Finding, VerdictStatus, determined
from dahl_ident.fitting import Optimum

IDENTIFIED_BELOW = 0.25  # u of a logarithm: 95 % within a factor of 1.6
NOT_IDENTIFIED_ABOVE = 1.0  # the same: a factor of 7, hardly an order of magnitude
FIRST_ORDER_UP_TO = 0.3  # the same: beyond it, intervals without profiles do not hold
_NEARLY_LINEAR = 0.15  # u of every logarithm: below it, profiles differ in the second digit
# Largest u of a logarithm from sources that rest on assumptions: the exponent's range, and the
# smoothness of a model error.
_MOST_BY = {EXPONENT: 0.1, MODEL_ERROR: IDENTIFIED_BELOW}
_MEASURE = "measure more points, or use a model that misses less"
_REMEDY = {
    EXPONENT: "give it if it is known, or measure on both sides of the knee",
    RUNS: "measure on more days or mountings",
}
_BY_PRIOR = 0.7  # u over that of the prior, above which the prior has more information
_NO_DIFFERENCE = 1.0  # of -2 ln L, between two values that are equally likely
_DIFFERENT = 9.0  # of -2 ln L, to first order: parameters that differ by 3 u
_MOST_EXCHANGED = 6  # parameters exchanged at once, in pairs
_MEASURE_EVEN = "measure the mean force or even harmonics too"
_VECTOR_PART = 0.05  # component of the undetermined direction worth naming


class Verdict(Enum):
    """How well a parameter is determined."""

    IDENTIFIED = "identified"
    BY_PRIOR = "known from its prior"
    WEAK = "weakly identified"
    NOT_IDENTIFIED = "not identified"

    @classmethod
    def of(cls, u: float) -> Verdict:
        """Return the verdict on a parameter with u, the standard uncertainty of its logarithm."""
        if u < IDENTIFIED_BELOW:
            return cls.IDENTIFIED
        return cls.WEAK if u <= NOT_IDENTIFIED_ABOVE else cls.NOT_IDENTIFIED

    @property
    def known(self) -> bool:
        """Whether the estimate can be used."""
        return self in (Verdict.IDENTIFIED, Verdict.BY_PRIOR)


@dataclass(frozen=True)
class ParameterVerdict:
    """The verdict on one parameter."""

    name: str
    unit: str
    verdict: Verdict
    # at 95.45 %: combined, of the profile, or of first order
    interval: Interval
    known_text: str  # the interval, or what is known instead, in words
    why: str = ""  # the reason, and what to do, where it is not identified

    @property
    def text(self) -> str:
        """Name and verdict in words."""
        return f"{self.name}: {self.reason}"

    @property
    def reason(self) -> str:
        """Interval and verdict in words, with the reason if it is not identified."""
        if self.why:
            return f"{self.known_text}, not determined, {self.why}"
        lost = self.verdict is Verdict.NOT_IDENTIFIED
        return self.known_text if lost else f"{self.known_text}, {self.verdict.value}"


@dataclass(frozen=True)
class Identifiability:
    """Which parameters and combinations the data determine.

    Examples
    --------
    >>> import dahl_ident as di
    >>> judged = di.diagnostics.identifiability(di.fit(di.load_dataset("microslip"), di.Dahl()))
    >>> {name: p.verdict.value for name, p in judged.parameters.items()}
    {'f_max': 'not identified', 'sigma': 'identified'}
    """

    parameters: Mapping[str, ParameterVerdict]
    combinations: tuple[DerivedQuantity, ...]  # determined ones, of parameters that are not
    # where no combination is known: the least determined direction in the parameters' logarithms
    # (in sizes that matter for those that have none)
    direction: Mapping[str, float]

    def named(self, verdict: Verdict) -> list[str]:
        """Return the names of the parameters with this verdict."""
        return [name for name, p in self.parameters.items() if p.verdict is verdict]

    @property
    def complete(self) -> bool:
        """Whether every parameter is identified, weakly or well."""
        return not self.named(Verdict.NOT_IDENTIFIED)

    @property
    def determined(self) -> tuple[str, ...]:
        """Names of the identified parameters, then of the combinations."""
        return (
            *self.named(Verdict.IDENTIFIED),
            *(combination.name for combination in self.combinations),
        )

    @property
    def finding(self) -> Finding:
        """Which parameters or combinations are determined."""
        weak = tuple(self.named(Verdict.WEAK))
        if self.complete:
            identified, by_prior = map(self.named, (Verdict.IDENTIFIED, Verdict.BY_PRIOR))
            known = {"identified": tuple(identified), "by_prior": tuple(by_prior)}
            return determined("identified", VerdictStatus.TRUSTED, weak=weak, **known)
        lost = tuple(self.named(Verdict.NOT_IDENTIFIED))
        return determined("undetermined", determined=self.determined, weak=weak, lost=lost)

    @property
    def headline(self) -> str:
        """The verdict in one sentence."""
        return str(self.finding)

    @property
    def open(self) -> tuple[ParameterVerdict, ...]:
        """The parameters that are not identified.

        If some of them have a limit, those without one are left out.
        """
        lost = [p for p in self.parameters.values() if p.verdict is Verdict.NOT_IDENTIFIED]
        limited = [p for p in lost if p.interval.lower > 0.0 or np.isfinite(p.interval.upper)]
        return tuple(limited or lost)

    def __str__(self) -> str:
        lines = [self.headline, *(f"- {p.text}" for p in self.parameters.values())]
        lines += [f"- determined: {combination}" for combination in self.combinations]
        if self.direction:
            vector = ", ".join(f"{name} {value:+.2f}" for name, value in self.direction.items())
            lines.append(f"- undetermined direction, in logarithms: {vector}")
        return "\n".join(lines)


def identifiability(fit: Any) -> Identifiability:
    """Return which parameters, or which combinations of them, the data of a fit determine.

    The fit is made with ``throw=False`` where there may be no optimum.

    Examples
    --------
    >>> import dahl_ident as di
    >>> known = di.diagnostics.identifiability(di.fit(di.load_dataset("noisy"), di.Dahl()))
    >>> known.complete
    True
    """
    judged: Identifiability = fit.identifiability
    return judged


def judged(
    optimum: Optimum,
    profile_of: Callable[[], ConfidenceIntervals] | None,
    errors: ErrorModel | None,
    stated: ConfidenceIntervals,
    sources: Mapping[str, ParameterBudget],
) -> Identifiability:
    """Return the verdicts on an optimum; `profile_of` computes its profiles at the three LEVELS.

    With `errors`, sources other than noise may leave a parameter undetermined. The limits in the
    texts are those of `stated`, and determined combinations those of the budget's `sources`.
    Without profiles, or where none is needed, the verdicts are first order.
    """
    information, problem = Information(optimum), optimum.problem
    natural = natural_sizes(optimum)
    fisher = np.sqrt(np.diagonal(optimum.covariance)) / natural
    if profile_of is None or np.all(fisher < _NEARLY_LINEAR):
        intervals = wald_intervals(optimum, LEVELS)
    else:
        intervals = profile_of()
    lower, upper = (
        search_coordinates(optimum, ends[1]) for ends in (intervals.lower, intervals.upper)
    )
    (q,) = thresholds(optimum, np.array([LEVELS[1]]))
    with np.errstate(divide="ignore", invalid="ignore"):
        by_profile = (upper - lower) / (2.0 * q * natural)
    spread = np.maximum(fisher, np.where(np.isnan(by_profile), np.inf, by_profile)).tolist()
    verdicts = {}
    for name, std in zip(problem.names, spread, strict=True):
        verdicts[name] = Verdict.of(std)
        if verdicts[name] is Verdict.WEAK and not np.isfinite(intervals[name][-1]).all():
            verdicts[name] = Verdict.NOT_IDENTIFIED
    not_by_noise = dict[str, str]()
    ambiguous = _ambiguous(optimum)
    if errors is not None:
        not_by_noise = _lost_beyond_noise(errors, verdicts, natural)
        for name, size in zip(problem.names, natural.tolist(), strict=True):
            direction = np.eye(len(errors.names))[errors.names.index(name)]
            U = coverage_factor(errors.dof(direction)) * float(errors.std(direction))
            if verdicts[name] is Verdict.IDENTIFIED and 0.5 * U / size > IDENTIFIED_BELOW:
                verdicts[name] = Verdict.WEAK
    verdicts |= dict.fromkeys((*not_by_noise, *ambiguous), Verdict.NOT_IDENTIFIED)
    stderr = optimum.stderr if errors is None else errors.stderr
    for name, prior in problem.priors.items():
        informative = stderr[name] > _BY_PRIOR * float(prior.std())
        if informative and verdicts[name] is Verdict.IDENTIFIED:
            verdicts[name] = Verdict.BY_PRIOR
    lost = frozenset(n for n, v in verdicts.items() if v is Verdict.NOT_IDENTIFIED)
    loose = lost | {n for n, v in verdicts.items() if v is Verdict.WEAK}
    determined = list(_combinations(optimum, sources, lost, loose))
    seen = None if determined else stiffness_seen(optimum)
    if seen is not None and seen.members <= loose and np.isfinite(seen.value):
        std = float(information.std(seen.direction))
        if std < IDENTIFIED_BELOW:
            u = abs(seen.value) * std
            determined.append(DerivedQuantity(seen.expression, seen.unit, None, seen.value, u))
    parameters = {}
    for name, parameter in zip(problem.names, problem.parameters, strict=True):
        unit = parameter.unit
        _, limits, widest = stated[name]
        shown, why = within(limits, unit), ""
        if name in ambiguous:
            shown = ambiguous[name]
        elif name in not_by_noise and errors is not None:
            shown = with_unit(errors.values[name], errors.stderr[name], unit)
            why = not_by_noise[name]
        elif verdicts[name] is Verdict.NOT_IDENTIFIED:
            why = advice(optimum, name, widest, lost)
        parameters[name] = ParameterVerdict(name, unit, verdicts[name], limits, shown, why)
    direction = {}
    if lost - ambiguous.keys() and not determined:
        vector = information.weakest(natural)
        parts = zip(problem.names, vector.tolist(), strict=True)
        direction = {n: v for n, v in parts if abs(v) > _VECTOR_PART}
        direction = direction if len(direction) > 1 else {}
    return Identifiability(parameters, tuple(determined), direction)


def _lost_beyond_noise(
    errors: ErrorModel, verdicts: Mapping[str, Verdict], natural: FloatArray
) -> dict[str, str]:
    """Return why sources other than noise leave parameters undetermined, by name."""
    reasons = {}
    for name, size in zip(verdicts, natural.tolist(), strict=True):
        i = errors.names.index(name)
        parts = {n: float(C[i, i]) for n, C in errors.contributions.items()}
        u = sum(parts.values()) ** 0.5 / size
        source = max(parts, key=lambda n: parts[n])
        most = _MOST_BY.get(source, NOT_IDENTIFIED_ABOVE)
        most = most if parts[source] > 0.5 * (u * size) ** 2 else NOT_IDENTIFIED_ABOVE
        if verdicts[name] is not Verdict.NOT_IDENTIFIED and u > most:
            reasons[name] = f"because of {source}: {_REMEDY.get(source, _MEASURE)}"
    return reasons


def _ambiguous(optimum: Optimum) -> dict[str, str]:
    """Return the texts on friction parameters whose sign or order the data do not determine.

    The fundamental is the same for a mirrored law: for the opposite sign of an asymmetry, or for
    parameters of pulling and pushing exchanged. Such a change does not raise the sum of squares,
    although by the derivatives it should.
    """
    problem, theta = optimum.problem, optimum.theta
    scale, error = optimum.scale or 1.0, np.sqrt(np.diagonal(optimum.covariance))
    driven = problem.data.controlled == "force"
    if not (problem.data.harmonic[driven] != 1).any():  # harmonics of motions need the motion
        problem = problem.with_steady("describing function")

    def alike(changed: FloatArray) -> bool:
        y, moved = problem.residuals(np.array([theta, changed]), scale)
        return abs(float(moved @ moved - y @ y)) < _NO_DIFFERENCE

    def shown(i: int, value: float) -> str:
        parameter = problem.parameters[i]
        return with_unit(value, optimum.stderr[parameter.name], parameter.unit)

    reasons, names = dict[str, str](), problem.names
    for i in problem.friction_columns.tolist():
        mirrored = theta.copy()
        mirrored[i] = -mirrored[i]
        if not problem.parameters[i].positive and abs(theta[i]) > error[i] and alike(mirrored):
            reasons[names[i]] = (
                f"its size is {shown(i, abs(float(optimum.values[i])))}, its sign is not "
                f"determined: the fundamental is the same for either; {_MEASURE_EVEN}"
            )
    for order in _exchanges(optimum):
        move = theta[order] - theta
        jacobian = problem.residuals_and_jacobian(theta, scale, tails=False)[1]
        if float(np.sum((jacobian @ move) ** 2)) > _DIFFERENT and alike(theta[order]):
            for i in np.flatnonzero(np.abs(move) > error).tolist():
                j = int(order[i])
                either = " or ".join(shown(k, float(optimum.values[k])) for k in (i, j))
                reasons[names[i]] = (
                    f"either {either}, as {names[i]} and {names[j]} are exchangeable: these data "
                    f"are the same for either order; {_MEASURE_EVEN}"
                )
            break
    return reasons


def _exchanges(optimum: Optimum) -> Iterator[IntArray]:
    """Yield the orders in which like parameters of an element are exchanged, in pairs.

    Single pairs come first, then several pairs at once. The identical parts that a law declares are
    left out, as their order is fixed.
    """
    problem = optimum.problem
    for element in problem.model.elements:
        ordered = {label for part in element.like_parts for label in part}
        alike: dict[tuple[object, ...], list[int]] = {}
        for label, p in zip(element.labels, element.parameters, strict=True):
            if p.free and label not in ordered:
                key = (p.unit, p.transform, p.lower, p.upper)
                alike.setdefault(key, []).append(problem.names.index(p.name))
        pairs = [pair for group in alike.values() for pair in combinations(group, 2)]
        for count in range(1, len(pairs) + 1):
            for chosen in combinations(pairs, count):
                if len({i for pair in chosen for i in pair}) == 2 * count <= _MOST_EXCHANGED:
                    order = np.arange(len(problem.names))
                    for i, j in chosen:
                        order[[i, j]] = j, i
                    yield order


def _combinations(
    optimum: Optimum,
    sources: Mapping[str, ParameterBudget],
    lost: frozenset[str],
    loose: frozenset[str],
) -> Iterator[DerivedQuantity]:
    """Yield the combinations in the budget of parameters that are not identified.

    A product is only informative with two `loose` parameters, which are weakly or not identified,
    and a sum only if it is known better than each of its parts.
    """
    stated = {c.expression for c in optimum.combinations}
    information = Information(optimum)
    for candidate in candidates(optimum):
        members, direction = candidate.members, candidate.direction
        enough = bool(members & lost) and len(members & loose) > 1
        if candidate.is_sum:
            parts = np.diag(direction)[np.flatnonzero(direction)]
            known_better = information.std(direction) > information.std(parts).min()
            enough = members <= lost and not known_better
        if enough:
            stated.add(candidate.expression)
    for name in (name for name in sources if lost and name in stated - {*optimum.names}):
        known = sources[name]
        yield DerivedQuantity(name, known.unit, None, known.value, known.u)


def within(limits: Interval, unit: str) -> str:
    """Return an interval with its level; an open side in words."""
    lower = -np.inf if limits.lower == 0.0 else limits.lower
    return f"{interval_text(lower, limits.upper, unit)} ({level_text(limits.level)})"
