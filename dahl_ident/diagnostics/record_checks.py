"""The checks of a fit to records: each yields findings, of which the worst is the status.

As for tables: which parameters are determined, whether the model describes the records, and which
assumptions the records cannot test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.checks import assumed, constraints, reading
from dahl_ident.diagnostics.contributions import (
    ALONG_MOTION,
    EXPONENT,
    MODEL_ERROR,
    NOISE,
    RUNS,
)
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus
from dahl_ident.diagnostics.physics import below_zero, is_single, slight
from dahl_ident.diagnostics.record_misfit import REMEDY
from dahl_ident.elements import Element
from dahl_ident.elements.recursion import Stretches, stretches
from dahl_ident.problem.record_noise import share_in_band
from dahl_ident.problem.record_problem import RecordProblem
from dahl_ident.units import Motion, percent, shown_unit, si_unit

if TYPE_CHECKING:
    from dahl_ident.diagnostics.record_assessment import RecordAssessment

_SEGMENTS = 50  # the worst one is 2 % of a record
_UNCERTAIN = 0.3  # relative standard uncertainty of a parameter that is not determined
_LONG_ENOUGH = 0.02  # share of samples near a reversal
_ALIKE = 0.95  # correlation at which two parameters cannot be distinguished
_FAIRLY = 0.04  # share of variance that a model misses: beyond it, intervals do not hold
_TOO_LARGE = 0.25  # share of variance left, of noise too: half of the output is not the model's
_FEW = 10.0  # degrees of freedom with which an uncertainty is known to a fifth
_BECAUSE = {  # by the source of most of the uncertainty
    EXPONENT: "of the exponent, which was not given: give it if it is known, or estimate it too",
    RUNS: "the records ask for different values: fit each alone, and look at what differs",
    ALONG_MOTION: "the residuals follow the motion: choose a model that describes what it does",
    MODEL_ERROR: (
        "parts of the records ask for different values: choose a model that describes them"
    ),
}
_DETERMINED, _DESCRIBED, _ASSUMED = Question
_TRUSTED, _APPROXIMATE, _NOT_DETERMINED, _NOT_DESCRIBED = VerdictStatus


@dataclass(frozen=True)
class RecordGoodness:
    """Residuals of all records.

    Attributes
    ----------
    share_left : float
        Variance of the residuals over that of the measured output.
    rms : float
        Root mean square of the residuals, in the output's unit.
    worst_record, worst_start, worst_stop, worst_rms : int and float
        The segment, a fiftieth of a record, with the largest residuals: record (from 1), times in
        s, and its root mean square.
    correlation : float
        Of residuals of neighbouring samples.
    share_in_band : float
        `share_left` at the drive's frequencies where residuals are weighted by their spectrum.
    """

    share_left: float
    rms: float
    worst_record: int
    worst_start: float
    worst_stop: float
    worst_rms: float
    correlation: float
    n_records: int
    share_in_band: float
    warnings: tuple[str, ...] = ()
    acceptable: bool = True
    objections: tuple[str, ...] = ()
    cause: str = ""

    @property
    def rms_misfit(self) -> float:
        """Root mean square of the residuals over that of the measured output's variation."""
        return float(np.sqrt(self.share_left))

    @property
    def worst_text(self) -> str:
        """The worst segment in words."""
        which = f" of record {self.worst_record}" if self.n_records > 1 else ""
        return (
            f"most between {self.worst_start:.4g} and {self.worst_stop:.4g} s{which}, where the "
            f"residuals are {self.worst_rms / self.rms if self.rms else 0.0:.2g} times larger"
        )

    @property
    def details(self) -> list[str]:
        """The numbers as text."""
        return [
            f"unexplained share of variance {self.share_left:.3g} ({percent(self.rms_misfit)} rms)",
            f"residuals {self.rms:.3g} rms; {self.worst_text}",
            f"correlation of neighbouring residuals {self.correlation:.2f}",
        ]


def record_goodness(problem: RecordProblem, residuals: Sequence[FloatArray]) -> RecordGoodness:
    """Return the statistics of the residuals of records, measured minus predicted output of each.

    Examples
    --------
    >>> from dahl_ident import Dahl, Record
    >>> t = np.arange(100.0)
    >>> record = Record(t, displacement=t, force=np.sin(t))
    >>> problem = RecordProblem([record], Dahl())
    >>> print(record_goodness(problem, [0.1 * np.sin(t)]).details[0])
    unexplained share of variance 0.01 (10 % rms)
    """
    records, measured = problem.records, problem.measured
    variance = sum(float(np.sum((y - y.mean()) ** 2)) for y in measured)
    together = np.concatenate(list(residuals))
    worst = (0, 0.0, 0.0, -1.0)
    for number, (record, e) in enumerate(zip(records, residuals, strict=True), 1):
        width = max(1, e.size // _SEGMENTS)
        sums = np.concatenate([[0.0], np.cumsum(e**2)])
        mean = (sums[width:] - sums[:-width]) / width
        place = int(np.argmax(mean))
        if mean[place] > worst[3]:
            stop = float(record.time[min(place + width, e.size) - 1])
            worst = (number, float(record.time[place]), stop, float(mean[place]))
    products = sum(float(e[1:] @ e[:-1]) for e in residuals)
    total = float(together @ together)
    left = total / variance
    if problem.whitening.size > 1:
        left = share_in_band([r.force_samples for r in records], measured, residuals)
    return RecordGoodness(
        total / variance,
        float(np.sqrt(total / together.size)),
        worst[0],
        worst[1],
        worst[2],
        float(np.sqrt(worst[3])),
        products / total if total else 0.0,
        len(records),
        left,
    )


def misses(fit: RecordAssessment) -> bool:
    """Return whether the model misses more than noise."""
    return not {MODEL_ERROR, ALONG_MOTION}.isdisjoint(fit.errors.contributions)


def undetermined(fit: RecordAssessment) -> Iterator[Finding]:
    """Yield the parameters that the records do not determine, the reasons, and a motion that would.

    Those of which the uncertainty is a third of their size.
    """
    problem, covariance = fit.problem, fit.errors.covariance
    free = {p.name: i for i, p in enumerate(problem.free)}
    paths = [stretches(r.displacement) for r in problem.records if r.displacement is not None]
    for element in fit.model.elements:
        for parameter in element.parameters:
            if parameter.name not in free:
                continue
            place = free[parameter.name]
            error, value = float(covariance[place, place]) ** 0.5, abs(float(parameter.value or 0))
            # a parameter that may be zero, such as an asymmetry, is known whatever its bounds
            limit = min(parameter.upper, -parameter.lower) if parameter.lower < 0.0 else 0.0
            if error <= _UNCERTAIN * max(limit if np.isfinite(limit) else 0.0, value):
                continue
            why = _motion_that_lacks(element, paths, problem.motion, known=error < value)
            why = why or _reason(fit, place)
            unit = shown_unit(parameter.unit, problem.motion)
            values = {"name": parameter.name, "stderr": error, "unit": unit, "why": why}
            yield Finding(_DETERMINED, _NOT_DETERMINED, "record_parameter", values)


def _motion_that_lacks(
    element: Element, paths: Sequence[Stretches], motion: Motion, *, known: bool
) -> str:
    """Return what the displacement lacks to determine a law; "" where it suffices.

    An estimate that is not `known` to its own size says nothing of where slip begins.
    """
    farthest = max((float(p.path.max()) for p in paths), default=np.nan)
    if farthest == 0.0:
        return ": the displacement is constant; move"
    if not element.has_memory or not paths:
        return ""
    values = [np.asarray(p.value if p.value is not None else 0.0) for p in element.parameters]
    low, high = (float(k) for k in element.knee(values))
    unit = si_unit("displacement", motion)
    if farthest < 2.0 * low:
        needs = f"{2.0 * high:.2g} {unit}" if known else "more"
        return (
            f": the motion moves no farther than {farthest:.2g} {unit} after a reversal, and slip "
            f"needs {needs}; move farther"
        )
    if np.mean(np.concatenate([p.path < 2.0 * low for p in paths])) < _LONG_ENOUGH:
        return (
            f": the motion never stays below x_c = {low:.2g} {unit} long enough; add reversals and "
            "small motions of that size, sampled closely"
        )
    return ""


def _reason(fit: RecordAssessment, place: int) -> str:
    """Return why a parameter is not determined: the largest source, or one that is like it."""
    covariance = fit.errors.covariance
    for source, C in fit.errors.contributions.items():
        if source in _BECAUSE and 0.5 * covariance[place, place] < C[place, place] < np.inf:
            return f" because {_BECAUSE[source]}"
    with np.errstate(all="ignore"):
        size = np.sqrt(covariance.diagonal())
        alike = np.abs(covariance[place] / size / size[place]) > _ALIKE
    others = [n for i, n in enumerate(fit.problem.names) if alike[i] and i != place]
    if others:
        return f": it cannot be distinguished from {', '.join(others)}; fix one of them"
    return ": its effect is small compared with the residuals; fix it, or leave the element out"


def _misfit(fit: RecordAssessment) -> Iterator[Finding]:
    """Yield whether the model describes the records."""
    converged = fit.optimum.converged
    far = fit.goodness.share_in_band > (_FAIRLY if misses(fit) else _TOO_LARGE)
    if far:
        yield Finding(_DESCRIBED, _NOT_DESCRIBED, "records_not_described")
    if not converged:
        message = {"message": fit.optimum.message}
        yield Finding(_DESCRIBED, _NOT_DESCRIBED, "no_optimum", message)
    displaced = all(record.displacement is not None for record in fit.problem.records)
    if fit.problem.output == "motion" and (far or not converged) and displaced:
        yield Finding(_DESCRIBED, _NOT_DESCRIBED, "motion_may_be_imposed")
    if misses(fit) and not far:
        misfit = fit.errors.misfit
        follows = misfit.follows if misfit else ""
        values = {"follows": follows, "remedy": REMEDY.get(follows, "")}
        yield Finding(_DESCRIBED, _APPROXIMATE, "records_misfit", values)
    if fit.errors.dof_of(NOISE) < _FEW:
        few = {"effective": fit.errors.effective, "unknowns": len(fit.problem.names)}
        yield Finding(_DESCRIBED, _APPROXIMATE, "few_effective_samples", few)


def _physics(fit: RecordAssessment) -> Iterator[Finding]:
    """Yield physical objections to the estimates, and objections to an exponent."""
    yield from below_zero(fit.problem, fit.known)
    for element in fit.model.elements:
        if not is_single(element):
            for text in element.physics([p.value or 0.0 for p in element.parameters]):
                yield Finding(_DESCRIBED, _APPROXIMATE, "unphysical", {"objection": text})
    for one in fit.errors.exponents:
        if one.contradicted:
            asked = {"name": one.name, "wanted": one.found}
            if one.assumed:
                yield Finding(_DESCRIBED, _APPROXIMATE, "exponent", asked)
            else:
                stated = {**asked, "held": one.value}
                yield Finding(_DESCRIBED, _NOT_DESCRIBED, "stated_exponent", stated)


def _slight(fit: RecordAssessment) -> Iterator[Finding]:
    """Yield elements that carry less force than the misfit, and may describe a part of it."""
    problem = fit.problem
    if problem.output == "motion" or not misses(fit):
        return
    size = np.concatenate([y - y.mean() for y in problem.measured]).std()

    def share_of(element: Element, value: float) -> float:
        force = [
            element.force_history([value], x, v, 0.0, acceleration=a) for x, v, a in problem.motions
        ]
        return float(np.concatenate([f - f.mean() for f in force]).std() / size)

    misfit = fit.goodness.share_in_band**0.5
    yield from slight(problem, fit.known, share_of, misfit, misfit)


def _delay(fit: RecordAssessment) -> Iterator[Finding]:
    """Yield the delay that was taken out: a doubt where it moves the output by more than noise."""
    problem = fit.problem
    if not problem.delay:
        return
    moved = problem.delay * np.concatenate(problem.delay_slopes(fit.optimum.values))
    doubtful = bool(np.sqrt(np.mean(moved**2)) > fit.goodness.rms)
    samples = problem.delay * problem.records[0].sample_rate
    lag = {"delay": problem.delay, "samples": samples, "doubtful": doubtful}
    yield Finding(_DESCRIBED, _APPROXIMATE if doubtful else _TRUSTED, "delay", lag)


def _notes(fit: RecordAssessment) -> Iterator[Finding]:
    """Yield the size of the residuals, and what was done with the records."""
    problem, goodness = fit.problem, fit.goodness
    size = {
        "rms": goodness.share_left**0.5, "output": problem.output, "worst": goodness.worst_text
    }  # fmt: skip
    yield Finding(_DESCRIBED, _TRUSTED, "record_residuals", size)
    if problem.whitening.size > 1:
        within = {"rms": goodness.share_in_band**0.5}
        yield Finding(_DESCRIBED, _TRUSTED, "slow_residuals", within)
    if problem.displacement_noise:
        noise = {
            "noise": problem.displacement_noise,
            "unit": si_unit("displacement", problem.motion),
            "travel": problem.noise_travel,
        }
        yield Finding(_DESCRIBED, _TRUSTED, "displacement_noise", noise)
    yield from reading(fit)
    size = {"effective": fit.errors.effective, "samples": problem.n_samples}
    yield Finding(_DESCRIBED, _TRUSTED, "effective_samples", size)


CHECKS: tuple[Callable[[RecordAssessment], Iterable[Finding]], ...] = (
    constraints,
    _misfit,
    undetermined,
    _physics,
    _slight,
    _delay,
    _notes,
    assumed,
)
