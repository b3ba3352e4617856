"""Checks and read-only copies for the fields of the data classes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import ValidationError


def frozen_copy(array: NDArray[Any]) -> NDArray[Any]:
    """Return a contiguous copy of `array` that cannot be written to."""
    copy = np.array(array, order="C")
    copy.setflags(write=False)
    return copy


def column(
    value: ArrayLike | None,
    name: str,
    n: int,
    check: Callable[[ArrayLike, str], FloatArray],
    *,
    shape: tuple[int, ...] = (),
) -> FloatArray | None:
    """Return a checked read-only ``(n, *shape)`` array, or None for None."""
    if value is None:
        return None
    array = check(value, name)
    if array.shape != (n, *shape):
        raise ValidationError(
            f"{name}: expected shape {(n, *shape)}, one entry for each frequency, got {array.shape}"
        )
    return frozen_copy(array)


def one_of(value: str, name: str, allowed: tuple[str, ...]) -> str:
    """Return `value` if it is among `allowed`, else name them."""
    if value not in allowed:
        raise ValidationError(f"{name} is {value!r}; expected one of {', '.join(allowed)}")
    return value


def frozen_mapping(value: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """Return a read-only copy of a mapping, or None for None."""
    return None if value is None else MappingProxyType(dict(value))


def thawed(pairs: Iterator[tuple[str, Any]]) -> dict[str, Any]:
    """Return constructor arguments with plain dicts, which pickle where proxies do not."""
    return {k: dict(v) if isinstance(v, MappingProxyType) else v for k, v in pairs}
