"""Proposals for several independent ensembles, all evaluated in one call.

Each ensemble of walkers is split at random into halves; one half moves with the other as its guide,
then they exchange roles (as in emcee, whose sampler runs these moves). A density that takes many
points at once costs least when the halves of all ensembles go into one call.

- `differential_evolution`: a walker moves along the difference of two of the other half, by
  2.38/(2 D)^(1/2) of it, now and then by all of it, which leads from mode to mode (ter Braak,
  Statistics and Computing 16, 2006; Nelson et al., ApJS 210, 2014).
- `snooker`: along the line to a walker of the other half, by the projected difference of two more
  (ter Braak and Vrugt, Statistics and Computing 18, 2008).
- `independent`: to a draw from Student's t around the mean of the other half, shaped by its
  covariance; in few dimensions many draws are accepted, successive positions are nearly
  independent, and heavy tails are reached from the centre.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.decorrelation import Decorrelation

Random = np.random.RandomState  # emcee's
Proposal = Callable[[FloatArray, FloatArray, Random], tuple[FloatArray, FloatArray]]
"""Half and guide, each (ensembles, W/2, D) -> places proposed and ln of the Hastings factor."""

_JITTER = 1e-5  # relative, of the step: keeps walkers off a lattice
_JUMP = 0.1  # part of the steps that go all the way
_TAIL = 2.0  # degrees of freedom of the independent proposals: few, to reach far tails
_SNOOKER = 1.7  # mean of the factors of ter Braak and Vrugt (2008), as in emcee


@dataclass(frozen=True)
class EnsembleMove:
    """One kind of proposal, applied to every ensemble by itself; a move of emcee's sampler.

    With a decorrelation, positions are proposed in coordinates in which ridges are straight.
    """

    proposal: Proposal
    ensembles: int
    decorrelation: Decorrelation | None = None

    def propose(self, model: Any, state: Any) -> tuple[Any, Any]:
        """Return the state after one proposal to every walker, and which were accepted."""
        walkers, dims = state.coords.shape
        each = walkers // self.ensembles
        random = model.random
        order = random.uniform(size=(self.ensembles, each)).argsort(axis=1)
        order += each * np.arange(self.ensembles)[:, None]
        accepted = np.zeros(walkers, dtype=bool)
        straight = (
            state.coords
            if self.decorrelation is None
            else self.decorrelation.decorrelated(state.coords)
        )
        halves = (order[:, : each // 2], order[:, each // 2 :])
        for half, guide in (halves, halves[::-1]):
            proposed, factor = self.proposal(straight[half], straight[guide], random)
            who, proposed = half.ravel(), proposed.reshape(-1, dims)
            places = (
                proposed if self.decorrelation is None else self.decorrelation.original(proposed)
            )
            log_density, _ = model.compute_log_prob_fn(places)
            gain = factor.ravel() + log_density - state.log_prob[who]
            moves = gain > np.log(random.uniform(size=who.size))
            who = who[moves]
            straight[who] = proposed[moves]
            state.coords[who] = places[moves]
            state.log_prob[who] = log_density[moves]
            accepted[who] = True
        return state, accepted


def moves_for(
    ensembles: int, decorrelation: Decorrelation | None
) -> list[tuple[EnsembleMove, float]]:
    """Return the moves and how often each is taken."""
    return [
        (EnsembleMove(independent, ensembles, decorrelation), 0.5),
        (EnsembleMove(differential_evolution, ensembles, decorrelation), 0.4),
        (EnsembleMove(snooker, ensembles, decorrelation), 0.1),
    ]


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
    # a walker at the position of its partner has no direction to move in and stays
    along = np.sum(line * (second - first), axis=-1) / np.where(length2 > 0.0, length2, 1.0)
    places = half + _SNOOKER * along[..., None] * line
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(np.sum((places - origin) ** 2, axis=-1)) - np.log(length2)
    factor = 0.5 * (half.shape[-1] - 1) * ratio
    return places, np.where(length2 > 0.0, factor, -np.inf)


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
    chi = np.sqrt(random.chisquare(_TAIL, size=half.shape[:-1]) / _TAIL)
    draws = normal / chi[..., None]
    places = mean + size * (draws @ root.swapaxes(1, 2))
    here = np.linalg.solve(root, ((half - mean) / size).swapaxes(1, 2)).swapaxes(1, 2)
    return places, _log_t(here) - _log_t(draws)


def _log_t(z: FloatArray) -> FloatArray:
    """Return ln of the density of Student's t up to a constant."""
    return np.asarray(-0.5 * (_TAIL + z.shape[-1]) * np.log1p(np.sum(z**2, axis=-1) / _TAIL))


def _partners(half: FloatArray, guide: FloatArray, random: Random, count: int) -> list[FloatArray]:
    """Return `count` different walkers of the guide for each walker of the half."""
    ensembles, n, _ = half.shape
    size = guide.shape[1]
    chosen = [random.randint(size, size=(ensembles, n))]
    for k in range(1, count):  # a draw among those left, shifted past those taken
        index = random.randint(size - k, size=(ensembles, n))
        for taken in np.sort(np.stack(chosen), axis=0):
            index = index + (index >= taken)
        chosen.append(index)
    rows = np.arange(ensembles)[:, None]
    return [guide[rows, index] for index in chosen]
