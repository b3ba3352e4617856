r"""Optima at infinity, to which a search tends if the data do not determine a parameter.

A law has limits with fewer parameters. The limits of Dahl's law are

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

and the friction may vanish. For a law that declares no limits, every direction with a unit
(:mod:`dahl_ident.fitting.directions`) is tried far out on either side of the data.

If the best fit is at such a limit, a search returns the arbitrary large number at which it stops.
A limit is therefore searched as a separate problem, in a **chart**: coordinates phi that stay
finite, mapped to a theta so far out that the model agrees with its limit to five digits or more
(three for no full slip). If the sum of squares there is not higher than at any finite optimum, the
limit is the optimum, and phi gives the determined quantities and their covariance.

In microslip with a free spring the cost has a long curved valley even if its minimum is finite. The
chart (kappa, x_c, sigma + stiffness) straightens it; if f_max is given, the chart
(sigma, sigma + stiffness).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dahl_ident.arrays import BoolArray, FloatArray, IntArray
from dahl_ident.elements import Asymptote, Element, Parameter
from dahl_ident.fitting.directions import Direction, Directions, directions, free_springs
from dahl_ident.fitting.optimum import DeterminedCombination, Status, blanked
from dahl_ident.problem import TableProblem

# friction's stiffness over the data's in a limit without friction: far below rounding
_NO_FRICTION = 1e-18
# ln of the scale of friction over that of the data, below which friction is negligible
_LEAST_FRICTION = -60.0
# range of directions with a unit in a search: factors of their smallest and largest sizes in the
# data; beyond it, the curve agrees with its limit to all digits
_EDGES = (1e-14, 1e8)
# the upper factor if microslip is a limit: spring and friction are then equal except for rounding
_TIED_EDGE = 1e4
_FASTEST = 1e4  # largest rate of either sign in a search, times the smallest amplitude
# range of numbers in a search: factors of the smallest and the largest start
_NUMBERS = (1.0 / 250.0, 25.0)
# lengths in a limit: factors of the largest amplitude, and below the smallest; in slip, the
# remaining stiffness of a law decreases only with the square root of the length
_LIMIT_LENGTHS = (1e9, 1e14)
# weight of determined combinations over that of single coordinates, to find phi from theta
_COMBINATION_WEIGHT = 1e3


@dataclass(frozen=True)
class Chart:
    """theta = matrix phi + offset, then theta[spring] -= exp(theta[sigma]) if `tied`."""

    matrix: FloatArray
    offset: FloatArray
    """(P,), or (S, P) for the tables of a batch."""
    back: FloatArray
    """phi near theta is back (theta - offset), after theta[spring] += exp(theta[sigma])."""
    tied: tuple[int, int] | None = None
    """Indices of the spring and of sigma, if phi has their sum in place of the spring."""

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

    def of(self, tables: IntArray | int) -> Chart:
        """Return the chart of some tables of a batch, or of one."""
        return self if self.offset.ndim == 1 else replace(self, offset=self.offset[tables])

    def phi(self, theta: FloatArray) -> FloatArray:
        """Return a phi near theta, (Q,) or (S, Q)."""
        theta = theta.copy()
        if self.tied is not None:
            spring, sigma = self.tied
            theta[..., spring] += np.exp(theta[..., sigma])
        return np.asarray((theta - self.offset) @ self.back.T)


@dataclass(frozen=True)
class Limit:
    """A limit: its chart, its meaning, and the values of the parameters."""

    names: tuple[str, ...]
    """The names of theta's coordinates."""
    status: Status
    meaning: str
    """The behaviour of the element in this limit, if the status does not state it."""
    chart: Chart
    extremes: dict[str, float]
    """Values, 0 or infinite, of the parameters that run away."""
    kept: tuple[tuple[str, FloatArray], ...] = ()
    """Determined combinations: expression, and the powers of theta's parameters in it."""

    def of(self, table: int) -> Limit:
        """Return the limit of one of a batch's tables."""
        return replace(self, chart=self.chart.of(table))

    def combinations(
        self,
        theta: FloatArray,
        phi: FloatArray,
        slopes: FloatArray,
        covariance: FloatArray,
        lost: BoolArray,
    ) -> tuple[DeterminedCombination, ...]:
        """Return the determined combinations; `slopes` is dtheta/dphi, the last two are of phi."""
        determined, finite = [], np.where(np.isfinite(covariance), covariance, 0.0)
        for expression, powers in self.kept:
            gradient = powers @ slopes
            if not gradient.any() or (lost & (np.abs(gradient) > 0.0)).any():
                continue
            value = float(np.exp(powers @ theta))
            std = float(np.sqrt(gradient @ finite @ gradient))
            determined.append(DeterminedCombination(expression, value, value * std))
        if self.chart.tied is not None:
            spring, sigma = self.chart.tied
            i = int(np.flatnonzero(self.chart.matrix[spring])[0])
            error = float(np.sqrt(covariance[i, i]))
            text = f"{self.names[sigma]} + {self.names[spring]}"
            determined.append(DeterminedCombination(text, float(phi[i]), error))
        return tuple(determined)

    def spread(
        self, slopes: FloatArray, inner: FloatArray, lost: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """Return the covariance of theta, and which parameters are undetermined.

        `slopes` is dtheta/dphi, (P, Q); `inner` is the covariance of phi, and `lost` says which
        elements of phi are undetermined.
        """
        covariance = slopes @ np.where(np.isfinite(inner), inner, 0.0) @ slopes.T
        undetermined = np.array([name in self.extremes for name in self.names])
        undetermined = undetermined | ((np.abs(slopes) > 0.0) & lost).any(axis=1)
        undetermined |= ~slopes.any(axis=1)
        return blanked(covariance, undetermined), undetermined


class Reach:
    """The region of searches, in which friction is neither at a limit nor negligible."""

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
                row, offset = scale.row(problem)
                rows.append(row)
                least.append(scale.sizes(view).min(axis=-1) + _LEAST_FRICTION - offset)
        self._rows = np.array(rows).reshape(-1, P).T
        self._least = np.stack(np.broadcast_arrays(*least), axis=-1) if least else np.empty(0)

    def __call__(self, theta: FloatArray, tables: IntArray | None = None) -> BoolArray:
        """Return whether theta is inside, () for (P,), (S,) for (S, P).

        `tables` are the tables of a batch to which theta belongs, all by default.
        """
        least = self._least
        if tables is not None and least.ndim > 1:
            least = least[tables]
        return np.asarray((theta @ self._rows > least).all(axis=-1))


def _tying(element: Element) -> Asymptote | None:
    """Return the limit in which a parameter adds to a free spring, if the law has one."""
    asymptotes = element.asymptotes(1.0, 1.0)
    return next((a for a in asymptotes if a.adds_to_spring is not None), None)


def microslip_charts(problem: TableProblem, *, scale_given: bool = False) -> list[Chart]:
    """Return the charts that straighten the valley of microslip: one per law and free spring.

    Their coordinates are the determined combination, the logarithm of the ratio that tends to
    infinity, and the sum of sigma and the spring. With `scale_given`, the charts are those of laws
    whose other scale parameter is given: ln sigma, and the sum.
    """
    charts = []
    for element in problem.model.elements:
        tying = _tying(element)
        if tying is None or tying.follows is None or tying.adds_to_spring is None:
            continue
        tied = element.parameter(tying.adds_to_spring)
        both = [element.parameter(label) for label in tying.follows[:2]]
        given = not all(p.free for p in both)
        if not tied.free or given != scale_given or (not given and len(tying.kept) != 1):
            continue
        matrix = np.eye(len(problem.parameters))
        if not given:
            pair = [problem.names.index(p.name) for p in both]
            powers = _powers(element, tying.kept[0][1], problem)[pair]
            matrix[np.ix_(pair, pair)] = np.linalg.inv(np.array([[1.0, -1.0], powers]))
        sigma = problem.names.index(tied.name)
        back = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
        springs = (problem.names.index(p.name) for p in free_springs(problem))
        charts += [Chart(matrix, np.zeros(len(matrix)), back, (at, sigma)) for at in springs]
    return charts


def limits(problem: TableProblem) -> list[Limit]:
    """Return the limits of every law with a free parameter.

    There are none if the displacement gain is unknown, because it could compensate any amplitude.
    """
    if "displacement_gain" in problem.names and "displacement_gain" not in problem.priors:
        return []
    springs = free_springs(problem)
    amplitude = problem.stiffness_data.amplitude
    every: list[Limit] = []
    for element in problem.model.elements:
        axes = directions(element)
        if element.is_linear or not any(p.free for p in element.parameters):
            continue
        declared = [
            replace(asymptote, meaning=f"the element is {asymptote.meaning}")
            for asymptote in element.asymptotes(amplitude.min(axis=-1), amplitude.max(axis=-1))
        ]
        vanishing = _vanishing(problem, axes) if len(problem.model.elements) > 1 else []
        for asymptote in (*(declared or _far_out(problem, axes)), *vanishing):
            every += _limits_of(problem, element, asymptote, springs)
    return every


def _limits_of(
    problem: TableProblem, element: Element, asymptote: Asymptote, springs: list[Parameter]
) -> list[Limit]:
    """Return the limits of an asymptote: one, or one for each spring to which it adds.

    There is none if a parameter that it pins, or that runs away, is given.
    """
    names, added = problem.names, asymptote.adds_to_spring
    free = {label for label, p in zip(element.labels, element.parameters, strict=True) if p.free}
    if not {*asymptote.pinned, *asymptote.runs_away} <= free:
        return []
    pins: dict[str, FloatArray | float] = {}
    for label, value in asymptote.pinned.items():
        p = element.parameter(label)
        pins[p.name] = np.log(np.asarray(value)) if p.positive else value
    follow = None
    if asymptote.follows is not None:
        label, other_label, factor = asymptote.follows
        follower, other = element.parameter(label), element.parameter(other_label)
        if other.free:
            tying = _tying(element)
            is_spring = tying is not None and other_label == tying.adds_to_spring
            if is_spring and springs and added is None:
                return []  # the law is a second spring in parallel with a free one
            follow = follower.name, other.name, np.log(factor)
        elif added is not None:
            return []
        else:
            pins[follower.name] = np.log(factor) + np.log(other.value or np.nan)
    combined = [(element.named(x), _powers(element, y, problem)) for x, y in asymptote.kept]
    kept = tuple((text, powers) for text, powers in combined if powers.any())
    limit = Limit(
        names,
        Status.__members__.get(asymptote.name.upper(), Status.RUNS_AWAY),
        asymptote.meaning,
        _chart(problem, pins, follow, [powers for _, powers in kept]),
        {element.parameter(x).name: value for x, value in asymptote.runs_away.items()},
        kept,
    )
    if added is None:
        return [limit]
    limits = []
    for spring in springs:
        tied = names.index(spring.name), names.index(element.parameter(added).name)
        extremes = {**limit.extremes, spring.name: -np.inf}
        chart = replace(limit.chart, tied=tied)
        limits.append(replace(limit, chart=chart, extremes=extremes))
    return limits


def _vanishing(problem: TableProblem, axes: Directions) -> list[Asymptote]:
    """Return the limit without friction: the law's free scale parameters tend to zero."""
    view, label = problem.stiffness_data, axes.element.label
    scale = [p for p in (*axes.scale, *axes.linear) if p.free and p.positive]
    pinned: dict[str, Any] = {}
    for p in scale:
        ln_size = Direction(p, None, p.dimension).sizes(view)
        middle = ln_size.min(axis=-1) if len(scale) == 1 else ln_size.mean(axis=-1)
        pinned[label(p)] = np.exp(middle) * _NO_FRICTION
    for direction in axes.nonlinear:
        p = direction.parameter
        if p in axes.scale:
            continue
        if direction.is_number and p.positive:
            pinned[label(p)] = float(np.clip(1.0, p.lower, p.upper))
        else:
            pinned[label(p)] = np.exp(direction.sizes(view).mean(axis=-1)) if p.positive else 0.0
    gone = {label(p): 0.0 for p in scale}
    return [Asymptote("no_friction", "", pinned, None, gone)] if scale else []


def _far_out(problem: TableProblem, axes: Directions) -> list[Asymptote]:
    """Return the limits of a law that declares none: the two ends of each direction with a unit.

    At one end of a length the element sticks at every amplitude, with a finite stiffness; at the
    other it slips at every amplitude, with a finite force.
    """
    view, label, reference = problem.stiffness_data, axes.element.label, axes.reference
    asymptotes = []
    for direction in axes.nonlinear:
        p, over = direction.parameter, direction.over
        if direction.is_number or not p.positive:
            continue
        _, length, time = direction.dimension
        ln_size = direction.sizes(view)
        above, below = _LIMIT_LENGTHS if length >= 0 else _LIMIT_LENGTHS[::-1]
        for end, far in (
            (np.inf, np.exp(ln_size.max(axis=-1)) * above),
            (0.0, np.exp(ln_size.min(axis=-1)) / below),
        ):
            sticks = (end > 0.0) == (length > 0)
            if time:
                meaning = f"the data lie far {'below' if end else 'above'} {p.name}"
            else:
                meaning = "no amplitude reaches slip" if sticks else "every amplitude slips"
            runs_away, kept = {label(p): end}, []
            if over is not None and over.free:
                # the stiffness stays finite if the element sticks, the force if it slips
                finite = over if sticks == (over.dimension[1] < p.dimension[1]) else p
                if finite is p:
                    runs_away = {label(over): 0.0 if end else np.inf}
                kept = [(label(finite), {label(finite): 1.0})]
            elif axes.is_free and reference is not None and not time:
                # the product that has the unit of a stiffness or of a force stays finite
                power = ((-1 if sticks else 0) - reference.dimension[1]) / length
                powers, expression = {label(reference): 1.0}, label(reference)
                if power:
                    powers[label(p)] = power
                    expression += f" {label(p)}" + (f"^{power:g}" if power != 1.0 else "")
                    runs_away[label(reference)] = np.inf
                kept = [(expression, powers)]
            if over is None:
                pinned, follows = {label(p): far}, None
            else:
                pinned, follows = {}, (label(p), label(over), far)
            limit = Asymptote("runs_away", meaning, pinned, follows, runs_away, tuple(kept))
            asymptotes.append(limit)
    return asymptotes


def _powers(element: Element, powers: Mapping[str, float], problem: TableProblem) -> FloatArray:
    """Return the powers of a combination as a row over theta, without given parameters."""
    row = np.zeros(len(problem.parameters))
    for label, power in powers.items():
        name = element.parameter(label).name
        if name in problem.names:
            row[problem.names.index(name)] = power
    return row


def _chart(
    problem: TableProblem,
    pins: Mapping[str, FloatArray | float],
    follow: tuple[str, str, FloatArray] | None = None,
    kept: Sequence[FloatArray] = (),
) -> Chart:
    """Return the chart with some coordinates pinned, and one at a fixed distance from another.

    The phi near a theta has the same values of the combinations `kept`, rows of powers.
    """
    names = problem.names
    offsets = dict(pins) if follow is None else {**pins, follow[0]: follow[2]}
    offset = np.stack(np.broadcast_arrays(*(offsets.get(name, 0.0) for name in names)), axis=-1)
    matrix = np.eye(len(names))[:, [i for i, name in enumerate(names) if name not in offsets]]
    columns = matrix.T.copy()
    if follow is not None:
        matrix[names.index(follow[0])] = matrix[names.index(follow[1])]
    rows = np.vstack([_COMBINATION_WEIGHT * np.reshape(kept, (-1, len(names))), columns])
    return Chart(matrix, offset, np.linalg.pinv(rows @ matrix) @ rows)
