r"""Laws that are parallel elastoplastic (Jenkins) elements, and so follow Masing's rules.

A Jenkins element of stiffness k slips at the displacement d. Loaded from rest, any sum of them has
the force V(x) = sum of k min(x, d), the **backbone curve**. After a reversal each element needs
twice its d to slip the other way, so that the force follows V at twice the scale,

    F = F_r + 2 s V(s (x - x_r)/2),

until the inner loop closes; from there on the force follows the outer curve again.
Under x = A cos(theta) partial integration gives, for odd k,

    N_k = F_k/A = (2 j/(pi k)) Int_0^pi V'(A sin^2(theta/2)) sin(theta) exp(-j k theta) dtheta.

**Unique response.** A abs(L + N) rises with A for every passive L (Im L >= 0) where
2 Im N + A Im N' >= A abs(N'). A Jenkins element has equality while it slips, both sides being
4 k d/(pi A), and a sum of them keeps it: the left sides add, the right side is at most their sum.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.facts import (
    STEP,
    HistoryGradient,
    Mechanics,
    Path,
    Values,
    clipped,
    difference,
)
from dahl_ident.elements.friction import Friction
from dahl_ident.elements.recursion import stretches
from dahl_ident.errors import ModelError

_SERIES = 0.1  # angle below which y - sin(y) loses digits
_NEARLY_SLIPS = 1.0 - 1e-6
_BISECTIONS = 200  # more than a number has digits


class Masing(Friction):
    """Parallel Jenkins elements, defined by the force of a first loading; see the module."""

    one_state = False
    starts = (("initial_load", "", "way from rest to the first sample, over that to full slip"),)
    unique_response = True

    @abstractmethod
    def backbone(self, values: Values, displacement: FloatArray) -> FloatArray:
        """Return V(x), the force when first loaded from rest to x >= 0, N."""

    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Raise ModelError: the force alone does not determine the slope."""
        raise ModelError(
            f"{self!r} remembers more than its present force, so it has no slope dF/dx(F); use "
            "a law with one state, such as Dahl or BoucWen"
        )

    def sliders(self, values: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any]]:
        """Return stiffnesses and rising slip displacements of the Jenkins elements.

        In plain arithmetic; as many as :attr:`n_states`.
        """
        raise ModelError(
            f"{self!r} says of no Jenkins elements what it consists of, so it cannot be driven by "
            "a force over time; add sliders() and n_states to it, or give records with measured "
            "displacement and force"
        )

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return the springs' forces, and their changes: none for a spring that slips."""
        rates = [
            k * velocity * (k * d - direction * force > 0.0)
            for k, d, force in zip(*self.sliders(values), states, strict=True)
        ]
        return Mechanics(0.0, sum(states), rates)

    def initial_states(self, values: Sequence[Any], starts: Sequence[Any]) -> Sequence[Any]:
        """Return the springs' forces on the backbone curve, loaded from rest."""
        stiffnesses, slips = self.sliders(values)
        way = starts[0] * slips[-1]
        return [k * clipped(way, d) for k, d in zip(stiffnesses, slips, strict=True)]

    def start_with(self, values: Sequence[Any], force: float) -> float:
        """Return the way along the backbone curve to a force, over that to full slip."""
        at = [np.asarray(v, dtype=np.float64) for v in values]
        return float(np.sign(force) * self._loaded_to(at, abs(force)) / self.knee(at)[1])

    def start_bounds(self, values: Values) -> tuple[float, float]:
        """Return those of loads, just below slip: at slip a spring forgets its load."""
        return -_NEARLY_SLIPS, _NEARLY_SLIPS

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample by Masing's rules, exactly, unchecked.

        The element comes from rest along the backbone curve; `state` is its load there.
        """
        if slopes:
            return self._differences(values, path, state)
        at = [np.asarray(v, dtype=np.float64) for v in values]
        x = path.displacement
        start = state * float(self.knee(at)[1])
        begun = np.sign(start) * self.backbone(at, np.abs(start))
        if x.size < 2:
            return HistoryGradient(np.full(x.shape, begun), np.ones(x.shape), ())
        u = x - x[0] + start
        paths = _Paths(start)
        cut = stretches(x)
        first = 0
        for heading, last in zip(cut.heading.tolist(), np.cumsum(cut.samples) - 1, strict=True):
            stop = min(last + 1, u.size - 1)
            paths.follow(u[first + 1 : stop + 1], heading)
            first = stop
        force = np.append(begun, paths.force(lambda x: self.backbone(at, x)))
        return HistoryGradient(force, force, ())

    def _differences(self, values: Sequence[Any], path: Path, state: float) -> HistoryGradient:
        """Return the force with central differences by the state and every value."""
        numbers = [state, *(float(v) for v in values)]

        def force(i: int, number: float) -> FloatArray:
            moved = [*numbers[:i], number, *numbers[i + 1 :]]
            return self.history(moved[1:], path, moved[0], slopes=False).value

        value = force(0, state)
        largest = self.start_with(numbers[1:], float(np.max(np.abs(value), initial=0.0)))
        by_state, *by = (
            difference(partial(force, i), number, STEP * ((abs(number) if i else largest) or 1.0))
            for i, number in enumerate(numbers)
        )
        return HistoryGradient(value, by_state, tuple(by))

    def _loaded_to(self, values: Values, force: float) -> float:
        """Return where the backbone curve has a force, by bisection."""
        low = high = force / float(self.rest_stiffness(values))
        farthest = 1e6 * high  # full slip, to rounding
        while float(self.backbone(values, np.asarray(high))) < force * (1.0 - 1e-15):
            low, high = high, 2.0 * high
            if high > farthest:
                break
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            if not low < middle < high:
                break
            below = float(self.backbone(values, np.asarray(middle))) < force
            low, high = (middle, high) if below else (low, middle)
        return high

    def answers(self, harmonic: int) -> bool:
        """Return whether the harmonic is odd: both directions are alike."""
        return harmonic % 2 == 1

    def force_limits(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the sum of all slip forces, for both directions."""
        top = self.backbone(values, np.asarray(2.0 * self.knee(values)[1]))
        return top, top

    def force_bounds(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the stiffness at rest, and 4/pi of the force limit.

        A Jenkins element's abs(N) falls with the amplitude.
        """
        return self.rest_stiffness(values), 4.0 / np.pi * self.force_limits(values)[0]

    def transient_decay(
        self, values: Values, amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return 0: the first full swing erases the history."""
        return np.zeros(np.broadcast_shapes(np.shape(amplitude), np.shape(omega)))

    def _top(self, values: Sequence[float], amplitude: float) -> float:
        return float(self.backbone([np.asarray(v) for v in values], np.asarray(amplitude)))


class _Paths:
    """Masing's rules over displacements u, counted from where the backbone curve begins.

    Each path begins at a reversal, or at the origin of the backbone curve; a reversal lies on the
    path before it. Forces follow at the end, from the backbone curve at all places at once.
    """

    def __init__(self, start: float) -> None:
        self._origin = [0.0]  # of each path
        self._parent = [0]  # the path on which each path's origin lies
        self._heading = [1.0]
        self._open: list[int] = []  # paths that have been left and not yet closed, outermost first
        self._on = 0
        self._here = start
        self._path_of: list[np.ndarray[Any, Any]] = []
        self._places: list[FloatArray] = []

    def follow(self, places: FloatArray, heading: float) -> None:
        """Move on in one direction through some places."""
        on_backbone = not self._open
        if not (on_backbone and (self._here == 0.0 or heading * self._here > 0.0)) and (
            on_backbone or heading != self._heading[self._open[-1]]
        ):
            self._origin.append(self._here)
            self._parent.append(self._open[-1] if self._open else 0)
            self._heading.append(heading)
            self._open.append(len(self._origin) - 1)
        path_of = np.zeros(places.size, dtype=np.intp)
        begin = 0
        while begin < places.size:
            if not self._open:
                break
            # a path ends where the one before it began; the first one mirrors its own origin
            path = self._open[-1]
            limit = self._origin[self._open[-2]] if len(self._open) > 1 else -self._origin[path]
            inside = int(np.searchsorted(heading * places, heading * limit, side="right"))
            path_of[begin:inside] = path
            begin = max(begin, inside)
            if begin < places.size:
                del self._open[-2:]
        self._path_of.append(path_of)
        self._places.append(places)
        self._here = float(places[-1])

    def force(self, backbone: Any) -> FloatArray:
        """Return the force at all places."""
        origin, parent = np.asarray(self._origin), np.asarray(self._parent)
        heading = np.asarray(self._heading)

        def beyond(place: FloatArray, path: Any) -> FloatArray:
            first = path == 0
            scale = np.where(first, 1.0, 2.0)
            moved = place - origin[path]
            sign = np.where(first, np.sign(moved), heading[path])
            return np.asarray(scale * sign * backbone(np.abs(moved) / scale))

        forces = beyond(origin, parent).tolist()
        forces[0] = 0.0
        for path in range(1, len(forces)):
            if self._parent[path]:
                forces[path] += forces[self._parent[path]]
        path_of = np.concatenate(self._path_of)
        return np.asarray(
            np.asarray(forces)[path_of] + beyond(np.concatenate(self._places), path_of)
        )


def jenkins(ratio: FloatArray, harmonic: int) -> tuple[ComplexArray, ComplexArray]:
    """Return N_k of a Jenkins element of unit stiffness, and its derivative.

    Examples
    --------
    >>> print(f"{3.0 * jenkins(np.asarray(1.0 / 1.3), 1)[0]:.7f}")
    2.4762675+0.6780566j
    """
    k, m = harmonic, np.asarray(ratio, dtype=np.float64)
    if k % 2 == 0:
        zero = np.zeros(m.shape, dtype=np.complex128)
        return zero, zero
    slips = m < 1.0
    m = np.where(slips, m, 1.0)
    t = 2.0 * np.arcsin(np.sqrt(m))
    if k == 1:
        y = 2.0 * t
        z = np.minimum(y, 2.0 * _SERIES) ** 2
        series = y**3 / 6.0 * (1.0 - z / 20.0 * (1.0 - z / 42.0 * (1.0 - z / 72.0)))
        real = np.where(t < _SERIES, series, y - np.sin(y)) / (2.0 * np.pi)
        value = real + 4j / np.pi * m * (1.0 - m)
    else:
        a, b = k - 1, k + 1
        real = np.sin(b * t / 2.0) ** 2 / b - np.sin(a * t / 2.0) ** 2 / a
        imag = 0.5 * (np.sin(b * t) / b - np.sin(a * t) / a)
        value = 2j / (np.pi * k) * (real + 1j * imag)
    by_ratio = 4j / (np.pi * k) * np.exp(-1j * k * t)
    stuck = 1.0 if k == 1 else 0.0
    return np.where(slips, value, stuck), np.where(slips, by_ratio, 0.0)
