r"""Laws that are parallel elastoplastic (Jenkins) elements, and so follow Masing's rules.

A Jenkins element of stiffness k slips at the displacement d. Loaded from rest, a sum of them has
the force V(x) = sum of k min(x, d), the **backbone curve**. After a reversal each element needs
twice its d to slip in the other direction, so that the force follows V at twice the scale,

    F = F_r + 2 s V(s (x - x_r)/2),

until the inner loop closes; from there on the force follows the outer curve again.
Under x = A cos(theta) partial integration gives, for odd k,

    N_k = F_k/A = (2 j/(pi k)) Int_0^pi V'(A sin^2(theta/2)) sin(theta) exp(-j k theta) dtheta.

**Unique response.** A abs(L + N) rises with A for every passive L (Im L >= 0) where
2 Im N + A Im N' >= A abs(N'). For a Jenkins element that slips both sides are equal, 4 k d/(pi A);
so the inequality holds for a sum of them: the left sides add, the right side is at most their sum.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from dahl_ident.arrays import EPS, ComplexArray, FloatArray, IntArray
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
_ROOT_ROUNDING = 4.0 * EPS  # relative tolerance of a root


class Masing(Friction):
    """Parallel Jenkins elements, defined by the force of a first loading; see the module."""

    one_state = False
    starts = (
        ("initial_load", "", "displacement from rest to the first sample, over that to full slip"),
    )
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
            f"{self!r} does not list its Jenkins elements",
            "it cannot be driven by a force over time: add sliders() and n_states to it, or give "
            "records with measured displacement and force",
        )

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return the total force of the springs, and their rates: 0 for a spring that slips."""
        rates = [
            k * velocity * (k * d - direction * force > 0.0)
            for k, d, force in zip(*self.sliders(values), states, strict=True)
        ]
        return Mechanics(0.0, sum(states), rates)

    def initial_states(self, values: Sequence[Any], starts: Sequence[Any]) -> Sequence[Any]:
        """Return the springs' forces on the backbone curve, loaded from rest."""
        stiffnesses, slips = self.sliders(values)
        x = starts[0] * slips[-1]
        return [k * clipped(x, d) for k, d in zip(stiffnesses, slips, strict=True)]

    def start_with(self, values: Sequence[Any], force: float) -> float:
        """Return the displacement on the backbone curve for a force, over that to full slip."""
        from scipy.optimize import brentq

        at = [np.asarray(v, dtype=np.float64) for v in values]
        full_slip = float(self.knee(at)[1])
        if abs(force) >= float(self.force_limits(at)[0]):
            return float(np.sign(force))

        def excess(load: float) -> float:
            return float(self.backbone(at, np.asarray(load * full_slip))) - abs(force)

        return float(np.sign(force) * brentq(excess, 0.0, 1.0, xtol=1e-300, rtol=_ROOT_ROUNDING))

    def start_bounds(self, values: Values) -> tuple[float, float]:
        """Return the bounds of a load, just below slip: at slip a spring forgets its load."""
        return -_NEARLY_SLIPS, _NEARLY_SLIPS

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample by Masing's rules, exactly; arguments are not checked.

        The element has come from rest along the backbone curve; `state` is its load on that curve.
        """
        if slopes:
            return self._differences(values, path, state)
        at = [np.asarray(v, dtype=np.float64) for v in values]
        start = state * float(self.knee(at)[1])
        u = path.displacement - path.displacement[0] + start
        origins, parents, headings, path_of = _paths(u)

        def along(x: FloatArray, path: IntArray) -> FloatArray:
            """Return the force added on a path from its origin to x."""
            moved = x - origins[path]
            scale = np.where(path == 0, 1.0, 2.0)
            sign = np.where(path == 0, np.sign(moved), headings[path])
            return np.asarray(scale * sign * self.backbone(at, np.abs(moved) / scale))

        forces = along(origins, parents).tolist()
        forces[0] = 0.0
        for number, parent in enumerate(parents.tolist()):
            if parent:
                forces[number] += forces[parent]
        force = np.asarray(forces)[path_of] + along(u, path_of)
        return HistoryGradient(force, np.ones(force.shape), ())

    def _differences(self, values: Sequence[Any], path: Path, state: float) -> HistoryGradient:
        """Return the force, and central differences with respect to the state and every value."""
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

    def has_harmonic(self, harmonic: int) -> bool:
        """Return whether the harmonic is odd, because both directions are alike."""
        return harmonic % 2 == 1

    def force_limits(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the sum of all slip forces, for both directions."""
        limit = self.backbone(values, np.asarray(2.0 * self.knee(values)[1]))
        return limit, limit

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


def _paths(
    u: FloatArray,
) -> tuple[FloatArray, IntArray, FloatArray, IntArray]:
    """Return the paths of Masing's rules along displacements that begin on the backbone curve.

    Path 0 is the backbone curve. Every other path begins at a reversal, on an earlier path, its
    parent. Returns origin, parent and direction of each path, and the path of each displacement.
    """
    origins, parents, headings = [0.0], [0], [1.0]
    path_of = np.zeros(u.size, dtype=np.intp)
    open_paths: list[int] = []  # begun and not yet closed, outermost first
    cut = stretches(u)
    first = 0
    for heading, last in zip(cut.direction.tolist(), np.cumsum(cut.samples) - 1, strict=True):
        stop = min(int(last) + 1, u.size - 1)
        here = float(u[first])
        if open_paths or heading * here < 0.0:
            parents.append(open_paths[-1] if open_paths else 0)
            open_paths.append(len(origins))
            origins.append(here)
            headings.append(heading)
        first += 1
        while open_paths and first <= stop:
            # a path ends where the one before it began, the first one opposite to its own origin
            path = open_paths[-1]
            limit = origins[open_paths[-2]] if len(open_paths) > 1 else -origins[path]
            inside = np.searchsorted(heading * u[first : stop + 1], heading * limit, side="right")
            path_of[first : first + inside] = path
            first += int(inside)
            if first <= stop:
                del open_paths[-2:]
        first = stop
    return np.asarray(origins), np.asarray(parents), np.asarray(headings), path_of


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
