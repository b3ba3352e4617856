"""Metadata from the laboratory: specimen, instruments, ambient conditions, operator."""

from __future__ import annotations

import datetime
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dahl_ident.errors import DataError, ValidationError

_TEXTS = ("title", "laboratory", "customer", "specimen", "operator", "measured", "remarks")
_INSTRUMENT = ("name", "quantity", "model", "serial", "calibration", "uncertainty")


@dataclass(frozen=True)
class Metadata:
    """Metadata that a laboratory states; an empty field is printed as a line to fill in.

    Attributes
    ----------
    title, laboratory, customer, specimen, operator, measured, remarks : str
        `measured` is the date of the measurement.
    ambient : tuple of str
        Such as "temperature 22.1 °C".
    instruments : tuple of str
        One line each: name, quantity, model, serial, calibration, uncertainty.
    """

    title: str = ""
    laboratory: str = ""
    customer: str = ""
    specimen: str = ""
    operator: str = ""
    measured: str = ""
    remarks: str = ""
    ambient: tuple[str, ...] = ()
    instruments: tuple[str, ...] = ()

    def header(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """Return the fields of the laboratory, each with its lines."""
        known = (
            ("Laboratory", self.laboratory),
            ("Customer", self.customer),
            ("Specimen", self.specimen),
            ("Instruments", self.instruments),
            ("Ambient conditions", self.ambient),
            ("Date of measurement", self.measured),
            ("Operator", self.operator),
            ("Remarks", self.remarks),
        )
        needless = ("Laboratory", "Customer", "Remarks")  # not printed where they are empty
        lines = ((name, (text,) if isinstance(text, str) else text) for name, text in known)
        return tuple(
            (name, tuple(line for line in given if line))
            for name, given in lines
            if any(given) or name not in needless
        )


def metadata_of(given: Mapping[str, Any] | str | Path | None) -> Metadata:
    """Return metadata from a mapping or a TOML file.

    Raises
    ------
    DataError
        If the file cannot be read or is not TOML.
    ValidationError
        If a field is unknown, or has the wrong type.
    """
    if given is None:
        return Metadata()
    if not isinstance(given, Mapping):
        return _checked(_from_file(Path(given)), f"{given}: ")
    return _checked(given, "")


def _from_file(path: Path) -> Mapping[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as exc:
        raise DataError(f"{path}: cannot be read: {exc.strerror or exc}") from exc
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as exc:
        raise DataError(f"{path}: is not a TOML file: {exc}") from exc


def _checked(given: Mapping[str, Any], where: str) -> Metadata:
    unknown = sorted(set(given) - {*_TEXTS, "ambient", "instruments"})
    if unknown:
        raise ValidationError(
            f"{where}metadata has the field {unknown[0]!r}; expected any of "
            f"{', '.join((*_TEXTS, 'ambient', 'instruments'))}"
        )
    texts = {name: _text(given[name], f"{where}{name}") for name in _TEXTS if name in given}
    return Metadata(
        **texts,
        ambient=_ambient(given.get("ambient", ()), f"{where}ambient"),
        instruments=_instruments(given.get("instruments", ()), f"{where}instruments"),
    )


def _text(value: Any, name: str) -> str:
    if isinstance(value, (str, int, float, datetime.date)) and not isinstance(value, bool):
        return str(value)
    raise ValidationError(f"{name} is {value!r}; expected a text, a number or a date")


def _ambient(value: Any, name: str) -> tuple[str, ...]:
    """Return conditions from a text or a table such as {temperature = "22 °C"}."""
    if isinstance(value, Mapping):
        return tuple(f"{key} {_text(item, f'{name}.{key}')}" for key, item in value.items())
    return (_text(value, name),) if value else ()


def _instruments(value: Any, name: str) -> tuple[str, ...]:
    """Return a line for each instrument, given as a text or as a table."""
    if not isinstance(value, (list, tuple)):
        raise ValidationError(f"{name} is {value!r}; expected a list, one entry an instrument")
    return tuple(_instrument(one, f"{name}[{i}]") for i, one in enumerate(value))


def _instrument(one: Any, name: str) -> str:
    if not isinstance(one, Mapping):
        return _text(one, name)
    unknown = sorted(set(one) - set(_INSTRUMENT))
    if unknown:
        raise ValidationError(
            f"{name} has the field {unknown[0]!r}; expected any of {', '.join(_INSTRUMENT)}"
        )
    words = {"serial": "serial ", "calibration": "calibrated: ", "uncertainty": "uncertainty "}
    parts = [
        words.get(key, "") + _text(one[key], f"{name}.{key}") for key in _INSTRUMENT if key in one
    ]
    missing = [f"{key} not stated" for key in ("calibration", "uncertainty") if key not in one]
    return ", ".join((*parts, *missing))
