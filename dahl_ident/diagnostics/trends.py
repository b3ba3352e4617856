"""Trends of the residuals with amplitude, frequency or drive, which show a wrong model.

**Trends.** For each covariate that varies, a smooth relative departure R exp(u) from the predicted
response R is fitted, where u, for gain and phase, is a complex polynomial of the logarithm of the
covariate. The part that the parameters could explain is removed
(:mod:`dahl_ident.diagnostics.residual_space`); an F or chi-square test shows whether the remainder
exceeds the noise. The size of the departure is given in percent, so that a significant trend can be
distinguished from one that matters. A Wald-Wolfowitz test of the residuals' signs detects
departures that no polynomial of low degree describes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from scipy import special

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.residual_space import ResidualSpace
from dahl_ident.fitting import Optimum
from dahl_ident.units import percent, shown_unit

LEAST_DOF = 6  # least degrees of freedom of a test of residuals of unknown scale
_DEGREES = {"amplitude": 3, "drive": 3, "frequency": 2}  # highest, of polynomials
_FEWEST_IN_A_GROUP = 3  # rows on average
_SAME_COVARIATE = 0.01  # difference of a covariate's logarithm up to which values are equal
LEAST_RANGE = np.log(1.05)  # of the logarithm of a covariate that varies
_LEAST_DOF_PER_COLUMN = 3  # with fewer for each polynomial, tests detect little
_FEWEST_SIGNS = 10  # of each sign on average; the number of runs is then nearly normal
_LARGEST_DEPARTURE = 9.0  # largest relative departure that is stated as a number


@dataclass(frozen=True)
class ResidualTest:
    """The result of a test of the residuals, with the probability that it is due to noise alone."""

    kind: str
    p_value: float
    text: str
    values: Mapping[str, Any]  # its numbers
    about: str = ""  # the covariate or column of labels
    brief: str = ""  # of a trend, the text without its range

    def __str__(self) -> str:
        return self.text


def groups(optimum: Optimum, space: ResidualSpace) -> Iterator[ResidualTest]:
    """Yield how the gain differs between groups of rows that a column labels, such as devices.

    The amplitude has to vary within each group: otherwise they are levels, which trends test. The
    `scatter` is half the range of ln gain.
    """
    data = optimum.problem.data
    amplitude = np.log(optimum.problem.stiffness_data.amplitude)
    columns = {} if "verdict" in data.quality else dict(data.quality)  # but not extraction's
    if data.level is not None:
        columns["level"] = data.level
    for name, labels in columns.items():
        names, number = np.unique(labels, return_inverse=True)
        if not 1 < len(names) <= data.n // _FEWEST_IN_A_GROUP:
            continue
        members = number == np.arange(len(names))[:, None]
        if min(float(np.ptp(amplitude[rows])) for rows in members) < LEAST_RANGE:
            continue
        changes = members.astype(np.complex128)
        p = space.p_value(changes)
        if not np.isnan(p):
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.log(np.abs(data.response / optimum.problem.predict(optimum.theta)))
            ratio[(data.harmonic != 1) | ~np.isfinite(ratio)] = np.nan
            gains = [float(np.exp(np.nanmedian(ratio[rows]))) for rows in members]
            low, high = int(np.argmin(gains)), int(np.argmax(gains))
            parts = [
                f"{percent(abs(gains[i] - 1.0))} {'below' if gains[i] < 1.0 else 'above'} the "
                f"model at {names[i]}"
                for i in (low, high)
            ]
            text = f"the gain differs with {name}: {' and '.join(parts)}"
            scatter = 0.5 * float(np.log(gains[high] / gains[low]))
            yield ResidualTest("groups", p, text, {"scatter": scatter}, name)


def trends(optimum: Optimum, space: ResidualSpace) -> Iterator[ResidualTest]:
    """Yield how the data depart from the fitted model over each covariate that varies enough.

    `largest` is the largest relative departure of a smooth curve through the fundamentals.
    """
    problem = optimum.problem
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(problem.data.response / problem.predict(optimum.theta))
    first = (problem.data.harmonic == 1) & np.isfinite(ratio)
    for name, values, unit in covariates(optimum):
        x = np.log(values)
        distinct = 1 + int((np.diff(np.sort(x)) > _SAME_COVARIATE).sum())
        degree = min(_DEGREES[name], distinct - 1, space.dof // (2 * _LEAST_DOF_PER_COLUMN))
        if degree < 1:
            continue
        shape = legendre.legvander(2.0 * (x - x.min()) / np.ptp(x) - 1.0, degree)[:, 1:].T
        changes = np.concatenate([shape, 1j * shape])
        p = space.p_value(changes)
        if np.isnan(p):
            continue
        curve = shape[:, first].T
        smooth = curve @ np.linalg.lstsq(curve + 0j, ratio[first], rcond=None)[0]
        largest = float(np.abs(np.expm1(smooth)).max(initial=0.0))
        departure = "the data depart from the model more than tenfold"
        if largest < _LARGEST_DEPARTURE:
            departure = f"the data depart from the model by up to {percent(largest)}"
        ends = f"from {values.min():.3g} to {values.max():.3g} {unit}".rstrip()
        text = f"over {name}, {ends}, {departure}"
        yield ResidualTest("trend", p, text, {"largest": largest}, name, f"over {name} {departure}")


def runs(optimum: Optimum, space: ResidualSpace) -> Iterator[ResidualTest]:
    """Yield the number of runs of equal sign in the residuals, in the order of each covariate."""
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
            text = f"{count} runs of sign over {name}, {mean:.0f} expected"
            yield ResidualTest("runs", float(special.ndtr(z)), text, {"runs": count}, name)


def covariates(optimum: Optimum) -> Iterator[tuple[str, FloatArray, str]]:
    """Yield name, values and unit of the quantities that vary over the rows."""
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
