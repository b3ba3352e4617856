"""Possible causes of a misfit: a sign convention, or single rows.

Both are tried with the same problem, model and noise, and reported if they explain the data. The
fit itself is not changed: nothing is corrected or dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import Protocol

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.formatting import percent
from dahl_ident.diagnostics.trends import covariates
from dahl_ident.errors import DahlIdentError
from dahl_ident.fitting import Optimum, Status, solve
from dahl_ident.fitting.global_start import starts
from dahl_ident.problem import Problem

EXPLAINS = 3.0  # times lower misfit
_PROMISING = 1.5  # the same, at the start of a search
_BY_CHANCE = 0.01  # probability that rows at random lie as close together
_RANGE = 5  # values, of which the first and the last are ends


@dataclass(frozen=True)
class Turn:
    """A change of sign of the response's real and imaginary part, and what makes it."""

    name: str
    real: int
    imaginary: int
    check: str

    def __call__(self, data: FrequencyResponse) -> FrequencyResponse:
        """Return the data turned, their covariances with them."""
        signs = np.array([self.real, self.imaginary])
        covariance = data.covariance
        cross, of_drive = data.amplitude_covariance, data.drive_covariance
        return replace(
            data,
            response=self.real * data.response.real + 1j * self.imaginary * data.response.imag,
            covariance=None if covariance is None else covariance * np.outer(signs, signs),
            amplitude_covariance=None if cross is None else cross * signs,
            drive_covariance=None if of_drive is None else of_drive * signs,
        )


_PHASE = (
    "check the sign of the phase, which is that of exp(+j omega t): the force leads the "
    "displacement where friction dissipates"
)
_SIGN = "check that force and displacement are positive in the same direction"
TURNS = (
    Turn("conjugated", 1, -1, _PHASE),
    Turn("negated", -1, -1, _SIGN),
    Turn("negated and conjugated", -1, 1, f"{_PHASE}, and {_SIGN}"),
)


def rms_misfit(problem: Problem, theta: FloatArray) -> float:
    """Return the root mean square of abs(measured - fitted)/abs(measured) of fundamentals."""
    return rms_misfit_of(problem, problem.predict(theta))


def rms_misfit_of(problem: Problem, fitted: ComplexArray) -> float:
    """Return the same for responses (n,) that were fitted in another way."""
    return float(np.sqrt(np.mean(_misfit(problem, fitted) ** 2)))


class Tested(Protocol):
    """Tests of a fit's residuals."""

    @property
    def rms_misfit(self) -> float:
        """Of the fundamentals."""

    @property
    def objections(self) -> tuple[str, ...]:
        """What speaks against the model."""


def sign_convention(optimum: Optimum, before: float, tested: Callable[[Optimum], Tested]) -> str:
    """Return which sign of the response explains data that the fit does not; "" where none.

    `before` is the misfit of the estimate, and `tested` tests that of another optimum: a missing
    mass or spring is met better with a turned sign as well, but not to the noise.
    """
    fitted = optimum.problem.predict(optimum.theta)
    middle = float(np.median(_misfit(optimum.problem, fitted)))
    found = []
    for turn in TURNS:
        try:
            problem = optimum.problem.like(data=turn(optimum.problem.data))
            # single rows near a resonance may miss at a start: the median is not bent by them
            first = float(np.median(_misfit(problem, problem.predict(starts(problem)[0]))))
        except DahlIdentError:
            continue
        if first * _PROMISING < middle:
            found.append((first, turn, problem))
    if not found:
        return ""
    _, turn, problem = min(found, key=lambda each: each[0])
    turned = tested(solve(problem, loss=optimum.loss))
    if turned.objections or not turned.rms_misfit * EXPLAINS < before:
        return ""
    return (
        f"With the response {turn.name} the misfit falls from {percent(before)} to "
        f"{percent(turned.rms_misfit)} rms: {turn.check}"
    )


def set_aside(optimum: Optimum, rows: Sequence[int]) -> Optimum | None:
    """Return the optimum of the other rows; None where they have none."""
    data = optimum.problem.data
    kept = np.ones(data.n, dtype=np.bool_)
    kept[list(rows)] = False
    try:
        other = solve(optimum.problem.like(data=data.select(rows=kept)), loss=optimum.loss)
    except DahlIdentError:
        return None
    return None if other.status is Status.NOT_CONVERGED else other


def least_misfit_without(optimum: Optimum, rows: Sequence[int]) -> float:
    """Return the least misfit of the other rows' fundamentals, to first order in the parameters."""
    problem, theta = optimum.problem, optimum.theta
    response, predicted = problem.data.response, problem.predict(theta)
    kept = (problem.data.harmonic == 1) & (response != 0.0) & np.isfinite(predicted)
    kept[list(rows)] = False
    if not kept.any():
        return 0.0
    y = (1.0 - predicted / response)[kept].view(np.float64)
    J = np.ascontiguousarray((problem.prediction_jacobian(theta) / response[:, None])[kept].T)
    J = J.view(np.float64).T
    move = np.linalg.lstsq(J[:, np.isfinite(J).all(axis=0)], y, rcond=None)[0]
    left = y - J[:, np.isfinite(J).all(axis=0)] @ move
    return float(np.sqrt(2.0 * np.mean(left**2)))


def neighbourhood(optimum: Optimum, rows: Sequence[int]) -> str:
    """Return where several rows lie closer together than rows at random do; "" if they do not."""
    k, n = len(rows), optimum.problem.data.n
    if k < 2:
        return ""
    for name, values, unit in covariates(optimum):
        low, high = values[list(rows)].min(), values[list(rows)].max()
        span = int(((values >= low) & (values <= high)).sum())
        beyond = min(int((values >= low).sum()), int((values <= high).sum()))
        within = sum((n - s + 1) * comb(s - 2, k - 2) for s in range(k, span + 1))
        if min(within, 2 * comb(beyond, k)) < _BY_CHANCE * comb(n, k):
            return f"{name} from {low:.3g} to {high:.3g} {unit}"
    return ""


def at_an_end(optimum: Optimum, rows: Sequence[int]) -> bool:
    """Return whether a single row is the first or last of a covariate: the model may fail there."""
    if len(rows) != 1:
        return False
    ranges = (values for _, values, _ in covariates(optimum) if np.unique(values).size >= _RANGE)
    return any(values[rows[0]] in (values.min(), values.max()) for values in ranges)


def _misfit(problem: Problem, fitted: ComplexArray) -> FloatArray:
    response, harmonic = problem.data.response, problem.data.harmonic
    order = 1 if (harmonic == 1).any() else harmonic.min()
    rows = (harmonic == order) & (response != 0.0)
    crossed = rows & (fitted != 0.0)  # within a gap there is nothing that a share could be of
    rows = crossed if crossed.any() else rows
    return np.asarray(np.abs(1.0 - fitted[rows] / response[rows]))
