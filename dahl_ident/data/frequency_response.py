"""Complex response against amplitude and frequency: what a fit is made to.

A structure with friction answers a sine of another amplitude with another gain and phase, so
one curve over frequency does not describe it. A :class:`FrequencyResponse` therefore has one
row for each measured point, and each row carries its amplitude. SI units throughout: m or
rad, N or N m, Hz. Amplitudes are zero to peak. Phasors go with exp(+j omega t), so that a
dissipating element has a positive imaginary part of its dynamic stiffness.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    finite_array,
    non_negative_array,
    positive_array,
)
from dahl_ident.data.columnwise import combined, shape_of
from dahl_ident.data.fields import (
    check_covariance,
    column,
    complex_values,
    controlled_words,
    degrees_of_freedom,
    frozen_copy,
    frozen_mapping,
    harmonic_numbers,
    labels,
    one_of,
    plain_values,
    spread,
)
from dahl_ident.data.quantities import converted, jacobian
from dahl_ident.data.summary import Lines, distinct, listed, response_lines
from dahl_ident.data.tabular import Tabular
from dahl_ident.errors import ValidationError
from dahl_ident.units import MOTIONS, QUANTITIES, Motion, Quantity, si_unit

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, init=False, eq=False, repr=False)
class FrequencyResponse(Tabular):
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
            "response": column(response, "response", n, complex_values),
            "amplitude": column(amplitude, "amplitude", n, positive_array),
            "drive": column(drive, "drive", n, positive_array),
            "covariance": column(covariance, "covariance", n, finite_array, shape=(2, 2)),
            "dof": spread(dof, "dof", n, degrees_of_freedom),
            "amplitude_std": column(amplitude_std, "amplitude_std", n, non_negative_array),
            "amplitude_covariance": column(
                amplitude_covariance, "amplitude_covariance", n, finite_array, shape=(2,)
            ),
            "level": spread(level, "level", n, labels),
            "controlled": spread(controlled, "controlled", n, controlled_words),
            "harmonic": spread(harmonic, "harmonic", n, harmonic_numbers),
            "quantity": one_of(quantity, "quantity", QUANTITIES),
            "motion": one_of(motion, "motion", MOTIONS),
            "quality": frozen_mapping(
                {
                    name: column(verdict, f"quality {name!r}", n, plain_values)
                    for name, verdict in (quality or {}).items()
                }
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
            check_covariance(self.covariance, self.amplitude_std, self.amplitude_covariance)
            even = (self.covariance + self.covariance.swapaxes(1, 2)) / 2.0  # but for rounding
            object.__setattr__(self, "covariance", frozen_copy(even))

    def __len__(self) -> int:
        return self.frequency_hz.size

    def _summary(self) -> tuple[str, Lines]:
        return response_lines(self)

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

    @property
    def levels(self) -> list[Any]:
        """Distinct level labels in order of appearance; empty where there are none."""
        return [] if self.level is None else distinct(self.level)

    @property
    def unit(self) -> str:
        """SI unit of the response."""
        return si_unit(self.quantity, self.motion)

    @property
    def units(self) -> dict[str, str]:
        """SI unit of each column that has one."""
        kinds = {"amplitude": "displacement", "drive": "force", "response": self.quantity}
        return {"frequency_hz": "Hz"} | {k: si_unit(v, self.motion) for k, v in kinds.items()}

    def to(self, quantity: Quantity) -> FrequencyResponse:
        """Return the same points as another standard quantity, their covariance with them.

        The covariance transforms by the Jacobian of the conversion, first order in the error.
        The reference of amplitude and drive stays: displacement and force.

        Parameters
        ----------
        quantity : str
            One of the six standard quantities.

        Returns
        -------
        FrequencyResponse

        Raises
        ------
        ValidationError
            If a response of zero would have to be inverted, or rows hold harmonics, which are
            dynamic stiffness only.

        Examples
        --------
        >>> data = FrequencyResponse([1.0], [4.0 + 3.0j], amplitude=[1e-3])
        >>> data.to("receptance").response
        array([0.16-0.12j])
        """
        one_of(quantity, "quantity", QUANTITIES)
        if quantity == self.quantity:
            return self
        if (self.harmonic > 1).any():
            raise ValidationError(
                f"rows with harmonics {listed(np.unique(self.harmonic))} cannot become "
                f"{quantity}; only dynamic stiffness has harmonics. Use select(harmonic=1) first"
            )
        response, derivative = converted(self.response, self.omega, self.quantity, quantity)
        J = jacobian(derivative)
        covariance, cross = self.covariance, self.amplitude_covariance
        return replace(
            self,
            response=response,
            quantity=quantity,
            covariance=None if covariance is None else J @ covariance @ J.swapaxes(1, 2),
            amplitude_covariance=None if cross is None else np.einsum("nij,nj->ni", J, cross),
        )

    def select(
        self,
        *,
        level: Any = None,
        frequency_hz: tuple[float, float] | None = None,
        harmonic: int | None = None,
        rows: ArrayLike | None = None,
    ) -> FrequencyResponse:
        """Return the points that meet every condition given.

        Parameters
        ----------
        level : label or list of labels, optional
            Keep these levels.
        frequency_hz : (low, high), optional
            Keep this range, both ends included, Hz.
        harmonic : int, optional
            Keep this harmonic.
        rows : (n,) array_like of bool, optional
            Keep these rows.

        Returns
        -------
        FrequencyResponse

        Raises
        ------
        ValidationError
            If no point is left, or a level is not there.

        Examples
        --------
        >>> data = FrequencyResponse([1.0, 2.0], [1.0, 1.0j], drive=[1.0, 1.0], level=["a", "b"])
        >>> data.select(level="b").frequency_hz
        array([2.])
        """
        keep = np.ones(self.n, dtype=bool)
        if level is not None:
            wanted = [level] if np.ndim(level) == 0 else list(level)
            absent = [w for w in wanted if w not in self.levels]
            if self.level is None or absent:
                raise ValidationError(f"no level {absent}; there are {listed(self.levels)}")
            keep &= np.isin(self.level, wanted)
        if frequency_hz is not None:
            low, high = frequency_hz
            keep &= (self.frequency_hz >= low) & (self.frequency_hz <= high)
        if harmonic is not None:
            keep &= self.harmonic == harmonic
        if rows is not None:
            mask = np.asarray(rows)
            if mask.dtype != np.bool_ or mask.shape != keep.shape:
                raise ValidationError(
                    f"rows: expected {self.n} of True or False, got dtype {mask.dtype} of shape "
                    f"{mask.shape}"
                )
            keep &= mask
        if not keep.any():
            raise ValidationError(f"none of the {self.n} points meets the conditions")
        return replace(self, **combined([self], lambda arrays: arrays[0][keep]))

    @staticmethod
    def concatenate(parts: Sequence[FrequencyResponse]) -> FrequencyResponse:
        """Return all points of several tables in one.

        Parameters
        ----------
        parts : sequence of FrequencyResponse
            Of one quantity and motion, each with the same columns.

        Returns
        -------
        FrequencyResponse
            Its provenance lists those of the parts.

        Raises
        ------
        ValidationError
            If quantity, motion or columns differ.

        Examples
        --------
        >>> part = FrequencyResponse([1.0], [1.0j], amplitude=[1e-3])
        >>> FrequencyResponse.concatenate([part, part]).n
        2
        """
        if not parts:
            raise ValidationError("concatenate needs at least one table, got none")
        first = parts[0]
        for i, part in enumerate(parts):
            ours, theirs = shape_of(first), shape_of(part)
            if ours != theirs:
                raise ValidationError(
                    f"parts[{i}] ({listed(sorted(theirs - ours)) or 'less'}) does not go with "
                    f"parts[0] ({listed(sorted(ours - theirs)) or 'less'}); bring them to one "
                    "quantity with .to() and to the same columns"
                )
        sources = [dict(p.provenance) for p in parts if p.provenance is not None]
        provenance = {"parts": sources} if sources else None
        return replace(first, **combined(parts, np.concatenate), provenance=provenance)

    def to_frame(self, *, polar: bool = False) -> pd.DataFrame:
        """Return a pandas table with one row for each point and units in the headers.

        Parameters
        ----------
        polar : bool
            Whether the response is given as ``gain`` and ``phase_deg`` with their standard
            deviations, instead of ``real`` and ``imag`` with their covariance. Only the latter
            keeps everything.

        Returns
        -------
        pandas.DataFrame

        Examples
        --------
        >>> data = FrequencyResponse([1.0], [4.0 + 3.0j], amplitude=[1e-3])
        >>> list(data.to_frame(polar=True).columns[:4])
        ['frequency_hz', 'amplitude [m]', 'gain [N/m]', 'phase_deg']
        """
        from dahl_ident.data.table import response_frame

        return response_frame(self, polar=polar)

    @classmethod
    def from_frame(
        cls,
        frame: pd.DataFrame,
        *,
        columns: Mapping[str, Any] | str | Path | None = None,
        amplitude: str | None = None,
        drive: str | None = None,
        passive: bool = True,
    ) -> FrequencyResponse:
        """Return the frequency response in a pandas table.

        Parameters
        ----------
        frame : pandas.DataFrame
            Columns as :func:`~dahl_ident.read_frequency_response` expects them in a file,
            units in brackets in their names.
        columns, amplitude, drive, passive
            As there.

        Returns
        -------
        FrequencyResponse

        Raises
        ------
        DataError, UnitError
            Naming row and column.

        Examples
        --------
        >>> data = FrequencyResponse([1.0], [4.0 + 3.0j], amplitude=[1e-3])
        >>> FrequencyResponse.from_frame(data.to_frame()).response
        array([4.+3.j])
        """
        from dahl_ident.data.columns import column_map
        from dahl_ident.data.readers.sheets import frame_source
        from dahl_ident.data.response_table import ResponseOptions, response_from

        options = ResponseOptions(amplitude=amplitude, drive=drive, passive=passive)
        data = response_from(frame_source(frame), column_map(columns), options)
        origin = (data.provenance or {}).get("origin")
        return data if origin is None else replace(data, provenance=origin)

    def to_control(self) -> dict[Any, Any]:
        """Return one python-control frequency response for each level.

        Returns
        -------
        dict
            ``control.FrequencyResponseData`` by level label, in the quantity of this table,
            over omega in rad/s; the key is None where the table has no levels.

        Raises
        ------
        ValidationError
            If rows hold harmonics, or a level has a frequency twice.

        Examples
        --------
        >>> data = FrequencyResponse([1.0, 2.0], [1.0j, 2.0j], drive=[0.1, 0.1], level="0.1 N")
        >>> list(data.to_control())
        ['0.1 N']
        """
        from dahl_ident.data.table import control_systems

        return control_systems(self)

    def plot(self, ax: Any = None) -> tuple[Any, Any]:
        """Draw gain and phase of the fundamental, over frequency or over amplitude.

        Over frequency, one curve a level, where a level has more than one frequency; over
        amplitude, with error bars where the covariance is known, otherwise.

        Parameters
        ----------
        ax : sequence of two matplotlib Axes, optional
            For gain and for phase; new ones where left out.

        Returns
        -------
        tuple of Axes

        Examples
        --------
        >>> data = FrequencyResponse([1.0, 1.0], [2.0 + 1.0j, 1.0 + 1.0j], amplitude=[1e-3, 2e-3])
        >>> top, bottom = data.plot()
        >>> top.get_ylabel()
        'dynamic stiffness [N/m]'
        """
        from dahl_ident.data.picture import draw_response

        return draw_response(self, ax)
