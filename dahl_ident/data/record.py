"""Sampled waveforms of motion and force, as a laboratory stored them.

A :class:`Record` keeps every sample where it was taken: time need not be evenly spaced, and
gaps are named, not filled. Accelerometers and vibrometers are welcome: motion may be
displacement, velocity or acceleration. SI units throughout.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray, finite_array, positive_number
from dahl_ident.data.fields import column, frozen_copy, frozen_mapping, one_of
from dahl_ident.data.sampling import gaps, is_even, sample_rate
from dahl_ident.data.summary import Lines, record_lines
from dahl_ident.data.tabular import Tabular
from dahl_ident.errors import ValidationError
from dahl_ident.units import MOTION_KINDS, MOTIONS, Motion

if TYPE_CHECKING:
    import pandas as pd

DriveUnit = Literal["N", "N m", "V", "A"]


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
        What drove the actuator, in `drive_unit`. At least one of `force` and `drive`.
    drive_unit : {"V", "A", "N", "N m"}
        Unit of `drive`.
    drive_factor : float, optional
        Force for one unit of drive, N/V or N/A; 1 where the drive is a force already.
    drive_factor_uncertainty : float
        Relative standard uncertainty of `drive_factor`.
    motion : {"translation", "rotation"}
        Whether displacement is m or rad.
    provenance : mapping, optional
        Where the samples come from: file, hash, options.

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
        seconds = _time(time)
        n = seconds.size
        channels: dict[str, ArrayLike | None] = {
            "displacement": displacement,
            "velocity": velocity,
            "acceleration": acceleration,
            "force": force,
            "drive": drive,
        }
        values: dict[str, Any] = {
            name: column(value, name, n, finite_array) for name, value in channels.items()
        }
        given = [name for name in MOTION_KINDS if values[name] is not None]
        if len(given) != 1:
            raise ValidationError(
                f"expected exactly one of {', '.join(MOTION_KINDS)}, got {given or 'none'}"
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
            "drive_factor_uncertainty": float(drive_factor_uncertainty),
            "motion": one_of(motion, "motion", MOTIONS),
            "provenance": frozen_mapping(provenance),
        }
        if drive_factor is not None:
            values["drive_factor"] = positive_number(drive_factor, "drive_factor")
        if not 0.0 <= drive_factor_uncertainty < np.inf:
            raise ValidationError(
                f"drive_factor_uncertainty is {drive_factor_uncertainty!r}; expected a relative "
                "standard uncertainty >= 0"
            )
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return self.time.size

    @property
    def motion_channel(self) -> Literal["displacement", "velocity", "acceleration"]:
        """Which kind of motion was recorded."""
        if self.displacement is not None:
            return "displacement"
        return "velocity" if self.velocity is not None else "acceleration"

    @property
    def motion_samples(self) -> FloatArray:
        """The samples of :attr:`motion_channel`."""
        samples = getattr(self, self.motion_channel)
        return np.asarray(samples)

    @property
    def force_samples(self) -> FloatArray:
        """Measured force; where there is none, drive times its factor. N or N m.

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

    def _summary(self) -> tuple[str, Lines]:
        return record_lines(self)

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
        from dahl_ident.data.table import record_frame

        return record_frame(self)


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
