"""Markov chains with emcee that run until they converge, and can be stopped and resumed.

The chain depends only on the density, the seed and the settings: a chain that is stopped and
resumed has the same steps as one that is not, because the positions of the walkers and the state of
the random generator are kept, and convergence is checked after fixed numbers of steps.

The integrated autocorrelation time tau is computed for each walker and averaged over walkers; the
window is Sokal's, the smallest M with M >= 5 tau(M) (as in emcee). N steps of W walkers then count
as N W/tau independent draws. R-hat compares ensembles, which are independent, and not walkers,
which are not; each ensemble is split into halves, so that drifts are detected as well (Gelman et
al., Bayesian Data Analysis, 2013, section 11.4).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, positive_number, whole_number
from dahl_ident.bayes.density import LogDensity
from dahl_ident.bayes.moves import moves_for
from dahl_ident.errors import ValidationError

# window of the autocorrelation over tau, as in emcee: a shorter one truncates tau, a longer one
# adds noise
_WINDOW = 5.0
_WARM_UP = 10.0  # autocorrelation times after which a chain is independent of its start
LENGTH = 50.0  # autocorrelation times for a sufficient estimate of tau, as in emcee
_R_HAT = 1.01  # limit of Vehtari et al. (2021); the older 1.1 accepts chains that differ
_LEAST_STEPS = 20  # fewest steps for an autocorrelation time
_FIRST_CHECK = 200  # steps at the first check: three times _WARM_UP + LENGTH for tau = 1
_GROWTH = 1.25  # ratio of the steps at successive checks: at most a quarter more than needed
_CHECK_MULTIPLE = 50  # checks are at multiples of this number of steps
_SHORTEST_PIECE = 50  # fewest steps between two calls of the listeners
_PIECES = 20  # of a long chain: a piece is this fraction of the steps so far
_POOL_PARTS = 8  # parts into which the points of one call are split for a pool

Pool = Any
"""Anything with map: multiprocessing, concurrent.futures, mpi4py."""


@dataclass(frozen=True)
class ChainSettings:
    """Settings of a chain, as given to :func:`dahl_ident.posterior`."""

    dims: int  # number of coordinates
    ensembles: int  # independent ensembles of walkers
    walkers: Any  # in all ensembles; None for a sufficient number
    seed: Any  # None for a random one
    steps: int | None  # in total; None to run until convergence
    max_steps: int  # limit without convergence
    ess: float  # effective draws of every parameter

    def __post_init__(self) -> None:
        ensembles, walkers, seed = self.ensembles, self.walkers, self.seed
        whole_number(ensembles, "ensembles", 2)
        if walkers is None:
            walkers = ensembles * max(32, 6 * self.dims)
        whole_number(walkers, "walkers", ensembles * max(8, 4 * self.dims))
        if walkers % (2 * ensembles):
            raise ValidationError(
                f"walkers is {walkers}; expected a multiple of {2 * ensembles}, because each of "
                f"{ensembles} ensembles moves in halves"
            )
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        object.__setattr__(self, "walkers", walkers)
        object.__setattr__(self, "seed", whole_number(seed, "seed", 0, np.inf))
        if self.steps is not None:
            whole_number(self.steps, "steps", _LEAST_STEPS)
        whole_number(self.max_steps, "max_steps", _LEAST_STEPS)
        positive_number(self.ess, "ess")


@dataclass(frozen=True)
class Chain:
    """All steps so far, and the state needed to continue."""

    seed: int
    points: FloatArray  # (steps, walkers, D) coordinates, walkers ordered by ensemble
    log_density: FloatArray  # (steps, walkers)
    start: FloatArray  # (walkers, D) before the first step
    random_state: tuple[Any, ...]  # after the last step, of numpy's RandomState

    @classmethod
    def at(cls, start: FloatArray, seed: int) -> Chain:
        """Return an empty chain."""
        bits = np.random.MT19937(np.random.SeedSequence(seed))
        state = np.random.RandomState(bits).get_state()
        return cls(
            seed, np.empty((0, *start.shape)), np.empty((0, len(start))), start, tuple(state)
        )

    @property
    def steps(self) -> int:
        """The number of steps so far."""
        return len(self.points)


Listener = Callable[[Chain, "Convergence | None"], None]
"""A function that is called after each piece with the chain and the last verdict."""


def run(
    density: LogDensity,
    chain: Chain,
    settings: ChainSettings,
    listeners: Sequence[Listener],
    pool: Pool | None = None,
) -> tuple[Chain, Convergence]:
    """Return the chain, continued until it has converged or reached its limit, and the verdict."""
    verdict: Convergence | None = None
    sampler = _sampler(density, settings, pool)
    end = settings.max_steps if settings.steps is None else settings.steps
    while True:
        check = _next_check(chain.steps, end) if settings.steps is None else end
        while chain.steps < check:
            piece = max(_SHORTEST_PIECE, chain.steps // _PIECES)
            chain = _continued(sampler, chain, min(piece, check - chain.steps))
            for listener in listeners:
                listener(chain, verdict)
        verdict = judge(chain.points, settings.ensembles, settings.ess)
        if chain.steps >= end or verdict.converged:
            return chain, verdict
        # more steps, without which the next check would be this one again
        chain = _continued(sampler, chain, min(_SHORTEST_PIECE, end - chain.steps))


def _next_check(steps: int, end: int) -> int:
    """Return the first number of steps, at least `steps`, after which convergence is judged."""
    check = _FIRST_CHECK
    while check < steps:
        check = int(np.ceil(_GROWTH * check / _CHECK_MULTIPLE)) * _CHECK_MULTIPLE
    return min(check, end)


def _sampler(density: LogDensity, settings: ChainSettings, pool: Pool | None) -> Any:
    from emcee import EnsembleSampler

    def mapped(x: FloatArray) -> FloatArray:
        assert pool is not None
        return np.concatenate(list(pool.map(density, np.array_split(x, _POOL_PARTS))))

    function = density if pool is None else mapped
    moves = moves_for(settings.ensembles, density.decorrelation)
    sampler: Any = EnsembleSampler(
        settings.walkers, len(density.names), function, moves=moves, vectorize=True
    )
    # emcee's wrapper prints points and traceback on standard output when a run is interrupted
    sampler.log_prob_fn = function
    return sampler


def _continued(sampler: Any, chain: Chain, steps: int) -> Chain:
    import emcee

    sampler.reset()
    first = chain.steps == 0
    state = emcee.State(
        chain.start if first else chain.points[-1],
        log_prob=None if first else chain.log_density[-1],
        random_state=chain.random_state,
    )
    last = sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    points = np.concatenate([chain.points, sampler.get_chain()])
    log_density = np.concatenate([chain.log_density, sampler.get_log_prob()])
    return replace(chain, points=points, log_density=log_density, random_state=last.random_state)


@dataclass(frozen=True)
class Convergence:
    """The verdict on one chain."""

    steps: int  # of the whole chain
    discard: int  # steps of warm-up
    # (D,) integrated autocorrelation time after the warm-up, steps; NaN if walkers never moved
    tau: FloatArray
    ess: FloatArray  # (D,) effective number of independent draws
    r_hat: FloatArray  # (D,) split R-hat across ensembles
    required: float  # effective number of draws asked for

    @property
    def usable(self) -> bool:
        """Whether tau could be estimated."""
        return bool(np.isfinite(self.tau).all())

    @property
    def unmet(self) -> list[str]:
        """The criteria that are not met, in words; empty for a converged chain."""
        if not self.usable:
            return ["some walkers never moved"]
        kept = self.steps - self.discard
        unmet = []
        if kept < LENGTH * self.tau.max():
            unmet.append(
                f"{kept} steps after warm-up are {kept / self.tau.max():.0f} autocorrelation "
                f"times, expected {LENGTH:.0f}"
            )
        if not self.r_hat.max() < _R_HAT:
            unmet.append(f"R-hat is {self.r_hat.max():.3f}, expected below {_R_HAT}")
        if self.ess.min() < self.required:
            unmet.append(f"{self.ess.min():.0f} effective draws, expected {self.required:.0f}")
        return unmet

    @property
    def converged(self) -> bool:
        """Whether all criteria are met."""
        return not self.unmet


def judge(chain: FloatArray, ensembles: int, required: float) -> Convergence:
    """Return the verdict on a chain of shape (steps, walkers, D), walkers by ensemble."""
    steps = len(chain)
    first = autocorrelation_time(chain[steps // 2 :])
    longest = np.nanmax(first) if np.isfinite(first).any() else steps
    discard = min(int(np.ceil(_WARM_UP * longest)), steps // 2)
    kept = chain[discard:]
    tau = autocorrelation_time(kept)
    ess = kept.shape[0] * kept.shape[1] / tau
    return Convergence(steps, discard, tau, ess, r_hat(kept, ensembles), required)


def autocorrelation_time(chain: FloatArray) -> FloatArray:
    """Return tau of each coordinate of a chain of shape (steps, walkers, D)."""
    steps = len(chain)
    centred = chain - chain.mean(axis=0)
    size = 1 << (2 * steps - 1).bit_length()
    power = np.abs(np.fft.rfft(centred, n=size, axis=0)) ** 2
    correlation = np.fft.irfft(power, n=size, axis=0)[:steps]
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = np.mean(correlation / correlation[0], axis=1)
    taus = 2.0 * np.cumsum(rho, axis=0) - 1.0
    enough = np.arange(steps)[:, None] >= _WINDOW * taus
    window = np.where(enough.any(axis=0), enough.argmax(axis=0), steps - 1)
    return np.asarray(np.take_along_axis(taus, window[None], axis=0)[0])


def r_hat(chain: FloatArray, ensembles: int) -> FloatArray:
    """Return split R-hat across ensembles, shape (D,)."""
    steps, walkers, dims = chain.shape
    half = steps // 2
    parts = chain[: 2 * half].reshape(2, half, ensembles, walkers // ensembles, dims)
    groups = parts.transpose(0, 2, 1, 3, 4).reshape(2 * ensembles, -1, dims)
    within = groups.var(axis=1, ddof=1).mean(axis=0)
    between = groups.mean(axis=1).var(axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(1.0 + between / within))
