from collections.abc import Callable
from typing import Any

from numpy import float64
from numpy.typing import NDArray

class Parameter:
    value: float
    stderr: float | None

class Parameters:
    def add(
        self, name: str, value: float = ..., vary: bool = ..., min: float = ..., max: float = ...
    ) -> None: ...
    def __getitem__(self, name: str) -> Parameter: ...
    def valuesdict(self) -> dict[str, float]: ...

class MinimizerResult:
    chain: NDArray[float64]
    params: Parameters
    covar: NDArray[float64]
    residual: NDArray[float64]
    chisqr: float
    redchi: float
    nfev: int
    success: bool

def minimize(
    fcn: Callable[..., NDArray[float64]],
    params: Parameters,
    method: str = ...,
    args: tuple[Any, ...] = ...,
    **kwargs: Any,
) -> MinimizerResult: ...

class Minimizer:
    def __init__(self, userfcn: Callable[..., NDArray[float64]], params: Parameters) -> None: ...
    def emcee(
        self,
        *,
        steps: int = ...,
        burn: int = ...,
        nwalkers: int = ...,
        is_weighted: bool = ...,
        progress: bool = ...,
        seed: int | None = ...,
    ) -> MinimizerResult: ...
