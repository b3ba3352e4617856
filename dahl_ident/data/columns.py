"""The columns of tables, each declared once, and the checks of their values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from operator import attrgetter
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import (
    SMALLEST,
    FloatArray,
    finite_array,
    non_negative_array,
    positive_array,
    real_array,
    refuse_masked,
)
from dahl_ident.errors import UnitError, ValidationError, choices
from dahl_ident.units import (
    DRIVE_KINDS,
    MOTION_KINDS,
    QUANTITIES,
    Motion,
    kind_of,
    parse_unit,
    polar_std,
    si_unit,
)

Check = Callable[[ArrayLike, str], NDArray[Any]]
Controlled = Literal["displacement", "force"]
CONTROLLED: tuple[Controlled, ...] = get_args(Controlled)


def frozen_copy(array: NDArray[Any]) -> NDArray[Any]:
    """Return a contiguous read-only copy of `array`, or `array` itself if it is one."""
    flags = array.flags
    if flags.owndata and flags.c_contiguous and not flags.writeable and type(array) is np.ndarray:
        return array
    copy = np.array(array, order="C")
    copy.setflags(write=False)
    return copy


def frozen_mapping(value: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """Return a read-only copy of a mapping, or None for None."""
    return None if value is None else MappingProxyType(dict(value))


def one_of(value: str, name: str, allowed: tuple[str, ...]) -> str:
    """Return `value` if it is among `allowed`, otherwise raise an error that lists them."""
    if value not in allowed:
        raise ValidationError(
            f"{name} is {value!r}; expected one of {choices(allowed, str(value))}"
        )
    return value


def set_checked(instance: Any, check: Callable[[Any, str], Any], *names: str) -> None:
    """Replace fields of a frozen dataclass by checked values; a default of None remains."""
    optional = {f.name for f in fields(instance) if f.default is None}
    for name in names:
        value = getattr(instance, name)
        if value is not None or name not in optional:
            object.__setattr__(instance, name, check(value, name))


def complex_values(value: ArrayLike, name: str) -> NDArray[np.complex128]:
    """Return finite complex numbers."""
    array = np.asarray(value)
    if array.dtype.kind not in "cfiu":
        raise ValidationError(f"{name}: expected complex numbers, got dtype {array.dtype}")
    finite_array(array.real, f"{name}.real")
    finite_array(array.imag, f"{name}.imag")
    return array.astype(np.complex128)


def degrees_of_freedom(value: ArrayLike, name: str) -> FloatArray:
    """Return numbers above zero; infinity is allowed."""
    array = real_array(value, name)
    for i in np.flatnonzero(~(array > 0.0))[:1]:
        raise ValidationError(
            f"{name}[{i}] is {float(array.flat[i])!r}; expected a number > 0 or infinity"
        )
    return array


def labels(value: ArrayLike, name: str) -> NDArray[Any]:
    """Return finite numbers, or text."""
    array = np.asarray(value)
    return array.astype(str) if array.dtype.kind in "OUT" else finite_array(array, name)


def run_labels(value: ArrayLike, name: str) -> NDArray[np.str_]:
    """Return text labels; numbers become text, with 3.0 equal to 3."""
    array = labels(value, name)
    if array.dtype.kind == "U":
        return array
    return np.array([f"{number:.15g}" for number in array.flat], np.str_).reshape(array.shape)


def controlled_words(value: ArrayLike, name: str) -> NDArray[np.str_]:
    """Return an array of the words in ``CONTROLLED``."""
    array = np.asarray(value, dtype=np.str_)
    for word in np.unique(array):
        one_of(str(word), name, CONTROLLED)
    return array


def harmonic_numbers(value: ArrayLike, name: str) -> NDArray[np.int64]:
    """Return whole numbers >= 0."""
    array = non_negative_array(value, name)
    for number in array[array != np.round(array)][:1]:
        raise ValidationError(f"{name}: expected whole numbers, got {float(number)!r}")
    return array.astype(np.int64)


def plain_values(value: ArrayLike, name: str) -> NDArray[Any]:
    """Return numbers (including NaN and infinity), truth values or text."""
    array = np.asarray(value)
    if array.dtype.kind in "OT":
        return array.astype(str)
    if array.dtype.kind not in "biufU":
        raise ValidationError(f"{name}: expected numbers or text, got dtype {array.dtype}")
    return array


def check_covariance(
    covariance: FloatArray, amplitude_std: FloatArray | None, cross: FloatArray | None
) -> None:
    """Refuse a matrix that is not a covariance of (amplitude, real part, imaginary part)."""
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
    bad = (asymmetry > 1e-9) | (np.linalg.eigvalsh(correlation)[:, 0] < -1e-9)
    for row in np.flatnonzero(bad)[:1]:
        raise ValidationError(
            f"covariance[{row}] is {covariance[row].tolist()}; expected a symmetric positive "
            "semidefinite matrix, also together with the amplitude's variance and covariance"
        )


Table = Any
"""A FrequencyResponse; its module imports this one."""
Source = str | Callable[[Table], NDArray[Any] | None]


@dataclass(frozen=True)
class Column:
    """A column of tables: its allowed values, its name and unit in files, and how it is saved.

    It is saved under the first of its `names` (or `header`) in `unit`, and only in tables of the
    `form`, if given; it is read under all of its names. A unit in a file may be of one of `kinds`;
    if the header has none, that of the first existing column in `like` is taken. `least` is the
    smallest number allowed, described by `expected`.

    `source` gives the values: an attribute of the table, of which `part` may select an entry of
    each row, or a function of the table. In memory the column has a `check`; `shape` is that of the
    value in one row; if it `repeats`, one value may be given for all rows; it requires the columns
    in `needs`.
    """

    names: tuple[str, ...] = ()
    unit: str = ""
    source: Source = ""
    check: Check | None = None
    shape: tuple[int, ...] = ()
    repeats: bool = False
    needs: tuple[str, ...] = ()
    part: tuple[int, ...] = ()
    form: str = ""
    header: str = ""
    kinds: tuple[str, ...] = ()
    like: tuple[str, ...] = ()
    expected: str = ""
    least: float = 0.0

    def checked(self, value: ArrayLike | None, name: str, n: int) -> NDArray[Any] | None:
        """Return a read-only array of n rows, or None for None."""
        if value is None:
            return None
        refuse_masked(value, name)
        array = np.asarray(value) if self.check is None else self.check(value, name)
        if self.repeats and not array.ndim:
            array = np.full(n, array)
        if array.shape != (n, *self.shape):
            raise ValidationError(
                f"{name}: expected shape {(n, *self.shape)}, one entry for each point, got "
                f"{array.shape}"
            )
        return frozen_copy(array)

    def saved(self, data: Table) -> NDArray[Any] | None:
        """Return the values in a table, None if the table does not have the column."""
        if not isinstance(self.source, str):
            return self.source(data)
        values = attrgetter(self.source)(data) if self.source else None
        return None if values is None else np.asarray(values[(slice(None), *self.part)])

    def unit_of(self, motion: Motion, quantity: str) -> str:
        """Return the SI unit in tables of a quantity for translation or rotation."""
        kinds = {kind: si_unit(kind, motion) for kind in ("displacement", "force")}
        return self.unit.format(**kinds, response=si_unit(quantity, motion))

    def accepts(self, unit: str | None, what: str) -> bool:
        """Return whether the unit of `what` is of one of the kinds."""
        if unit is None or not self.kinds:
            return False
        try:
            kind_of(parse_unit(unit), self.kinds, what)
        except UnitError:
            return False
        return True


def _polar_std(data: Table, axis: int) -> FloatArray | None:
    """Return the standard deviation of gain (axis 0) or phase in degrees (1)."""
    if data.covariance is None:
        return None
    return polar_std(data.response, data.covariance)[axis] * (180.0 / np.pi) ** axis


def backbone_std(data: Table, axis: int) -> FloatArray:
    """Return the standard deviation of a backbone's frequencies, Hz, or damping ratios (axis 1)."""
    assert data.covariance is not None  # a backbone has one
    std = np.sqrt(data.covariance[:, axis, axis])
    return np.asarray(std if axis else data.frequency_hz * std)


def check_table(data: Table) -> None:
    """Refuse a table without a column that it needs, or with an impossible row."""
    if data.amplitude is None and data.drive is None:
        raise ValidationError(
            "neither amplitude nor drive is given; a response with friction means nothing "
            "without the amplitude it was measured at"
        )
    for name, column in COLUMNS.items():
        absent = [need for need in column.needs if getattr(data, need) is None]
        if absent and getattr(data, name) is not None:
            raise ValidationError(f"{name} is given without {' and '.join(absent)}")
    if data.quantity == "backbone":
        if data.amplitude is None or data.covariance is None:
            raise ValidationError(
                "a backbone needs amplitudes, and standard deviations of the natural "
                "frequencies and of the damping ratios"
            )
        for row in np.flatnonzero((data.response.imag < 0.0) | (data.controlled == "force"))[:1]:
            raise ValidationError(
                f"row {row} has the damping ratio {data.response.imag[row]:g} and "
                f"controlled {data.controlled[row]!r}; expected a ratio >= 0, and "
                "'displacement', at whose amplitude the frequency was found"
            )
    if data.quantity != "dynamic_stiffness":
        forced = (data.quantity == "receptance") & (data.controlled == "force")
        for row in np.flatnonzero((data.harmonic != 1) & ~forced)[:1]:
            raise ValidationError(
                f"harmonic[{row}] is {data.harmonic[row]} in a table of {data.quantity}, "
                f"{data.controlled[row]} controlled; harmonics of the force are rows of "
                "dynamic stiffness, F_k/X_1, those of the displacement rows of receptance, "
                "X_k/F_1, with the force controlled"
            )
    mean = data.harmonic == 0
    for row in np.flatnonzero(mean & (data.response.imag != 0.0))[:1]:
        raise ValidationError(
            f"response[{row}] is {data.response[row]}; expected a real number, as a row with "
            "harmonic 0 holds a mean over the amplitude of what was controlled"
        )
    if data.covariance is not None:
        imaginary = np.abs(data.covariance[:, 1, :]).sum(axis=1)
        if data.amplitude_covariance is not None:
            imaginary = imaginary + np.abs(data.amplitude_covariance[:, 1])
        for row in np.flatnonzero(mean & (imaginary != 0.0))[:1]:
            raise ValidationError(
                f"covariance[{row}] gives the imaginary part an error; expected 0, as a row "
                "with harmonic 0 is a real number"
            )
        check_covariance(data.covariance, data.amplitude_std, data.amplitude_covariance)
        check_covariance(data.covariance, data.drive_std, data.drive_covariance)


_A, _F, _R = "{displacement}", "{force}", "{response}"
_PEAK: dict[str, Any] = {"check": positive_array, "expected": "a value > 0", "least": SMALLEST}
_PARTS = (
    ("real", ("real", "re", "real_part"), ()),
    ("imag", ("imag", "im", "imaginary", "imag_part"), ("real",)),
)
_std = partial(Column, expected="a standard deviation >= 0")
_response = partial(Column, unit=_R, kinds=QUANTITIES)
_RESPONSE = (
    Column(
        ("frequency", "freq", "frequency_hz", "freq_hz"),
        "Hz",
        "frequency_hz",
        positive_array,
        header="frequency_hz",
        kinds=("frequency", "angular_frequency"),
        least=SMALLEST,
        expected="a frequency > 0",
    ),
    Column(("level",), "", "level", labels, repeats=True),
    Column(("run", "test", "file", "day"), "", "run", run_labels, repeats=True),
    Column(("amplitude", "displacement_amplitude"), _A, "amplitude", kinds=MOTION_KINDS, **_PEAK),
    Column(
        ("drive", "force", "force_amplitude", "drive_amplitude", "torque"),
        _F,
        "drive",
        kinds=DRIVE_KINDS,
        **_PEAK,
    ),
    _response(("response", "frf"), source="response", check=complex_values, form="complex"),
    *(
        _response(
            (*names, *(f"{q}_{end}" for q in QUANTITIES for end in (names[1], part))),
            source=f"response.{part}",
            form="rectangular",
            like=like,
        )
        for part, names, like in _PARTS
    ),
    Column(source="covariance", check=finite_array, shape=(2, 2)),
    *(
        Column((f"covariance_{name}",), f"({_R})^2", "covariance", part=part, form="rectangular")
        for name, part in (("real_real", (0, 0)), ("real_imag", (0, 1)), ("imag_imag", (1, 1)))
    ),
    Column(
        ("damping_ratio", "zeta"),
        "1",
        "response.imag",
        form="backbone",
        header="damping_ratio",
        expected="a damping ratio >= 0",
    ),
    _std(
        ("frequency_std",),
        "Hz",
        partial(backbone_std, axis=0),
        form="backbone",
        like=("frequency",),
    ),
    _std(
        ("damping_ratio_std", "zeta_std"),
        "1",
        partial(backbone_std, axis=1),
        form="backbone",
        header="damping_ratio_std",
    ),
    _response(("gain", "magnitude", "mag"), source="gain", form="polar"),
    _response(("gain_db", "magnitude_db", "mag_db")),
    Column(
        ("phase", "phase_deg", "phase_rad"),
        "deg",
        lambda d: np.degrees(d.phase),
        form="polar",
        header="phase_deg",
        kinds=("angle",),
    ),
    _std(("std",), _R, like=("gain", "real", "response")),
    *(_std((f"{part}_std",), _R, like=("real", "response")) for part in ("real", "imag")),
    _std(("gain_std",), _R, partial(_polar_std, axis=0), form="polar", like=("gain",)),
    _std(
        ("phase_std", "phase_std_deg", "phase_std_rad"),
        "rad",
        partial(_polar_std, axis=1),
        form="polar",
        header="phase_std_deg",
    ),
    Column(("dof",), "", "dof", degrees_of_freedom, repeats=True, needs=("covariance",)),
    *(
        column
        for name, unit in (("amplitude", _A), ("drive", _F))
        for column in (
            _std(
                (f"{name}_std",),
                unit,
                f"{name}_std",
                non_negative_array,
                needs=(name,),
                like=(name,),
            ),
            Column(
                source=f"{name}_covariance",
                check=finite_array,
                shape=(2,),
                needs=(f"{name}_std", "covariance"),
            ),
            *(
                Column(
                    (f"covariance_{name}_{part}",),
                    f"({unit})*({_R})",
                    f"{name}_covariance",
                    part=(i,),
                    form="rectangular",
                )
                for i, (part, _, _) in enumerate(_PARTS)
            ),
        )
    ),
    Column(("controlled",), "", "controlled", controlled_words, repeats=True),
    Column(("harmonic",), "", "harmonic", harmonic_numbers, repeats=True),
)
RECORD_COLUMNS = {
    names[0]: Column(names, unit, names[0], finite_array, kinds=kinds)
    for names, unit, kinds in (
        (("time", "t", "time_s", "timestamp"), "s", ("time",)),
        (("displacement", "disp", "position", "x"), "um", ("displacement",)),
        (("velocity", "vel", "v"), "mm/s", ("velocity",)),
        (("acceleration", "accel", "acc", "a"), "m/s^2", ("acceleration",)),
        (("force", "f", "torque"), _F, ("force",)),
        (("drive", "voltage", "current"), _F, DRIVE_KINDS),
    )
}
"""Columns of a record, in memory and in files."""
COLUMNS = {str(column.source): column for column in _RESPONSE if column.check}
"""Columns of a frequency response in memory."""
RESPONSE_COLUMNS = {column.names[0]: column for column in _RESPONSE if column.names}
"""Columns of files of responses, in the order in which they are saved."""
FILE_COLUMNS = RECORD_COLUMNS | RESPONSE_COLUMNS


def combined(
    parts: Sequence[Table], combine: Callable[[list[NDArray[Any]]], NDArray[Any]]
) -> dict[str, Any]:
    """Return constructor arguments: `combine` applied to each column of all parts."""
    columns: dict[str, Any] = {
        name: combine([getattr(part, name) for part in parts])
        for name in COLUMNS
        if getattr(parts[0], name) is not None
    }
    columns["quality"] = {
        name: combine([part.quality[name] for part in parts])
        for name in parts[0].quality
        if all(name in part.quality for part in parts)
    }
    return columns


def shared_properties(data: Table) -> set[str]:
    """Return the properties in which two tables must agree to be concatenated."""
    columns = {name for name in COLUMNS if getattr(data, name) is not None}
    columns.add(f"a drive factor uncertain by {data.drive_factor_uncertainty:.3g}")
    if data.level is not None:
        columns.add("text levels" if data.level.dtype.kind == "U" else "numeric levels")
    return columns | {data.quantity, data.motion}
