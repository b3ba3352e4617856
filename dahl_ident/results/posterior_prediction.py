"""Predictions of a posterior: responses with bands, and derived quantities.

Everything is computed at draws from the posterior; no linearization is involved.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray, positive_array
from dahl_ident.diagnostics.bands import ENERGY, DerivedQuantity
from dahl_ident.diagnostics.confidence_levels import checked_levels
from dahl_ident.elements import Element
from dahl_ident.problem import Problem
from dahl_ident.units import shown_unit


@dataclass(frozen=True)
class PredictiveBand:
    """A predicted response at draws from the posterior; noise is not included.

    Attributes
    ----------
    draws : ndarray of complex, shape (draws, n)
        The response at each draw.

    Examples
    --------
    >>> import dahl_ident as di
    >>> grid = di.posterior(di.load_dataset("noisy"), di.Dahl(alpha=1.0), method="grid")
    >>> band = grid.predict([1.0, 1.0], amplitude=[0.002, 0.004])
    >>> low, high = band.gain()
    >>> print(abs(band.response).round(1), (high - low).round(1))
    [27.3 22. ] [0.2 0.2]
    """

    draws: ComplexArray

    @property
    def response(self) -> ComplexArray:
        """The posterior mean, shape (n,)."""
        return np.asarray(self.draws.mean(axis=0))

    def gain(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the gain at each point."""
        return _central(np.abs(self.draws), level)

    def phase(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the phase at each point, rad."""
        centre = np.angle(self.response)
        low, high = _central(np.angle(self.draws * np.exp(-1j * centre)), level)
        return centre + low, centre + high

    def real(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the real part at each point."""
        return _central(self.draws.real, level)

    def imag(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the imaginary part at each point."""
        return _central(self.draws.imag, level)


def _central(values: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
    tail = 0.5 * (1.0 - float(checked_levels([level])[0]))
    low, high = np.quantile(values, [tail, 1.0 - tail], axis=0)
    return low, high


def derived_at_draws(
    problem: Problem,
    by_name: Mapping[str, FloatArray],
    amplitudes: Sequence[float],
    frequency_hz: float | None,
) -> Iterator[DerivedQuantity]:
    """Yield the knee of each law, and at each amplitude stiffness, loss and damping of friction.

    `by_name` are draws of the free parameters.
    """
    motion, size = problem.motion, len(next(iter(by_name.values())))
    friction = [e for e in problem.model.elements if e.has_memory]
    values = [_own_values(e, by_name) for e in friction]
    for element, p in zip(friction, values, strict=True):
        low, high = (np.broadcast_to(k, size) for k in element.knee(p))
        if np.array_equal(low, high):
            label = "x_c" if element.name is None else f"{element.name}_x_c"
            yield _quantity(label, shown_unit("m", motion), None, low)
    omega = 2.0 * np.pi * float(positive_array(1.0 if frequency_hz is None else frequency_hz, "f"))
    for A in positive_array(amplitudes, "amplitudes").ravel().tolist():
        at = np.full(size, A), np.full(size, omega)
        N = np.sum(
            [e.stiffness(p, *at) for e, p in zip(friction, values, strict=True)],
            axis=0,
        )
        yield _quantity(ENERGY, "J", A, np.pi * A**2 * N.imag)
        yield _quantity("equivalent stiffness", shown_unit("N/m", motion), A, N.real)
        if frequency_hz is not None:
            yield _quantity("equivalent damping", shown_unit("N s/m", motion), A, N.imag / omega)


def _own_values(element: Element, by_name: Mapping[str, FloatArray]) -> list[FloatArray]:
    return [by_name.get(p.name, np.asarray(p.value)) for p in element.parameters]


def _quantity(name: str, unit: str, amplitude: float | None, draws: FloatArray) -> DerivedQuantity:
    return DerivedQuantity(name, unit, amplitude, float(draws.mean()), float(draws.std(ddof=1)))
