"""Which parameters are free, and the coordinates in which they are searched for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import BoolArray, FloatArray, IntArray, positive_array, real_array
from dahl_ident.elements import Element, Model, Parameter
from dahl_ident.elements.force_law import prefixed
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.sensors import Sensors

_INSIDE = 1.0 - 1e-9  # largest part of the way to a bound, at which the slope is zero


class Space:
    """The free parameters of a problem and their search coordinates theta, (P,) or (S, P).

    Coordinates are the logarithms of `positive` parameters and the values of the others. Parameters
    with a size above 0 in `bends`, (P,), are searched by the inverse hyperbolic sine of the value
    over it, and those `inside`, between two finite bounds, by an angle (`angular`) whose sine gives
    the value, or its logarithm where that is the transform, so that no step leaves the bounds.
    A step of 1 of `relative` coordinates is large for any data.
    """

    def __init__(
        self,
        parameters: Sequence[Parameter],
        bends: FloatArray | None = None,
        *,
        inside: bool | BoolArray = False,
    ) -> None:
        self.parameters = tuple(parameters)
        self.names = tuple(p.name for p in self.parameters)
        self._lower = np.array([p.lower for p in self.parameters])
        self._upper = np.array([p.upper for p in self.parameters])
        self.angular = between = inside & np.isfinite(self._lower) & np.isfinite(self._upper)
        self._angles = np.flatnonzero(between)
        logarithmic = np.array([p.positive for p in self.parameters], dtype=np.bool_)
        self._by_log = (logarithmic & (self._lower > 0.0))[between]
        low, high = self._scaled(self._lower[between]), self._scaled(self._upper[between])
        self._middle, self._reach = 0.5 * (low + high), 0.5 * (high - low)
        bends = np.zeros(len(self.parameters)) if bends is None else bends
        self._bent = np.flatnonzero(bends > 0.0)
        self._size = bends[self._bent]
        self._curved = bool(self._angles.size or self._bent.size)
        self.positive = ~between & logarithmic
        self.relative = logarithmic | between | (bends > 0.0)
        self._all_positive = bool(self.positive.all())

    def checked(self, theta: ArrayLike, name: str = "theta") -> FloatArray:
        """Return `theta` as an array of shape (P,) or (S, P), and refuse other shapes."""
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
        theta = np.where(self.positive, np.log(np.where(self.positive, array, 1.0)), array)
        if self._curved:
            part = (self._scaled(array[..., self._angles]) - self._middle) / self._reach
            theta[..., self._angles] = np.arcsin(np.clip(part, -_INSIDE, _INSIDE))
            theta[..., self._bent] = np.arcsinh(array[..., self._bent] / self._size)
        return theta

    def to_values(self, theta: FloatArray) -> FloatArray:
        """Return the parameter values, unchecked."""
        with np.errstate(over="ignore", under="ignore"):
            if self._all_positive:
                return np.exp(theta)
            values = np.where(self.positive, np.exp(np.where(self.positive, theta, 0.0)), theta)
            if self._curved:
                between = self._middle + self._reach * np.sin(theta[..., self._angles])
                values[..., self._angles] = np.where(self._by_log, np.exp(between), between)
                values[..., self._bent] = self._size * np.sinh(theta[..., self._bent])
        return values

    def value(self, index: int, coordinate: Any, math: Any) -> Any:
        """Return one value from its coordinate, with the functions of another library."""
        if self.positive[index]:
            return math.exp(coordinate)
        if self.angular[index]:
            place = self._angles.tolist().index(index)
            between = self._middle[place] + self._reach[place] * math.sin(coordinate)
            return math.exp(between) if self._by_log[place] else between
        if self.relative[index]:
            return self._size[self._bent.tolist().index(index)] * math.sinh(coordinate)
        return coordinate

    def slopes(self, values: FloatArray) -> FloatArray:
        """Return d value / d theta at parameter values."""
        slopes = np.where(self.positive, values, 1.0)
        if self._curved:
            bounded = values[..., self._angles]
            aside = self._scaled(bounded) - self._middle
            unit = np.where(self._by_log, bounded, 1.0)
            slopes[..., self._angles] = unit * np.sqrt(np.maximum(self._reach**2 - aside**2, 0.0))
            slopes[..., self._bent] = np.hypot(values[..., self._bent], self._size)
        return slopes

    def _scaled(self, values: FloatArray) -> FloatArray:
        """Return values of parameters that are searched by angles, or their logarithms."""
        return np.where(self._by_log, np.log(np.where(self._by_log, values, 1.0)), values)

    def unfolded(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta, (S, P), its angles within a right angle, and the signs of derivatives."""
        theta, signs = theta.copy(), np.ones(theta.shape)
        angles = theta[:, self._angles]
        theta[:, self._angles] = np.arcsin(np.sin(angles))
        signs[:, self._angles] = np.where(np.cos(angles) < 0.0, -1.0, 1.0)
        return theta, signs

    @cached_property
    def is_bounded(self) -> bool:
        """Whether any parameter has a finite bound in search coordinates."""
        return bool(np.isfinite(self.bounds).any())

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """The parameters' lower and upper bounds in search coordinates."""
        with np.errstate(divide="ignore"):
            low = np.log(np.maximum(self._lower, 0.0), out=self._lower.copy(), where=self.positive)
            high = np.log(self._upper, out=self._upper.copy(), where=self.positive)
        low[self._angles], high[self._angles] = -0.5 * np.pi, 0.5 * np.pi
        low[self._bent] = np.arcsinh(low[self._bent] / self._size)
        high[self._bent] = np.arcsinh(high[self._bent] / self._size)
        return low, high


class Interchangeable:
    """Interchangeable elements of a model, and interchangeable parts of one element.

    Elements are ordered by their knees, parts by the first parameter of each. Their states at the
    first sample of each record, whose names end in one of `endings`, go with them.
    """

    def __init__(self, model: Model, names: tuple[str, ...], endings: Sequence[str] = ()) -> None:
        alike: dict[tuple[object, ...], list[Element]] = {}
        for element in model.elements:
            if not element.is_linear and any(p.free for p in element.parameters):
                settings = tuple(
                    (p.free, None if p.free else p.value, p.lower, p.upper)
                    for p in element.parameters
                )
                alike.setdefault((type(element), element.labels, settings), []).append(element)
        self._sets = [elements for elements in alike.values() if len(elements) > 1]

        def first_states(element: Element) -> list[list[int]]:
            starts = element.starts if element.has_memory else ()
            states = [prefixed(element.name, start) for start, *_ in starts]
            return [[names.index(state + ending) for ending in endings] for state in states]

        self._columns = []
        for elements in self._sets:
            columns = [[names.index(p.name) for p in e.parameters if p.free] for e in elements]
            for row, element in zip(columns, elements, strict=True):
                row += [i for state in first_states(element) for i in state]
            self._columns.append(np.array(columns))
        self._parts = []
        for element in model.elements:
            by_label = dict(zip(element.labels, element.parameters, strict=True))
            parts = [[by_label[label] for label in part] for part in element.like_parts]
            if parts and all(p.free for part in parts for p in part):
                columns = [[names.index(p.name) for p in part] for part in parts]
                states = first_states(element)
                if len(states) == len(parts):
                    columns = [c + at for c, at in zip(columns, states, strict=True)]
                self._parts.append(np.array(columns))

    def in_order(self, theta: FloatArray, space: Space) -> FloatArray:
        """Return `theta` with the columns of like elements exchanged until the knees rise."""
        array = theta.copy() if self._sets or self._parts else theta
        for columns in self._parts:
            _exchange(array, columns, array[..., columns[:, 0]])
        for elements, columns in zip(self._sets, self._columns, strict=True):
            values = space.to_values(array)
            knees = []
            for element, element_columns in zip(elements, columns, strict=True):
                free = iter(values[..., column] for column in element_columns)
                at = [next(free) if p.free else np.asarray(p.value) for p in element.parameters]
                knees.append(np.broadcast_to(element.knee(at)[0], theta.shape[:-1]))
            _exchange(array, columns, np.stack(knees, axis=-1))
        return array


def _exchange(array: FloatArray, columns: IntArray, key: FloatArray) -> None:
    """Exchange the rows of `columns` in `array` until the key rises."""
    order = np.argsort(key, axis=-1)
    for alike in columns.T:
        array[..., alike] = np.take_along_axis(array[..., alike], order, axis=-1)


def with_changes(
    model: Model, sensors: Sensors, free: Iterable[str], fixed: Mapping[str, float]
) -> tuple[Model, Sensors]:
    """Free and fix parameters by name, in the model and the sensors."""
    if not isinstance(sensors, Sensors):
        raise ValidationError(f"sensors is {sensors!r}; expected Sensors(...)")
    if isinstance(free, str) or not isinstance(free, Iterable):
        raise ValidationError(f"free is {free!r}; expected a collection of names: ['{free}']")
    if not isinstance(fixed, Mapping):
        raise ValidationError(
            f"fixed is {fixed!r}; expected a mapping of names to numbers, such as {{'f_max': 0.1}}"
        )
    free = tuple(free)
    if not free and not fixed:
        return model, sensors
    both = set(free) & set(fixed)
    if both:
        raise ModelError(f"{', '.join(sorted(both))} is both in free and in fixed; choose one")
    sensed = {p.name for p in sensors.parameters}
    model = model.with_free([n for n in free if n not in sensed])
    model = model.with_fixed({n: v for n, v in fixed.items() if n not in sensed})
    sensors = sensors.with_free([n for n in free if n in sensed])
    return model, sensors.with_fixed({n: v for n, v in fixed.items() if n in sensed})
