"""Trends of the residuals with amplitude, frequency or drive, which show a wrong model.

**Trends.** For each covariate that varies, a smooth relative departure R exp(u) from the predicted
response R is fitted, where u, for gain and phase, is a complex polynomial of the logarithm of the
covariate. The part that the parameters could explain is removed
(:mod:`dahl_ident.diagnostics.residual_space`); an F or chi-square test shows whether the remainder
exceeds the noise. The size of the departure is given in percent, so that a significant trend can be
distinguished from one that matters. A Wald-Wolfowitz test of the residuals' signs detects
departures that no polynomial of low degree describes.

**Stiffening.** A stiffness that rises with amplitude contradicts every law that softens, whatever
its parameters and the rest of the misfit are. No curve is assumed: the range of ln A is divided
into a few bands, and in each the real part of the dynamic stiffness, minus that of the linear
elements, is fitted by a straight line, by weighted least squares and together with the correction
of a free mass. The values at the centres of the bands are compared. Rows that are predicted by the
exact steady motion are not tested.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy import special

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.information import parameter_values
from dahl_ident.diagnostics.physics import friction_stiffness, is_spring
from dahl_ident.diagnostics.residual_space import Coefficient, RelativeSpace, ResidualSpace
from dahl_ident.fitting import Optimum
from dahl_ident.units import COMPLIANCES, percent, shown_unit

_BANDS = 8  # number of bands of amplitude: few, so that each has enough rows
_NARROWEST = np.log(1.1)  # least width of a band of ln A
_FEWEST_ROWS = 3  # in a band
LEAST_DOF = 6  # least degrees of freedom of a test of residuals of unknown scale
_DEGREES = {"amplitude": 3, "drive": 3, "frequency": 2}  # highest, of polynomials
_FEWEST_IN_A_GROUP = 3  # rows on average
_SAME_COVARIATE = 0.01  # difference of a covariate's logarithm up to which values are equal
LEAST_RANGE = np.log(1.05)  # of the logarithm of a covariate that varies
_LEAST_DOF_PER_COLUMN = 3  # with fewer for each polynomial, tests detect little
_FEWEST_SIGNS = 10  # of each sign on average; the number of runs is then nearly normal
_STEEPEST = np.log(10.0)  # largest change of a logarithm that is stated as a number
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


def stiffening(optimum: Optimum) -> ResidualTest | None:
    """Return the most significant rise of stiffness with amplitude; None if there is no rise.

    The p-value is the probability of such a rise between any two bands by noise alone. `low` and
    `high` are the geometric means of the amplitudes in the two bands, and `rise` is relative to the
    stiffness at `low`.
    """
    elements = optimum.problem.model.elements
    friction = [e for e in elements if not e.is_linear]
    if optimum.is_exact or not friction or not all(e.softens for e in friction):
        return None
    problem, view = optimum.problem, optimum.problem.stiffness_data
    sines = ~(problem.is_exact & (problem.data.controlled == "force"))
    rows = np.flatnonzero((view.harmonic == 1) & (view.weights > 0.0) & sines)
    if not rows.size:
        return None
    kept, band = _bands(np.log(view.amplitude[rows]))
    rows = rows[kept]
    count = int(band.max(initial=-1)) + 1
    if count < 2:
        return None
    in_band = (band[:, None] == np.arange(count)).astype(np.float64)
    x = np.log(view.amplitude[rows])
    weights = view.weights[rows]
    centre = x @ in_band / in_band.sum(axis=0)
    design = np.column_stack([in_band, in_band * (x[:, None] - centre)])
    linear = (e.parameter(n) for e in elements if e.is_linear for n in e.linear_parameters)
    if any(p.free and p.is_mass for p in linear):
        square = view.omega[rows] ** 2
        design = np.column_stack([design, square / square.mean() - 1.0])
    dof = len(rows) - design.shape[1]
    if dof < LEAST_DOF:
        return None
    stiffness = friction_stiffness(optimum, with_springs=True).real[rows]
    inverse = np.linalg.pinv(weights[:, None] * design)
    values = inverse @ (weights * stiffness)
    residuals = weights * (stiffness - design @ values)
    covariance = inverse @ inverse.T * float(residuals @ residuals / dof)
    i, j = np.triu_indices(count, 1)
    rise = values[j] - values[i]
    variance = np.diagonal(covariance)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.sqrt(variance[i] + variance[j] - 2.0 * covariance[i, j])
        t = np.nan_to_num(rise / error)
    best = int(np.argmax(t))
    low, high = i[best], j[best]
    if t[best] <= 0.0 or values[low] <= 0.0:
        return None
    ends = np.exp(centre)
    unit = shown_unit("m", optimum.problem.data.motion)
    p = min(1.0, len(t) * float(special.stdtr(dof, -t[best])))
    rise, error = rise[best] / values[low], error[best] / values[low]
    numbers = {"low": ends[low], "high": ends[high], "rise": rise, "stderr": error}
    text = (
        f"stiffness rises with amplitude, by {with_unit(100.0 * rise, 100.0 * error, '%')} from "
        f"{ends[low]:.3g} to {ends[high]:.3g} {unit}, which this law cannot describe"
    )
    return ResidualTest("stiffening", p, text, numbers)


def _bands(x: FloatArray) -> tuple[BoolArray, NDArray[np.int64]]:
    """Return which rows lie in bands with enough rows, and the number of the band of each."""
    width = max(float(np.ptp(x)) / _BANDS, _NARROWEST) * (1.0 + 1e-9)
    position = np.floor((x - x.min()) / width)
    _, number, size = np.unique(position, return_inverse=True, return_counts=True)
    kept = size[number] >= _FEWEST_ROWS
    _, band = np.unique(number[kept], return_inverse=True)
    return kept, band


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

    `stiffness` and `loss` are the changes of ln of the real and imaginary part of friction's
    stiffness, data over model, over the range of the covariate, by a straight line over its
    logarithm: -0.36 is a fall by 30 %. The stiffness is that of friction and springs together where
    only their sum is determined. `largest` is the largest relative departure of the response by the
    smooth curve.
    """
    friction, relative = _friction_parts(optimum), RelativeSpace(optimum)
    for name, values, unit in covariates(optimum):
        x = np.log(values)
        distinct = 1 + int((np.diff(np.sort(x)) > _SAME_COVARIATE).sum())
        degree = min(_DEGREES[name], distinct - 1, space.dof // (2 * _LEAST_DOF_PER_COLUMN))
        if degree < 1:
            continue
        unit_range = 2.0 * (x - x.min()) / np.ptp(x) - 1.0
        shape = legendre.legvander(unit_range, degree)[:, 1:].T
        changes_of_response = np.concatenate([shape, 1j * shape])
        p = space.p_value(changes_of_response)
        if np.isnan(p):
            continue
        stiffness, loss = (relative.coefficient(0.5 * unit_range * part) for part in friction)
        with np.errstate(over="ignore", invalid="ignore"):
            sizes = np.abs(np.expm1(relative.fitted(changes_of_response)))
        largest = float(np.where(np.isnan(sizes), np.inf, sizes).max())
        departure = "the data depart from the model more than tenfold"
        if largest < _LARGEST_DEPARTURE:
            departure = f"the data depart from the model by up to {percent(largest)}"
        parts = [
            f"{part} {_change(change)}"
            for part, change in (("stiffness", stiffness), ("loss", loss))
            if abs(change.value) > 2.0 * change.stderr
        ]
        changes = f"friction's {' and '.join(parts)} against the model's" if parts else ""
        ends = f"from {values.min():.3g} to {values.max():.3g} {unit}".rstrip()
        text = f"over {name}, {ends}, {departure}{f' ({changes})' if changes else ''}"
        numbers = {"stiffness": stiffness, "loss": loss, "largest": largest}
        yield ResidualTest("trend", p, text, numbers, name, f"over {name} {changes or departure}")


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


def _friction_parts(optimum: Optimum) -> tuple[ComplexArray, ComplexArray]:
    """Return the relative changes of the response per ln of friction's stiffness and loss.

    The stiffness is that of friction and springs together if only their sum is determined.
    """
    problem = optimum.problem
    values = parameter_values(optimum)
    view = problem.stiffness_data
    total, stiffness, loss = np.zeros((3, len(view.amplitude)), dtype=np.complex128)
    for element in problem.model.elements:
        law_values = [np.asarray(values[p.name]) for p in element.parameters]
        part = view.stiffness_of(element, law_values)
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


def _change(part: Coefficient) -> str:
    """Return "falls by 30 ± 4 %", or "falls more than tenfold"."""
    word = "rises" if part.value > 0.0 else "falls"
    if abs(part.value) > _STEEPEST:
        return f"{word} more than tenfold"
    size = 100.0 * abs(np.expm1(part.value))
    return f"{word} by {with_unit(size, 100.0 * np.exp(part.value) * part.stderr, '%')}"
