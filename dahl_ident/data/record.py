"""Recorded waveforms of motion and force in SI units."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    SMALLEST,
    FloatArray,
    finite_array,
    non_negative_number,
    positive_number,
)
from dahl_ident.data.columns import RECORD_COLUMNS, frozen_copy, frozen_mapping, one_of
from dahl_ident.data.storage import plain_data
from dahl_ident.data.tabular import Lines, Tabular, extent, noted
from dahl_ident.errors import DataWarning, ValidationError
from dahl_ident.units import MOTION_KINDS, MOTIONS, Motion, percent, si_unit

if TYPE_CHECKING:
    import pandas as pd

DriveUnit = Literal["N", "N m", "V", "A"]
_GAP = 1.5  # median steps; in a longer step a sample is missing
_SMALLEST_VALUE = SMALLEST**0.5  # products and ratios of such numbers have representable squares
_LONG_GAP = 5.0  # median steps; a longer gap is not interpolated
_MOST_GAPS = 0.02  # fraction of the samples; with more gaps the record has uneven steps
_SHOWN_GAPS = 3
_EVEN = 0.01  # fraction of a step by which samples may deviate from an even grid


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Record(Tabular):
    """Time, one channel of motion, and force or drive.

    Parameters
    ----------
    time : (n,) array_like
        Strictly increasing, s.
    displacement, velocity, acceleration : (n,) array_like, optional
        Exactly one of them, m (rad), m/s (rad/s) or m/s^2 (rad/s^2).
    force : (n,) array_like, optional
        Measured force, N (N m in rotation).
    drive : (n,) array_like, optional
        Signal that drove the actuator, in `drive_unit`. At least one of `force` and `drive`.
    drive_unit : {"V", "A", "N", "N m"}
        Unit of `drive`.
    drive_factor : float, optional
        Force per unit of drive, N/V or N/A; 1 if the drive is a force already.
    drive_factor_uncertainty : float
        Relative standard uncertainty of `drive_factor`.
    motion : {"translation", "rotation"}
        Whether displacement is in m or rad.
    provenance : mapping, optional
        Source of the samples: file, hash, options.

    Raises
    ------
    ValidationError
        If a channel is missing, has another length than `time`, or holds NaN; or time does
        not increase.

    Examples
    --------
    >>> t = np.arange(5) / 100.0
    >>> record = Record(t, displacement=np.sin(t), force=np.cos(t))
    >>> record.sample_rate, record.uniform
    (100.0, True)
    """

    time: FloatArray
    displacement: FloatArray | None
    velocity: FloatArray | None
    acceleration: FloatArray | None
    force: FloatArray | None
    drive: FloatArray | None
    drive_unit: DriveUnit
    drive_factor: float | None
    drive_factor_uncertainty: float
    motion: Motion
    provenance: Mapping[str, Any] | None

    def __init__(
        self,
        time: ArrayLike,
        *,
        displacement: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        force: ArrayLike | None = None,
        drive: ArrayLike | None = None,
        drive_unit: DriveUnit = "V",
        drive_factor: float | None = None,
        drive_factor_uncertainty: float = 0.0,
        motion: Motion = "translation",
        provenance: Mapping[str, Any] | None = None,
    ) -> None:
        columns = {name: value for name, value in locals().items() if name in RECORD_COLUMNS}
        seconds = _time(columns.pop("time"))
        values: dict[str, Any] = {
            name: RECORD_COLUMNS[name].checked(value, name, seconds.size)
            for name, value in columns.items()
        }
        for name, samples in values.items():
            size = 0.0 if samples is None else float(np.abs(samples).max())
            if 0.0 < size < _SMALLEST_VALUE:
                raise ValidationError(
                    f"no sample of {name} is above {size:.3g} in size; expected at least "
                    f"{_SMALLEST_VALUE:g}: check the unit"
                )
        motions = [name for name in MOTION_KINDS if values[name] is not None]
        if len(motions) != 1:
            raise ValidationError(
                f"expected exactly one of {', '.join(MOTION_KINDS)}, got {motions or 'none'}"
            )
        if force is None and drive is None:
            raise ValidationError("neither force nor drive is given; a record needs one of them")
        one_of(drive_unit, "drive_unit", ("V", "A", "N", "N m"))
        if drive_factor is None and drive_unit in ("N", "N m"):
            drive_factor = 1.0
        values |= {
            "time": seconds,
            "drive_unit": drive_unit,
            "drive_factor": drive_factor,
            "drive_factor_uncertainty": non_negative_number(
                drive_factor_uncertainty, "drive_factor_uncertainty"
            ),
            "motion": one_of(motion, "motion", MOTIONS),
            "provenance": frozen_mapping(provenance),
        }
        if drive_factor is not None:
            values["drive_factor"] = positive_number(drive_factor, "drive_factor")
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return self.time.size

    @property
    def motion_channel(self) -> Literal["displacement", "velocity", "acceleration"]:
        """The kind of motion that was recorded."""
        if self.displacement is not None:
            return "displacement"
        return "velocity" if self.velocity is not None else "acceleration"

    @property
    def motion_samples(self) -> FloatArray:
        """The samples of :attr:`motion_channel`."""
        return np.asarray(getattr(self, self.motion_channel))

    @property
    def force_samples(self) -> FloatArray:
        """Measured force, or otherwise drive times its factor, N or N m.

        Raises
        ------
        ValidationError
            If the only channel is a drive in V or A without a factor.
        """
        if self.force is not None:
            return self.force
        if self.drive is None or self.drive_factor is None:
            raise ValidationError(
                f"the drive is in {self.drive_unit} and has no factor; give drive_factor, "
                f"N/{self.drive_unit}"
            )
        return self.drive * self.drive_factor

    @property
    def duration(self) -> float:
        """Time from the first sample to the last, s."""
        return float(self.time[-1] - self.time[0])

    @property
    def sample_rate(self) -> float:
        """Mean number of samples per second outside the gaps, Hz."""
        return sample_rate(self.time)

    @property
    def uniform(self) -> bool:
        """Whether every sample lies within 1 % of a step of an even grid."""
        return is_even(self.time)

    @property
    def gaps(self) -> FloatArray:
        """Start and end of every gap, (m, 2), s: steps above 1.5 times the median step."""
        return gaps(self.time)

    def plot(self, kind: Literal["waveforms", "loops"] = "waveforms", ax: Any = None) -> Any:
        """Draw the waveforms over time, or force over motion.

        Parameters
        ----------
        kind : {"waveforms", "loops"}, default "waveforms"
            One panel per channel over time, or force (otherwise drive) over motion.
        ax : matplotlib Axes, optional
            One for loops, a sequence of one per channel for waveforms; new by default.

        Returns
        -------
        Axes, or ndarray of Axes

        Raises
        ------
        ValidationError
            If `kind` is unknown, or `ax` does not hold one of the axes for each channel.

        Examples
        --------
        >>> record = Record([0.0, 0.1], displacement=[0.0, 1.0], force=[0.0, 2.0])
        >>> [axis.get_ylabel() for axis in record.plot()]
        ['displacement [m]', 'force [N]']
        """
        from dahl_ident.data.curves import draw_waveforms

        return draw_waveforms(self.time, self.to_frame(), kind, ax)

    def _summary(self) -> tuple[str, Lines]:
        kind = self.motion_channel
        spacing = "even" if self.uniform else "uneven"
        lines = [("sampling", f"{self.sample_rate:.6g} Hz, {spacing}, {self.duration:.6g} s")]
        if len(self.gaps):
            lines.append(("gaps", str(len(self.gaps))))
        units = self._units
        lines += [(n, extent(getattr(self, n), unit)) for n, unit in units.items() if n != "time"]
        if self.drive_unit in ("V", "A") and self.drive_factor is not None:
            unit = f"{si_unit('force', self.motion)}/{self.drive_unit}"
            uncertain = f" within {percent(self.drive_factor_uncertainty)}"
            lines.append(("drive factor", f"{self.drive_factor:.6g} {unit}{uncertain}"))
        lines += noted(self.provenance)
        return f"Record: {self.n} samples of {kind} in {self.motion}", lines

    @property
    def _units(self) -> dict[str, str]:
        units = {kind: si_unit(kind, self.motion) for kind in (*MOTION_KINDS, "force")}
        units = {"time": "s", **units, "drive": self.drive_unit}
        return {name: unit for name, unit in units.items() if getattr(self, name) is not None}

    def to_sdypy(self) -> list[dict[str, Any]]:
        """Return the channels as SDyPy's time series (its enhancement proposal 5).

        Returns
        -------
        list of dict
            ``name``, ``data``, ``unit_str`` and ``time`` of each channel, and ``fs`` if the samples
            are evenly spaced and begin at zero. :func:`~dahl_ident.read_record` reads the list.

        Examples
        --------
        >>> record = Record([0.0, 0.1], displacement=[0.0, 1.0], force=[0.0, 2.0])
        >>> [(c["name"], c["unit_str"]) for c in record.to_sdypy()]
        [('displacement', 'm'), ('force', 'N')]
        """
        sampling: dict[str, Any] = {"time": self.time}
        if self.uniform and self.time[0] == 0.0:
            sampling["fs"] = self.sample_rate
        units = self._units
        del units["time"]
        return [
            {"name": name, "data": getattr(self, name), "unit_str": unit, **sampling}
            for name, unit in units.items()
        ]

    def to_frame(self) -> pd.DataFrame:
        """Return a pandas table with one row for each sample and units in the headers.

        Returns
        -------
        pandas.DataFrame

        Examples
        --------
        >>> record = Record([0.0, 0.1], displacement=[0.0, 1.0], force=[0.0, 2.0])
        >>> list(record.to_frame().columns)
        ['time [s]', 'displacement [m]', 'force [N]']
        """
        import pandas as pd

        frame = pd.DataFrame({f"{n} [{unit}]": getattr(self, n) for n, unit in self._units.items()})
        frame.attrs["dahl_ident"] = {
            "drive_factor": self.drive_factor,
            "drive_factor_uncertainty": self.drive_factor_uncertainty,
            "provenance": plain_data(self.provenance),
        }
        return frame


def unbroken(record: Record, shortest: int) -> list[Record]:
    """Return the parts of a record between long gaps, and warn if there are several.

    The state of hysteresis is unknown after a gap. Parts of fewer than `shortest` samples are left
    out. A record without a longer part, or with many gaps, has uneven steps rather than gaps.
    """
    steps = np.diff(record.time)
    after = np.flatnonzero(steps > _LONG_GAP * np.median(steps)) + 1
    edges = np.concatenate([[0], after, [record.n]])
    kept = [slice(a, b) for a, b in pairwise(edges.tolist()) if b - a >= shortest]
    if not after.size or not kept or after.size > _MOST_GAPS * record.n:
        return [record]
    shown = [f"{record.time[a - 1]:.6g} to {record.time[a]:.6g} s" for a in after.tolist()]
    shown[_SHOWN_GAPS:] = ["others"][: len(shown) > _SHOWN_GAPS]
    parts = "one part is used" if len(kept) == 1 else f"{len(kept)} parts are fitted"
    lost = record.n - sum(part.stop - part.start for part in kept)
    message = (
        f"nothing is known from {', '.join(shown)}; {parts}, each from a first state of its own"
        + (f"; {lost} samples in shorter parts are left out" if lost else "")
    )
    provenance = _with_warning(record, message)
    return [replace(cut(record, part), provenance=provenance) for part in kept]


def at_even_times(record: Record) -> Record:
    """Return a record with even steps, and warn if cubic splines resample it."""
    time = record.time
    if time.size <= 3 or record.uniform:
        return record
    from scipy.interpolate import make_interp_spline

    step = float(np.median(np.diff(time)))
    grid = np.linspace(time[0], time[-1], 1 + round((time[-1] - time[0]) / step))
    message = (
        f"the samples from {time[0]:.6g} to {time[-1]:.6g} s are not evenly spaced; resampled at "
        f"{1.0 / step:.6g} Hz"
    )
    columns: dict[str, Any] = {
        name: make_interp_spline(time, getattr(record, name))(grid) for name in record._units
    }
    return replace(record, **columns | {"time": grid}, provenance=_with_warning(record, message))


def _with_warning(record: Record, message: str) -> dict[str, Any]:
    provenance = dict(record.provenance or {})
    warnings.warn(f"{provenance.get('file', 'the record')}: {message}", DataWarning, stacklevel=3)
    return provenance | {"warnings": [*provenance.get("warnings", ()), message]}


def cut(record: Record, part: slice) -> Record:
    """Return a record of some of the samples."""
    return replace(record, **{name: getattr(record, name)[part] for name in record._units})


def _time(value: ArrayLike) -> FloatArray:
    time = finite_array(value, "time")
    if time.ndim != 1 or time.size < 2:
        raise ValidationError(f"time: expected at least two samples, got shape {time.shape}")
    backwards = np.flatnonzero(time[1:] <= time[:-1])
    if backwards.size:
        i = int(backwards[0])
        raise ValidationError(
            f"time[{i + 1}] is {float(time[i + 1])!r} after time[{i}] = {float(time[i])!r} "
            f"({backwards.size} such steps); expected strictly increasing time"
        )
    return frozen_copy(time)


def sample_rate(time: FloatArray) -> float:
    """Return the mean number of samples per second outside the gaps."""
    steps = np.diff(time)
    kept = steps[steps <= _GAP * np.median(steps)]
    return float(kept.size / kept.sum())


def is_even(time: FloatArray) -> bool:
    """Return whether every sample lies within 1 % of a step of an even grid."""
    grid = np.linspace(time[0], time[-1], time.size)
    step = (time[-1] - time[0]) / (time.size - 1)
    return bool(np.abs(time - grid).max() <= _EVEN * step)


def gaps(time: FloatArray) -> FloatArray:
    """Return start and end of every step longer than 1.5 times the median step, (m, 2)."""
    steps = np.diff(time)
    before = np.flatnonzero(steps > _GAP * np.median(steps))
    return np.column_stack([time[before], time[before + 1]])
