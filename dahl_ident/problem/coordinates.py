"""Which parameters are free, and the coordinates in which they are searched for.

The logarithm of positive parameters, the number itself for the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import FloatArray, positive_array, real_array
from dahl_ident.elements import Element, Model, Parameter
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.sensors import Sensors


class Coordinates:
    """The free parameters of a problem and their search coordinates theta, (P,) or (S, P)."""

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        self.parameters = tuple(parameters)
        self.names = tuple(p.name for p in self.parameters)
        self.positive = np.array([p.transform == "log" for p in self.parameters])
        self._all_positive = bool(self.positive.all())

    def checked(self, theta: ArrayLike, name: str = "theta") -> FloatArray:
        """Return `theta` as an array of shape (P,) or (S, P), or say what it is instead."""
        array = real_array(theta, name)
        P = len(self.parameters)
        if array.ndim not in (1, 2) or array.shape[-1] != P:
            raise ValidationError(
                f"{name} has shape {array.shape}; expected ({P},) or (S, {P}) for "
                f"{', '.join(self.names)}"
            )
        return array

    def to_search(self, values: ArrayLike) -> FloatArray:
        """Return the search coordinates of parameter values."""
        array = self.checked(values, "values")
        for index in np.flatnonzero(self.positive):
            positive_array(array[..., index], self.names[index])
        return np.where(self.positive, np.log(np.where(self.positive, array, 1.0)), array)

    def to_values(self, theta: FloatArray) -> FloatArray:
        """Return the parameter values, unchecked."""
        with np.errstate(over="ignore", under="ignore"):
            if self._all_positive:
                return np.exp(theta)
            return np.where(self.positive, np.exp(np.where(self.positive, theta, 0.0)), theta)

    def slopes(self, values: FloatArray) -> FloatArray:
        """Return d value / d theta: the value itself for positive parameters, 1 for others."""
        return np.where(self.positive, values, 1.0)

    @cached_property
    def is_bounded(self) -> bool:
        """Whether any parameter has a finite bound in search coordinates."""
        return any(
            p.upper < np.inf or p.lower > (0.0 if p.transform == "log" else -np.inf)
            for p in self.parameters
        )

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """The parameters' lower and upper bounds in search coordinates."""
        lower = np.array([p.lower for p in self.parameters])
        upper = np.array([p.upper for p in self.parameters])
        with np.errstate(divide="ignore"):
            low = np.log(np.maximum(lower, 0.0), out=lower.copy(), where=self.positive)
            high = np.log(upper, out=upper.copy(), where=self.positive)
        return low, high


class Interchangeable:
    """Like elements of a model, and like parts of one, whose labels could switch.

    Elements are ordered by their knees, parts by the first parameter of each.
    """

    def __init__(self, model: Model, names: tuple[str, ...]) -> None:
        alike: dict[tuple[object, ...], list[Element]] = {}
        for element in model.elements:
            if not element.is_linear and any(p.free for p in element.parameters):
                settings = tuple(
                    (p.free, None if p.free else p.value, p.lower, p.upper)
                    for p in element.parameters
                )
                alike.setdefault((type(element), element.labels, settings), []).append(element)
        self._sets = [elements for elements in alike.values() if len(elements) > 1]
        self._columns = [
            np.array([[names.index(p.name) for p in e.parameters if p.free] for e in elements])
            for elements in self._sets
        ]
        self._parts = []
        for element in model.elements:
            own = dict(zip(element.labels, element.parameters, strict=True))
            parts = [[own[label] for label in part] for part in element.like_parts]
            if parts and all(p.free for part in parts for p in part):
                self._parts.append(np.array([[names.index(p.name) for p in q] for q in parts]))

    def in_order(self, theta: FloatArray, coordinates: Coordinates) -> FloatArray:
        """Return `theta` with the columns of like elements exchanged until the knees rise."""
        array = theta.copy() if self._sets or self._parts else theta
        for columns in self._parts:
            _exchange(array, columns, array[..., columns[:, 0]])
        for elements, columns in zip(self._sets, self._columns, strict=True):
            values = coordinates.to_values(array)
            knees = []
            for element, own in zip(elements, columns, strict=True):
                free = iter(values[..., column] for column in own)
                at = [next(free) if p.free else np.asarray(p.value) for p in element.parameters]
                knees.append(np.broadcast_to(element.knee(at)[0], theta.shape[:-1]))
            _exchange(array, columns, np.stack(knees, axis=-1))
        return array


def _exchange(array: FloatArray, columns: NDArray[np.intp], key: FloatArray) -> None:
    """Exchange the rows of `columns` in `array` until the key rises."""
    order = np.argsort(key, axis=-1)
    for kind in columns.T:
        array[..., kind] = np.take_along_axis(array[..., kind], order, axis=-1)


def with_changes(
    model: Model, sensors: Sensors, free: Iterable[str], fixed: Mapping[str, float]
) -> tuple[Model, Sensors]:
    """Free and fix parameters by name, wherever they live."""
    if not isinstance(sensors, Sensors):
        raise ValidationError(f"sensors is {sensors!r}; expected Sensors(...)")
    if isinstance(free, str):
        raise ValidationError(f"free is {free!r}; expected a collection of names: [{free!r}]")
    if not isinstance(fixed, Mapping):
        raise ValidationError(
            f"fixed is {fixed!r}; expected a mapping of names to numbers, such as {{'f_max': 0.1}}"
        )
    free = tuple(free)
    if not free and not fixed:
        return model, sensors
    both = set(free) & set(fixed)
    if both:
        raise ModelError(f"{', '.join(sorted(both))} is both in free= and in fixed=; choose one")
    sensed = {p.name for p in sensors.parameters}
    model = model.with_free([n for n in free if n not in sensed])
    model = model.with_fixed({n: v for n, v in fixed.items() if n not in sensed})
    sensors = sensors.with_free([n for n in free if n in sensed])
    return model, sensors.with_fixed({n: v for n, v in fixed.items() if n in sensed})
