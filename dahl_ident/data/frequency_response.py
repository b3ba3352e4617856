"""Complex response against amplitude and frequency: the data of a fit.

Each row includes its amplitude. SI units, Hz, amplitudes zero to peak; phasors refer to
exp(+j omega t), so the dynamic stiffness of a dissipating element has a positive imaginary part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    non_negative_array,
    non_negative_number,
    positive_array,
)
from dahl_ident.data.columns import (
    COLUMNS,
    FILE_COLUMNS,
    RESPONSE_COLUMNS,
    Column,
    check_table,
    combined,
    frozen_copy,
    frozen_mapping,
    one_of,
    plain_values,
    shared_properties,
)
from dahl_ident.data.storage import plain_data
from dahl_ident.data.tabular import Lines, Tabular, distinct, extent, listed, noted
from dahl_ident.errors import ValidationError, spelled
from dahl_ident.units import (
    MOTIONS,
    QUANTITIES,
    Motion,
    Quantity,
    converted,
    counted,
    jacobian,
    percent,
    si_unit,
)

if TYPE_CHECKING:
    import pandas as pd


def fundamental_alone() -> str:
    """Return how the rows of the fundamental are selected, for messages."""
    return spelled("select(harmonic=1)", "--where 'harmonic == 1'")


@dataclass(frozen=True, init=False, eq=False, repr=False)
class FrequencyResponse(Tabular):
    """Complex response, its amplitude and frequency, and their errors.

    Parameters
    ----------
    frequency_hz : (n,) array_like
        Frequencies, Hz.
    response : (n,) array_like of complex
        The `quantity` at each point, SI units. A row with harmonic k other than 1 holds
        F_k/X_1, its phase referred to k times the displacement's phase; for k = 0 that is the
        mean force over the displacement amplitude, a real number. Where the force was controlled
        it holds X_k/F_1, in a table of receptance, with the phase referred to k times the force's.
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
    drive_std : (n,) array_like, optional
        Standard deviation of `drive`, noise of each row alone.
    drive_covariance : (n, 2) array_like, optional
        Covariance of `drive` with the real and the imaginary part of the response: a receptance
        is a quotient with the force, so they share the force's error.
    level : (n,) array_like or one label, optional
        Nominal drive or displacement level, numbers or text.
    run : (n,) array_like or one label, optional
        Measurements made in one session: a file, a day, a mounting. Kept as text. Scatter between
        runs is not noise.
    controlled : {"displacement", "force"} or (n,) array_like of them
        The controlled quantity.
    harmonic : int or (n,) array_like of int
        0 for the mean force (or displacement), 1 for the fundamental, 2, 3, ... above it.
    quantity : str
        One of the six standard quantities; or "backbone", see :meth:`backbone`.
    motion : {"translation", "rotation"}
        Whether displacement is m or rad.
    drive_factor_uncertainty : float
        Relative standard uncertainty of the factor that made forces of a drive in V or A. All
        rows share it, so it is not in `covariance`.
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
    drive_std: FloatArray | None
    drive_covariance: FloatArray | None
    level: NDArray[Any] | None
    run: NDArray[np.str_] | None
    controlled: NDArray[np.str_]
    harmonic: NDArray[np.int64]
    quantity: Quantity
    motion: Motion
    drive_factor_uncertainty: float
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
        drive_std: ArrayLike | None = None,
        drive_covariance: ArrayLike | None = None,
        level: ArrayLike | None = None,
        run: ArrayLike | None = None,
        controlled: ArrayLike = "displacement",
        harmonic: ArrayLike = 1,
        quantity: Quantity = "dynamic_stiffness",
        motion: Motion = "translation",
        drive_factor_uncertainty: float = 0.0,
        quality: Mapping[str, ArrayLike] | None = None,
        provenance: Mapping[str, Any] | None = None,
    ) -> None:
        columns = {name: value for name, value in locals().items() if name in COLUMNS}
        columns["frequency_hz"] = frequency = positive_array(frequency_hz, "frequency_hz")
        if frequency.ndim != 1 or frequency.size == 0:
            raise ValidationError(
                f"frequency_hz: expected one number for each point, got shape {frequency.shape}"
            )
        n = frequency.size
        values = {k: column.checked(columns[k], k, n) for k, column in COLUMNS.items()} | {
            "quantity": one_of(quantity, "quantity", (*QUANTITIES, "backbone")),
            "motion": one_of(motion, "motion", MOTIONS),
            "drive_factor_uncertainty": non_negative_number(
                drive_factor_uncertainty, "drive_factor_uncertainty"
            ),
            "quality": frozen_mapping(
                {
                    name: Column(check=plain_values).checked(verdict, f"quality {name!r}", n)
                    for name, verdict in (quality or {}).items()
                }
            ),
            "provenance": frozen_mapping(provenance),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        check_table(self)
        if self.covariance is not None:  # made symmetric to the last digit
            symmetric = (self.covariance + self.covariance.swapaxes(1, 2)) / 2.0
            object.__setattr__(self, "covariance", frozen_copy(symmetric))

    @classmethod
    def backbone(
        cls,
        amplitude: ArrayLike,
        natural_frequency_hz: ArrayLike,
        damping_ratio: ArrayLike,
        *,
        frequency_std: ArrayLike,
        damping_ratio_std: ArrayLike,
        **columns: Any,
    ) -> FrequencyResponse:
        r"""Return natural frequency and damping ratio against amplitude, as a table.

        Tests with a phase-locked loop and modal analysis of ring-downs give such data. The response
        is ``Z/(2 m omega^2)``, Z the dynamic stiffness of mode and friction and m the modal mass:
        at resonance its real part is zero, and its imaginary part the damping ratio. The standard
        deviation of its real part is that of the frequency over the frequency.

        Parameters
        ----------
        amplitude : (n,) array_like
            Zero-to-peak displacement amplitude, m or rad.
        natural_frequency_hz : (n,) array_like
            Hz, where the force is in quadrature with the displacement.
        damping_ratio : (n,) array_like
            Fraction of critical damping.
        frequency_std, damping_ratio_std : (n,) array_like or float
            Standard deviations.
        **columns
            Further columns of :class:`FrequencyResponse`, such as `run` and `motion`.

        Returns
        -------
        FrequencyResponse
            Of the quantity "backbone". A fit needs a model with a Mass of known value.

        Raises
        ------
        ValidationError
            If a column has the wrong shape or impossible values.

        Examples
        --------
        >>> data = FrequencyResponse.backbone(
        ...     [1e-4, 1e-3], [21.0, 20.0], [0.02, 0.03], frequency_std=0.01, damping_ratio_std=1e-3
        ... )
        >>> data.quantity, data.response.imag.tolist()
        ('backbone', [0.02, 0.03])
        """
        frequency = positive_array(natural_frequency_hz, "natural_frequency_hz")
        of_frequency = positive_array(frequency_std, "frequency_std")
        of_damping = positive_array(damping_ratio_std, "damping_ratio_std")
        covariance = np.zeros((*frequency.shape, 2, 2))
        covariance[..., 0, 0] = (of_frequency / frequency) ** 2
        covariance[..., 1, 1] = of_damping**2
        return cls(
            frequency,
            1j * non_negative_array(damping_ratio, "damping_ratio"),
            amplitude,
            covariance=covariance,
            quantity="backbone",
            **columns,
        )

    def with_mass(self, mass: float) -> FrequencyResponse:
        """Return a backbone as dynamic stiffness of mode, friction and this mass, kg or kg m^2."""
        if self.quantity != "backbone" or self.covariance is None:
            raise ValidationError(f"this table is of {self.quantity}; expected a backbone")
        factor = 2.0 * mass * self.omega**2
        return replace(
            self,
            response=self.response * factor,
            covariance=self.covariance * factor[:, None, None] ** 2,
            quantity="dynamic_stiffness",
        )

    def __len__(self) -> int:
        return self.frequency_hz.size

    def _summary(self) -> tuple[str, Lines]:
        name = self.quantity.replace("_", " ")
        lines = [("frequency", extent(self.frequency_hz, "Hz"))]
        if self.levels:
            lines.append((counted(len(self.levels), "level"), listed(self.levels)))
        if self.runs:
            lines.append((counted(len(self.runs), "run"), listed(self.runs)))
        for field in ("amplitude", "drive"):
            values = getattr(self, field)
            if values is not None:
                lines.append((field, f"{extent(values, self.units[field])}, zero to peak"))
        if self.quantity == "backbone":
            lines.append(("damping ratio", extent(self.response.imag, "1")))
        else:
            lines.append(("gain", extent(self.gain, self.unit)))
            lines.append(("phase", extent(np.degrees(self.phase), "deg")))
        lines.append(("controlled", listed(distinct(self.controlled))))
        if (self.harmonic != 1).any():
            lines.append(("harmonics", listed(distinct(self.harmonic))))
        dof = "" if self.dof is None else f", {extent(self.dof, 'degrees of freedom')}"
        lines.append(("covariance", "unknown" if self.covariance is None else f"known{dof}"))
        if self.quality:
            lines.append(("quality", listed(self.quality)))
        if self.drive_factor_uncertainty:
            lines.append(("drive factor", f"uncertain by {percent(self.drive_factor_uncertainty)}"))
        lines += noted(self.provenance)
        return f"FrequencyResponse: {counted(self.n, 'point')} of {name}, {self.motion}", lines

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
    def runs(self) -> list[str]:
        """Distinct run labels in order of appearance; empty where there are none."""
        return [] if self.run is None else distinct(self.run)

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
        """Return the same points, with their covariance, as another standard quantity.

        The covariance transforms by the Jacobian of the conversion, first order in the error.
        Amplitude and drive remain those of displacement and force.

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
            If a response of zero would have to be inverted, or rows hold harmonics, which cannot
            be converted.

        Examples
        --------
        >>> data = FrequencyResponse([1.0], [4.0 + 3.0j], amplitude=[1e-3])
        >>> data.to("receptance").response
        array([0.16-0.12j])
        """
        one_of(quantity, "quantity", QUANTITIES)
        if quantity == self.quantity:
            return self
        if self.quantity == "backbone":
            raise ValidationError(
                f"a backbone becomes {quantity} only with the modal mass: with_mass(mass).to(...)"
            )
        if (self.harmonic != 1).any():
            raise ValidationError(
                f"rows with harmonics {listed(np.unique(self.harmonic))} cannot become "
                f"{quantity}; take {fundamental_alone()} first"
            )
        response, derivative = converted(self.response, self.omega, self.quantity, quantity)
        J = jacobian(derivative)
        changed: dict[str, Any] = {"response": response, "quantity": quantity}
        if self.covariance is not None:
            changed["covariance"] = J @ self.covariance @ J.swapaxes(1, 2)
        for name in ("amplitude_covariance", "drive_covariance"):
            if getattr(self, name) is not None:
                changed[name] = np.einsum("nij,nj->ni", J, getattr(self, name))
        return replace(self, **changed)

    def select(
        self,
        *,
        level: Any = None,
        run: Any = None,
        frequency_hz: tuple[float, float] | None = None,
        harmonic: int | None = None,
        rows: ArrayLike | None = None,
    ) -> FrequencyResponse:
        """Return the points that meet all conditions.

        Parameters
        ----------
        level : label or list of labels, optional
            Keep these levels.
        run : label or list of labels, optional
            Keep these runs.
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
            If no point remains, or a level or run does not exist.

        Examples
        --------
        >>> data = FrequencyResponse([1.0, 2.0], [1.0, 1.0j], drive=[1.0, 1.0], level=["a", "b"])
        >>> data.select(level="b").frequency_hz
        array([2.])
        """
        keep = np.ones(self.n, dtype=bool)
        for name, label, existing in (("level", level, self.levels), ("run", run, self.runs)):
            if label is None:
                continue
            labels = [label] if np.ndim(label) == 0 else list(label)
            absent = [label for label in labels if label not in existing]
            if not existing or absent:
                raise ValidationError(f"no {name} {absent}; there are {listed(existing) or 'none'}")
            keep &= np.isin(getattr(self, name), labels)
        if frequency_hz is not None:
            low, high = frequency_hz
            keep &= (self.frequency_hz >= low) & (self.frequency_hz <= high)
        if harmonic is not None:
            keep &= self.harmonic == harmonic
        if rows is not None:
            mask = np.asarray(rows)
            if mask.dtype != np.bool_ or mask.shape != keep.shape:
                raise ValidationError(
                    f"rows: expected {self.n} values, True or False; got dtype {mask.dtype} of "
                    f"shape {mask.shape}"
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
            ours, theirs = shared_properties(first), shared_properties(part)
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
            deviations, instead of ``real`` and ``imag`` with their covariance. The polar form loses
            the correlation of gain and phase.

        Returns
        -------
        pandas.DataFrame

        Examples
        --------
        >>> data = FrequencyResponse([1.0], [4.0 + 3.0j], amplitude=[1e-3])
        >>> list(data.to_frame(polar=True).columns[:4])
        ['frequency_hz', 'amplitude [m]', 'gain [N/m]', 'phase_deg']
        """
        import pandas as pd

        for name in sorted(self.quality.keys() & {*FILE_COLUMNS, "frequency_hz"}):
            raise ValidationError(
                f"quality {name!r} is also the name of a column of the table; rename it"
            )
        form = "backbone" if self.quantity == "backbone" else "polar" if polar else "rectangular"
        columns: dict[str, Any] = {}
        for name, column in RESPONSE_COLUMNS.items():
            unit = f" [{column.unit_of(self.motion, self.quantity)}]" if column.unit else ""
            if column.form in ("", form):
                columns[column.header or f"{name}{unit}"] = column.saved(self)
        columns = {n: c for n, c in (columns | dict(self.quality)).items() if c is not None}
        frame = pd.DataFrame(columns)
        frame.attrs["dahl_ident"] = {
            "quality": {name: verdict.dtype.kind for name, verdict in self.quality.items()},
            "text": [str(name) for name, c in columns.items() if c.dtype.kind == "U"],
            "drive_factor_uncertainty": self.drive_factor_uncertainty,
            "provenance": plain_data(self.provenance),
        }
        return frame

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
        import control

        if (self.harmonic != 1).any():
            raise ValidationError(
                f"a transfer function has no harmonics; use {fundamental_alone()} first"
            )
        systems = {}
        for label in self.levels or [None]:
            part = self if label is None else self.select(level=label)
            order = np.argsort(part.omega, kind="stable")
            twice = np.flatnonzero(np.diff(part.omega[order]) == 0.0)
            if twice.size:
                raise ValidationError(
                    f"level {label!r} has {part.frequency_hz[order][twice[0]]:g} Hz more "
                    "than once; a transfer function has one value at each frequency. Give the rows "
                    "levels"
                )
            systems[label] = control.FrequencyResponseData(part.response[order], part.omega[order])
        return systems

    def plot(self, ax: Any = None) -> tuple[Any, Any]:
        """Draw gain and phase of the fundamental, over frequency or over amplitude.

        Over frequency, with one curve for each level, if a level has more than one frequency;
        otherwise over amplitude, with error bars where the covariance is known.

        Parameters
        ----------
        ax : sequence of two matplotlib Axes, optional
            For gain and for phase; new ones by default.

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
        from dahl_ident.data.curves import draw

        return draw(self, ax)
