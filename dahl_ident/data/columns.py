"""Column maps: what a laboratory calls time, displacement, force and drive.

A laboratory describes its files once, in a small TOML file, and reuses it. Each role is the
name of a column, or a table with the name, its unit where the header does not say it, a sign
and a constant factor::

    drive_factor = "12.5 N/V"
    drive_factor_uncertainty = 0.01

    time = "t"
    [displacement]
    column = "LVDT 2"
    unit = "um"
    sign = -1
    [drive]
    column = "amplifier"
    unit = "V"

In files with paths (MATLAB, HDF5) a ``*`` stands for any name or index, and every match becomes
one level: ``column = "FRdata.*[*].frequency"``. Indices count from 0.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from dahl_ident.arrays import finite_number, non_negative_array, positive_number
from dahl_ident.data.fields import CONTROLLED, one_of
from dahl_ident.errors import DataError, ValidationError
from dahl_ident.units import QUANTITIES, Quantity

# Names under which a column is found without a map.
RECORD_NAMES: dict[str, tuple[str, ...]] = {
    "time": ("time", "t", "time_s"),
    "displacement": ("displacement", "disp", "position", "x"),
    "velocity": ("velocity", "vel", "v"),
    "acceleration": ("acceleration", "accel", "acc", "a"),
    "force": ("force", "f", "torque"),
    "drive": ("drive", "voltage", "current"),
}
RESPONSE_NAMES: dict[str, tuple[str, ...]] = {
    "frequency": ("frequency", "freq", "frequency_hz", "freq_hz"),
    "amplitude": ("amplitude", "displacement_amplitude"),
    "drive": ("drive", "force", "force_amplitude", "drive_amplitude", "torque"),
    "level": ("level",),
    "harmonic": ("harmonic",),
    "controlled": ("controlled",),
    "response": ("response", "frf"),
    "real": ("real", "re", "real_part"),
    "imag": ("imag", "im", "imaginary", "imag_part"),
    "gain": ("gain", "magnitude", "mag"),
    "gain_db": ("gain_db", "magnitude_db", "mag_db"),
    "phase": ("phase", "phase_deg", "phase_rad"),
    "std": ("std",),
    "real_std": ("real_std",),
    "imag_std": ("imag_std",),
    "gain_std": ("gain_std",),
    "phase_std": ("phase_std", "phase_std_deg", "phase_std_rad"),
    "covariance_real_real": ("covariance_real_real",),
    "covariance_real_imag": ("covariance_real_imag",),
    "covariance_imag_imag": ("covariance_imag_imag",),
    "dof": ("dof",),
    "amplitude_std": ("amplitude_std",),
    "covariance_amplitude_real": ("covariance_amplitude_real",),
    "covariance_amplitude_imag": ("covariance_amplitude_imag",),
}
ROLES = tuple(dict.fromkeys((*RECORD_NAMES, *RESPONSE_NAMES)))


@dataclass(frozen=True)
class Column:
    """Where a role is found and how its numbers count.

    Parameters
    ----------
    column : str or None
        Name or path; None where the usual name is meant.
    unit : str or None
        Overrides the file's unit.
    sign : {1, -1}
    factor : float
        Constant factor, sign not included.
    """

    column: str | None = None
    unit: str | None = None
    sign: int = 1
    factor: float = 1.0


@dataclass(frozen=True)
class ColumnMap:
    """Roles and what else a file does not say about itself.

    Parameters
    ----------
    roles : mapping of str to Column
    quantity : str, optional
        What gain and phase, or real and imaginary part, are.
    controlled : str or mapping, optional
        ``"displacement"`` or ``"force"``; or patterns of level labels for each of the two.
    sample_rate : float, optional
        Hz, for records without a time column.
    drive_factor : str, optional
        Force for one unit of drive, such as ``"12.5 N/V"``.
    drive_factor_uncertainty : float
        Its relative standard uncertainty.
    """

    roles: Mapping[str, Column] = field(default_factory=dict)
    quantity: Quantity | None = None
    controlled: str | Mapping[str, str] | None = None
    sample_rate: float | None = None
    drive_factor: str | None = None
    drive_factor_uncertainty: float = 0.0


_SETTINGS = tuple(f.name for f in fields(ColumnMap) if f.name != "roles")


def column_map(value: Mapping[str, Any] | str | Path | None, **overrides: Any) -> ColumnMap:
    """Read a column map.

    Parameters
    ----------
    value : mapping, path of a TOML file, or None
        As the module describes it.
    **overrides
        Entries that replace those of `value`; None counts as absent.

    Returns
    -------
    ColumnMap

    Raises
    ------
    DataError
        If the file cannot be read, or an entry is unknown or of the wrong kind.

    Examples
    --------
    >>> column_map({"force": {"column": "F", "unit": "kN"}}).roles["force"].unit
    'kN'
    """
    if value is None or isinstance(value, Mapping):
        name, entries = "columns", dict(value or {})
    else:
        name, entries = str(value), _toml(Path(value))
    entries |= {key: entry for key, entry in overrides.items() if entry is not None}
    try:
        return _read(entries)
    except ValidationError as exc:
        raise DataError(f"{name}: {exc}") from exc


def _read(entries: Mapping[str, Any]) -> ColumnMap:
    roles: dict[str, Column] = {}
    settings: dict[str, Any] = {}
    for key, entry in entries.items():
        if key == "controlled" and not _is_column(entry):
            settings[key] = _controlled(entry)
        elif key in ROLES:
            roles[key] = _column(entry, key)
        elif key in _SETTINGS:
            settings[key] = _setting(key, entry)
        else:
            raise ValidationError(
                f"unknown entry {key!r}; expected one of {', '.join((*ROLES, *_SETTINGS))}"
            )
    return ColumnMap(roles, **settings)


def _toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as exc:
        raise DataError(f"{path}: the column map cannot be read: {exc.strerror}") from exc
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as exc:
        raise DataError(f"{path}: not a TOML file: {exc}") from exc


def _is_column(entry: Any) -> bool:
    return isinstance(entry, Mapping) and "column" in entry


def _column(entry: Any, role: str) -> Column:
    if isinstance(entry, str):
        return Column(entry)
    if not isinstance(entry, Mapping):
        raise ValidationError(
            f"{role} is {entry!r}; expected a column's name, or a table with column, unit, sign "
            "and factor"
        )
    unknown = set(entry) - {"column", "unit", "sign", "factor"}
    if unknown:
        raise ValidationError(
            f"{role}: unknown entry {sorted(unknown)[0]!r}; expected column, unit, sign or factor"
        )
    for key in ("column", "unit"):
        if not isinstance(entry.get(key, ""), str):
            raise ValidationError(f"{role}.{key} is {entry[key]!r}; expected text")
    sign = entry.get("sign", 1)
    if sign not in (1, -1):
        raise ValidationError(f"{role}.sign is {sign!r}; expected 1 or -1")
    factor = positive_number(entry.get("factor", 1.0), f"{role}.factor")
    return Column(entry.get("column"), entry.get("unit"), int(sign), factor)


def _controlled(entry: Any) -> str | dict[str, str]:
    if isinstance(entry, str):
        return one_of(entry, "controlled", CONTROLLED)
    if isinstance(entry, Mapping) and all(isinstance(v, str) for v in entry.values()):
        return {one_of(key, "controlled", CONTROLLED): entry[key] for key in entry}
    raise ValidationError(
        f"controlled is {entry!r}; expected 'displacement' or 'force', or a pattern of level "
        "labels for each of them"
    )


def _setting(key: str, entry: Any) -> Any:
    match key:
        case "quantity":
            return one_of(entry, key, QUANTITIES)
        case "sample_rate":
            return positive_number(entry, key)
        case "drive_factor_uncertainty":
            return finite_number(non_negative_array(entry, key), key)
        case _:
            if not isinstance(entry, str):
                raise ValidationError(f"{key} is {entry!r}; expected text such as '12.5 N/V'")
            return entry
