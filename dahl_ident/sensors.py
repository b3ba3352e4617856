r"""Errors of the measurement channels: gains and delay.

A measured response differs from that of the mechanism if a channel has a gain error, or if one
channel lags the other. With F and X the true phasors,

    measured F = force_gain F
    measured X = displacement_gain X exp(-j omega delay)

so the measured dynamic stiffness of harmonic k is
``(force_gain / displacement_gain) exp(+j k omega delay) Z_k``, because the phase of F_k is
referred to k times the displacement's phase. All six quantities follow from it. The measured
X_k/F_1 of a driven plant is ``(displacement_gain / force_gain) exp(-j k omega delay)`` times the
true one, because its phase is referred to k times the force's.

A gain also affects the amplitudes of a table: the true amplitude is the measured one divided by
`displacement_gain`, and the true drive is the measured one divided by `force_gain`. For friction
without other elements, only x_c is therefore determined if the force gain is unknown, and only
f_max if the displacement gain is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray, finite_number
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ValidationError, argument, spelled

if TYPE_CHECKING:
    from dahl_ident.data.laboratory import Metadata


class Prior(Protocol):
    """A frozen distribution of scipy.stats, or anything with these methods."""

    def logpdf(self, x: Any) -> Any:
        """Return the logarithm of the density at x."""

    def mean(self) -> Any:
        """Return the mean."""

    def std(self) -> Any:
        """Return the standard deviation."""


def calibrations(metadata: Metadata) -> dict[str, Any]:
    """Return the priors of the sensors' parameters from a report's metadata, by name."""
    if not (stated := metadata.calibrations()):
        return {}
    from scipy import stats

    return {n: stats.norm(0.0 if n == "delay" else 1.0, u) for n, u in stated.items()}


_CHANNELS = (
    ("force_gain", "", "measured over true force", 1.0),
    ("displacement_gain", "", "measured over true displacement", 1.0),
    ("delay", "s", "lag of the displacement channel", 0.0),
)


@dataclass(frozen=True)
class Sensors:
    """Gains of the two channels and the delay between them.

    Parameters
    ----------
    force_gain : float, None or scipy.stats distribution, default 1
        Measured over true force, > 0. A number fixes it, None frees it, a frozen distribution
        such as ``scipy.stats.norm(1.0, 0.005)`` frees it with that prior.
    displacement_gain : float, None or scipy.stats distribution, default 1
        Measured over true displacement, > 0.
    delay : float, None or scipy.stats distribution, default 0
        Time by which the displacement channel lags the force channel, s.

    Raises
    ------
    ValidationError
        If a gain is not above zero, or a number is not finite.

    Examples
    --------
    >>> [p.name for p in Sensors(force_gain=None).parameters if p.free]
    ['force_gain']
    """

    force_gain: float | Prior | None = 1.0
    displacement_gain: float | Prior | None = 1.0
    delay: float | Prior | None = 0.0

    def __post_init__(self) -> None:
        for name, *_ in _CHANNELS:
            stated = getattr(self, name)
            if stated is not None and not hasattr(stated, "logpdf"):
                object.__setattr__(self, name, finite_number(stated, name))
        _ = self.parameters  # checks the bounds

    def stated_uncertainties(self) -> dict[str, float]:
        """Return the standard deviation of each channel's prior, by name.

        Raises
        ------
        ValidationError
            If a value is not a prior about 1 (the delay: about 0).

        Examples
        --------
        >>> from scipy import stats
        >>> Sensors(force_gain=stats.norm(1.0, 0.005)).stated_uncertainties()
        {'force_gain': 0.005}
        """
        uncertainties = {}
        for name, _, _, neutral in _CHANNELS:
            stated = getattr(self, name)
            if isinstance(stated, float) and stated == neutral:
                continue
            if stated is None or isinstance(stated, float) or float(stated.mean()) != neutral:
                value = "free" if stated is None else f"{stated}"
                if name in self.priors:
                    value = f"a prior about {self.priors[name].mean():g}"
                prior = "norm(0, 1e-4)" if name == "delay" else "norm(1, 0.005)"
                raise ValidationError(
                    f"{argument(name).rstrip('=')} is {value}; a fit of records expects a prior "
                    f"about {neutral:g}, such as {spelled(f'scipy.stats.{prior}', repr(prior))}, "
                    "which counts in the uncertainty: correct the record for what is known, or fit "
                    "an extracted table"
                )
            uncertainties[name] = float(stated.std())
        return uncertainties

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any] | str | Path) -> Sensors:
        """Return the sensors with the calibrations in a report's metadata.

        Each instrument with a channel (force, displacement or delay), an uncertainty and its
        coverage factor k gives a normal prior of the standard deviation ``uncertainty / k``.

        Parameters
        ----------
        metadata : mapping or path of a TOML file
            As for :func:`dahl_ident.report`.

        Returns
        -------
        Sensors
            Exact where no uncertainty is stated.

        Raises
        ------
        DataError
            If the file cannot be read.
        ValidationError
            If a field is unknown, or an uncertainty is not a number with its unit.

        Examples
        --------
        >>> cell = {"name": "Load cell", "channel": "force", "uncertainty": "0.5 %", "k": 2}
        >>> float(Sensors.from_metadata({"instruments": [cell]}).force_gain.std())
        0.0025
        """
        from dahl_ident.data.laboratory import metadata_of

        return cls(**calibrations(metadata_of(metadata)))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The three parameters, in the order of the constructor."""
        return tuple(
            _parameter(name, unit, meaning, getattr(self, name), neutral)
            for name, unit, meaning, neutral in _CHANNELS
        )

    @cached_property
    def priors(self) -> dict[str, Prior]:
        """The prior of each parameter that has one, by name."""
        stated = {p.name: getattr(self, p.name) for p in self.parameters}
        return {n: v for n, v in stated.items() if not (v is None or isinstance(v, float))}

    @cached_property
    def are_exact(self) -> bool:
        """Whether the channels are taken as exact: both gains 1, no delay."""
        return (self.force_gain, self.displacement_gain, self.delay) == (1.0, 1.0, 0.0)

    def with_free(self, names: Sequence[str]) -> Sensors:
        """Return these sensors with the named parameters free and without a prior."""
        return replace(self, **dict.fromkeys(names))

    def with_fixed(self, values: Mapping[str, float]) -> Sensors:
        """Return these sensors with the named parameters held at the given values."""
        return replace(self, **values)


def measured_stiffness_factor(
    values: Sequence[FloatArray], omega: FloatArray, harmonic: int | NDArray[np.int64]
) -> ComplexArray:
    """Return measured over true F_k/X_1 for sensor `values` in the order of the parameters."""
    force_gain, displacement_gain, delay = values
    return np.asarray(
        force_gain / displacement_gain * np.exp(1j * harmonic * omega * delay),
        dtype=np.complex128,
    )


def _parameter(
    name: str, unit: str, description: str, stated: float | Prior | None, neutral: float
) -> Parameter:
    positive = neutral > 0.0
    value = stated if stated is None or isinstance(stated, float) else float(stated.mean())
    if value is not None and positive and value <= 0.0:
        raise ValidationError(
            f"{name} is {value!r}; expected a number > 0 (change the sign of a channel when "
            "reading it)"
        )
    return Parameter(
        name,
        unit,
        description,
        neutral if value is None else value,
        free=not isinstance(stated, float),
        lower=0.0 if positive else -np.inf,
        transform="log" if positive else "linear",
    )


EXACT = Sensors()
