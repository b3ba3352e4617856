"""Checks of a law that a user has written, made when it is first used.

They concern the declared parameters, what ``slope`` returns, and the loop that follows from it;
those of :mod:`dahl_ident.elements.equations` the slope in symbols. If a parameter has no value,
several sets of values are tried, and a slope is refused only if it fails at all of them.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from keyword import iskeyword
from numbers import Real
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.force_law import ForceLaw
from dahl_ident.elements.parameter import UNITS, Parameter
from dahl_ident.errors import ModelError, ValidationError

TRIALS = 12  # sets of values
SPREAD = 0.5  # decades to either side of a typical value
_MAGNITUDES = np.geomspace(1e-12, 1e12, 481)  # N
_REST = len(_MAGNITUDES)  # index of force 0, after all negative ones
_FRACTIONS = np.linspace(0.0, 1.0, 201)  # of the largest force in each direction
_LARGEST_FORCE = 1e3  # times the scale: the largest force of a law without full slip
_FAR_BEYOND = 1e3  # times full slip: up to there a slope that is positive again is a fault
_EXCEEDED = 1.001  # of the force of full slip, which stages of an integrator may exceed
_OVERFLOW = 1e6  # times the slope at rest: a law that hardens so far has no full slip
_ZOOMS = 8  # by 64 each, towards the largest slope; then forces differ by rounding only
_CHANGED = 0.1  # of the slope at rest: the force at which it has changed so much is the scale
_SLOPE_ROUNDING = 1e-9  # of the largest slope
_LOOP = 0.98  # of the force of full slip: the largest force of a loop
_LOOP_WITHOUT_SLIP = 2.94  # times the scale: the same for a law without full slip
_CREATED = 0.01  # of the work in both directions: energy that integration may create
_FORCE_UNIT = 32.0  # N, a unit in which a law has the same form; a power of 2 changes no digit
_OVERRIDDEN = {"rest_stiffness": 1, "force_limits": 2, "force_bounds": 2, "knee": 2}
"""Methods that a law may override, and how many arrays each returns."""
_RESERVED = ("name", "kind", "element")  # keys of an element in files

_CHECKED: WeakKeyDictionary[type, set[tuple[Parameter, ...]]] = WeakKeyDictionary()
_SCALING: WeakKeyDictionary[type, tuple[str, ...]] = WeakKeyDictionary()


class _SlopeLaw(Protocol):
    """What is asked of a friction law here."""

    parameters: tuple[Parameter, ...]
    rate_independent: bool
    one_state: bool

    @property
    def n_states(self) -> int: ...

    def label(self, parameter: Parameter) -> str: ...

    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any: ...


def is_of_package(law: type) -> bool:
    """Return whether a class belongs to this package."""
    return law.__module__.partition(".")[0] == "dahl_ident"


def check_declarations(law: type[ForceLaw]) -> None:
    """Refuse parameters that are not declared as they should be."""
    if is_of_package(law):
        return
    name = law.__name__
    declared: Any = law.parameters  # whatever a user wrote
    if not isinstance(declared, tuple) or not all(isinstance(p, Parameter) for p in declared):
        raise ValidationError(
            f"{name}.parameters is {declared!r}; expected a tuple of di.Parameter(...), such as "
            '(di.Parameter("f_max", "N", "friction limit", lower=0.0, transform="log"),)'
        )
    if hasattr(law, "states"):
        raise ValidationError(
            f"{name} declares states = {law.states!r}; a law has one state, its force. Write it as "
            "dF/dx = slope(force, ...), and add laws in parallel where several forces are needed"
        )
    for p in declared:
        for holds, fault in _requirements(p):
            if not holds:
                raise ValidationError(f"{name}: {fault}")
    for label, count in Counter(p.name for p in declared).items():
        if count > 1:
            raise ValidationError(
                f"{name} declares the parameter {label} {count} times; give each its own name"
            )


def _requirements(p: Any) -> Iterator[tuple[bool, str]]:
    """Yield whether what a user declared as a parameter is sound, and the fault if it is not."""
    usable = isinstance(p.name, str) and p.name.isidentifier() and not iskeyword(p.name)
    yield (
        usable and p.name not in _RESERVED,
        f"a parameter called {p.name!r}; expected letters, digits and underscores, such as "
        f"'f_max', no word of Python, and none of {', '.join(_RESERVED)}",
    )
    for what, text in {"unit": p.unit, "description": p.description}.items():
        fault = f"the {what} of {p.name} is {text!r}; expected text, such as 'N/m'"
        yield isinstance(text, str), fault
    for what, pair in {"bounds": (p.lower, p.upper), "prior": p.prior or (0, 1)}.items():
        is_pair = isinstance(pair, tuple) and len(pair) == 2
        rises = is_pair and all(isinstance(x, Real) for x in pair) and pair[0] < pair[1]
        yield rises, f"{p.name} has the {what} {pair!r}; expected two numbers, the lower one first"
    yield (
        isinstance(p.scan, tuple) and all(isinstance(x, Real) for x in p.scan),
        f"{p.name} has the scan {p.scan!r}; expected a tuple of numbers, such as (0.5, 1.0, 2.0)",
    )
    for value in p.scan:
        fault = f"{p.name} is scanned at {value:g}, which is outside its bounds"
        yield p.lower <= value <= p.upper, fault
    yield (
        p.transform in ("log", "linear"),
        f"the transform of {p.name} is {p.transform!r}; expected 'log' or 'linear'",
    )
    side, limit = ("lower", p.lower) if -np.inf < p.lower < 0.0 else ("upper", p.upper)
    yield (
        not p.positive or (side == "upper" and limit > 0.0),
        f"{p.name} is searched by its logarithm, but its {side} bound is {limit:g}; expected "
        'lower=0.0 or more, or transform="linear"',
    )
    yield (
        p.is_mechanical,
        f"the unit of {p.name} is {p.unit!r}; expected a product of powers of {', '.join(UNITS)}, "
        "such as 'N/m' or 'N s/m', or '' for a pure number",
    )


def check_slope(law: _SlopeLaw) -> None:
    """Refuse a law whose slope cannot be that of a friction law."""
    if is_of_package(type(law)) or not law.one_state:
        return
    if law.n_states != 1:
        raise ModelError(
            f"{type(law).__name__} has {law.n_states} states; expected one, the force: leave "
            "n_states out, and add laws in parallel with +"
        )
    parameters = law.parameters
    checked = _CHECKED.setdefault(type(law), set())
    if parameters in checked:
        return
    rng = np.random.default_rng(0)
    count = 1 if all(p.value is not None for p in parameters) else TRIALS
    columns = [trial_values(p, rng, count) for p in parameters]
    trials = [_Trial(law, values) for values in np.reshape(columns, (len(columns), count)).T]
    for check in (_Trial.up_to_slip, _Trial.constant, _Trial.energy, _Trial.without_slip):
        objections = [check(trial) for trial in trials]
        if all(objections):
            raise ModelError(f"{type(law).__name__}.slope {objections[0]}")
    _check_overridden(law, columns)
    checked.add(parameters)


def _check_overridden(law: _SlopeLaw, values: list[FloatArray]) -> None:
    """Refuse an overridden method that does not return as many arrays as the original."""
    for method, count in _OVERRIDDEN.items():
        if is_of_package(next(c for c in type(law).__mro__ if method in vars(c))):
            continue
        name, arrays = f"{type(law).__name__}.{method}", "an array" if count == 1 else "two arrays"
        try:
            with np.errstate(all="ignore"):
                returned: Any = getattr(law, method)(values)
        except Exception as exc:  # whatever a user's code raises
            raise ModelError(f"{name} failed: {explanation(exc)}") from exc
        parts = (returned,) if count == 1 else returned
        complete = isinstance(parts, tuple) and len(parts) == count
        if not complete or any(np.asarray(part).dtype.kind not in "fiu" for part in parts):
            raise ModelError(
                f"{name} returned {short_repr(returned)}; expected {arrays} of real numbers, one "
                "for each set of values: end it with return"
            )


def scaling_the_force(law: _SlopeLaw) -> tuple[str, ...]:
    """Return the labels of the parameters with a unit of force, which together scale the force.

    Empty if the slope does not agree with the units.
    """
    if type(law) not in _SCALING:
        labels = tuple(law.label(p) for p in law.parameters if p.dimension[0])
        _SCALING[type(law)] = labels if _agrees_with_units(law) else ()
    return _SCALING[type(law)]


def _agrees_with_units(law: _SlopeLaw) -> bool:
    """Return whether the slope scales with the force and all parameters with a unit of force."""
    powers = [p.dimension[0] for p in law.parameters]
    if not set(powers) <= {0, 1}:
        return False
    rng = np.random.default_rng(2)
    values = [trial_values(p, rng, TRIALS) for p in law.parameters]
    force = rng.uniform(-1.0, 1.0, TRIALS) * 10.0 ** rng.uniform(-3.0, 3.0, TRIALS)
    direction = np.resize([1.0, -1.0], TRIALS)
    speed = None if law.rate_independent else direction * rng.uniform(0.1, 1.0, TRIALS)
    scaled = [v * _FORCE_UNIT**power for v, power in zip(values, powers, strict=True)]
    try:
        with np.errstate(all="ignore"):
            slope = np.asarray(law.slope(force, direction, speed, values))
            rescaled = np.asarray(law.slope(_FORCE_UNIT * force, direction, speed, scaled))
    except Exception as exc:  # not seen with one set of values, such as an if on a value
        raise ModelError(
            f"{type(law).__name__}.slope failed for arrays of {TRIALS} forces and of {TRIALS} "
            f"of each value: {explanation(exc)}"
        ) from exc
    return bool(np.allclose(rescaled, _FORCE_UNIT * slope, rtol=1e-12, atol=0.0, equal_nan=True))


class _Trial:
    """A law's slope at one set of values."""

    def __init__(self, law: _SlopeLaw, values: FloatArray) -> None:
        self._law = law
        self._values = values
        # forces in the direction of motion, and the slopes there for both directions
        self._forces = np.concatenate([-_MAGNITUDES[::-1], [0.0], _MAGNITUDES])
        self._slopes = [self._slope(s * self._forces, s) for s in (1.0, -1.0)]
        ahead = self._slopes[0][_REST:]
        self._rest_slope = ahead[0]
        both = zip((1.0, -1.0), self._slopes, strict=True)
        self._limits = [self._limit(direction, slopes) for direction, slopes in both]
        with np.errstate(all="ignore"):
            changed = np.abs(ahead / self._rest_slope - 1.0) > _CHANGED
        first = self._forces[_REST + changed.argmax()] if changed.any() else np.inf
        scale = min(first, *self._limits)
        self._scale = float(scale) if math.isfinite(scale) else 1.0

    def _where(self, force: float, direction: float) -> str:
        """Return force, direction and parameters in words."""
        where = [f"force = {force + 0.0:.4g} N", f"direction = {direction:+g}"]
        return f"at {', '.join([*where, *self._values_in_words()])}"

    def _values_in_words(self) -> list[str]:
        pairs = zip(self._law.parameters, self._values.tolist(), strict=True)
        return [f"{p.name} = {v:.4g}" for p, v in pairs]

    def _slope(self, force: FloatArray, direction: float) -> FloatArray:
        """Return dF/dx at a row of forces; refuse results of a wrong type or shape."""
        name, rate_independent = f"{type(self._law).__name__}.slope", self._law.rate_independent
        force = force[None]
        heading = np.full(force.shape, direction)
        arguments = f"an array of {force.shape} forces, and {len(self._values)} values"
        try:
            returned = self._call(force, heading, None if rate_independent else 0.0)
        except Exception as exc:  # whatever a user's code raises
            if rate_independent and self._works_with_velocity(force, heading):
                raise ModelError(
                    f"{name} failed without a velocity ({exc}); a law that uses the velocity must "
                    "declare rate_independent = False"
                ) from exc
            raise ModelError(f"{name} failed for {arguments}: {explanation(exc)}") from exc
        if returned is None:
            raise ModelError(f"{name} returned None; expected dF/dx, N/m: end it with return")
        array: NDArray[Any] = np.asarray(returned)
        if array.dtype.kind not in "fiub":
            raise ModelError(
                f"{name} returned {short_repr(returned)}, numbers of type {array.dtype}; expected "
                "dF/dx, N/m, as real numbers"
            )
        try:
            return np.asarray(np.broadcast_to(array.astype(np.float64), force.shape)[0])
        except ValueError:
            raise ModelError(
                f"{name} returned the shape {array.shape} for {arguments}; expected "
                f"{force.shape}, one number for each force"
            ) from None

    def _call(self, force: FloatArray, direction: FloatArray, velocity: float | None) -> Any:
        with np.errstate(all="ignore"):
            values = [np.full((1, 1), v) for v in self._values]
            return self._law.slope(force.copy(), direction, velocity, values)

    def _works_with_velocity(self, force: FloatArray, direction: FloatArray) -> bool:
        try:
            self._call(force, direction, 0.0)
        except Exception:  # whatever a user's code raises
            return False
        return True

    def _limit(self, direction: float, slopes: FloatArray) -> float:
        """Return the force in the direction of motion at which the slope ceases to be positive.

        inf if there is none.
        """
        forces, ahead = self._forces[_REST:], slopes[_REST:]
        with np.errstate(invalid="ignore"):
            stops = np.flatnonzero(~((ahead > 0.0) & (ahead < np.inf)))
        before = ahead[: stops[0]] if stops.size else ahead
        if not stops.size or (before.size and before[-1] > _OVERFLOW * before[0]):
            return np.inf
        low, high = forces[max(0, stops[0] - 1)], forces[stops[0]]
        for _ in range(4):
            between = np.linspace(low, high, 33)
            with np.errstate(invalid="ignore"):
                positive = self._slope(direction * between, direction) > 0.0
            stop = 32 if positive.all() else max(int(positive.argmin()), 1)
            low, high = between[stop - 1], between[stop]
        return float(high)

    def up_to_slip(self) -> str:
        """Return the objection to the slope up to full slip; without it, up to the scale."""
        ends = [limit if math.isfinite(limit) else self._scale for limit in self._limits]
        return self._objection([end * _FRACTIONS for end in ends])

    def without_slip(self) -> str:
        """Return the objection to the slope at larger forces, for laws without full slip."""
        if np.isfinite(self._limits).all():
            return ""
        return self._objection([self._reachable(0), self._reachable(1)])

    def _objection(self, reachable: list[FloatArray]) -> str:
        """Return the objection to the slope at the forces that are reached in each direction."""
        for side, direction in enumerate((1.0, -1.0)):
            # after a reversal, those of the other direction
            ahead, behind = reachable[side], reachable[1 - side]
            forces = np.concatenate([-behind[:0:-1], ahead, _EXCEEDED * ahead[-1:]])
            slopes = self._slope(direction * forces, direction)
            steepest, peak = self._peak(forces, slopes, direction)
            objection = self._not_finite(
                np.append(steepest, forces), np.append(peak, slopes), direction
            ) or self._not_positive(forces, slopes, side, direction)
            if objection:
                return objection
        return ""

    def _reachable(self, side: int) -> FloatArray:
        """Return the forces that are reached in one direction, from 0.

        Up to full slip; without it, at growing distances, until the slope in one direction
        overflows.
        """
        limit, scale = self._limits[side], self._scale
        if math.isfinite(limit):
            return _FRACTIONS * limit
        before, after = self._slopes[side][_REST + 1 :], self._slopes[1 - side][_REST - 1 :: -1]
        with np.errstate(invalid="ignore"):
            steepest = np.maximum(np.abs(before), np.abs(after))
            wild = ~(steepest < _OVERFLOW * self._rest_slope) & (scale < _MAGNITUDES)
        farthest = np.where(wild, _MAGNITUDES, _LARGEST_FORCE * scale).min()
        return np.asarray(scale * np.expm1(_FRACTIONS * np.log1p(farthest / scale)))

    def _peak(
        self, forces: FloatArray, slopes: FloatArray, direction: float
    ) -> tuple[float, float]:
        """Return the force at which the slope is largest, and the slope there; inf at a pole."""
        ends, gaps = (forces[0], forces[-1]), np.pad(np.diff(forces), 1)
        widths = np.maximum(gaps[:-1], gaps[1:])
        second_largest = np.sort(np.abs(slopes))[-2]  # the largest may be at a pole
        for _ in range(_ZOOMS):
            largest = np.argmax(np.abs(slopes))
            force, peak, width = forces[largest], slopes[largest], widths[largest]
            forces = np.clip(force + width * np.linspace(-1.0, 1.0, 129), *ends)
            slopes = self._slope(direction * forces, direction)
            widths = np.full(forces.shape, width / 64.0)
        return force, np.inf if abs(peak) > _OVERFLOW * second_largest else peak

    def _not_finite(self, forces: FloatArray, slopes: FloatArray, direction: float) -> str:
        wrong = np.flatnonzero(~np.isfinite(slopes))
        if not wrong.size:
            return ""
        first = wrong[np.argmin(np.abs(forces[wrong]))]
        return (
            f"is {slopes[first]} {self._where(direction * forces[first], direction)}; expected a "
            "finite number for every force up to full slip, also after the direction has changed, "
            "and a little beyond it, as from np.sign(m) * np.abs(m)**alpha with "
            "m = 1 - direction*force/f_max"
        )

    def _not_positive(
        self, forces: FloatArray, slopes: FloatArray, side: int, direction: float
    ) -> str:
        """Return the objection to a negative slope at smaller forces than a positive one."""
        if not self._rest_slope > 0.0:
            where = self._where(0.0, direction)
            return (
                f"is {self._rest_slope:.4g} N/m {where}; expected a positive slope at rest and "
                "up to full slip"
            )
        smallest = _SLOPE_ROUNDING * np.max(np.abs(slopes))
        limit, farther = self._limits[side], self._forces
        beyond = (farther > limit) & (farther < _FAR_BEYOND * limit)
        forces = np.concatenate([forces, farther[beyond]])
        slopes = np.concatenate([slopes, self._slopes[side][beyond]])
        with np.errstate(invalid="ignore"):
            negative = np.flatnonzero(slopes < -smallest)
            positive = np.flatnonzero(slopes > smallest)
        negative = negative[negative < positive.max(initial=-1)]
        if not negative.size:
            return ""
        worst = negative[np.argmin(slopes[negative])]
        return (
            f"is {slopes[worst]:.4g} N/m, negative before full slip, "
            f"{self._where(direction * forces[worst], direction)}, and positive again at larger "
            "forces; expected a positive slope until full slip, also after the direction has "
            "changed"
        )

    def constant(self) -> str:
        """Return the objection to a slope that is the same for all forces and directions."""
        slopes = np.concatenate(self._slopes)
        slopes = slopes[np.isfinite(slopes)]  # forces far beyond full slip may overflow
        same = slopes.size and np.ptp(slopes) <= _SLOPE_ROUNDING * np.max(np.abs(slopes))
        if not (same and self._law.rate_independent):
            return ""
        return (
            f"is {slopes[0]:.4g} N/m for every force and direction: a constant number, which "
            "is a spring without friction; expected a slope that depends on force and "
            "direction (np.max takes the largest of a whole array, np.maximum of each), or use "
            "di.Spring"
        )

    def energy(self) -> str:
        """Return the objection to a loop between two forces that creates energy.

        In each direction, dx = dF/slope.
        """
        ends = [
            _LOOP * limit if math.isfinite(limit) else _LOOP_WITHOUT_SLIP * self._scale
            for limit in self._limits
        ]
        upper, lower = ends[0] * _FRACTIONS, -ends[1] * _FRACTIONS
        with np.errstate(all="ignore"):
            gap, work, size = self._integrals(upper)
            lower_gap, lower_work, lower_size = self._integrals(lower)
            # the loop closes where both directions need the same displacement
            closes = np.diff(np.sign(lower_gap - gap[:, None]), axis=1) != 0.0
            turn = 1 + closes.argmax(axis=1)
            lost = work - lower_work[turn]
            created = -lost / (size + np.abs(lower_size[turn]))
        created[~closes.any(axis=1)] = -np.inf
        created[0] = -np.inf
        worst = int(np.nanargmax(created))
        if not created[worst] > _CREATED:
            return ""
        return (
            f"creates energy: {-lost[worst]:.3g} J in each cycle between "
            f"{lower[turn[worst]]:.3g} and {upper[worst]:.3g} N, at "
            f"{', '.join(self._values_in_words())}; expected a loop that loses energy: the slope "
            "after a reversal must not be below that before it"
        )

    def _integrals(self, force: FloatArray) -> FloatArray:
        """Return three integrals from rest to each force, over both directions of motion.

        Of the difference in displacement, the difference in work, and the sum of the work's sizes.
        """
        from scipy.integrate import cumulative_trapezoid

        rising, falling = (1.0 / self._slope(force, s) for s in (1.0, -1.0))
        parts = (rising - falling, force * (rising - falling), np.abs(force) * (rising + falling))
        return np.asarray(cumulative_trapezoid(parts, force, initial=0))


def trial_values(parameter: Parameter, rng: np.random.Generator, count: int) -> FloatArray:
    """Return trial values of a parameter: its own if it is fixed, else some within its range."""
    if parameter.value is not None and (not parameter.free or count == 1):
        return np.full(count, float(parameter.value))
    if parameter.scan:
        return np.resize(np.asarray(parameter.scan, dtype=np.float64), count)
    low, high = parameter.prior or (parameter.lower, parameter.upper)
    spread = 10.0 ** rng.uniform(-SPREAD, SPREAD, count)
    if math.isfinite(low) and math.isfinite(high):
        share = rng.uniform(0.05, 0.95, count)
        if parameter.positive and low > 0.0:
            return np.asarray(low * (high / low) ** share)
        return np.asarray(low + share * (high - low))
    if parameter.value is not None:
        return np.clip(parameter.value * spread, low, high)
    if math.isfinite(low):
        return np.asarray(low + (abs(low) or 1.0) * spread)
    if math.isfinite(high):
        return np.asarray(high - (abs(high) or 1.0) * spread)
    return np.asarray(spread)


def explanation(exc: Exception) -> str:
    """Return why a user's code failed, and what to write instead."""
    text = " ".join(str(exc).split())
    if "truth value" in text:
        return (
            "it asks a Python question of arrays (if, and, or, not, min, max); write comparisons "
            "as factors, such as stiffness * (direction * force < f_max), or np.where"
        )
    if re.search("operand type.* for (&|\\||unary ~)", text):
        return (
            "it joins comparisons by &, | or ~; write np.logical_and(a, b), np.logical_or(a, b) "
            "and np.logical_not(a), which work on arrays"
        )
    return (
        f"{type(exc).__name__}: {text[:200]}; expected plain arithmetic and numpy's functions, "
        "which work on arrays"
    )


def short_repr(value: Any) -> str:
    """Return what Python shows of a value, at most 40 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 40 else f"{text[:40]}..."
