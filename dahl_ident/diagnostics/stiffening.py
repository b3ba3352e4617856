r"""Test for a stiffness that rises with amplitude, which most friction laws exclude.

Re N falls with A for every Dahl element and for every sum of them, whatever the parameters; a
spring adds a constant. A law says so of itself (`softens`); with one that does not, there is no
test, and none of rows that are predicted by the exact steady motion: N is that of a displacement
that is a sine. The real part of the measured dynamic stiffness, less the modelled parts
of mass and other linear elements, is therefore a falling function of amplitude, and a rise
between any two amplitudes speaks against every such model, also where the fitted one leaves
other departures. No curve is assumed: the stiffness is a straight line over the logarithm of the
amplitude in each of a few bands, estimated with a free mass's correction by weighted least
squares, and compared from centre to centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.physics import friction_stiffness
from dahl_ident.elements import Element
from dahl_ident.fitting import Optimum
from dahl_ident.units import shown_unit

_BANDS = 8  # of the range of amplitudes: few, so that each holds rows for a mean
_NARROWEST = np.log(1.1)  # of a band, in the logarithm of the amplitude
_FEWEST_ROWS = 3  # in a band
LEAST_DOF = 6  # with fewer, no test of residuals of unknown scale applies


@dataclass(frozen=True)
class Stiffening:
    """The largest rise of stiffness with amplitude that the data show, against its error."""

    low: float  # the amplitudes between which it rises: means over their bands, geometric
    high: float
    unit: str  # theirs
    rise: float  # relative to the stiffness at `low`
    stderr: float
    p_value: float  # probability of as much by noise alone, all pairs of bands considered

    def __str__(self) -> str:
        size = with_unit(100.0 * self.rise, 100.0 * self.stderr, "%")
        ends = f"from {self.low:.3g} to {self.high:.3g} {self.unit}"
        return f"stiffness rises with amplitude, by {size} {ends}, which this law cannot describe"


def stiffening(optimum: Optimum) -> Stiffening | None:
    """Return the most significant rise of stiffness with amplitude; None where there is none."""
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
    count = int(band.max()) + 1 if band.size else 0
    own = (band[:, None] == np.arange(count)).astype(np.float64)
    x = np.log(view.amplitude[rows])
    centre = x @ own / own.sum(axis=0)
    design = np.column_stack([own, own * (x[:, None] - centre)])
    if any(_is_free_mass(e) for e in elements):
        square = view.omega[rows] ** 2
        design = np.column_stack([design, square / square.mean() - 1.0])
    dof = len(rows) - design.shape[1]
    if count < 2 or dof < LEAST_DOF:
        return None
    stiffness = friction_stiffness(optimum, with_springs=True).real[rows]
    values, covariance = _weighted_means(design, stiffness, view.weights[rows], dof)
    unit = shown_unit("m", optimum.problem.data.motion)
    return _largest_rise(
        np.exp(centre).tolist(), unit, values[:count], covariance[:count, :count], dof
    )


def _is_free_mass(element: Element) -> bool:
    own = [element.parameter(label) for label in element.linear_parameters]
    return element.is_linear and any(p.free and p.is_mass for p in own)


def _bands(x: FloatArray) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which rows lie in bands with enough of them, and the number of the band of each."""
    width = max(float(np.ptp(x)) / _BANDS, _NARROWEST) * (1.0 + 1e-9)
    place = np.floor((x - x.min()) / width)
    _, number, size = np.unique(place, return_inverse=True, return_counts=True)
    kept = size[number] >= _FEWEST_ROWS
    _, band = np.unique(number[kept], return_inverse=True)
    return kept, band


def _weighted_means(
    design: FloatArray, y: FloatArray, weights: FloatArray, dof: int
) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients of weighted least squares and their covariance as they scatter."""
    inverse = np.linalg.pinv(weights[:, None] * design)
    values = inverse @ (weights * y)
    left = weights * (y - design @ values)
    return values, inverse @ inverse.T * float(left @ left / dof)


def _largest_rise(
    amplitude: Sequence[float], unit: str, values: FloatArray, covariance: FloatArray, dof: int
) -> Stiffening | None:
    """Return the rise between two bands that is the largest against its error."""
    pairs = list(combinations(range(len(values)), 2))
    rise = np.array([values[j] - values[i] for i, j in pairs])
    error = np.array(
        [(covariance[i, i] + covariance[j, j] - 2.0 * covariance[i, j]) ** 0.5 for i, j in pairs]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.nan_to_num(rise / error)
    best = int(np.argmax(t))
    i, j = pairs[best]
    if t[best] <= 0.0 or values[i] <= 0.0:
        return None
    p = min(1.0, len(pairs) * float(special.stdtr(dof, -t[best])))
    size, spread = rise[best] / values[i], error[best] / values[i]
    return Stiffening(amplitude[i], amplitude[j], unit, float(size), float(spread), p)
