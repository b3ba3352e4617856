r"""A gap in the link to a friction element.

The link carries no force while the gap is crossed. After a reversal the element unloads along its
own curve to zero force; the gap is crossed; then the element continues on its curve. So the
element moves with the amplitude A - gap/2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import KINDS, Element, class_named
from dahl_ident.elements.facts import (
    Asymptote,
    Combination,
    HistoryGradient,
    Mechanics,
    Path,
    Values,
    clipped,
)
from dahl_ident.elements.force_law import prefixed
from dahl_ident.elements.friction import Friction
from dahl_ident.elements.held_motion import loops_of
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError

if TYPE_CHECKING:
    from dahl_ident.engine import Settled

_CLOSED_GAP = 1e-9  # gap over the smallest amplitude, in the limit of no gap
_NARROWEST = 1e-9  # gap over the path: the crossing of a narrower gap is not resolved


class Backlash(Friction):
    """A gap in series with a rate-independent friction element, crossed at zero force.

    Parameters
    ----------
    element : Friction
        The law behind the gap, such as ``Dahl()``; its parameters and its name are kept.
    gap : float, optional
        The play between the two contacts, m (rad in rotation); half of it is lost from the
        element's amplitude. Given: fixed; left out: free.

    Raises
    ------
    ModelError
        If `element` is not friction with one state, or depends on the rate.
    ValidationError
        If `gap` is not a number above zero.

    Notes
    -----
    At amplitudes up to gap/2 the force is zero. A history starts in the middle of the gap, or in
    contact if it starts with a force.

    Examples
    --------
    >>> from dahl_ident import Backlash, Dahl
    >>> law = Backlash(Dahl(f_max=1.0, sigma=3.0), gap=0.8)
    >>> print(f"{law.describing_function(2.0):.7f}")
    0.3901538+0.4032069j
    >>> law.describing_function(0.3).real.item()
    0.0
    """

    kind = "backlash"
    starts = (
        ("initial_play", "m", "position in the gap at the first sample; beyond the gap in contact"),
    )
    equation = "F = F_element(y), y = x - play, abs(play) <= gap/2; the play moves at F = 0"
    n_states = 2  # the force, and the position in the gap

    def __init__(self, element: Element, gap: float | None = None) -> None:
        if not (isinstance(element, Friction) and element.rate_independent and element.one_state):
            raise ModelError(
                f"Backlash got {element!r}; expected rate-independent friction with one state, "
                "such as Dahl()"
            )
        if isinstance(element, Backlash):
            raise ModelError(f"Backlash got {element!r}, which has a gap already; widen that one")
        self._element = element
        self.name = element.name
        self.equation = f"{element.equation}; {type(self).equation}"
        self.scale_parameters = element.scale_parameters
        self.parameters = (
            *element.parameters,
            Parameter(
                prefixed(self.name, "gap"),
                "m",
                "play of the link",
                gap,
                lower=0.0,
                transform="log",
            ),
        )

    @property
    def element(self) -> Friction:
        """The law behind the gap, with its parameters as they are in this element."""
        return self._element.copy_with(self.parameters[:-1])

    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx while the link is in contact."""
        return self._element.slope(force, direction, velocity, values[: len(self.parameters) - 1])

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return the force, and the rates of force and play, one of which is 0."""
        force, play = states
        has_room = 0.5 * values[-1] - direction * play > 0.0
        crossing = has_room * (1.0 - (direction * force < 0.0))
        slope = self.slope(force, direction, velocity, values)
        return Mechanics(0.0, force, (slope * velocity * (1.0 - crossing), velocity * crossing))

    @property
    def inner_elements(self) -> tuple[Any, ...]:
        """The element behind the gap."""
        return (self._element,)

    def initial_states(self, values: Sequence[Any], starts: Sequence[Any]) -> Sequence[Any]:
        """Return the force and the position in the gap; beyond the gap the element is a spring."""
        (start,) = starts
        play = clipped(start, 0.5 * values[-1])
        return self.slope(0.0, 1.0, 0.0, values) * (start - play), play

    def start_with(self, values: Sequence[Any], force: float) -> float:
        """Return the position beyond the gap at which a spring has the force; 0 for no force."""
        return float(np.sign(force) * 0.5 * values[-1] + force / self._stiffness(values))

    def _stiffness(self, values: Sequence[Any]) -> float:
        """Return the stiffness of the element at zero force."""
        return float(self.slope(0.0, 1.0, 0.0, values))

    def _loops(
        self, table: FloatArray, orders: Sequence[int] = (1,), chosen: Sequence[int] = ()
    ) -> Settled:
        """Return the settled loops at rows of amplitude, frequency and values."""
        return loops_of(self._element, table, orders, chosen, gap=True)

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample with its derivatives, unchecked."""
        if float(values[-1]) >= _NARROWEST * float(np.abs(np.diff(path.displacement)).sum()):
            return super().history(values, path, state, slopes=slopes)
        stiffness = self._stiffness(values)
        result = self.element.history(values[:-1], path, stiffness * state, slopes=slopes)
        by_parameter = (*result.by_parameter, np.zeros(path.displacement.shape))
        return result._replace(by_state=stiffness * result.by_state, by_parameter=by_parameter)

    def rest_stiffness(self, values: Values) -> FloatArray:
        """Return 0: small motions stay within the gap."""
        return np.zeros(np.broadcast_shapes(*(np.shape(v) for v in values)))

    def force_limits(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the limits of the element."""
        return self._element.force_limits(values[:-1])

    def force_bounds(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the bounds of the element, whose amplitude is smaller."""
        return self._element.force_bounds(values[:-1])

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return half the gap, and the amplitude at which the element behind it slips."""
        low, high = self._element.knee(values[:-1])
        half = 0.5 * np.asarray(values[-1])
        return np.minimum(half, low), high + half

    def transient_decay(
        self, values: Values, amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return the factor by which a deviation shrinks in one cycle: that of the element."""
        remaining = np.maximum(amplitude - 0.5 * np.asarray(values[-1]), 0.0)
        return self._element.transient_decay(values[:-1], remaining, omega)

    def asymptotes(self, low: float, high: float) -> tuple[Asymptote, ...]:
        """Return the limits of the element, and that without a gap."""
        closed = Asymptote("no_gap", "no gap", {"gap": _CLOSED_GAP * low}, None, {"gap": 0.0})
        return (*self.element.asymptotes(low, high), closed)

    def combinations(self) -> tuple[Combination, ...]:
        """Return the combinations of the element."""
        return self.element.combinations()

    def resolved(self, values: Values, amplitude: FloatArray) -> Values:
        """Return the values that the element resolves, and the gap."""
        return [*self.element.resolved(values[:-1], amplitude), values[-1]]

    def physical_objections(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return the objections of the element."""
        return self.element.physical_objections(values[:-1])

    def describe(self) -> dict[str, Any]:
        """Return the element and the gap as plain data."""
        return {
            "kind": self.kind,
            "element": self.element.describe(),
            "gap": self.parameters[-1].describe(),
        }

    @classmethod
    def from_description(cls, description: Mapping[str, Any], name: str | None) -> Self:
        """Return the element that :meth:`describe` described."""
        entry = description.get("element")
        inner = dict(entry) if isinstance(entry, Mapping) else {}
        law = class_named(str(inner.pop("kind", None)))
        if set(description) != {"element", "gap"} or law is None:
            raise ModelError(
                f"the backlash element has the keys {', '.join(description)}; expected element, a "
                f"table with a kind of {', '.join(KINDS)}, and gap"
            )
        element = cls(law.from_description(inner, inner.pop("name", name)))
        gap = element.parameters[-1].described(description["gap"])
        return element.copy_with((*element.parameters[:-1], gap))

    def __repr__(self) -> str:
        return f"Backlash({self.element!r}, {self._argument(self.parameters[-1])})"
