r"""Optima at infinity: what a search tends to when the data cannot hold a parameter.

The describing function has limits that fewer numbers describe:

==================  ===============================  =====================  =====================
limit               Z of the element                 runs away              determined
==================  ===============================  =====================  =====================
no loss             sigma                            f_max                  sigma
microslip           sigma + j 4 alpha kappa A/3 pi   f_max, sigma and the   kappa = sigma^2/f_max
                                                     spring                 sigma + stiffness
gross slip          j 4 f_max / (pi A)               sigma                  f_max
no friction         0                                f_max, sigma to 0
sharp knee          elastic, then f_max              alpha to 0             f_max, sigma
no full slip        dF/dx = sigma exp(-s F/phi)      f_max, alpha           phi = f_max/alpha, sigma
==================  ===============================  =====================  =====================

Each lies on the edge of the model, so the best fit may lie there, and a search would then return
whatever huge number it stopped at. A limit is searched as a problem of its own, in a **chart**:
coordinates phi that stay finite, mapped to a theta so far out that the model is its limit, to five
digits or more (three for no full slip). If the sum of squares there is no higher than at any
finite optimum, the limit is the optimum, and phi gives what is determined, with its covariance.

In microslip beside a free spring the way to the optimum is a long bent valley even where it is
finite. The chart (kappa, x_c, sigma + stiffness) straightens it; where f_max is given, the chart
(sigma, sigma + stiffness).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Dahl, Parameter, Spring
from dahl_ident.fitting.status import Status
from dahl_ident.problem import Problem

_MICROSLIP = 1e5  # x_c over the largest amplitude
_NO_LOSS = 1e9
_GROSS_SLIP = 1e-16  # x_c over the smallest amplitude
_NO_FRICTION = 1e-18  # sigma over the median stiffness
_LEAST_FRICTION = -60.0  # ln of sigma over the median stiffness that a search may reach
_SHARP, _SOFT = 1e-6, 1e3  # alpha
_SEARCHED_ALPHA = (1e-3, 1e2)  # that a search may reach
_EDGES = (1e-14, 1e8)  # x_c over the smallest and largest amplitude that a search may reach
_TIED_EDGE = 1e4  # the same where microslip has a limit: short of it


@dataclass(frozen=True)
class Chart:
    """theta = matrix phi + offset, then theta[spring] -= exp(theta[sigma]) if `tied`."""

    matrix: FloatArray
    offset: FloatArray
    """(P,), or (S, P) for the tables of a batch."""
    back: FloatArray
    """Gives a phi near a theta: back theta, after theta[spring] += exp(theta[sigma])."""
    tied: tuple[int, int] | None = None
    """Indices of the spring and of sigma, where phi holds their sum in the spring's place."""

    def theta(self, phi: FloatArray) -> FloatArray:
        """Return the search coordinates at phi, (Q,) or (S, Q)."""
        theta = phi @ self.matrix.T + self.offset
        if self.tied is not None:
            spring, sigma = self.tied
            theta[..., spring] -= np.exp(theta[..., sigma])
        return theta

    def derivative(self, theta: FloatArray) -> FloatArray:
        """Return dtheta/dphi, (P, Q) or (S, P, Q)."""
        derivative = np.broadcast_to(self.matrix, (*theta.shape[:-1], *self.matrix.shape)).copy()
        if self.tied is not None:
            spring, sigma = self.tied
            size = np.exp(theta[..., sigma])[..., None]
            derivative[..., spring, :] -= size * self.matrix[sigma]
        return derivative

    def of(self, tables: NDArray[np.intp]) -> Chart:
        """Return the chart of some tables of a batch."""
        return self if self.offset.ndim == 1 else replace(self, offset=self.offset[tables])

    def phi(self, theta: FloatArray) -> FloatArray:
        """Return a phi near theta, (Q,) or (S, Q)."""
        theta = theta.copy()
        if self.tied is not None:
            spring, sigma = self.tied
            theta[..., spring] += np.exp(theta[..., sigma])
        return np.asarray(theta @ self.back.T)


@dataclass(frozen=True)
class Limit:
    """A chart of one limit, with its name and what it says about the parameters."""

    names: tuple[str, ...]
    """The names of theta's coordinates."""
    status: Status
    chart: Chart
    extremes: dict[str, float]
    """Values of the parameters that run away."""
    kept: tuple[tuple[str, int, bool], ...]
    """Determined combinations: expression, index into phi, whether phi is the logarithm."""


class Reach:
    """Where friction is neither at a limit nor negligible: what a search may pass through."""

    def __init__(self, problem: Problem) -> None:
        view = problem.stiffness_data
        smallest, largest = view.amplitude.min(axis=-1), view.amplitude.max(axis=-1)
        softest = np.log(view.typical_stiffness) + _LEAST_FRICTION
        springs = bool(_free_springs(problem))
        rows, limits = [], []
        for element in problem.model.elements:
            if isinstance(element, Dahl):
                f_max, sigma = (_row(problem, p) for p in element.parameters[:2])
                x_c = f_max[0] - sigma[0], f_max[1] - sigma[1]
                tied = springs and all(p.free for p in element.parameters[:2])
                edge = np.log(largest * (_TIED_EDGE if tied else _EDGES[1]))
                rows += [x_c[0], -x_c[0], sigma[0]]
                limits += [
                    np.log(smallest * _EDGES[0]) - x_c[1], x_c[1] - edge, softest - sigma[1]
                ]  # fmt: skip
                if element.parameters[2].free:
                    alpha, _ = _row(problem, element.parameters[2])
                    rows += [alpha, -alpha]
                    limits += [np.log(_SEARCHED_ALPHA[0]), -np.log(_SEARCHED_ALPHA[1])]
        self._rows = np.array(rows).reshape(-1, len(problem.parameters)).T
        self._limits = np.stack(np.broadcast_arrays(*limits), axis=-1) if limits else np.empty(0)

    def __call__(
        self, theta: FloatArray, tables: NDArray[np.intp] | None = None
    ) -> NDArray[np.bool_]:
        """Return whether theta is inside, () for (P,), (S,) for (S, P).

        `tables` says which of a batch's tables theta belongs to, all by default.
        """
        edges = self._limits
        if tables is not None and edges.ndim > 1:
            edges = edges[tables]
        return np.asarray((theta @ self._rows > edges).all(axis=-1))


def _row(problem: Problem, parameter: Parameter) -> tuple[FloatArray, float]:
    """Return a logarithm as row times theta plus number."""
    row = np.zeros(len(problem.parameters))
    if parameter.free:
        row[problem.names.index(parameter.name)] = 1.0
        return row, 0.0
    return row, _ln(parameter)


def valleys(problem: Problem) -> list[Chart]:
    """Return the straightened charts of microslip: each free Dahl element with a free spring."""
    charts = []
    for f_max, sigma, _, spring in _tied(problem):
        matrix = np.eye(len(problem.parameters))
        matrix[sigma, f_max] = 1.0  # ln sigma = ln kappa + ln x_c
        matrix[f_max, f_max], matrix[f_max, sigma] = 2.0, 1.0
        charts.append(_straightened(matrix, spring, sigma))
    return charts


def stiffness_valleys(problem: Problem) -> list[Chart]:
    """Return the same for elements of which sigma alone is free: ln sigma, sigma + stiffness."""
    return [
        _straightened(np.eye(len(problem.parameters)), *map(problem.names.index, (spring, s.name)))
        for f, s, _ in (e.parameters for e in problem.model.elements if isinstance(e, Dahl))
        if s.free and not f.free
        for spring in _free_springs(problem)
    ]


def _straightened(matrix: FloatArray, spring: int, sigma: int) -> Chart:
    back = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return Chart(matrix, np.zeros(len(matrix)), back, (spring, sigma))


def limits(problem: Problem) -> list[Limit]:
    """Return the limits of every Dahl element of which f_max or sigma is free.

    None where an unknown displacement gain could undo any distance from the amplitudes.
    """
    if "displacement_gain" in problem.names and "displacement_gain" not in problem.priors:
        return []
    view = problem.stiffness_data
    low, high = np.log(view.amplitude.min(axis=-1)), np.log(view.amplitude.max(axis=-1))
    least = np.log(view.typical_stiffness) + np.log(_NO_FRICTION)
    stuck, slipping = high + np.log(_NO_LOSS), low + np.log(_GROSS_SLIP)  # ln x_c
    found = []
    for element in problem.model.elements:
        if not isinstance(element, Dahl):
            continue
        f, s, alpha = element.parameters
        f_max, sigma = f.name, s.name
        pins: dict[str, FloatArray | float] = {alpha.name: 0.0} if alpha.free else {}
        alone = len(problem.model.elements) == 1
        if f.free and s.free:
            if not _free_springs(problem):
                chart = _chart(problem, pins, (f_max, sigma, stuck))
                kept = [(sigma, sigma, True)]
                found.append(_limit(problem, Status.NO_LOSS, chart, {f_max: np.inf}, kept))
            chart = _chart(problem, pins, (sigma, f_max, -slipping))
            kept = [(f_max, f_max, True)]
            found.append(_limit(problem, Status.GROSS_SLIP, chart, {sigma: np.inf}, kept))
            vanishing = {sigma: least, f_max: least + 0.5 * (low + high)}
        elif f.free:
            chart = _chart(problem, {**pins, f_max: _ln(s) + stuck})
            found.append(_limit(problem, Status.NO_LOSS, chart, {f_max: np.inf}))
            vanishing = {f_max: least + low}
        elif s.free:
            chart = _chart(problem, {**pins, sigma: _ln(f) - slipping})
            found.append(_limit(problem, Status.GROSS_SLIP, chart, {sigma: np.inf}))
            vanishing = {sigma: least}
        else:
            vanishing = {}
        if vanishing and not alone:
            chart = _chart(problem, {**pins, **vanishing})
            gone = dict.fromkeys(vanishing, 0.0)
            found.append(_limit(problem, Status.NO_FRICTION, chart, gone))
        if alpha.free:
            chart = _chart(problem, {alpha.name: np.log(_SHARP)})
            kept = [(p.name, p.name, True) for p in (f, s) if p.free]
            found.append(_limit(problem, Status.SHARP_KNEE, chart, {alpha.name: 0.0}, kept))
        if alpha.free and f.free:
            found.append(_no_full_slip(problem, f_max, alpha.name))
    return found + [
        _microslip(problem, high + np.log(_MICROSLIP), *tied) for tied in _tied(problem)
    ]


def _microslip(
    problem: Problem, ln_x_c: FloatArray, f_max: int, sigma: int, alpha: int | None, spring: int
) -> Limit:
    names = problem.names
    pins = {} if alpha is None else {names[alpha]: 0.0}
    plain = _chart(problem, pins, (names[f_max], names[sigma], ln_x_c))
    offset = plain.offset.copy()
    offset[..., sigma] += ln_x_c  # phi holds ln kappa = ln sigma - ln x_c in sigma's place
    offset[..., f_max] += ln_x_c
    back = plain.back.copy()
    place = plain.matrix[sigma].argmax()
    back[place, sigma], back[place, f_max] = 2.0, -1.0
    chart = Chart(plain.matrix, offset, back, (spring, sigma))
    kappa = f"{names[sigma]}^2/{names[f_max]}"
    if alpha is not None:
        kappa = f"{names[alpha]} {kappa}"
    kept = [
        (kappa, names[sigma], True),
        (f"{names[sigma]} + {names[spring]}", names[spring], False),
    ]
    extremes = {names[f_max]: np.inf, names[sigma]: np.inf, names[spring]: -np.inf}
    return _limit(problem, Status.MICROSLIP, chart, extremes, kept)


def _no_full_slip(problem: Problem, f_max: str, alpha: str) -> Limit:
    plain = _chart(problem, {alpha: np.log(_SOFT)})
    row, place = problem.names.index(f_max), problem.names.index(alpha)
    offset, back = plain.offset.copy(), plain.back.copy()
    offset[..., row] += np.log(_SOFT)  # phi holds ln f_max - ln alpha in f_max's place
    back[plain.matrix[row].argmax(), place] = -1.0
    chart = Chart(plain.matrix, offset, back)
    extremes = {f_max: np.inf, alpha: np.inf}
    kept = [(f"{f_max}/{alpha}", f_max, True)]
    return _limit(problem, Status.NO_FULL_SLIP, chart, extremes, kept)


def _limit(
    problem: Problem,
    status: Status,
    chart: Chart,
    extremes: dict[str, float],
    kept: Sequence[tuple[str, str, bool]] = (),
) -> Limit:
    """Return a limit; `kept` gives each combination the parameter in whose place phi has it."""
    places = {name: index for index, name in enumerate(problem.names)}
    return Limit(
        problem.names,
        status,
        chart,
        extremes,
        tuple((text, int(chart.matrix[places[at]].argmax()), log) for text, at, log in kept),
    )


def _chart(
    problem: Problem,
    pins: Mapping[str, FloatArray | float],
    follow: tuple[str, str, FloatArray] | None = None,
) -> Chart:
    """Return theta with some coordinates pinned, and one following another at a distance."""
    names = problem.names
    places = dict(pins) if follow is None else {**pins, follow[0]: follow[2]}
    offset = np.stack(np.broadcast_arrays(*(places.get(name, 0.0) for name in names)), axis=-1)
    matrix = np.eye(len(names))[:, [i for i, name in enumerate(names) if name not in places]]
    back = matrix.T.copy()
    if follow is not None:
        matrix[names.index(follow[0])] = matrix[names.index(follow[1])]
    return Chart(matrix, offset, back)


def _tied(problem: Problem) -> list[tuple[int, int, int | None, int]]:
    """Return (f_max, sigma, alpha, spring) by index for each pair that microslip confounds."""
    index = problem.names.index
    return [
        (index(f.name), index(s.name), index(a.name) if a.free else None, index(spring))
        for f, s, a in (e.parameters for e in problem.model.elements if isinstance(e, Dahl))
        if f.free and s.free
        for spring in _free_springs(problem)
    ]


def _free_springs(problem: Problem) -> list[str]:
    """Return the names of free springs that no bound keeps from any value."""
    springs = (e.parameters[0] for e in problem.model.elements if isinstance(e, Spring))
    return [p.name for p in springs if p.free and np.isinf(p.lower)]


def _ln(parameter: Parameter) -> float:
    return float("nan") if parameter.value is None else float(np.log(parameter.value))
