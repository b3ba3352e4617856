"""The columns of tables, each declared once, and the checks of what they may hold.

:data:`COLUMNS` are those of a frequency response in memory. :data:`RESPONSE_COLUMNS` and
:data:`RECORD_COLUMNS` are those of files: how each is called, its unit, and what is saved in it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any

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
from dahl_ident.data.quantities import polar_std
from dahl_ident.errors import UnitError, ValidationError, choices
from dahl_ident.units import (
    DRIVE_KINDS,
    MOTION_KINDS,
    QUANTITIES,
    Motion,
    kind_of,
    parse_unit,
    si_unit,
)

Check = Callable[[ArrayLike, str], NDArray[Any]]
CONTROLLED = ("displacement", "force")


def frozen_copy(array: NDArray[Any]) -> NDArray[Any]:
    """Return a contiguous copy of `array` that cannot be written to; one of these, as it is."""
    flags = array.flags
    if flags.owndata and flags.c_contiguous and not flags.writeable and type(array) is np.ndarray:
        return array
    copy = np.array(array, order="C")
    copy.setflags(write=False)
    return copy


def frozen_mapping(value: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """Return a read-only copy of a mapping, or None for None."""
    return None if value is None else MappingProxyType(dict(value))


def plain_mappings(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return constructor arguments with plain dicts, which pickle where proxies do not."""
    return {k: dict(v) if isinstance(v, MappingProxyType) else v for k, v in pairs}


def one_of(value: str, name: str, allowed: tuple[str, ...]) -> str:
    """Return `value` if it is among `allowed`, else name them."""
    if value not in allowed:
        raise ValidationError(
            f"{name} is {value!r}; expected one of {choices(allowed, str(value))}"
        )
    return value


def set_checked(instance: Any, check: Callable[[Any, str], Any], *names: str) -> None:
    """Replace fields of a frozen dataclass by what a check returns; a default of None stays."""
    optional = {one.name for one in fields(instance) if one.default is None}
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
    """Return numbers above zero, infinity among them."""
    array = real_array(value, name)
    bad = np.flatnonzero(~(array > 0.0))
    if bad.size:
        raise ValidationError(
            f"{name}[{bad[0]}] is {float(array.flat[bad[0]])!r}; expected a number > 0 or infinity"
        )
    return array


def labels(value: ArrayLike, name: str) -> NDArray[Any]:
    """Return finite numbers, or text."""
    array = np.asarray(value)
    return array.astype(str) if array.dtype.kind in "OUT" else finite_array(array, name)


def run_labels(value: ArrayLike, name: str) -> NDArray[np.str_]:
    """Return text labels; numbers become text, 3.0 the same as 3."""
    array = labels(value, name)
    if array.dtype.kind == "U":
        return array
    return np.array([f"{number:.15g}" for number in array.flat], np.str_).reshape(array.shape)


def controlled_words(value: ArrayLike, name: str) -> NDArray[np.str_]:
    """Return words out of ``CONTROLLED``."""
    array = np.asarray(value, dtype=np.str_)
    for word in np.unique(array):
        one_of(str(word), name, CONTROLLED)
    return array


def harmonic_numbers(value: ArrayLike, name: str) -> NDArray[np.int64]:
    """Return whole numbers of 0 and above."""
    array = non_negative_array(value, name)
    broken = array != np.round(array)
    if broken.any():
        raise ValidationError(f"{name}: expected whole numbers, got {float(array[broken][0])!r}")
    return array.astype(np.int64)


def plain_values(value: ArrayLike, name: str) -> NDArray[Any]:
    """Return numbers (NaN and infinity among them), truth values or text."""
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
    smallest = np.linalg.eigvalsh(correlation)[:, 0]
    bad = (asymmetry > 1e-9) | (smallest < -1e-9)
    if bad.any():
        row = int(np.argmax(bad))
        raise ValidationError(
            f"covariance[{row}] is {covariance[row].tolist()}; expected a symmetric positive "
            "semidefinite matrix, also together with the amplitude's variance and covariance"
        )


@dataclass(frozen=True)
class Column:
    """A column of a frequency response or a record in memory.

    `check` returns an array of allowed values, or raises an error that names the column; `shape` is
    that of one row's value; where it `repeats`, one value may be given for all rows; without the
    columns that it `needs` it means nothing.
    """

    check: Check
    shape: tuple[int, ...] = ()
    repeats: bool = False
    needs: tuple[str, ...] = ()

    def checked(self, value: ArrayLike | None, name: str, n: int) -> NDArray[Any] | None:
        """Return a read-only array of n rows, or None for None."""
        if value is None:
            return None
        refuse_masked(value, name)
        array = self.check(value, name)
        if self.repeats and not array.ndim:
            array = np.full(n, array)
        if array.shape != (n, *self.shape):
            raise ValidationError(
                f"{name}: expected shape {(n, *self.shape)}, one entry for each point, got "
                f"{array.shape}"
            )
        return frozen_copy(array)


COLUMNS = {
    "frequency_hz": Column(positive_array),
    "response": Column(complex_values),
    "amplitude": Column(positive_array),
    "drive": Column(positive_array),
    "covariance": Column(finite_array, (2, 2)),
    "dof": Column(degrees_of_freedom, repeats=True, needs=("covariance",)),
    "amplitude_std": Column(non_negative_array, needs=("amplitude",)),
    "amplitude_covariance": Column(finite_array, (2,), needs=("amplitude_std", "covariance")),
    "drive_std": Column(non_negative_array, needs=("drive",)),
    "drive_covariance": Column(finite_array, (2,), needs=("drive_std", "covariance")),
    "level": Column(labels, repeats=True),
    "run": Column(run_labels, repeats=True),
    "controlled": Column(controlled_words, repeats=True),
    "harmonic": Column(harmonic_numbers, repeats=True),
}


Table = Any
"""A frequency response, whose own module uses this one."""
Saved = Callable[[Table], NDArray[Any] | None]


@dataclass(frozen=True)
class FileColumn:
    """A column of a file, with its name and others under which it is found without a map.

    `unit` is that in which it is saved, such as ``({displacement})*({response})``; where a header
    has none, the first column of `like` gives it. `kinds` are those that a file's unit may be of,
    where they are several. `least` is the smallest number that is allowed, and `expected` says so.
    `saved` returns its values in a frequency response; `form` is the only form of table that has
    it: "rectangular", "polar" or "backbone". It is saved under `header`, by default its name with
    its unit in brackets.
    """

    names: tuple[str, ...]
    unit: str = ""
    saved: Saved | None = None
    form: str = ""
    header: str = ""
    kinds: tuple[str, ...] = ()
    like: tuple[str, ...] = ()
    expected: str = ""
    least: float = 0.0

    def unit_of(self, motion: Motion, quantity: str) -> str:
        """Return the SI unit in tables of a quantity, of translation or rotation."""
        kinds = {kind: si_unit(kind, motion) for kind in ("displacement", "force")}
        return self.unit.format(**kinds, response=si_unit(quantity, motion))

    def header_of(self, data: Table) -> str:
        """Return the header with which it is saved."""
        unit = f" [{self.unit_of(data.motion, data.quantity)}]" if self.unit else ""
        return self.header or f"{self.names[0]}{unit}"

    def measures(self, unit: str | None, what: str) -> bool:
        """Return whether a unit, that `what` has, is of one of the kinds."""
        if unit is None or not self.kinds:
            return False
        try:
            kind_of(parse_unit(unit), self.kinds, what)
        except UnitError:
            return False
        return True

    @property
    def example(self) -> str:
        """A unit such as this column might have."""
        return self.unit.format(displacement="um", force="N", response="N/m")


def _of(name: str, *part: int) -> Saved:
    """Return a function of a frequency response that gives a column, or a part of each row's."""

    def saved(data: Table) -> NDArray[Any] | None:
        values = getattr(data, name)
        return None if values is None else values[(slice(None), *part)]

    return saved


def _polar(axis: int) -> Saved:
    """Return a function that gives the standard deviation of gain (0) or phase, in degrees (1)."""

    def saved(data: Table) -> NDArray[Any] | None:
        if data.covariance is None:
            return None
        std = polar_std(data.response, data.covariance)[axis]
        return np.degrees(std) if axis else std

    return saved


def backbone_std(data: Table, axis: int) -> FloatArray:
    """Return the standard deviation of a backbone's frequencies, Hz (0), or damping ratios (1)."""
    assert data.covariance is not None  # a backbone has one
    std = np.sqrt(data.covariance[:, axis, axis])
    return np.asarray(std if axis else data.frequency_hz * std)


_A, _F, _R = "{displacement}", "{force}", "{response}"
_STD: dict[str, Any] = {"expected": "a standard deviation >= 0"}
_PEAK: dict[str, Any] = {"expected": "a value > 0", "least": SMALLEST}
_OF_RESPONSE: dict[str, Any] = {"kinds": QUANTITIES}
_RESPONSE = (
    FileColumn(
        ("frequency", "freq", "frequency_hz", "freq_hz"), "Hz", _of("frequency_hz"),
        header="frequency_hz", kinds=("frequency", "angular_frequency"), least=SMALLEST,
        expected="a frequency > 0",
    ),
    FileColumn(("level",), saved=_of("level")),
    FileColumn(("run", "test", "file", "day"), saved=_of("run")),
    FileColumn(
        ("amplitude", "displacement_amplitude"), _A, _of("amplitude"), kinds=MOTION_KINDS, **_PEAK
    ),
    FileColumn(
        ("drive", "force", "force_amplitude", "drive_amplitude", "torque"), _F, _of("drive"),
        kinds=DRIVE_KINDS, **_PEAK,
    ),
    FileColumn(("response", "frf"), _R, **_OF_RESPONSE),
    FileColumn(
        (
            "real", "re", "real_part",
            *(f"{q}_{part}" for q in QUANTITIES for part in ("re", "real")),
        ),
        _R, lambda d: d.response.real, "rectangular", **_OF_RESPONSE,
    ),
    FileColumn(
        (
            "imag", "im", "imaginary", "imag_part",
            *(f"{q}_{part}" for q in QUANTITIES for part in ("im", "imag")),
        ),
        _R, lambda d: d.response.imag, "rectangular", like=("real",), **_OF_RESPONSE,
    ),
    *(
        FileColumn((f"covariance_{name}",), f"({_R})^2", _of("covariance", *part), "rectangular")
        for name, part in (("real_real", (0, 0)), ("real_imag", (0, 1)), ("imag_imag", (1, 1)))
    ),
    FileColumn(
        ("damping_ratio", "zeta"), "1", lambda d: d.response.imag, "backbone", "damping_ratio",
        expected="a damping ratio >= 0",
    ),
    FileColumn(
        ("frequency_std",), "Hz", lambda d: backbone_std(d, 0), "backbone", like=("frequency",),
        **_STD,
    ),
    FileColumn(
        ("damping_ratio_std", "zeta_std"), "1", lambda d: backbone_std(d, 1), "backbone",
        "damping_ratio_std", **_STD,
    ),
    FileColumn(("gain", "magnitude", "mag"), _R, lambda d: d.gain, "polar", **_OF_RESPONSE),
    FileColumn(("gain_db", "magnitude_db", "mag_db"), _R, **_OF_RESPONSE),
    FileColumn(
        ("phase", "phase_deg", "phase_rad"), "deg", lambda d: np.degrees(d.phase), "polar",
        "phase_deg", ("angle",),
    ),
    FileColumn(("std",), _R, like=("gain", "real", "response"), **_STD),
    FileColumn(("real_std",), _R, like=("real", "response"), **_STD),
    FileColumn(("imag_std",), _R, like=("real", "response"), **_STD),
    FileColumn(("gain_std",), _R, _polar(0), "polar", like=("gain",), **_STD),
    FileColumn(
        ("phase_std", "phase_std_deg", "phase_std_rad"), "rad", _polar(1), "polar",
        "phase_std_deg", **_STD,
    ),
    FileColumn(("dof",), saved=_of("dof")),
    FileColumn(("amplitude_std",), _A, _of("amplitude_std"), like=("amplitude",), **_STD),
    FileColumn(("drive_std",), _F, _of("drive_std"), like=("drive",), **_STD),
    *(
        FileColumn(
            (f"covariance_{level}_{part}",), f"({unit})*({_R})", _of(f"{level}_covariance", i),
            "rectangular",
        )
        for level, unit in (("amplitude", _A), ("drive", _F))
        for i, part in enumerate(("real", "imag"))
    ),
    FileColumn(("controlled",), saved=_of("controlled")),
    FileColumn(("harmonic",), saved=_of("harmonic")),
)  # fmt: skip
_RECORD = (
    FileColumn(("time", "t", "time_s", "timestamp"), "s", kinds=("time",)),
    FileColumn(("displacement", "disp", "position", "x"), "um", kinds=("displacement",)),
    FileColumn(("velocity", "vel", "v"), "mm/s", kinds=("velocity",)),
    FileColumn(("acceleration", "accel", "acc", "a"), "m/s^2", kinds=("acceleration",)),
    FileColumn(("force", "f", "torque"), _F, kinds=("force",)),
    FileColumn(("drive", "voltage", "current"), _F, kinds=DRIVE_KINDS),
)
RESPONSE_COLUMNS = {column.names[0]: column for column in _RESPONSE}
"""Of tables of responses, in the order in which they are saved."""
RECORD_COLUMNS = {column.names[0]: column for column in _RECORD}
FILE_COLUMNS = RECORD_COLUMNS | RESPONSE_COLUMNS
