"""Array types, and the checks that every public function applies to its arguments."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.errors import ValidationError

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

EPS = float(np.finfo(np.float64).eps)
"""Distance from 1 to the next number."""

TINY = float(np.finfo(np.float64).tiny)
"""Replaces 0 in denominators, so that quotients are finite."""

NORMAL_MEDIAN = 0.6745
"""Median of a normal variable's absolute value, in standard deviations."""

LARGEST_COUNT = 2**53
"""Up to here floats hold every whole number; arrays of as many numbers exceed any memory."""

SMALLEST, LARGEST = 1e-90, 1e90
"""Allowed magnitudes: squares, products and ratios of such numbers remain representable."""


def quotient(
    numerator: ComplexArray | float, denominator: ComplexArray | FloatArray
) -> ComplexArray:
    """Return a quotient, 0 where the denominator is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(denominator != 0.0, numerator / denominator, 0.0)


def unit_diagonal(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a matrix scaled to a diagonal of 1, or 0, and the roots of its diagonal, 1 for 0."""
    size = np.sqrt(matrix.diagonal())
    size = np.where(size > 0.0, size, 1.0)
    return matrix / np.outer(size, size), size


def cholesky_root(covariance: FloatArray) -> FloatArray:
    """Return a root of a covariance, whatever the sizes of its standard deviations."""
    correlation, std = unit_diagonal(covariance)
    return std[:, None] * np.linalg.cholesky(correlation)


def interleaved(values: ComplexArray) -> FloatArray:
    """Return real and imaginary parts, interleaved in the last axis."""
    return np.ascontiguousarray(values, dtype=np.complex128).view(np.float64)


def real_array(value: ArrayLike, name: str) -> FloatArray:
    """Return `value` as a float array, or raise an error that names the argument."""
    refuse_masked(value, name)
    try:
        array = np.asarray(value)
    except ValueError as exc:
        raise ValidationError(f"{name}: expected an array of real numbers, got {exc}") from exc
    if array.dtype.kind == "c":
        raise ValidationError(
            f"{name}: expected real numbers, got complex ones (dtype {array.dtype}); "
            "pass an amplitude or a waveform, not a phasor"
        )
    if array.dtype.kind not in "fiu":
        got = f"dtype {array.dtype}" if array.ndim else repr(value)
        raise ValidationError(f"{name}: expected real numbers, got {got}")
    return array.astype(np.float64, copy=False)


def refuse_masked(value: ArrayLike, name: str) -> None:
    """Refuse a numpy array with masked values."""
    if np.ma.is_masked(value):
        raise ValidationError(f"{name}: some values are masked; leave these rows out")


def finite_array(value: ArrayLike, name: str) -> FloatArray:
    """Return `value` as a float array of absolute values up to 1e90."""
    array = real_array(value, name)
    good = np.abs(array) <= LARGEST
    if not good.all():
        finite = np.isfinite(array)
        if finite.all():
            _refuse(array, good, name, f"numbers of at most {LARGEST:g} in size; check the unit")
        _refuse(array, finite, name, "finite numbers")
    return array


def non_negative_array(value: ArrayLike, name: str) -> FloatArray:
    """Return `value` as a finite float array without negative numbers."""
    array = finite_array(value, name)
    good = array >= 0.0
    if not good.all():
        _refuse(array, good, name, "numbers >= 0")
    return array


def positive_array(value: ArrayLike, name: str) -> FloatArray:
    """Return `value` as a float array of numbers above zero, from 1e-90 to 1e90."""
    array = finite_array(value, name)
    good = array >= SMALLEST
    if not good.all():
        positive = array > 0.0
        if positive.all():
            _refuse(array, good, name, f"numbers of at least {SMALLEST:g}; check the unit")
        _refuse(array, positive, name, "numbers > 0")
    return array


def array_between(value: ArrayLike, name: str, low: float, high: float) -> FloatArray:
    """Return `value` as a finite float array of numbers from `low` to `high`."""
    array = finite_array(value, name)
    good = (array >= low) & (array <= high)
    if not good.all():
        _refuse(array, good, name, f"numbers from {low:g} to {high:g}")
    return array


def positive_number(value: Any, name: str) -> float:
    """Return `value` as one float above zero."""
    return _one(positive_array(value, name), name)


def non_negative_number(value: Any, name: str) -> float:
    """Return `value` as one finite float >= 0."""
    return _one(non_negative_array(value, name), name)


def finite_number(value: Any, name: str) -> float:
    """Return `value` as one finite float."""
    return _one(finite_array(value, name), name)


def real_number(value: Any, name: str) -> float:
    """Return `value` as one float, which may be NaN or infinite."""
    return _one(real_array(value, name), name)


def _one(array: FloatArray, name: str) -> float:
    if array.ndim:
        raise ValidationError(f"{name}: expected one number, got an array of shape {array.shape}")
    return float(array)


def whole_number(value: Any, name: str, minimum: int, maximum: float = LARGEST_COUNT) -> int:
    """Return `value` as an int from `minimum` to `maximum`; a float or a bool is refused."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < minimum:
        raise ValidationError(f"{name} is {value!r}; expected a whole number >= {minimum}")
    if value > maximum:
        raise ValidationError(f"{name} is {value!r}; expected a whole number <= {maximum}")
    return int(value)


def broadcast_shape(**named: NDArray[Any]) -> tuple[int, ...]:
    """Return the common shape of the named arrays, or raise an error that names their shapes."""
    try:
        return np.broadcast_shapes(*(a.shape for a in named.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in named.items())
        raise ValidationError(f"shapes do not go together: {shapes}") from None


def _refuse(array: FloatArray, good: BoolArray, name: str, expected: str) -> None:
    bad = np.argwhere(~good)
    first = tuple(int(i) for i in bad[0])
    value = float(array[first])
    where = f"[{', '.join(map(str, first))}]" if first else ""
    more = f" ({len(bad)} such values)" if len(bad) > 1 else ""
    raise ValidationError(f"{name}{where} is {value!r}{more}; expected {expected}")
