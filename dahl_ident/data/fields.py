"""Checks and read-only copies for the fields of the data classes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import (
    FloatArray,
    finite_array,
    non_negative_array,
    real_array,
    refuse_masked,
)
from dahl_ident.errors import ValidationError

CONTROLLED = ("displacement", "force")


def frozen_copy(array: NDArray[Any]) -> NDArray[Any]:
    """Return a contiguous copy of `array` that cannot be written to; one of these, as it is."""
    flags = array.flags
    if flags.owndata and flags.c_contiguous and not flags.writeable and type(array) is np.ndarray:
        return array
    copy = np.array(array, order="C")
    copy.setflags(write=False)
    return copy


def frozen_mapping(value: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """Return a read-only copy of a mapping, or None for None."""
    return None if value is None else MappingProxyType(dict(value))


def plain_mappings(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return constructor arguments with plain dicts, which pickle where proxies do not."""
    return {k: dict(v) if isinstance(v, MappingProxyType) else v for k, v in pairs}


def one_of(value: str, name: str, allowed: tuple[str, ...]) -> str:
    """Return `value` if it is among `allowed`, else name them."""
    if value not in allowed:
        raise ValidationError(f"{name} is {value!r}; expected one of {', '.join(allowed)}")
    return value


def column(
    value: ArrayLike | None,
    name: str,
    n: int,
    check: Callable[[ArrayLike, str], NDArray[Any]],
    *,
    shape: tuple[int, ...] = (),
) -> NDArray[Any] | None:
    """Return a checked read-only ``(n, *shape)`` array, or None for None."""
    if value is None:
        return None
    refuse_masked(value, name)
    array = check(value, name)
    if array.shape != (n, *shape):
        raise ValidationError(
            f"{name}: expected shape {(n, *shape)}, one entry for each point, got {array.shape}"
        )
    return frozen_copy(array)


def spread(
    value: ArrayLike | None, name: str, n: int, check: Callable[[ArrayLike, str], NDArray[Any]]
) -> NDArray[Any] | None:
    """Return like :func:`column`, with one value allowed for all points."""
    if value is None or np.ndim(value):
        return column(value, name, n, check)
    return frozen_copy(np.full(n, check(value, name)))


def complex_values(value: ArrayLike, name: str) -> NDArray[np.complex128]:
    """Return finite complex numbers."""
    array = np.asarray(value)
    if array.dtype.kind not in "cfiu":
        raise ValidationError(f"{name}: expected complex numbers, got dtype {array.dtype}")
    finite_array(array.real, f"{name}.real")
    finite_array(array.imag, f"{name}.imag")
    return array.astype(np.complex128)


def degrees_of_freedom(value: ArrayLike, name: str) -> FloatArray:
    """Return numbers above zero, infinity among them."""
    array = real_array(value, name)
    bad = np.flatnonzero(~(array > 0.0))
    if bad.size:
        raise ValidationError(
            f"{name}[{bad[0]}] is {float(array.flat[bad[0]])!r}; expected a number > 0 or infinity"
        )
    return array


def labels(value: ArrayLike, name: str) -> NDArray[Any]:
    """Return finite numbers, or text."""
    array = np.asarray(value)
    if array.dtype.kind in "OUT":
        return array.astype(str)
    return finite_array(array, name)


def controlled_words(value: ArrayLike, name: str) -> NDArray[np.str_]:
    """Return words out of ``CONTROLLED``."""
    array = np.asarray(value, dtype=np.str_)
    for word in np.unique(array):
        one_of(str(word), name, CONTROLLED)
    return array


def run_labels(value: ArrayLike, name: str) -> NDArray[np.str_]:
    """Return text labels; numbers become text, 3.0 the same as 3."""
    array = labels(value, name)
    if array.dtype.kind == "U":
        return array
    return np.array([f"{number:.15g}" for number in array.flat], np.str_).reshape(array.shape)


def harmonic_numbers(value: ArrayLike, name: str) -> NDArray[np.int64]:
    """Return whole numbers of 0 and above."""
    array = non_negative_array(value, name)
    broken = array != np.round(array)
    if broken.any():
        raise ValidationError(f"{name}: expected whole numbers, got {float(array[broken][0])!r}")
    return array.astype(np.int64)


def plain_values(value: ArrayLike, name: str) -> NDArray[Any]:
    """Return numbers (NaN and infinity among them), truth values or text."""
    array = np.asarray(value)
    if array.dtype.kind in "OT":
        return array.astype(str)
    if array.dtype.kind not in "biufU":
        raise ValidationError(f"{name}: expected numbers or text, got dtype {array.dtype}")
    return array


def check_covariance(
    covariance: FloatArray, amplitude_std: FloatArray | None, cross: FloatArray | None
) -> None:
    """Refuse a matrix that is not a covariance of (amplitude, real part, imaginary part)."""
    joint = np.zeros((len(covariance), 3, 3))
    joint[:, 1:, 1:] = covariance
    if amplitude_std is not None:
        joint[:, 0, 0] = amplitude_std**2
    if cross is not None:
        joint[:, 0, 1:] = joint[:, 1:, 0] = cross
    scale = np.sqrt(np.abs(np.diagonal(joint, axis1=1, axis2=2)))
    scale[scale == 0.0] = 1.0
    correlation = joint / (scale[:, :, None] * scale[:, None, :])
    asymmetry = np.abs(correlation[:, 1, 2] - correlation[:, 2, 1])
    smallest = np.linalg.eigvalsh(correlation)[:, 0]
    bad = (asymmetry > 1e-9) | (smallest < -1e-9)
    if bad.any():
        row = int(np.argmax(bad))
        raise ValidationError(
            f"covariance[{row}] is {covariance[row].tolist()}; expected a symmetric positive "
            "semidefinite matrix, also together with the amplitude's variance and covariance"
        )


def check_mean_covariance(
    covariance: FloatArray, cross: FloatArray | None, mean: NDArray[np.bool_]
) -> None:
    """Refuse an error of the imaginary part in rows of the mean force, which have none."""
    imaginary = np.abs(covariance[:, 1, :]).sum(axis=1)
    if cross is not None:
        imaginary = imaginary + np.abs(cross[:, 1])
    bad = mean & (imaginary != 0.0)
    if bad.any():
        raise ValidationError(
            f"covariance[{int(np.argmax(bad))}] gives the imaginary part an error; expected 0, as "
            "a row with harmonic 0 is a real number"
        )
