"""Complex response against amplitude and frequency: what a fit is made to.

A structure with friction answers a sine of another amplitude with another gain and phase, so
one curve over frequency does not describe it. A :class:`FrequencyResponse` therefore has one
row for each measured point, and each row carries its amplitude. SI units throughout: m or
rad, N or N m, Hz. Amplitudes are zero to peak. Phasors go with exp(+j omega t), so that a
dissipating element has a positive imaginary part of its dynamic stiffness.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    finite_array,
    non_negative_array,
    positive_array,
    real_array,
)
from dahl_ident.data.fields import column, frozen_copy, frozen_mapping, one_of, thawed
from dahl_ident.errors import ValidationError

Quantity = Literal[
    "receptance",
    "mobility",
    "accelerance",
    "dynamic_stiffness",
    "mechanical_impedance",
    "apparent_mass",
]
Motion = Literal["translation", "rotation"]
QUANTITIES = (
    "receptance",
    "mobility",
    "accelerance",
    "dynamic_stiffness",
    "mechanical_impedance",
    "apparent_mass",
)
MOTIONS = ("translation", "rotation")
CONTROLLED = ("displacement", "force")


@dataclass(frozen=True, init=False, eq=False, repr=False)
class FrequencyResponse:
    """Complex response, its amplitude and frequency, and what is known of their errors.

    Parameters
    ----------
    frequency_hz : (n,) array_like
        Frequencies, Hz.
    response : (n,) array_like of complex
        The `quantity` at each point, SI units. A row with harmonic k > 1 holds F_k/X_1, its
        phase referred to k times the displacement's phase.
    amplitude : (n,) array_like, optional
        Zero-to-peak displacement amplitude abs(X_1), m or rad.
    drive : (n,) array_like, optional
        Zero-to-peak force amplitude abs(F_1), N or N m. At least one of `amplitude` and
        `drive` is needed.
    covariance : (n, 2, 2) array_like, optional
        Covariance of the real and the imaginary part of each response.
    dof : (n,) array_like or float, optional
        Degrees of freedom with which `covariance` was estimated; infinite where it is known.
    amplitude_std : (n,) array_like, optional
        Standard deviation of `amplitude`.
    amplitude_covariance : (n, 2) array_like, optional
        Covariance of `amplitude` with the real and the imaginary part of the response: the
        response is a quotient with the displacement, so they share the displacement's error.
    level : (n,) array_like or one label, optional
        Nominal drive or displacement level, numbers or text.
    controlled : {"displacement", "force"} or (n,) array_like of them
        What the laboratory held constant.
    harmonic : int or (n,) array_like of int
        1 for the fundamental.
    quantity : str
        One of the six standard quantities.
    motion : {"translation", "rotation"}
        Whether displacement is m or rad.
    quality : mapping of str to (n,) array_like, optional
        Verdicts on each point, such as ``settled``.
    provenance : mapping, optional
        Where the data come from: file, hash, options.

    Raises
    ------
    ValidationError
        If a field has the wrong shape or impossible values.

    Examples
    --------
    >>> data = FrequencyResponse([1.0, 1.0], [2.0 + 1.0j, 1.0 + 1.0j], amplitude=[1e-3, 2e-3])
    >>> data.n
    2
    """

    frequency_hz: FloatArray
    response: ComplexArray
    amplitude: FloatArray | None
    drive: FloatArray | None
    covariance: FloatArray | None
    dof: FloatArray | None
    amplitude_std: FloatArray | None
    amplitude_covariance: FloatArray | None
    level: NDArray[Any] | None
    controlled: NDArray[np.str_]
    harmonic: NDArray[np.int64]
    quantity: Quantity
    motion: Motion
    quality: Mapping[str, NDArray[Any]]
    provenance: Mapping[str, Any] | None

    def __init__(
        self,
        frequency_hz: ArrayLike,
        response: ArrayLike,
        amplitude: ArrayLike | None = None,
        drive: ArrayLike | None = None,
        *,
        covariance: ArrayLike | None = None,
        dof: ArrayLike | None = None,
        amplitude_std: ArrayLike | None = None,
        amplitude_covariance: ArrayLike | None = None,
        level: ArrayLike | None = None,
        controlled: ArrayLike = "displacement",
        harmonic: ArrayLike = 1,
        quantity: Quantity = "dynamic_stiffness",
        motion: Motion = "translation",
        quality: Mapping[str, ArrayLike] | None = None,
        provenance: Mapping[str, Any] | None = None,
    ) -> None:
        frequency = positive_array(frequency_hz, "frequency_hz")
        if frequency.ndim != 1 or frequency.size == 0:
            raise ValidationError(
                f"frequency_hz: expected one number for each point, got shape {frequency.shape}"
            )
        n = frequency.size
        values = {
            "frequency_hz": frozen_copy(frequency),
            "response": _complex_column(response, n),
            "amplitude": column(amplitude, "amplitude", n, positive_array),
            "drive": column(drive, "drive", n, positive_array),
            "covariance": column(covariance, "covariance", n, finite_array, shape=(2, 2)),
            "dof": _dof(dof, n),
            "amplitude_std": column(amplitude_std, "amplitude_std", n, non_negative_array),
            "amplitude_covariance": column(
                amplitude_covariance, "amplitude_covariance", n, finite_array, shape=(2,)
            ),
            "level": _level(level, n),
            "controlled": _controlled(controlled, n),
            "harmonic": _harmonic(harmonic, n),
            "quantity": one_of(quantity, "quantity", QUANTITIES),
            "motion": one_of(motion, "motion", MOTIONS),
            "quality": frozen_mapping(
                {k: _quality_column(v, k, n) for k, v in (quality or {}).items()}
            ),
            "provenance": frozen_mapping(provenance),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        self._check_together()

    def _check_together(self) -> None:
        """Check what only several fields together can violate."""
        if self.amplitude is None and self.drive is None:
            raise ValidationError(
                "neither amplitude nor drive is given; a response with friction means nothing "
                "without the amplitude it was measured at"
            )
        if self.amplitude_std is not None and self.amplitude is None:
            raise ValidationError("amplitude_std is given without amplitude")
        if self.dof is not None and self.covariance is None:
            raise ValidationError("dof is given without the covariance that it belongs to")
        if self.amplitude_covariance is not None and (
            self.amplitude_std is None or self.covariance is None
        ):
            raise ValidationError(
                "amplitude_covariance is given without amplitude_std and covariance"
            )
        if self.quantity != "dynamic_stiffness" and (self.harmonic > 1).any():
            row = int(np.argmax(self.harmonic > 1))
            raise ValidationError(
                f"harmonic[{row}] is {self.harmonic[row]} in a table of {self.quantity}; "
                "only dynamic stiffness has rows for harmonics"
            )
        if self.covariance is not None:
            _check_covariance(self.covariance, self.amplitude_std, self.amplitude_covariance)

    def __len__(self) -> int:
        return self.frequency_hz.size

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (thawed((f.name, getattr(self, f.name)) for f in fields(self)),)

    @property
    def n(self) -> int:
        """Number of points."""
        return len(self)

    @property
    def omega(self) -> FloatArray:
        """Angular frequency, rad/s."""
        return 2.0 * np.pi * self.frequency_hz

    @property
    def gain(self) -> FloatArray:
        """Absolute value of the response."""
        return np.abs(self.response)

    @property
    def phase(self) -> FloatArray:
        """Phase of the response, rad, in (-pi, pi]."""
        return np.angle(self.response)


def _rebuild(arguments: dict[str, Any]) -> FrequencyResponse:
    return FrequencyResponse(**arguments)


def _complex_column(value: ArrayLike, n: int) -> ComplexArray:
    array = np.asarray(value)
    if array.dtype.kind not in "cfiu":
        raise ValidationError(f"response: expected complex numbers, got dtype {array.dtype}")
    if array.shape != (n,):
        raise ValidationError(f"response: expected shape {(n,)}, got {array.shape}")
    array = array.astype(np.complex128)
    finite_array(array.real, "response.real")
    finite_array(array.imag, "response.imag")
    return frozen_copy(array)


def _dof(value: ArrayLike | None, n: int) -> FloatArray | None:
    if value is None:
        return None
    array = real_array(value, "dof")
    if array.ndim == 0:
        array = np.full(n, float(array))
    good = array > 0.0
    if not good.all():
        row = int(np.argmin(good))
        raise ValidationError(f"dof[{row}] is {array[row]!r}; expected a number > 0 or infinity")
    return column(array, "dof", n, real_array)


def _level(value: ArrayLike | None, n: int) -> NDArray[Any] | None:
    if value is None:
        return None
    array = np.asarray(value)
    if array.dtype.kind == "O":
        array = array.astype(str)
    array = array if array.dtype.kind == "U" else finite_array(array, "level")
    if array.ndim == 0:
        array = np.full(n, array)
    if array.shape != (n,):
        raise ValidationError(f"level: expected one label or shape {(n,)}, got {array.shape}")
    return frozen_copy(array)


def _controlled(value: ArrayLike, n: int) -> NDArray[np.str_]:
    array = np.asarray(value, dtype=np.str_)
    if array.ndim == 0:
        array = np.full(n, array)
    if array.shape != (n,):
        raise ValidationError(f"controlled: expected one word or shape {(n,)}, got {array.shape}")
    for word in np.unique(array):
        one_of(str(word), "controlled", CONTROLLED)
    return frozen_copy(array)


def _harmonic(value: ArrayLike, n: int) -> NDArray[np.int64]:
    array = positive_array(value, "harmonic")
    if (array != np.round(array)).any():
        raise ValidationError(f"harmonic: expected whole numbers, got {array[array % 1 != 0][0]!r}")
    if array.ndim == 0:
        array = np.full(n, array)
    if array.shape != (n,):
        raise ValidationError(f"harmonic: expected one number or shape {(n,)}, got {array.shape}")
    return frozen_copy(array.astype(np.int64))


def _quality_column(value: ArrayLike, name: str, n: int) -> NDArray[Any]:
    array = np.asarray(value)
    if array.shape != (n,):
        raise ValidationError(f"quality {name!r}: expected shape {(n,)}, got {array.shape}")
    return frozen_copy(array.astype(str) if array.dtype.kind == "O" else array)


def _check_covariance(
    covariance: FloatArray, amplitude_std: FloatArray | None, cross: FloatArray | None
) -> None:
    """Refuse what is no covariance of (amplitude, real part, imaginary part)."""
    joint = np.zeros((len(covariance), 3, 3))
    joint[:, 1:, 1:] = covariance
    if amplitude_std is not None:
        joint[:, 0, 0] = amplitude_std**2
    if cross is not None:
        joint[:, 0, 1:] = joint[:, 1:, 0] = cross
    scale = np.sqrt(np.abs(np.diagonal(joint, axis1=1, axis2=2)))
    scale[scale == 0.0] = 1.0
    correlation = joint / (scale[:, :, None] * scale[:, None, :])
    asymmetry = np.abs(correlation[:, 1, 2] - correlation[:, 2, 1])
    smallest = np.linalg.eigvalsh(correlation)[:, 0]
    bad = (asymmetry > 1e-9) | (smallest < -1e-9)
    if bad.any():
        row = int(np.argmax(bad))
        raise ValidationError(
            f"covariance[{row}] is {covariance[row].tolist()}; expected a symmetric positive "
            "semidefinite matrix, also together with the amplitude's variance and covariance"
        )
