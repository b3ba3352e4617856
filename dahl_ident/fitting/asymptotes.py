r"""Optima at infinity, to which a search tends if the data do not determine a parameter.

A law has limits with fewer parameters. Dahl, for instance, declares

==================  ===============================  =====================  =====================
limit               Z of the element                 runs away              determined
==================  ===============================  =====================  =====================
no loss             sigma                            f_max                  sigma
microslip           sigma + j 4 alpha kappa A/3 pi   f_max, sigma and the   kappa = sigma^2/f_max
                                                     spring                 sigma + stiffness
gross slip          j 4 f_max / (pi A)               sigma                  f_max
sharp knee          elastic, then f_max              alpha to 0             f_max, sigma
no full slip        dF/dx = sigma exp(-s F/phi)      f_max, alpha           phi = f_max/alpha, sigma
==================  ===============================  =====================  =====================

and any law may vanish. Of a law that declares none, every direction with a unit
(:mod:`dahl_ident.fitting.directions`) is tried far out on either side of the data.

Each lies at the boundary of the model, so the best fit may lie there, and a search would then
return the arbitrary large number at which it stopped. A limit is searched as a separate problem, in
a **chart**: coordinates phi that stay finite, mapped to a theta so far out that the model is its
limit, to five digits or more (three for no full slip). If the sum of squares there is no higher
than at any finite optimum, the limit is the optimum, and phi gives what is determined, with its
covariance.

In microslip with a free spring the cost has a long curved valley even where its minimum is
finite. The chart (kappa, x_c, sigma + stiffness) straightens it; where f_max is given, the chart
(sigma, sigma + stiffness).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Asymptote, Element, Parameter
from dahl_ident.fitting.directions import Direction, Directions, directions, free_springs
from dahl_ident.fitting.optimum import DeterminedCombination, Status, blanked
from dahl_ident.problem import TableProblem

_NO_FRICTION = 1e-18  # friction's stiffness over the median one, where it counts as none
_LEAST_FRICTION = -60.0  # ln of a scale over that of the data that a search may reach
_EDGES = (1e-14, 1e8)  # a direction over the data's smallest and largest that a search may reach
_TIED_EDGE = 1e4  # the same where microslip has a limit: short of it
_FASTEST = 1e4  # a rate that may be negative over the inverse of the smallest amplitude, likewise
_NUMBERS = (1.0 / 250.0, 25.0)  # a number over the least and most that its law scans, likewise
_FAR = (1e9, 1e14)
"""How far a length lies above the largest amplitude, and below the smallest, in a limit.

In slip the remaining stiffness of a law decreases only with the square root of the length.
"""
_FIRMLY = 1e3  # weight of what a limit determines relative to single coordinates, in a chart's phi


@dataclass(frozen=True)
class Chart:
    """theta = matrix phi + offset, then theta[spring] -= exp(theta[sigma]) if `tied`."""

    matrix: FloatArray
    offset: FloatArray
    """(P,), or (S, P) for the tables of a batch."""
    back: FloatArray
    """phi near theta is back (theta - offset), after theta[spring] += exp(theta[sigma])."""
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

    @property
    def one(self) -> Chart:
        """The chart of one table, of a batch of one."""
        return self if self.offset.ndim == 1 else replace(self, offset=self.offset[0])

    def phi(self, theta: FloatArray) -> FloatArray:
        """Return a phi near theta, (Q,) or (S, Q)."""
        theta = theta.copy()
        if self.tied is not None:
            spring, sigma = self.tied
            theta[..., spring] += np.exp(theta[..., sigma])
        return np.asarray((theta - self.offset) @ self.back.T)


@dataclass(frozen=True)
class Limit:
    """A chart of one limit, with its name and what it says about the parameters."""

    names: tuple[str, ...]
    """The names of theta's coordinates."""
    status: Status
    meaning: str
    """What the element becomes in this limit, where the status does not say it."""
    chart: Chart
    extremes: dict[str, float]
    """Values of the parameters that run away."""
    kept: tuple[tuple[str, FloatArray], ...] = ()
    """Determined combinations: expression, and the powers of theta's parameters in it."""

    def of(self, tables: NDArray[np.intp]) -> Limit:
        """Return the limit of one of a batch's tables."""
        return replace(self, chart=self.chart.of(tables).one)

    def combinations(
        self,
        theta: FloatArray,
        phi: FloatArray,
        slopes: FloatArray,
        covariance: FloatArray,
        lost: NDArray[np.bool_],
    ) -> tuple[DeterminedCombination, ...]:
        """Return what is determined; `slopes` is dtheta/dphi, and the last two are of phi."""
        determined = []
        for expression, powers in self.kept:
            by_phi = powers @ slopes
            if not by_phi.any() or (lost & (np.abs(by_phi) > 0.0)).any():
                continue
            value = float(np.exp(powers @ theta))
            determined.append(
                DeterminedCombination(expression, value, value * _spread(by_phi, covariance))
            )
        if self.chart.tied is not None:
            spring, sigma = self.chart.tied
            place = int(np.flatnonzero(self.chart.matrix[spring])[0])
            error = float(np.sqrt(covariance[place, place]))
            text = f"{self.names[sigma]} + {self.names[spring]}"
            determined.append(DeterminedCombination(text, float(phi[place]), error))
        return tuple(determined)

    def spread(
        self, slopes: FloatArray, inner: FloatArray, lost: NDArray[np.bool_]
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the covariance of theta, and which of it is undetermined, from that of phi.

        `slopes` is dtheta/dphi, (P, Q); `inner` and `lost` are the same two of phi.
        """
        covariance = slopes @ np.where(np.isfinite(inner), inner, 0.0) @ slopes.T
        undetermined = np.array([name in self.extremes for name in self.names])
        undetermined = undetermined | ((np.abs(slopes) > 0.0) & lost).any(axis=1)
        undetermined |= ~slopes.any(axis=1)
        return blanked(covariance, undetermined), undetermined


def _spread(by_phi: FloatArray, covariance: FloatArray) -> float:
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    return float(np.sqrt(by_phi @ finite @ by_phi))


class Reach:
    """The region where friction is neither at a limit nor negligible; searches stay in it."""

    def __init__(self, problem: TableProblem) -> None:
        view = problem.stiffness_data
        springs = bool(free_springs(problem))
        P = len(problem.parameters)
        rows: list[FloatArray] = []
        least: list[FloatArray] = []
        for element in problem.model.elements:
            if element.is_linear:
                continue
            axes = directions(element)
            for direction in axes.nonlinear:
                row, offset = direction.row(problem)
                if not direction.parameter.positive:
                    if direction.dimension == (0, -1, 0):
                        fastest = np.exp(direction.sizes(view).max(axis=-1)) * _FASTEST
                        rows += [row, -row]
                        least += [-fastest, -fastest]
                    continue
                if direction.is_number:
                    scan = direction.parameter.scan or (0.25, 4.0)
                    low, high = np.log(min(scan) * _NUMBERS[0]), np.log(max(scan) * _NUMBERS[1])
                else:
                    tied = springs and axes.is_free and _tying(element) is not None
                    size = direction.sizes(view)
                    edges = _EDGES[0], _TIED_EDGE if tied else _EDGES[1]
                    if direction.dimension[1] < 0:
                        edges = 1.0 / edges[1], 1.0 / edges[0]
                    low = size.min(axis=-1) + np.log(edges[0])
                    high = size.max(axis=-1) + np.log(edges[1])
                rows += [row, -row]
                least += [np.asarray(low - offset), np.asarray(offset - high)]
            if axes.is_free and axes.reference is not None and axes.reference.positive:
                scale = Direction(axes.reference, None, axes.reference.dimension)
                (row, offset) = scale.row(problem)
                softest = scale.sizes(view)
                rows.append(row)
                least.append(softest.min(axis=-1) + _LEAST_FRICTION - offset)
        self._rows = np.array(rows).reshape(-1, P).T
        self._least = np.stack(np.broadcast_arrays(*least), axis=-1) if least else np.empty(0)

    def __call__(
        self, theta: FloatArray, tables: NDArray[np.intp] | None = None
    ) -> NDArray[np.bool_]:
        """Return whether theta is inside, () for (P,), (S,) for (S, P).

        `tables` says which of a batch's tables theta belongs to, all by default.
        """
        least = self._least
        if tables is not None and least.ndim > 1:
            least = least[tables]
        return np.asarray((theta @ self._rows > least).all(axis=-1))


def _declared(element: Element, problem: TableProblem) -> tuple[Asymptote, ...]:
    """Return the limits that a law declares, with numbers (S,) for the tables of a batch."""
    amplitude = problem.stiffness_data.amplitude
    low, high = amplitude.min(axis=-1), amplitude.max(axis=-1)
    return element.asymptotes(low, high)


def _tying(element: Element) -> Asymptote | None:
    """Return the limit in which a parameter adds to a free spring, if the law has one."""
    every = element.asymptotes(1.0, 1.0)
    return next((a for a in every if a.adds_to_spring is not None), None)


def _tied(problem: TableProblem) -> list[tuple[Element, Asymptote, int]]:
    """Return element, limit and the spring's index for each pair that microslip confounds."""
    springs = [problem.names.index(p.name) for p in free_springs(problem)]
    return [
        (element, asymptote, spring)
        for element in problem.model.elements
        for asymptote in _declared(element, problem)
        if asymptote.adds_to_spring is not None
        for spring in springs
    ]


def microslip_charts(problem: TableProblem) -> list[Chart]:
    """Return the straightened charts of microslip: each free law that ties a free spring.

    Their coordinates stand in the places of theta's: the determined combination in that of the
    parameter that adds to the spring, and the logarithm of the ratio that runs away.
    """
    return [chart for chart, whole in _straight_charts(problem) if whole]


def stiffness_charts(problem: TableProblem) -> list[Chart]:
    """Return the same for laws whose other scale parameter is given: ln sigma, the sum."""
    return [chart for chart, whole in _straight_charts(problem) if not whole]


def _straight_charts(problem: TableProblem) -> Iterator[tuple[Chart, bool]]:
    """Yield the charts, and whether both parameters of the combination are free."""
    for element, asymptote, spring in _tied(problem):
        if asymptote.follows is None or asymptote.adds_to_spring is None:
            continue
        tied = element.parameter(asymptote.adds_to_spring)
        both = [element.parameter(label) for label in asymptote.follows[:2]]
        matrix = np.eye(len(problem.parameters))
        whole = all(p.free for p in both)
        if not tied.free or (whole and len(asymptote.kept) != 1):
            continue
        if whole:
            pair = [problem.names.index(p.name) for p in both]
            powers = _powers(element, asymptote.kept[0][1], problem)[pair]
            matrix[np.ix_(pair, pair)] = np.linalg.inv(np.array([[1.0, -1.0], powers]))
        sigma = problem.names.index(tied.name)
        back = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
        yield Chart(matrix, np.zeros(len(matrix)), back, (spring, sigma)), whole


def limits(problem: TableProblem) -> list[Limit]:
    """Return the limits of every law with a free parameter.

    None where an unknown displacement gain could undo any distance from the amplitudes.
    """
    if "displacement_gain" in problem.names and "displacement_gain" not in problem.priors:
        return []
    springs = free_springs(problem)
    alone = len(problem.model.elements) == 1
    every: list[Limit] = []
    for element in problem.model.elements:
        axes = directions(element)
        if element.is_linear or not any(p.free for p in element.parameters):
            continue
        declared = _declared(element, problem)
        for asymptote in declared:
            if asymptote.adds_to_spring is None:
                every += _plain(problem, element, asymptote, bool(springs))
            else:
                every += _microslip(problem, element, asymptote, springs)
        if not declared:
            every += _undeclared(problem, axes)
        if not alone:
            every += _vanishing(problem, axes)
    return every


def _plain(
    problem: TableProblem, element: Element, asymptote: Asymptote, spring: bool
) -> list[Limit]:
    """Return a declared limit, or none where the parameters that run away are not free."""
    free = {label for label, p in zip(element.labels, element.parameters, strict=True) if p.free}
    pins = _pins(element, asymptote)
    if pins is None or not set(asymptote.runs_away) <= free:
        return []
    follow = None
    if asymptote.follows is not None:
        label, followed, factor = asymptote.follows
        names = [element.parameter(x).name for x in (label, followed)]
        if followed in free:
            tying = _tying(element)
            if spring and tying is not None and {followed} == {tying.adds_to_spring}:
                return []  # in parallel with a spring the law has no effect
            follow = names[0], names[1], np.log(np.asarray(factor))
        else:
            pins[names[0]] = np.log(np.asarray(factor)) + _ln(element.parameter(followed))
    chart = _chart(problem, pins, follow, _kept(problem, element, asymptote))
    return [_limit(problem, element, asymptote, chart)]


def _microslip(
    problem: TableProblem, element: Element, asymptote: Asymptote, springs: list[Parameter]
) -> list[Limit]:
    """Return a limit that exists only with a free spring, for each of them."""
    pins = _pins(element, asymptote)
    if pins is None or asymptote.follows is None or asymptote.adds_to_spring is None:
        return []
    label, followed, factor = asymptote.follows
    both = [element.parameter(x) for x in (label, followed)]
    if not all(p.free for p in both):
        return []
    sigma = problem.names.index(element.parameter(asymptote.adds_to_spring).name)
    in_microslip = []
    for parameter in springs:
        spring = problem.names.index(parameter.name)
        follow = both[0].name, both[1].name, np.log(np.asarray(factor))
        plain = _chart(problem, pins, follow, _kept(problem, element, asymptote))
        chart = replace(plain, tied=(spring, sigma))
        limit = _limit(problem, element, asymptote, chart)
        in_microslip.append(replace(limit, extremes={**limit.extremes, parameter.name: -np.inf}))
    return in_microslip


def _vanishing(problem: TableProblem, axes: Directions) -> list[Limit]:
    """Return the limit in which the law has no force: its free scale parameters go to zero."""
    view = problem.stiffness_data
    scale = [p for p in (*axes.scale, *axes.linear) if p.free and p.positive]
    if not scale:
        return []
    pins: dict[str, FloatArray | float] = {}
    for p in scale:  # all together, or the one that is free however large the others are
        ln_size = Direction(p, None, p.dimension).sizes(view)
        middle = ln_size.min(axis=-1) if len(scale) == 1 else ln_size.mean(axis=-1)
        pins[p.name] = middle + np.log(_NO_FRICTION)
    for direction in axes.nonlinear:
        if direction.parameter not in axes.scale:
            pins[direction.parameter.name] = _middle(problem, direction)
    gone = dict.fromkeys((p.name for p in scale), 0.0)
    return [Limit(problem.names, Status.NO_FRICTION, "", _chart(problem, pins), gone)]


def _undeclared(problem: TableProblem, axes: Directions) -> list[Limit]:
    """Return limits far out in every direction with a unit, on either side of the data."""
    view = problem.stiffness_data
    far_out = []
    for direction in axes.nonlinear:
        if direction.is_number or not direction.parameter.positive:
            continue
        p, over = direction.parameter, direction.over
        size = direction.sizes(view)
        above, below = _FAR if direction.dimension[1] >= 0 else _FAR[::-1]
        for far, value in (
            (size.max(axis=-1) + np.log(above), np.inf),
            (size.min(axis=-1) - np.log(below), 0.0),
        ):
            large = np.isinf(value)
            rising = direction.dimension[1] > 0
            if over is None or not over.free:
                base = 0.0 if over is None else _ln(over)
                chart = _chart(problem, {p.name: far + base})
                extremes, kept = {p.name: value}, []
                if axes.is_free and axes.reference is not None:
                    stuck = large == rising
                    kept = [_kept_product(problem, axes.reference, direction, -1 if stuck else 0)]
                    if np.count_nonzero(kept[0][1]) > 1:
                        extremes[axes.reference.name] = np.inf
            else:
                # of two parameters in a fixed ratio, the one with the unit of the limit remains
                stiff = over.dimension[1] < p.dimension[1]
                stays = over if (large == rising) == stiff else p
                goes = p if stays is over else over
                follow = p.name, over.name, far
                powers = np.zeros(len(problem.parameters))
                powers[problem.names.index(stays.name)] = 1.0
                kept = [(stays.name, powers)]
                chart = _chart(problem, {}, follow, [powers])
                extremes = {goes.name: value if goes is p else np.inf if value == 0.0 else 0.0}
            meaning = "no amplitude reaches slip" if large == rising else "every amplitude slips"
            if direction.dimension[2]:
                meaning = f"the data lie far {'below' if large else 'above'} {p.name}"
            far_out.append(
                Limit(problem.names, Status.RUNS_AWAY, meaning, chart, extremes, tuple(kept))
            )
    return far_out


def _kept_product(
    problem: TableProblem, reference: Parameter, direction: Direction, unit: int
) -> tuple[str, FloatArray]:
    """Return the product of scale and length that has a unit: a stiffness (-1), a force (0).

    The stiffness remains of a law that never slips, the force of one that always slips.
    """
    power = (unit - reference.dimension[1]) / direction.dimension[1]
    powers = np.zeros(len(problem.parameters))
    powers[problem.names.index(reference.name)] = 1.0
    powers[problem.names.index(direction.parameter.name)] = power
    text = reference.name
    if power:
        times = "" if power == 1.0 else f"^{power:g}"
        text = f"{reference.name} {direction.parameter.name}{times}"
    return text, powers


def _middle(problem: TableProblem, direction: Direction) -> FloatArray | float:
    """Return a plain value of a direction, as a search coordinate."""
    p = direction.parameter
    if direction.is_number:
        plain = min(p.scan or (1.0,), key=lambda v: abs(np.log(v)) if v > 0.0 else np.inf)
        return float(np.log(plain)) if p.positive else 0.0
    if not p.positive:
        return 0.0
    return np.asarray(direction.sizes(problem.stiffness_data).mean(axis=-1))


def _pins(element: Element, asymptote: Asymptote) -> dict[str, FloatArray | float] | None:
    """Return the pinned search coordinates by name; None where one of them is not free."""
    pins: dict[str, FloatArray | float] = {}
    for label, value in asymptote.pinned.items():
        p = element.parameter(label)
        if not p.free:
            return None
        pins[p.name] = np.log(np.asarray(value)) if p.positive else value
    return pins


def _powers(element: Element, powers: Mapping[str, float], problem: TableProblem) -> FloatArray:
    """Return a combination's powers as a row over theta; parameters that are given fall out."""
    row = np.zeros(len(problem.parameters))
    for label, power in powers.items():
        name = element.parameter(label).name
        if name in problem.names:
            row[problem.names.index(name)] = power
    return row


def _kept(problem: TableProblem, element: Element, asymptote: Asymptote) -> list[FloatArray]:
    rows = [_powers(element, powers, problem) for _, powers in asymptote.kept]
    return [row for row in rows if row.any()]


def _limit(problem: TableProblem, element: Element, asymptote: Asymptote, chart: Chart) -> Limit:
    """Return a declared limit with the parameters' full names."""
    status = Status.__members__.get(asymptote.name.upper(), Status.RUNS_AWAY)
    kept = []
    for expression, powers in asymptote.kept:
        row = _powers(element, powers, problem)
        if row.any():
            kept.append((element.named(expression), row))
    extremes = {element.parameter(x).name: v for x, v in asymptote.runs_away.items()}
    meaning = f"the element is {asymptote.meaning}"
    return Limit(problem.names, status, meaning, chart, extremes, tuple(kept))


def _chart(
    problem: TableProblem,
    pins: Mapping[str, FloatArray | float],
    follow: tuple[str, str, FloatArray] | None = None,
    kept: Sequence[FloatArray] = (),
) -> Chart:
    """Return theta with some coordinates pinned, and one following another at a distance.

    The phi near a theta has the same combinations `kept`, rows of powers.
    """
    names = problem.names
    places = dict(pins) if follow is None else {**pins, follow[0]: follow[2]}
    offset = np.stack(np.broadcast_arrays(*(places.get(name, 0.0) for name in names)), axis=-1)
    matrix = np.eye(len(names))[:, [i for i, name in enumerate(names) if name not in places]]
    columns = matrix.T.copy()
    if follow is not None:
        matrix[names.index(follow[0])] = matrix[names.index(follow[1])]
    rows = np.vstack([_FIRMLY * np.reshape(kept, (-1, len(names))), columns])
    return Chart(matrix, offset, np.linalg.pinv(rows @ matrix) @ rows)


def _ln(parameter: Parameter) -> float:
    return float("nan") if parameter.value is None else float(np.log(parameter.value))
