from collections.abc import Sequence
from typing import Any

from emcee import autocorr as autocorr
from numpy.typing import NDArray

class State:
    coords: NDArray[Any]
    log_prob: NDArray[Any]
    random_state: Any
    def __init__(
        self, coords: Any, log_prob: Any = ..., blobs: Any = ..., random_state: Any = ...
    ) -> None: ...

class EnsembleSampler:
    def __init__(
        self,
        nwalkers: int,
        ndim: int,
        log_prob_fn: Any,
        pool: Any = ...,
        moves: Sequence[Any] | None = ...,
        *,
        vectorize: bool = ...,
    ) -> None: ...
    def reset(self) -> None: ...
    def run_mcmc(
        self, initial_state: State, nsteps: int, *, skip_initial_state_check: bool = ...
    ) -> State: ...
    def get_chain(self) -> NDArray[Any]: ...
    def get_log_prob(self) -> NDArray[Any]: ...
