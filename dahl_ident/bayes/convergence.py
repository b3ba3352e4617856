"""Whether a chain has converged, and its effective number of draws.

The integrated autocorrelation time tau is computed from the paths of single walkers and averaged
over walkers; the window is Sokal's, the smallest M with M >= 5 tau(M) (as in emcee). N steps of W
walkers then count as N W/tau independent draws. R-hat compares ensembles, which are independent,
rather than walkers, which are not; each is split in halves, so that drifts are detected as well
(Gelman et al., Bayesian Data Analysis, 2013, section 11.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray

WINDOW = 5.0  # times tau, of Sokal's window: shorter cuts tau off, longer adds noise; as in emcee
WARM_UP = 10.0  # autocorrelation times until the chain is independent of its start
LENGTH = 50.0  # autocorrelation times needed for a reliable estimate of tau
R_HAT = 1.01  # as Vehtari et al. (2021) recommend; the older 1.1 passes chains that differ


@dataclass(frozen=True)
class Convergence:
    """The verdict on one chain."""

    steps: int  # of the whole chain
    discard: int  # steps of warm-up
    # (D,) integrated autocorrelation time after the warm-up, steps; NaN where nothing moved
    tau: FloatArray
    ess: FloatArray  # (D,) effective number of independent draws
    r_hat: FloatArray  # (D,) split R-hat across ensembles
    wanted: float  # number of draws asked for

    @property
    def usable(self) -> bool:
        """Whether tau could be estimated at all."""
        return bool(np.isfinite(self.tau).all())

    @property
    def lacks(self) -> list[str]:
        """The criteria that are not met, in words; empty for a converged chain."""
        if not self.usable:
            return ["some walkers never moved"]
        kept = self.steps - self.discard
        lacks = []
        if kept < LENGTH * self.tau.max():
            lacks.append(
                f"{kept} steps after warm-up are {kept / self.tau.max():.0f} autocorrelation "
                f"times, expected {LENGTH:.0f}"
            )
        if not self.r_hat.max() < R_HAT:
            lacks.append(f"R-hat is {self.r_hat.max():.3f}, expected below {R_HAT}")
        if self.ess.min() < self.wanted:
            lacks.append(f"{self.ess.min():.0f} effective draws, expected {self.wanted:.0f}")
        return lacks

    @property
    def reached(self) -> bool:
        """Whether all criteria are met."""
        return not self.lacks


def judge(chain: FloatArray, ensembles: int, wanted: float) -> Convergence:
    """Return the verdict on a chain of shape (steps, walkers, D), walkers by ensemble."""
    steps = len(chain)
    first = autocorrelation_time(chain[steps // 2 :])
    longest = np.nanmax(first) if np.isfinite(first).any() else steps
    discard = min(int(np.ceil(WARM_UP * longest)), steps // 2)
    kept = chain[discard:]
    tau = autocorrelation_time(kept)
    ess = kept.shape[0] * kept.shape[1] / tau
    return Convergence(steps, discard, tau, ess, r_hat(kept, ensembles), wanted)


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
    enough = np.arange(steps)[:, None] >= WINDOW * taus
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
