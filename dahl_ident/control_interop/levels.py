"""Frequency responses of a plant with friction at several drives or amplitudes (Fig. 7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import control
import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import ComplexArray, FloatArray, positive_array
from dahl_ident.data.columns import CONTROLLED, one_of
from dahl_ident.data.quantities import converted
from dahl_ident.elements.element import Element
from dahl_ident.errors import ValidationError
from dahl_ident.steady_state import Steady, response
from dahl_ident.units import QUANTITIES, Quantity, si_unit

Kind = Literal["bode", "nyquist", "nichols"]


@dataclass(frozen=True)
class LevelResponses:
    """Complex responses over frequency, one row a level.

    Attributes
    ----------
    frequency_hz : ndarray, shape (n,)
        Hz.
    levels : ndarray, shape (m,)
        Drive, N, or displacement amplitude, m; zero-to-peak.
    controlled : {"force", "displacement"}
        What is held along a row.
    quantity : str
        What the response is.
    response : ndarray of complex, shape (m, n)
        NaN where a plant has no steady amplitude.
    """

    frequency_hz: FloatArray
    levels: FloatArray
    controlled: Literal["force", "displacement"]
    quantity: Quantity
    response: ComplexArray

    def to_control(self) -> dict[float, Any]:
        """Return one python-control frequency response for each level.

        Returns
        -------
        dict of float to control.FrequencyResponseData
            By level; points without a steady amplitude are left out.

        Examples
        --------
        >>> from dahl_ident import Dahl, Mass
        >>> from dahl_ident.control_interop import level_responses
        >>> plant = Dahl(f_max=1.0, sigma=1.0) + Mass(1.0)
        >>> list(level_responses(plant, [1.0, 2.0], [0.1, 1.0]).to_control())
        [0.1, 1.0]
        """
        omega = 2.0 * np.pi * self.frequency_hz
        return {
            level: control.frd(row[np.isfinite(row)], omega[np.isfinite(row)])
            for level, row in zip(self.levels.tolist(), self.response, strict=True)
        }

    def plot(self, kind: Kind = "bode", ax: Any = None) -> Any:
        """Draw all levels in one picture.

        Parameters
        ----------
        kind : {"bode", "nyquist", "nichols"}
            Gain and phase over frequency, imaginary over real part, or gain over phase.
        ax : Axes, or a sequence of two for "bode", optional
            New where left out.

        Returns
        -------
        Axes, or a tuple of two for "bode"

        Raises
        ------
        ValidationError
            If `kind` is unknown.
        """
        from dahl_ident.plots import plot_frequency_response, plot_nichols, plot_nyquist

        unit = "N" if self.controlled == "force" else "m"
        label = f"{self.quantity.replace('_', ' ')} [{si_unit(self.quantity)}]"
        rows = [
            (f"{level:.3g} {unit}", self.frequency_hz, row)
            for level, row in zip(self.levels.tolist(), self.response, strict=True)
        ]
        if kind == "bode":
            return plot_frequency_response(rows, gain_label=label, ax=ax)
        curves = [(name, row) for name, _, row in rows]
        if kind == "nyquist":
            return plot_nyquist(curves, label=label, ax=ax)
        if kind == "nichols":
            return plot_nichols(curves, gain_label=label, ax=ax)
        raise ValidationError(f"kind is {kind!r}; expected 'bode', 'nyquist' or 'nichols'")


def level_responses(
    plant: Element,
    frequency_hz: ArrayLike,
    levels: ArrayLike,
    *,
    controlled: Literal["force", "displacement"] = "force",
    quantity: Quantity = "receptance",
    steady: Steady = "exact",
) -> LevelResponses:
    """Return the plant's response over frequency at several levels, as in Fig. 7.

    Parameters
    ----------
    plant : Element
        With a value for every parameter.
    frequency_hz : array_like, shape (n,)
        Hz, > 0.
    levels : array_like, shape (m,)
        Zero-to-peak drives, N, or displacement amplitudes, m; > 0.
    controlled : {"force", "displacement"}, default "force"
        Which of the two a level holds constant over frequency.
    quantity : str, default "receptance"
        One of the six standard quantities.
    steady : {"exact", "describing function"}, default "exact"
        How the response to a force that is held is found, see :func:`dahl_ident.response`.

    Returns
    -------
    LevelResponses
        With `to_control()` and `plot()`.

    Raises
    ------
    ModelError
        If a parameter has no value.
    ValidationError
        If a frequency or level is not above zero, or a choice is unknown.

    Examples
    --------
    >>> from dahl_ident import Dahl, Damper, Mass, Spring
    >>> from dahl_ident.control_interop import level_responses
    >>> plant = Dahl(f_max=0.1, sigma=30) + Mass(0.3) + Damper(0.24) + Spring(0.3)
    >>> f, u0 = np.geomspace(0.01, 10.0, 400), np.geomspace(1e-4, 1e1, 51)
    >>> fig_7 = level_responses(plant, f, u0, steady="describing function")  # as in the paper
    >>> top, bottom = fig_7.plot()
    """
    f, held = (
        np.atleast_1d(positive_array(value, name))
        for value, name in ((frequency_hz, "frequency_hz"), (levels, "levels"))
    )
    if f.ndim != 1 or held.ndim != 1:
        raise ValidationError(
            f"frequency_hz has shape {f.shape} and levels {held.shape}; expected one dimension each"
        )
    one_of(quantity, "quantity", QUANTITIES)
    one_of(controlled, "controlled", CONTROLLED)
    omega = 2.0 * np.pi * f
    if controlled == "force":
        R = np.asarray(response(plant, f, held[:, None], steady=steady).receptance)
    else:
        R = 1.0 / np.asarray(plant.dynamic_stiffness(held[:, None], omega))
    with np.errstate(invalid="ignore"):  # where there is no steady amplitude
        R, _ = converted(R, omega, "receptance", quantity)
    return LevelResponses(f, held, controlled, quantity, R)
