"""Metadata of a test report (ISO/IEC 17025:2017, 7.8.2 and 7.8.3), and calibrations."""

from __future__ import annotations

import contextlib
import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dahl_ident.data.storage import path_of, read_toml
from dahl_ident.errors import DahlIdentError, ValidationError, choices
from dahl_ident.units import parse_quantity

CHANNELS = {"force": "force_gain", "displacement": "displacement_gain", "delay": "delay"}
"""The channels of instruments, and the sensor parameters to which their uncertainties apply."""

_FIELDS = {
    "laboratory": "Laboratory",
    "customer": "Customer",
    "specimen": "Specimen",
    "method": "Method",
    "instruments": "Instruments",
    "traceability": "Traceability",
    "ambient": "Ambient conditions",
    "received": "Date of receipt",
    "measured": "Date of measurement",
    "place": "Place of measurement",
    "operator": "Operator",
    "remarks": "Remarks",
}
"""The printed fields in order."""
_LISTS = ("ambient", "instruments")
_TEXTS = (
    "title",
    "number",
    *(key for key in _FIELDS if key not in _LISTS),
    "authorised_by",
    "role",
)
_ALWAYS_PRINTED = ("specimen", "instruments", "ambient", "measured", "operator")
_PREFIXES = {
    "serial": "serial ",
    "calibration": "calibrated: ",
    "uncertainty": "uncertainty ",
    "k": "k\u00a0=\u00a0",
}
_INSTRUMENT = ("name", "quantity", "model", "serial", "calibration", "channel", "uncertainty", "k")


@dataclass(frozen=True)
class Instrument:
    """An instrument in one line; `u` is the standard uncertainty of its channel, or 0."""

    text: str
    channel: str = ""
    u: float = 0.0


@dataclass(frozen=True)
class Metadata:
    """Metadata stated by a laboratory; usual fields that are missing are printed as blank lines."""

    texts: Mapping[str, str] = field(default_factory=dict)
    ambient: tuple[str, ...] = ()
    instruments: tuple[Instrument, ...] = ()

    @property
    def title(self) -> str:
        """Title of the report; empty by default."""
        return self.texts.get("title", "")

    @property
    def number(self) -> str:
        """Number of the report; empty by default."""
        return self.texts.get("number", "")

    @property
    def signatory(self) -> tuple[str, ...]:
        """Name and role of the person who signs the report."""
        return tuple(self.texts[n] for n in ("authorised_by", "role") if self.texts.get(n))

    @property
    def lines(self) -> dict[str, tuple[str, ...]]:
        """The lines of each printed field by its printed name, in order."""
        stated = self.facts()
        printed = {
            key: value if key in _LISTS else tuple(map(str.strip, value.splitlines()))
            for key, value in stated.items()
        }
        kept = (key for key in _FIELDS if any(printed[key]) or key in _ALWAYS_PRINTED)
        return {_FIELDS[key]: printed[key] for key in kept}

    def facts(self) -> dict[str, Any]:
        """Return all fields as plain data; those not stated are empty."""
        texts = {name: self.texts.get(name, "") for name in _TEXTS}
        instruments = tuple(one.text for one in self.instruments)
        return {**texts, "ambient": self.ambient, "instruments": instruments}

    def calibrations(self) -> dict[str, float]:
        """Return the standard uncertainty (root sum of squares) of each sensor parameter."""
        variances: dict[str, float] = {}
        for instrument in self.instruments:
            if instrument.u > 0.0:
                name = CHANNELS[instrument.channel]
                variances[name] = variances.get(name, 0.0) + instrument.u**2
        return {name: math.sqrt(variance) for name, variance in variances.items()}


def metadata_of(source: Mapping[str, Any] | str | Path | None) -> Metadata:
    """Return metadata from a mapping or a TOML file."""
    entries, where = source or {}, ""
    if not isinstance(entries, Mapping):
        entries, where = read_toml(path_of(entries, "metadata")), f"{source}: "
    texts = _texts(entries, _TEXTS, _LISTS, f"{where}metadata", where)
    ambient, instruments = entries.get("ambient", ()), entries.get("instruments", ())
    name = f"{where}ambient"
    if isinstance(ambient, Mapping):  # such as {temperature = "22 °C"}
        ambient = [f"{key} {_text(item, f'{name}.{key}')}" for key, item in ambient.items()]
    elif ambient not in ((), ""):
        ambient = [_text(ambient, name)]
    if not isinstance(instruments, (list, tuple)):
        raise ValidationError(
            f"{where}instruments is {instruments!r}; expected a list, one entry an instrument"
        )
    described = (_instrument(one, f"{where}instruments[{i}]") for i, one in enumerate(instruments))
    return Metadata(texts, tuple(ambient), tuple(described))


def _texts(
    entries: Mapping[str, Any], known: Sequence[str], others: Sequence[str], name: str, where: str
) -> dict[str, str]:
    """Return the texts of the `known` fields, in their order; refuse fields not in either list."""
    unknown = sorted(set(entries) - {*known, *others})
    if unknown:
        expected = choices((*known, *others), *unknown)
        raise ValidationError(f"{name} has the field {unknown[0]!r}; expected any of {expected}")
    return {key: _text(entries[key], f"{where}{key}") for key in known if key in entries}


def _text(value: Any, name: str) -> str:
    if isinstance(value, (str, int, float, datetime.date)) and not isinstance(value, bool):
        return str(value)
    raise ValidationError(f"{name} is {value!r}; expected a text, a number or a date")


def _instrument(entry: Any, name: str) -> Instrument:
    if not isinstance(entry, Mapping):
        return Instrument(_text(entry, name))
    texts = _texts(entry, _INSTRUMENT, (), name, f"{name}.")
    parts = [_PREFIXES.get(key, "") + text for key, text in texts.items() if key != "channel"]
    parts += [f"{key} not stated" for key in ("calibration", "uncertainty") if key not in texts]
    channel = texts.get("channel", "")
    if "channel" in texts and channel not in CHANNELS:
        raise ValidationError(
            f"{name}.channel is {channel!r}; expected {choices(CHANNELS, channel)}"
        )
    u = _standard_uncertainty(texts, name) if channel and "uncertainty" in texts else 0.0
    return Instrument(", ".join(parts), channel, u)


def _standard_uncertainty(texts: Mapping[str, str], name: str) -> float:
    channel, text = texts["channel"], texts["uncertainty"]
    if "k" not in texts:
        raise ValidationError(
            f"{name} has an uncertainty for the channel {channel}, but no k; expected the coverage "
            "factor of the certificate, k = 2, or k = 1 for a standard uncertainty"
        )
    u = k = math.nan
    with contextlib.suppress(ValueError, DahlIdentError):
        k = float(texts["k"])
        if channel == "delay":
            u = parse_quantity(text, ("time",), "uncertainty")[0]
        elif text.endswith("%"):
            u = float(text.removesuffix("%")) / 100.0
    if not (0.0 < u < math.inf and 0.0 < k < math.inf):
        expected = '"20 us"' if channel == "delay" else 'a share of the reading, "0.5 %"'
        raise ValidationError(
            f"{name} has uncertainty {text!r} and k {texts['k']!r}; expected {expected}, and a "
            "number above zero"
        )
    return u / k
