from typing import Any

from numpy.typing import NDArray

def integrated_time(
    x: NDArray[Any], c: float = ..., tol: float = ..., quiet: bool = ...
) -> NDArray[Any]: ...
