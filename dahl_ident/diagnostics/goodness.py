"""Goodness of fit: whether what is left is noise, and what was fitted is physics.

Every test that applies is made: chi-square where the noise is known, trends and runs of the
residuals over amplitude, frequency and drive, the exponent's score (departure from the universal
curve h(beta)), the third harmonic against the model's. Together they may cry wolf once in a
thousand data sets, so each has a thousandth over their number as its level.

A fit can be statistically perfect and physically absurd; what no mechanism does is said as a
warning (:mod:`dahl_ident.diagnostics.physics`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

from dahl_ident.arrays import ComplexArray
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.outliers import SuspiciousPoint, suspicious_points
from dahl_ident.diagnostics.physics import physical_warnings
from dahl_ident.diagnostics.residual_space import ResidualSpace
from dahl_ident.diagnostics.trends import Runs, Trend, runs, trends
from dahl_ident.elements import Dahl
from dahl_ident.fitting import Optimum
from dahl_ident.problem import Problem

_FALSE_ALARM = 1e-3


@dataclass(frozen=True)
class ChiSquare:
    """Sum of squared residuals of known variance, and how likely noise alone gives as much."""

    value: float
    dof: int
    p_value: float

    def __str__(self) -> str:
        return f"chi-square {self.value:.4g} with {self.dof} degrees of freedom"


@dataclass(frozen=True)
class ThirdHarmonic:
    """Measured third harmonic of the force over the model's, from rows that hold it.

    `ratio` is the data's over the model's, where 1 is agreement; `p_value` also sees wrong phases.
    """

    ratio: float
    stderr: float
    p_value: float

    def __str__(self) -> str:
        return f"the third harmonic is {with_unit(self.ratio, self.stderr, '')} times the model's"


@dataclass(frozen=True)
class Exponent:
    """The exponent that the data ask for by their score, where the fit holds it fixed."""

    name: str
    fixed: float
    wanted: float
    stderr: float
    p_value: float

    def __str__(self) -> str:
        value = with_unit(self.wanted, self.stderr, "")
        return f"the data ask for {self.name} near {value} in place of {self.fixed:g}"


@dataclass(frozen=True)
class Goodness:
    """What is left after the fit, and what it means.

    Attributes
    ----------
    rms_misfit : float
        Root mean square of |measured - fitted| / |measured|, fundamentals only.
    chi_square : ChiSquare or None
        None where the noise's scale was estimated: nothing is known to compare with.
    trends : tuple of Trend
        Departure over each covariate that varies.
    runs : tuple of Runs
        Runs of sign over each covariate.
    exponent : Exponent or None
        Where one Dahl element has a fixed exponent.
    third_harmonic : ThirdHarmonic or None
        Where rows hold it.
    suspicious : tuple of SuspiciousPoint
        Points that stand apart.
    warnings : tuple of str
        What no mechanism does.
    level : float
        p-value below which one test counts.
    """

    rms_misfit: float
    chi_square: ChiSquare | None
    trends: tuple[Trend, ...]
    runs: tuple[Runs, ...]
    exponent: Exponent | None
    third_harmonic: ThirdHarmonic | None
    suspicious: tuple[SuspiciousPoint, ...]
    warnings: tuple[str, ...]

    @cached_property
    def level(self) -> float:
        """p-value below which one test counts."""
        single = (self.chi_square, self.exponent, self.third_harmonic)
        tests = len(self.trends) + len(self.runs) + sum(test is not None for test in single)
        return _FALSE_ALARM / max(tests, 1)

    @cached_property
    def significant_trends(self) -> list[Trend]:
        """Trends that noise does not explain, the clearest first."""
        found = [trend for trend in self.trends if trend.p_value < self.level]
        return sorted(found, key=lambda trend: trend.p_value)

    @property
    def acceptable(self) -> bool:
        """Whether the residuals look like noise."""
        return not self.objections

    @cached_property
    def objections(self) -> tuple[str, ...]:
        """What speaks against the model, in words with numbers; empty where nothing does."""
        found = [str(trend) for trend in self.significant_trends]
        frequency = any(trend.covariate == "frequency" for trend in self.significant_trends)
        if frequency:
            found.append("no rate-independent model has a trend with frequency")
        tests = (self.exponent, self.third_harmonic, self.chi_square)
        found += [str(test) for test in tests if test is not None and test.p_value < self.level]
        found += [
            f"the residuals keep their sign over {r.covariate}: {r.runs} runs, "
            f"{r.expected:.0f} expected"
            for r in self.runs
            if r.p_value < self.level and r.covariate not in {t.covariate for t in self.trends}
        ]
        if not found and any(r.p_value < self.level for r in self.runs):
            worst = min(self.runs, key=lambda r: r.p_value)
            found.append(
                f"the residuals keep their sign over {worst.covariate}: {worst.runs} runs, "
                f"{worst.expected:.0f} expected"
            )
        return tuple(found)

    @property
    def headline(self) -> str:
        """The verdict in one sentence."""
        misfit = f"{100.0 * self.rms_misfit:.2g} % rms misfit"
        if self.acceptable:
            return f"The residuals look like noise ({misfit})."
        return f"The model does not describe these data ({misfit}): {'; '.join(self.objections)}."

    def __str__(self) -> str:
        lines = [self.headline]
        if self.chi_square is not None:
            lines.append(f"- {self.chi_square} (p = {self.chi_square.p_value:.2g})")
        lines += [f"- {trend} (p = {trend.p_value:.2g})" for trend in self.trends]
        lines += [
            f"- {r.runs} runs of sign over {r.covariate}, {r.expected:.0f} expected "
            f"(p = {r.p_value:.2g})"
            for r in self.runs
        ]
        for test in (self.exponent, self.third_harmonic):
            if test is not None:
                lines.append(f"- {test} (p = {test.p_value:.2g})")
        lines += [f"- suspicious: {point}" for point in self.suspicious]
        lines += [f"- warning: {text}" for text in self.warnings]
        return "\n".join(lines)


def goodness(optimum: Optimum) -> Goodness:
    """Return every test of an optimum's residuals, and physical warnings."""
    space, problem = ResidualSpace(optimum), optimum.problem
    fundamental = problem.data.harmonic == 1
    response = problem.data.response
    misfit = np.abs(response - problem.predict(optimum.theta))[fundamental]
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = misfit / np.abs(response[fundamental])
    return Goodness(
        float(np.sqrt(np.mean(relative**2))),
        _chi_square(optimum, space),
        tuple(trends(optimum, space)),
        tuple(runs(optimum, space)),
        _exponent(optimum, space),
        _third_harmonic(optimum, space),
        suspicious_points(optimum, space),
        tuple(physical_warnings(optimum)),
    )


def _chi_square(optimum: Optimum, space: ResidualSpace) -> ChiSquare | None:
    if not optimum.scale_known or optimum.dof <= 0:
        return None
    value = float(space.residuals @ space.residuals)
    return ChiSquare(value, optimum.dof, float(special.chdtrc(optimum.dof, value)))


def _exponent(optimum: Optimum, space: ResidualSpace) -> Exponent | None:
    """Return the score of the one Dahl element's fixed exponent."""
    problem = optimum.problem
    elements = [e for e in problem.model.elements if isinstance(e, Dahl)]
    if len(elements) != 1 or elements[0].parameters[2].free or optimum.status.at_infinity:
        return None
    alpha = elements[0].parameters[2]
    assert alpha.value is not None
    change = _by_alpha(optimum, alpha.name)
    slope, error = space.coefficient(change)
    p = space.p_value(change[None])
    if not np.isfinite(error) or np.isnan(p):
        return None
    wanted = alpha.value * float(np.exp(slope))
    return Exponent(alpha.name, alpha.value, wanted, wanted * error, p)


def _by_alpha(optimum: Optimum, name: str) -> ComplexArray:
    """Return the relative change of the response with ln alpha, sensors and drive included."""
    given = optimum.problem
    freed = Problem(given.data, given.model, noise=given.noise, sensors=given.sensors, free=[name])
    theta = np.zeros(len(freed.names))
    known = dict(zip(optimum.names, optimum.theta, strict=True))
    for i, parameter in enumerate(freed.parameters):
        theta[i] = known.get(parameter.name, np.log(parameter.value or 1.0))
    response, jacobian = freed.predict(theta), freed.prediction_jacobian(theta)
    return np.asarray(jacobian[:, freed.names.index(name)] / response)


def _third_harmonic(optimum: Optimum, space: ResidualSpace) -> ThirdHarmonic | None:
    rows = optimum.problem.data.harmonic == 3
    if not rows.any():
        return None
    own = rows.astype(np.complex128)
    ratio, error = space.coefficient(own)
    return ThirdHarmonic(1.0 + ratio, error, space.p_value(np.array([own, 1j * own])))
