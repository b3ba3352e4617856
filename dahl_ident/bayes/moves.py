r"""Proposals for several independent ensembles, all evaluated in one call.

Each ensemble of walkers is split at random into halves. The walkers of one half move, with
proposals made from the positions of the other half, the guide; then the halves exchange roles (as
in emcee, whose sampler runs these moves). Evaluating all ensembles in one call is fastest.

- `differential_evolution`: a walker moves along the difference of two walkers of the guide, by
  2.38/(2 D)^(1/2) of it, and sometimes by all of it, which leads from mode to mode (ter Braak,
  Statistics and Computing 16, 2006; Nelson et al., ApJS 210, 2014).
- `snooker`: a walker moves along the line to a walker of the guide, by the projected difference of
  two others (ter Braak and Vrugt, Statistics and Computing 18, 2008).
- `independent`: a walker moves to a draw from Student's t with the mean and the covariance of the
  guide. In few dimensions many draws are accepted, successive positions are nearly independent, and
  heavy tails are reached.

**Decorrelation.** The data determine the sum of the stiffnesses of a spring and of friction in
parallel. If they do not determine f_max and sigma, the density has a curved ridge, which straight
steps leave. Proposals are therefore made in coordinates in which the ridge is straight. The
dependence of the linear parameters l on the friction is estimated by weighted least squares: the
describing function N(p) of the law with parameters p is fitted by the columns G of spring, damper
and mass, at the amplitudes and with the weights w of the data. The coordinates that replace l are

    phi = l + W N(p),    W = (G' w^2 G)^-1 G' w^2,

the combination that the data determine. At constant p, phi is l with a shift, so volumes are
preserved and the density over phi equals the density over l.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, IntArray, interleaved
from dahl_ident.elements import Element
from dahl_ident.problem import TableProblem

Random = np.random.RandomState  # emcee's
Proposal = Callable[[FloatArray, FloatArray, Random], tuple[FloatArray, FloatArray]]
"""From half and guide, (ensembles, W/2, D), to proposals and ln of their Hastings factors."""

_JITTER = 1e-5  # relative scatter of a step, so that walkers do not form a lattice
_JUMP = 0.1  # share of the steps that are the full difference of two walkers
_PROPOSAL_DOF = 2.0  # degrees of freedom of the independent proposals: few, for heavy tails
_SNOOKER = 1.7  # length of a snooker step: the mean of ter Braak and Vrugt's range, as in emcee
_OUTSIDE_PRIORS = 1e300  # replaces a shift that is not finite; outside any prior


@dataclass(frozen=True)
class Decorrelation:
    """The shift of the linear parameters; made by :func:`decorrelation_of`."""

    problem: TableProblem | None  # points (S, D) begin with its theta (S, P); None for no shift
    friction: tuple[Element, ...]  # the nonlinear elements with free parameters
    linear: IntArray  # (L,) indices of the coordinates l
    projection: FloatArray  # (2 n, L) from Re N and Im N of every row to the shift

    def decorrelated(self, x: FloatArray) -> FloatArray:
        """Return points with phi instead of l."""
        return self._moved(x, 1.0)

    def original(self, x: FloatArray) -> FloatArray:
        """Return points with l instead of phi."""
        return self._moved(x, -1.0)

    def _moved(self, x: FloatArray, sign: float) -> FloatArray:
        if self.problem is None:
            return x
        names = self.problem.names
        view = self.problem.stiffness_data
        moved = x.copy()
        by_name = dict(zip(names, self.problem.to_values(x[:, : len(names)]).T, strict=True))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore", under="ignore"):
            N = sum(
                view.stiffness_of(
                    e,
                    [by_name.get(p.name, np.asarray(p.value)) for p in e.parameters],
                    at_nodes=True,
                )
                for e in self.friction
            )
            shift = interleaved(np.asarray(N)) @ self.projection
        moved[:, self.linear] += sign * np.where(np.isfinite(shift), shift, _OUTSIDE_PRIORS)
        return moved


STRAIGHT = Decorrelation(None, (), np.zeros(0, dtype=np.intp), np.zeros((0, 0)))
"""No change of the coordinates."""


@dataclass(frozen=True)
class EnsembleMove:
    """A move of emcee's sampler: one kind of proposal, applied to each ensemble separately.

    With a decorrelation, positions are proposed in coordinates in which ridges are straight.
    """

    proposal: Proposal
    ensembles: int
    decorrelation: Decorrelation = STRAIGHT

    def propose(self, model: Any, state: Any) -> tuple[Any, Any]:
        """Return the state after one proposal to every walker, and which were accepted."""
        walkers, dims = state.coords.shape
        size = walkers // self.ensembles
        random = model.random
        order = random.uniform(size=(self.ensembles, size)).argsort(axis=1)
        order += size * np.arange(self.ensembles)[:, None]
        accepted = np.zeros(walkers, dtype=bool)
        straight = self.decorrelation.decorrelated(state.coords)
        halves = (order[:, : size // 2], order[:, size // 2 :])
        for half, guide in (halves, halves[::-1]):
            proposed, factor = self.proposal(straight[half], straight[guide], random)
            moved, proposed = half.ravel(), proposed.reshape(-1, dims)
            points = self.decorrelation.original(proposed)
            log_density, _ = model.compute_log_prob_fn(points)
            gain = factor.ravel() + log_density - state.log_prob[moved]
            accept = gain > np.log(random.uniform(size=moved.size))
            moved = moved[accept]
            straight[moved] = proposed[accept]
            state.coords[moved] = points[accept]
            state.log_prob[moved] = log_density[accept]
            accepted[moved] = True
        return state, accepted


def moves_for(ensembles: int, decorrelation: Decorrelation) -> list[tuple[EnsembleMove, float]]:
    """Return the moves and how often each is taken."""
    shares = {independent: 0.5, differential_evolution: 0.4, snooker: 0.1}
    return [(EnsembleMove(move, ensembles, decorrelation), p) for move, p in shares.items()]


def differential_evolution(
    half: FloatArray, guide: FloatArray, random: Random
) -> tuple[FloatArray, FloatArray]:
    """Propose steps along the difference of two walkers of the guide."""
    first, second = _partners(half, guide, random, 2)
    step = 2.38 / np.sqrt(2.0 * half.shape[-1]) * np.ones(half.shape[:-1])
    step[random.uniform(size=step.shape) < _JUMP] = 1.0
    step *= 1.0 + _JITTER * random.standard_normal(step.shape)
    return half + step[..., None] * (second - first), np.zeros(half.shape[:-1])


def snooker(half: FloatArray, guide: FloatArray, random: Random) -> tuple[FloatArray, FloatArray]:
    """Propose steps along the line to a walker of the guide."""
    origin, first, second = _partners(half, guide, random, 3)
    line = half - origin
    length2 = np.sum(line**2, axis=-1)
    # a walker at the position of its partner has no direction, and stays
    along = np.sum(line * (second - first), axis=-1) / np.where(length2 > 0.0, length2, 1.0)
    points = half + _SNOOKER * along[..., None] * line
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(np.sum((points - origin) ** 2, axis=-1)) - np.log(length2)
    factor = 0.5 * (half.shape[-1] - 1) * ratio
    return points, np.where(length2 > 0.0, factor, -np.inf)


def independent(
    half: FloatArray, guide: FloatArray, random: Random
) -> tuple[FloatArray, FloatArray]:
    """Propose draws from Student's t with the guide's mean and covariance."""
    dims = half.shape[-1]
    mean = guide.mean(axis=1, keepdims=True)
    centred = guide - mean
    covariance = centred.swapaxes(1, 2) @ centred / (guide.shape[1] - 1)
    size = np.sqrt(np.einsum("eii->ei", covariance))[:, None, :] + 1e-300
    correlation = covariance / size / size.swapaxes(1, 2)
    root = np.linalg.cholesky(correlation + 1e-9 * np.eye(dims))
    normal = random.standard_normal(half.shape)
    chi = np.sqrt(random.chisquare(_PROPOSAL_DOF, size=half.shape[:-1]) / _PROPOSAL_DOF)
    draws = normal / chi[..., None]
    points = mean + size * (draws @ root.swapaxes(1, 2))
    current = np.linalg.solve(root, ((half - mean) / size).swapaxes(1, 2)).swapaxes(1, 2)
    return points, _log_t(current) - _log_t(draws)


def _log_t(z: FloatArray) -> FloatArray:
    """Return ln of the density of Student's t up to a constant."""
    return np.asarray(
        -0.5 * (_PROPOSAL_DOF + z.shape[-1]) * np.log1p(np.sum(z**2, axis=-1) / _PROPOSAL_DOF)
    )


def _partners(half: FloatArray, guide: FloatArray, random: Random, count: int) -> list[FloatArray]:
    """Return `count` different walkers of the guide for each walker of the half."""
    ensembles, n, _ = half.shape
    size = guide.shape[1]
    chosen = [random.randint(size, size=(ensembles, n))]
    for k in range(1, count):  # a draw from those not yet chosen, whose indices skip the chosen
        index = random.randint(size - k, size=(ensembles, n))
        for taken in np.sort(np.stack(chosen), axis=0):
            index = index + (index >= taken)
        chosen.append(index)
    rows = np.arange(ensembles)[:, None]
    return [guide[rows, index] for index in chosen]


def decorrelation_of(problem: TableProblem) -> Decorrelation | None:
    """Return the decorrelation of a problem; None without free friction and linear elements."""
    view = problem.stiffness_data
    free = set(problem.names)
    elements = [e for e in problem.model.elements if any(p.name in free for p in e.parameters)]
    friction = tuple(e for e in elements if not e.is_linear)
    linear = [
        (e, p.name)
        for e in elements
        if e.is_linear and len(e.parameters) == 1
        for p in e.parameters
        if e.label(p) in e.linear_parameters
    ]
    if not friction or not linear:
        return None
    weights = np.repeat(view.weights, 2)
    columns = np.stack(
        [interleaved(view.stiffness_of(e, [np.ones(())])) for e, _ in linear], axis=-1
    )
    weighted = columns * weights[:, None]
    size = np.sqrt((weighted**2).sum(axis=0))
    projection = np.linalg.pinv(weighted / size) * weights / size[:, None]
    at = [problem.names.index(name) for _, name in linear]
    return Decorrelation(problem, friction, np.array(at), projection.T)
