"""Goodness of fit: whether residuals are consistent with noise, and estimates physically possible.

Every test that applies is made: chi-square where the noise is known, trends and runs of the
residuals over amplitude, frequency and drive, a stiffness that rises with amplitude, the
exponent's score (departure from the universal curve h(beta)), the third harmonic against the
model's. Their joint false-alarm rate is 1 %: the level of each test is 1 % divided by the number of
tests with at least its p-value (Holm, Scandinavian Journal of Statistics 6 (1979) 65).
The noise that trends have to exceed includes the misfit of the estimate.

If the model does not describe the data, the sign of the response and the suspicious rows are tried
as causes (:mod:`dahl_ident.diagnostics.misfit_explanations`); the verdict begins with the cause.

A fit may agree with the data and still be physically impossible; this gives a warning
(:mod:`dahl_ident.diagnostics.physics`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import special

from dahl_ident.arrays import quotient
from dahl_ident.diagnostics.contributions import MODEL_ERROR, RUNS
from dahl_ident.diagnostics.error_model import ErrorModel, error_model
from dahl_ident.diagnostics.formatting import p_text, with_unit
from dahl_ident.diagnostics.judgement import Finding, VerdictStatus, described
from dahl_ident.diagnostics.misfit_explanations import (
    EXPLAINS,
    SuspiciousPoint,
    flagged_rows,
    is_at_end,
    neighbourhood,
    refitted_without,
    rms_misfit_of,
    sign_convention,
    suspicious_points,
)
from dahl_ident.diagnostics.physics import physical_warnings
from dahl_ident.diagnostics.residual_space import ResidualSpace
from dahl_ident.diagnostics.slip_density import FAR_LESS, least_misfit
from dahl_ident.diagnostics.trends import (
    LEAST_DOF,
    LEAST_RANGE,
    ResidualTest,
    groups,
    runs,
    stiffening,
    trends,
)
from dahl_ident.fitting import Optimum
from dahl_ident.units import counted, percent

_TRUSTED, _APPROXIMATE, _NOT_DETERMINED, _NOT_DESCRIBED = VerdictStatus
_FALSE_ALARM = 0.01  # of all tests together: one sound data set in a hundred is doubted
_HINT = 0.05  # the same for hints, which do not change the verdict
_FAR_MORE = 2.0  # scatter over that which the data's covariance states
_NO_SENSOR = 0.15  # noise over the response, more than any sensor has
_MEDIAN_SQUARE = 2.0 * np.log(2.0)  # of two normal numbers' sum of squares
_CLOSE = 0.8  # bound over the misfit, above which no law of this kind helps
_OF_ONE_DEVICE = 0.25  # u of a logarithm: 95 % within a factor of 1.6, see verdicts.py
_WORTH_NAMING = 0.1  # share of the largest scatter, below which a scatter is not listed


@dataclass(frozen=True)
class Goodness:
    """Residuals after the fit, and what they mean.

    Examples
    --------
    >>> import dahl_ident as di
    >>> goodness = di.fit(di.load_dataset("noisy"), di.Dahl()).goodness
    >>> goodness.acceptable, round(goodness.rms_misfit, 3), goodness.suspicious
    (True, 0.014, ())
    """

    # root mean square of abs(measured - fitted)/abs(measured), of fundamentals if there are any;
    # of records, of the residuals over that of the measured output's variation
    rms_misfit: float
    warnings: tuple[str, ...] = ()  # what is impossible or unsafe, and is not a finding
    flagged: tuple[str, ...] = ()  # rows that the extraction flagged, with the reason
    # every test that applies; within runs, if the scatter between runs exceeds the noise
    tests: tuple[ResidualTest, ...] = ()
    # estimated noise over the size of the response; None if the noise's scale is known
    noise_share: float | None = None
    dof: int = 0
    # scatter about the fit over that of the data's covariance, if the fit did not use it
    scatter: float | None = None
    suspicious: tuple[SuspiciousPoint, ...] = ()  # points that stand apart
    # whether the amplitudes give no more numbers than friction has free parameters, so that any
    # law fits
    untested: bool = False
    rows: int = 0
    fundamentals: int = 0  # rows of the fundamental
    sign: str = ""  # the sign convention that would explain the misfit
    apart: tuple[str, ...] = ()  # suspicious rows, where they alone contradict the model
    verdict_without: str = ""  # how the model describes the data without those rows
    # where the suspicious rows lie, if they alone depart from the model but are neighbours; for a
    # robust fit also if a single one is at an end
    neighbours: str = ""
    # least misfit of parallel Jenkins elements, if it helps to explain a misfit
    bound: float | None = None

    @cached_property
    def level(self) -> float:
        """p-value below which one test counts, by Holm's procedure."""
        remaining = len(self.tests)
        for p in sorted(test.p_value for test in self.tests):
            if remaining == 1 or not p < _FALSE_ALARM / remaining:
                break
            remaining -= 1
        return _FALSE_ALARM / max(remaining, 1)

    def of(self, kind: str) -> list[ResidualTest]:
        """Return the tests of one kind."""
        return [test for test in self.tests if test.kind == kind]

    @property
    def acceptable(self) -> bool:
        """Whether residuals that can be judged are consistent with noise, and no row is flagged."""
        return not self.objections and not self.flagged and self.judged

    @property
    def judged(self) -> bool:
        """Whether the data test the model, and distinguish a wrong one from noise."""
        return not self.untested and self._enough_points

    @property
    def _enough_points(self) -> bool:
        return self.noise_share in (None, 0.0) or self.dof >= LEAST_DOF

    @cached_property
    def objections(self) -> tuple[str, ...]:
        """Objections to the model, in words with numbers."""
        return tuple(self._departures(self.level))

    @cached_property
    def hints(self) -> tuple[str, ...]:
        """Objections at a level that noise alone reaches in one data set of twenty."""
        return tuple(self._departures(_HINT / _FALSE_ALARM * self.level))

    def _departures(self, level: float) -> Iterator[str]:
        """Yield every departure whose p-value is below `level`, the most informative first."""

        def clear(kind: str) -> list[ResidualTest]:
            return [test for test in self.of(kind) if test.p_value < level]

        yield from map(str, (*clear("groups"), *self.of("runs differ")))
        departing = clear("trend")
        with_rate = [trend for trend in departing if trend.about == "frequency"]
        yield from (f"{t.brief}, which no rate-independent model can describe" for t in with_rate)
        yield from map(str, clear("stiffening"))
        if self.beyond_any_sensor and self.noise_share is not None:
            yield (
                f"the scatter is {percent(self.noise_share)} of the response, "
                "more than any sensor's noise"
            )
        with_level = [trend.brief for trend in departing if trend not in with_rate]
        with_level += map(str, clear("exponent"))
        if with_level and any(test.values["fixed"] == 1.0 for test in self.of("exponent")):
            with_level[0] = f"these data are not linear Dahl: {with_level[0]}"
        yield from with_level
        yield from map(str, () if departing else clear("smooth"))
        yield from map(str, (*clear("third harmonic"), *clear("chi-square")))
        yield from map(str, () if departing else clear("runs"))

    @property
    def runs_scatter(self) -> Mapping[str, float]:
        """Scatter between runs beyond the noise: of ln gain, phase (rad), and ln of parameters."""
        return next((test.values for test in self.of("runs differ")), {})

    @property
    def is_of_several_devices(self) -> bool:
        """Whether runs or labelled rows scatter as those of several devices do."""
        groups = [t.values["scatter"] for t in self.of("groups") if t.p_value < self.level]
        return max([*self.runs_scatter.values(), *groups], default=0.0) > _OF_ONE_DEVICE

    @property
    def law_is_wrong(self) -> bool:
        """Whether a law of parallel Jenkins elements describes the data far better."""
        return self.bound is not None and self.bound < FAR_LESS * self.rms_misfit

    @property
    def beyond_any_sensor(self) -> bool:
        """Whether the scatter exceeds that of any sensor."""
        return self.noise_share is not None and self.noise_share > _NO_SENSOR

    def findings(
        self, severity: VerdictStatus = _NOT_DESCRIBED, *, counted: bool = False
    ) -> Iterator[Finding]:
        """Yield whether the model describes the data."""
        misfit: dict[str, Any] = {"rms": self.rms_misfit}
        if self.sign:
            yield described("sign", _NOT_DESCRIBED, convention=self.sign)
        elif self.apart:
            apart = {"names": self.apart, "rows": self.rows, "remaining": self.verdict_without}
            yield described("rows_apart", severity, **misfit, **apart)
        elif self.objections:
            yield described(
                "misfit", severity, **misfit, objections=self.objections, counted=counted
            )
        if not self._enough_points:
            yield described("too_few_points", _NOT_DETERMINED, **misfit, dof=self.dof)
        elif self.untested:
            yield described("one_amplitude", _NOT_DETERMINED, **misfit)
        elif not self.objections:
            far_more = self.scatter is not None and self.scatter > _FAR_MORE
            scatter = self._scatter_in_words if far_more else ""
            yield described("noise", _TRUSTED, **misfit, hints=self.hints, scatter=scatter)
        if self.flagged:
            every = len(self.flagged) == self.fundamentals
            worst = _NOT_DETERMINED if every else _APPROXIMATE
            yield described("flagged", worst, points=self.flagged, every=every)
        if self.sign or self.apart:
            return
        if self.suspicious and 2 * len(self.suspicious) < self.rows:  # most rows are not outliers
            names = tuple(point.name for point in self.suspicious)
            worst = _APPROXIMATE if self.neighbours else _TRUSTED
            yield described("suspicious", worst, names=names, neighbours=self.neighbours)
        if self.bound is not None:
            law = self.law_is_wrong
            worst = severity if law else _TRUSTED
            yield described("jenkins_bound", worst, least=self.bound, law=law)

    @property
    def _scatter_in_words(self) -> str:
        return f"the scatter is {self.scatter:.2g} times what the data's covariance states"

    @property
    def cause(self) -> str:
        """The reason why the model does not describe the data, in words; "" if none is known."""
        causes = (f for f in self.findings() if f.code in ("sign", "rows_apart"))
        return next(map(str, causes), "")

    @property
    def headline(self) -> str:
        """Whether the model describes the data, in a few sentences."""
        return " ".join(str(finding) for finding in self.findings())

    @property
    def details(self) -> list[str]:
        """Every test with its p-value, suspicious points and warnings, a line each."""
        lines = [f"{test} ({p_text(test.p_value)})" for test in self.tests]
        if self.scatter is not None:
            lines.append(self._scatter_in_words)
        lines += [f"suspicious: {point}" for point in self.suspicious]
        lines += [f"warning: {text}" for text in self.warnings]
        return lines + [f"flagged in extraction: {text}" for text in self.flagged]

    def __str__(self) -> str:
        return "\n".join([self.headline, *(f"- {line}" for line in self.details)])


def goodness(optimum: Optimum, errors: ErrorModel | None = None) -> Goodness:
    """Return every test of an estimate's residuals, physical warnings, and the cause of a misfit.

    The estimate is that of `errors`, if known; a scatter between runs that exceeds the noise is
    removed first.
    """
    tested = _tested(optimum, errors)
    if errors is not None and tested.objections:
        within, stated = _within_runs(errors), optimum.problem.data.run is not None
        if within is not None:  # unless runs are stated, labels may explain their differences
            if not stated:
                others = (test for test in within.tests if test.kind != "groups")
                within = replace(within, tests=(*others, *tested.of("groups")))
            tested = within
    if optimum.loss != "linear":  # a robust loss hides where the model fails
        tested = replace(tested, neighbours=_side_by_side(optimum, tested))
    if optimum.method == "ipopt" or (optimum.success and not tested.objections):
        return tested  # Ipopt may have had constraints, which other searches would not keep
    sign = sign_convention(optimum, tested.rms_misfit, _misfit_if_described)
    if sign:
        return replace(tested, sign=sign)
    tested = _without_suspicious(optimum, tested)
    differ = tested.runs_scatter or any(t.p_value < tested.level for t in tested.of("groups"))
    if differ or not tested.objections:
        return tested  # no law describes several devices at once
    least, misfit = least_misfit(optimum), tested.rms_misfit
    helps = least is not None and (least < FAR_LESS * misfit or _CLOSE * misfit < least <= misfit)
    return replace(tested, bound=least) if helps else tested


def _tested_estimate(optimum: Optimum) -> Goodness:
    """Return the tests of the estimate that belongs to an optimum."""
    return _tested(optimum, error_model(optimum, of_combinations=True))


def _misfit_if_described(optimum: Optimum) -> float:
    tested = _tested_estimate(optimum)
    return np.inf if tested.objections else tested.rms_misfit


def _without_suspicious(optimum: Optimum, tested: Goodness) -> Goodness:
    """Return `tested` with the objections that remain without the suspicious rows."""
    rows = [point.row for point in tested.suspicious]
    down_weighted = optimum.loss != "linear"
    if down_weighted or not (rows and tested.objections and not is_at_end(optimum, rows)):
        return tested
    optimum_without = refitted_without(optimum, rows)
    without = None if optimum_without is None else _tested_estimate(optimum_without)
    if without is None or without.hints or not without.judged:  # hints include objections
        return tested
    if not without.rms_misfit * EXPLAINS < tested.rms_misfit:
        return tested
    if neighbours := _side_by_side(optimum, tested):
        return replace(tested, neighbours=neighbours)
    (remaining,) = (str(f) for f in without.findings() if f.code == "noise")
    names = tuple(point.name for point in tested.suspicious)
    return replace(tested, apart=names, verdict_without=remaining)


def _side_by_side(optimum: Optimum, tested: Goodness) -> str:
    """Return a clause if suspicious rows are neighbours, or if one alone is at an end, or ""."""
    rows = [point.row for point in tested.suspicious]
    if is_at_end(optimum, rows):
        return "it is the first or the last"
    region = neighbourhood(optimum, rows)
    return f"they are neighbours, {region}" if region else ""


def _within_runs(errors: ErrorModel) -> Goodness | None:
    """Return the tests of the residuals within runs; None if the runs do not differ.

    If differences between runs use half of the degrees of freedom, as with one point a run, they
    cannot be distinguished from a wrong model, for which the plain residuals are tested.
    """
    runs, optimum = errors.runs, errors.at_estimate
    if runs is None:
        return None
    plain, within = ResidualSpace(optimum), ResidualSpace(optimum, runs)
    if 2 * within.dof <= plain.dof:
        return None
    explained = float(plain.residuals @ plain.residuals - within.residuals @ within.residuals)
    p = plain.tail(explained, plain.dof - within.dof)
    tested = _tested(optimum, errors, within)
    if not p < tested.level:
        return None
    scatter = {
        source.per_test: v**0.5
        for source, v in zip(errors.sources, errors.variances.tolist(), strict=True)
        if source.name == RUNS and v > 0.0
    }
    least = _WORTH_NAMING * max(scatter.values())
    parts = [
        f"{name} by {f'{np.degrees(s):.2g} deg' if name == 'phase' else percent(s)}"
        for name, s in scatter.items()
        if s >= least
    ]
    text = f"the runs differ ({', '.join(parts)})"
    return replace(tested, tests=(ResidualTest("runs differ", p, text, scatter), *tested.tests))


def _tested(
    optimum: Optimum, errors: ErrorModel | None, within: ResidualSpace | None = None
) -> Goodness:
    """Return every test of the residuals at the estimate, and physical warnings."""
    if errors is not None:
        optimum = errors.at_estimate
    space, problem = within or ResidualSpace(optimum), optimum.problem
    weighted = space
    if errors is not None and errors.estimate.problem.has_misfit:
        weighted = ResidualSpace(optimum, None if within is None else errors.runs, errors.estimate)
    chi_square = _chi_square(optimum, space)
    tests = (
        chi_square,
        stiffening(optimum),
        *groups(optimum, space),
        *trends(optimum, weighted),
        *runs(optimum, space),
        _exponent(optimum, space, chi_square),
        _third_harmonic(optimum, space),
        _smooth(errors) if within is None else None,
    )
    return Goodness(
        rms_misfit_of(problem, problem.predict(optimum.theta)),
        tuple(physical_warnings(optimum)),
        flagged_rows(problem.data),
        tuple(test for test in tests if test is not None),
        _noise_share(optimum),
        optimum.dof,
        _scatter(optimum),
        suspicious=suspicious_points(optimum, space),
        untested=_untested(optimum),
        rows=problem.data.n,
        fundamentals=int((problem.data.harmonic == 1).sum()),
    )


def _smooth(errors: ErrorModel | None) -> ResidualTest | None:
    """Return the test of a departure that is smooth over amplitude and frequency."""
    if errors is None or errors.structure <= 1.0:
        return None
    size = errors.rms(MODEL_ERROR)
    text = (
        f"the data depart smoothly from the model by {percent(size)} rms, more than their noise "
        f"({percent(size / errors.structure)})"
    )
    return ResidualTest("smooth", errors.structure_by_chance, text, {"size": size})


def _untested(optimum: Optimum) -> bool:
    """Return whether friction has as many free parameters as one amplitude has numbers."""
    problem = optimum.problem
    view = problem.stiffness_data
    elements = [e for e in problem.model.elements if not e.is_linear]
    free = sum(bool(p.free) for e in elements for p in e.parameters)
    return np.ptp(np.log(view.amplitude)) < LEAST_RANGE and free >= 2 * len(view.orders)


def _chi_square(optimum: Optimum, space: ResidualSpace) -> ResidualTest | None:
    if not optimum.scale_known or space.dof <= 0:
        return None
    value = float(space.residuals @ space.residuals)
    text = f"chi-square {value:.4g} with {counted(space.dof, 'degree of freedom')}"
    p = float(special.chdtrc(space.dof, value))
    return ResidualTest("chi-square", p, text, {"value": value, "dof": space.dof})


def _noise_share(optimum: Optimum) -> float | None:
    """Return the estimated noise over the size of the response; 0 if it is rounding.

    A few rows that depart far do not raise it.
    """
    if optimum.scale_known:
        return None
    if optimum.is_exact:
        return 0.0
    problem, size = optimum.problem, 1.0
    if problem.noise == "absolute":
        size = float(np.sqrt(np.mean(np.abs(problem.data.response) ** 2)))
    y = problem.residuals_and_jacobian(optimum.theta)[0][: problem.n_residuals]
    middle = float(np.median(np.sum(y.reshape(-1, 2) ** 2, axis=1)))
    return min(optimum.scale, float(np.sqrt(middle / _MEDIAN_SQUARE))) / size


def _scatter(optimum: Optimum) -> float | None:
    problem = optimum.problem
    if problem.noise == "measured" or problem.data.covariance is None or optimum.dof <= 0:
        return None
    y, _ = problem.like(noise="measured").residuals_and_jacobian(optimum.theta, tails=False)
    return float(np.sqrt(y @ y / optimum.dof))


def _exponent(
    optimum: Optimum, space: ResidualSpace, chi_square: ResidualTest | None
) -> ResidualTest | None:
    """Return the score test of the exponent that the only friction law holds fixed.

    `widened` is the factor by which `stderr` is larger if chi-square shows a misfit.
    """
    elements = [e for e in optimum.problem.model.elements if not e.is_linear]
    exponents = [p for e in elements for p in e.parameters if p.is_exponent]
    if len(elements) != 1 or len(exponents) != 1 or optimum.status.at_infinity:
        return None
    (alpha,) = exponents
    if alpha.free or alpha.value is None:
        return None
    freed = optimum.problem.like(free=[alpha.name])  # sensors and drive included
    theta = optimum.theta_in(freed)
    by_alpha = freed.prediction_jacobian(theta)[:, freed.names.index(alpha.name)]
    change = quotient(by_alpha, freed.predict(theta))
    slope, error = space.coefficient(change)
    p = space.p_value(change[None])
    if not error < 1.0 or np.isnan(p):  # with a larger error the exponent is unknown
        return None
    indicated, widened, widening = alpha.value * float(np.exp(slope)), 1.0, ""
    if chi_square is not None and chi_square.p_value < _FALSE_ALARM:
        widened = (chi_square.values["value"] / chi_square.values["dof"]) ** 0.5
    if widened > 1.0:
        widening = f" (error widened {widened:.2g} times because of the misfit)"
    u = indicated * error * widened
    text = (
        f"{alpha.name} near {with_unit(indicated, u, '')}{widening} describes the data better than "
        f"{alpha.value:g}"
    )
    numbers = {"fixed": alpha.value, "indicated": indicated, "stderr": u, "widened": widened}
    return ResidualTest("exponent", p, text, numbers, alpha.name)


def _third_harmonic(optimum: Optimum, space: ResidualSpace) -> ResidualTest | None:
    """Return the test of the third harmonic: the size of the data's over the model's.

    The p-value accounts for the phase as well.
    """
    rows = optimum.problem.data.harmonic == 3
    if not rows.any():
        return None
    third = rows.astype(np.complex128)
    excess, error = space.coefficient(third)
    text = f"the third harmonic is {with_unit(1.0 + excess, error, '')} times the model's"
    p = space.p_value(np.array([third, 1j * third]))
    return ResidualTest("third harmonic", p, text, {"ratio": 1.0 + excess})
