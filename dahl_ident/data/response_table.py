"""From the columns of a table to a frequency response.

The unit of the response says which quantity it is. Amplitudes may be those of a velocity or an
acceleration, divided by the angular frequency; the phase stays that of the response.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import SMALLEST, ComplexArray, FloatArray, positive_number, real_array
from dahl_ident.data.column_map import Binding, ColumnMap, by_level, column_map_of, proposal
from dahl_ident.data.columns import CONTROLLED, RECORD_COLUMNS, RESPONSE_COLUMNS
from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.data.plausibility import (
    check_drive,
    check_energy,
    check_phase_size,
    check_phase_unit,
)
from dahl_ident.data.raw_columns import TRACE, RawChannel, RawFile, plain
from dahl_ident.data.tabular import ASSUMED, listed
from dahl_ident.errors import ANY, DataError, UnitError, ValidationError, argument, spelled
from dahl_ident.units import (
    DRIVE_KINDS,
    MOTION_KINDS,
    Quantity,
    parse_quantity,
    parse_unit,
    si_unit,
)

_FORMS = (("response",), ("real", "imag"), ("gain", "phase"), ("gain_db", "phase"))
_NUMBER = r"([0-9.]+(?:[eE][-+]?[0-9]+)?)"
_SWEEP = re.compile(rf"\s*{_NUMBER}\s*:\s*{_NUMBER}\s*(Hz|kHz)[\s,]+(log|linear)\s*")
_LARGE_PHASE = 10.0  # exceeded in degrees by a sweep through a resonance, or through slip
_UNKNOWN_FREQUENCY = (
    "the table says no frequency: taken as 1 Hz, and good for laws that do not depend on it"
)
_ERROR_FORMS = (
    ("covariance_real_real", "covariance_real_imag", "covariance_imag_imag"),
    ("std",),
    ("real_std", "imag_std"),
    ("gain_std", "phase_std"),
)


class WaveformsError(DataError):
    """A file holds waveforms where a table of responses was expected."""


@dataclass(frozen=True)
class ResponseOptions:
    """Statements of the user for a whole table; see :func:`read_frequency_response`."""

    frequency: float | None = None
    amplitude: str | None = None
    drive: str | None = None
    level: str | float | None = None
    run: str | None = None
    frequency_hz: tuple[float, float] | None = None
    passive: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.level, str | Real | None):
            raise ValidationError(f"level is {self.level!r}; expected a text or a number")
        limits = self.frequency_hz
        if limits is not None and real_array(limits, "frequency_hz").shape != (2,):
            raise ValidationError(f"frequency_hz is {limits!r}; expected (low, high)")


def response_from(
    source: RawFile, columns: ColumnMap, options: ResponseOptions
) -> FrequencyResponse:
    """Return the frequency response in a source, with all its levels in one table."""
    source = replace(source, channels=tuple(map(_as_gain, source.channels)))
    source, options = _with_stated(source, columns, options)
    whole = Binding(source, columns, RESPONSE_COLUMNS)
    if source.runs:
        whole.warn(f"the header is repeated in the file: read as {len(source.runs) + 1} runs")
    if source.format == TRACE and not {"gain", "phase"} & columns.roles.keys():
        first, second = map(source.numbers, source.channels[:2])
        largest = np.abs(second).max()
        in_degrees = _LARGE_PHASE < largest <= 360.0 and largest > 10.0 * first.max()
        if in_degrees and (first > 0.0).all():
            gain, phase = {"column": "real", "unit": ANY}, {"column": "imag", "unit": "deg"}
            polar = column_map_of({"gain": gain, "phase": phase})
            whole.warn(
                "the columns of the trace are taken as real and imaginary part, but look like "
                f"magnitude and phase in degrees; if they are, give {polar}"
            )
    parts = []
    for label, level_columns in by_level(source, columns).items():
        named, prefix = source, ""
        if label is not None:
            options = replace(options, level=label)
            prefix = f"level {label}: "
            named = replace(source, name=f"{source.name}, level {label}")
        table = _TableBinding(named, level_columns, options)
        try:
            parts.append(table.response())
        except ValidationError as exc:
            raise DataError(f"{named.name}: {exc}") from exc
        whole.used |= table.used
        whole.notes += table.notes
        whole.warnings += [f"{prefix}{text}" for text in table.warnings]
    data = parts[0] if len(parts) == 1 else FrequencyResponse.concatenate(parts)
    assumed = {"frequency": ASSUMED} if _UNKNOWN_FREQUENCY in whole.notes else {}
    return replace(data, provenance=whole.provenance() | assumed)


def _as_gain(channel: RawChannel) -> RawChannel:
    """Return a channel called amplitude as a gain if its unit is that of a response."""
    named = plain(channel.short or channel.name) in RESPONSE_COLUMNS["amplitude"].names
    if named and RESPONSE_COLUMNS["gain"].accepts(channel.unit, channel.name):
        return replace(channel, role="gain")
    return channel


def _with_stated(
    source: RawFile, columns: ColumnMap, options: ResponseOptions
) -> tuple[RawFile, ResponseOptions]:
    """Add the level stated in the file's header if neither a column nor the user gives one."""
    levels = {role: RESPONSE_COLUMNS[role] for role in ("drive", "amplitude")}
    stated: dict[str, Any] = dict(source.stated)
    if "amplitude" in stated:
        stated.pop("drive", None)
    elif "drive" in stated and columns.drive_factor is None:
        _, kind, _ = parse_quantity(stated["drive"], DRIVE_KINDS, "drive")
        stated = stated if kind == "force" else {}
    is_stated = options.drive or options.amplitude or levels.keys() & columns.roles.keys()
    if is_stated or any(c.is_called(level) for c in source.channels for level in levels.values()):
        return source, options
    notes = [f"{role} {text}, as the file's header states" for role, text in stated.items()]
    return replace(source, notes=(*source.notes, *notes)), replace(options, **stated)


def _swept(sweep: str, rows: int) -> FloatArray:
    match = _SWEEP.fullmatch(sweep)
    if match is None:
        raise ValidationError(
            f"sweep is {sweep!r}; expected the first and the last frequency and their spacing, "
            "such as '1:100Hz log' or '0:800Hz linear'"
        )
    unit = 1e3 if match[3] == "kHz" else 1.0
    first, last, log = unit * float(match[1]), unit * float(match[2]), match[4] == "log"
    if rows < 2 or not (first > 0.0 if log else first >= 0.0) or not first < last < np.inf:
        raise ValidationError(f"sweep is {sweep!r} for {rows} rows; expected rising frequencies")
    return (np.geomspace if log else np.linspace)(first, last, rows)


class _TableBinding(Binding):
    """One table with one column for each role."""

    def __init__(self, source: RawFile, columns: ColumnMap, options: ResponseOptions) -> None:
        super().__init__(source, columns, RESPONSE_COLUMNS)
        self.options = options
        self.level = options.drive if options.level is None else options.level
        self.factor_uncertainty = 0.0

    def response(self) -> FrequencyResponse:
        options = self.options
        self._add_stated()
        self.same_length({r: c for r in RESPONSE_COLUMNS if (c := self.channel(r)) is not None})
        if options.frequency_hz is not None:  # before anything is judged
            low, high = options.frequency_hz
            frequency_hz = self.si("frequency", least=False)
            keep = (frequency_hz >= low) & (frequency_hz <= high)
            if not keep.any():
                raise ValidationError(f"no frequency lies from {low:g} to {high:g} Hz")
            self.source = self.source.rows(keep)
        frequency_hz = self.si("frequency")
        amplitude, drive = self._amplitude(frequency_hz), self._drive()
        if amplitude is None and drive is None:
            raise ValidationError(
                "neither an amplitude nor a drive is given; friction answers every amplitude "
                f"differently. Name a column with {column_map_of({'amplitude': ANY})}"
                f"{proposal()}, or give {argument('drive', '0.2 N')} or "
                f"{argument('amplitude', '5 um')} for the whole file"
            )
        harmonic: Any = 1
        if (channel := self.channel("harmonic")) is not None:
            harmonic = self.numbers("harmonic", channel)
            whole = (harmonic >= 0.0) & (harmonic == np.round(harmonic))
            self.source.require(whole, channel, "a whole number >= 0")
        if self.has("damping_ratio"):
            data = self._backbone(frequency_hz, amplitude)
            quantity, response = data.quantity, data.response
            errors = self._errors(quantity, response) | {"covariance": data.covariance}
        else:
            quantity, response = self._response(frequency_hz, amplitude, drive)
            zero = np.flatnonzero((np.abs(response) < SMALLEST) & (harmonic == 1))
            if zero.size:
                raise DataError(
                    f"{self.source.name}, {self.source.row_name(int(zero[0]))}: the response is 0 "
                    f"({zero.size} such rows); expected a measured value"
                )
            errors = self._errors(quantity, response)
            mean = np.broadcast_to(harmonic == 0, response.shape)  # real, but for rounding
            rounding = mean & (np.abs(response.imag) <= 1e-9 * np.abs(response.real))
            response.imag[rounding] = 0.0
            if errors["covariance"] is not None:
                errors["covariance"][mean, 1, :] = 0.0
                errors["covariance"][mean, :, 1] = 0.0
        saved = self.source.metadata.get("drive_factor_uncertainty")
        data = FrequencyResponse(
            frequency_hz,
            response,
            amplitude,
            drive,
            level=self._labels("level", self.level),
            run=self._labels("run", options.run),
            controlled=self._controlled(drive is not None and amplitude is None),
            harmonic=harmonic,
            quantity=quantity,
            motion=self.motion(),
            drive_factor_uncertainty=self.factor_uncertainty or float(saved or 0.0),
            quality=self._quality(len(response)),
            **errors,
        )
        if quantity != "backbone":
            check_drive(data, self.warn_rows)
            check_phase_size(data, self.warn_rows)
            if options.passive:
                check_energy(self.source.name, data, self.warn_rows)
        return data

    def _add_stated(self) -> None:
        """Add a column for each of frequency, amplitude and drive that is stated for all rows."""
        options, sweep, channels = self.options, self.map.sweep, self.source.channels
        roles = ("frequency", *(role for form in _FORMS for role in form))
        rows = next((c.size for role in roles if (c := self.channel(role)) is not None), 0)
        if sweep is not None:
            self._add("frequency", _swept(sweep, rows), "Hz", "sweep", sweep)
            self.notes.append(f"frequencies from the sweep stated, {sweep}")
        hertz = options.frequency
        if not self.has("frequency"):
            self._refuse_waveforms()
            in_hertz = any(RESPONSE_COLUMNS["frequency"].accepts(c.unit, c.name) for c in channels)
            if hertz is None and rows and (in_hertz or not self.has("amplitude")):
                raise ValidationError(
                    f"no column holds the frequency{proposal()}; name it with "
                    f"{column_map_of({'frequency': ANY})}, or say what was swept, such as "
                    f"{argument('sweep', '1:100Hz log')}, or give {argument('frequency', 5)}"
                )
            if not rows:
                self.required("frequency")
            if hertz is None:
                self.notes.append(_UNKNOWN_FREQUENCY)
                hertz = 1.0
        if hertz is not None:
            hertz = positive_number(hertz, "frequency")
            self._add("frequency", np.full(rows, hertz), "Hz", "frequency", hertz)
        for role, kinds in (("amplitude", MOTION_KINDS), ("drive", DRIVE_KINDS)):
            text = getattr(options, role)
            if text is not None:
                value, kind, motion = parse_quantity(text, kinds, f"{self.source.name}: {role}")
                if not 0.0 < value < np.inf:
                    raise ValidationError(f"{role} is {text!r}; expected a value > 0")
                unit = f"{si_unit(kind, motion)} pk"
                self._add(role, np.full(rows, value), unit, role, text)

    def _add(self, role: str, values: FloatArray, unit: str, option: str, text: Any) -> None:
        """Add a column that an option states, unless the table has one."""
        existing = self.channel(role)
        if existing is not None:
            raise ValidationError(
                f"{argument(option, text)} is given, and column {existing.name!r} holds the {role} "
                "too; leave out one of them"
            )
        channels = (*self.source.channels, RawChannel(str(text), values, unit, role))
        self.source = replace(self.source, channels=channels)

    def _refuse_waveforms(self) -> None:
        channels = self.source.channels
        roles = ("time", *MOTION_KINDS, "force")
        called = [r for r in roles if any(c.is_called(RECORD_COLUMNS[r]) for c in channels)]
        called = [r for r in roles if r in self.map.roles] or called
        if called[:1] == ["time"] and len(called) > 1:
            raise WaveformsError(
                f"{self.source.name}: it holds waveforms ({listed([c.header for c in channels], 5)}"
                "), and a table of responses at some frequencies was expected. If they are sine "
                "tests, make such a table with extract; any other motion is fitted as a record: "
                + spelled(
                    "di.fit(di.read_record(file), model)",
                    "dahl-ident fit --record",
                    argument("kind", "waveforms"),
                )
            )

    def _backbone(
        self, frequency_hz: FloatArray, amplitude: FloatArray | None
    ) -> FrequencyResponse:
        roles = ("damping_ratio", "frequency_std", "damping_ratio_std")
        ratio, frequency_std, ratio_std = (self.si(role) for role in roles)
        if amplitude is None or frequency_std is None or ratio_std is None:
            raise ValidationError(
                "a table of damping ratios is a backbone; expected the columns amplitude, "
                "frequency_std and damping_ratio_std in addition to frequency and damping_ratio"
            )
        return FrequencyResponse.backbone(
            amplitude, frequency_hz, ratio, frequency_std=frequency_std, damping_ratio_std=ratio_std
        )

    def _peaks(self, role: str) -> tuple[Any, str]:
        """Return a column of amplitudes and their kind, and note the assumptions."""
        channel = self.channel(role)
        if channel is None:
            return None, ""
        values = self.si(role)
        unit = self.unit(role, channel)
        if unit.marker is None and not self.source.metadata:
            self.notes.append(f"{role} [{unit.text}] taken as zero to peak: the table does not say")
        return values, self.kind(role, unit)[0]

    def _amplitude(self, frequency_hz: FloatArray) -> FloatArray | None:
        values, kind = self._peaks("amplitude")
        if values is None:
            return None
        return np.asarray(values / (2.0 * np.pi * frequency_hz) ** MOTION_KINDS.index(kind))

    def _drive(self) -> FloatArray | None:
        values, kind = self._peaks("drive")
        columns = [(role, self.channel(role)) for role in ("gain", "gain_db", "real", "response")]
        units = [self.unit(role, channel).text for role, channel in columns if channel is not None]
        if all(_per_drive(unit) is None for unit in units):
            self.refuse_idle_factor(kind or None)
        if values is None:
            return None
        factor, self.factor_uncertainty = self.force_per(kind)
        return np.asarray(values * factor)

    def _response(
        self, frequency_hz: FloatArray, amplitude: FloatArray | None, drive: FloatArray | None
    ) -> tuple[Quantity, ComplexArray]:
        match self._form(_FORMS):
            case ("response",):
                quantity, factor, _ = self._factor("response")
                channel = self.required("response")
                return quantity, factor * self.source.complex_numbers(channel)
            case ("real", "imag"):
                quantity, real = self._part("real")
                imag_is, imag = self._part("imag")
                if imag_is != quantity:
                    raise UnitError(
                        f"{self.source.name}: units disagree: real is {quantity}, imag {imag_is}"
                    )
                return quantity, real + 1j * imag
            case (role, "phase"):
                quantity, gain = self._part(role)
                return quantity, gain * np.exp(1j * self._phase())
        if amplitude is None or drive is None or not self.has("phase"):
            headers = listed([channel.header for channel in self.source.channels], 20)
            raise ValidationError(
                "no response; expected real and imag, gain (or gain_db) and phase, complex "
                f"numbers, or a phase together with amplitude and drive; there are {headers}"
                f"{proposal()}"
            )
        if self.map.quantity is None:
            raise ValidationError(
                "the phase stands without a gain; say which quantity's it is with "
                f"{argument('quantity', 'receptance')} or another"
            )
        receptance = FrequencyResponse(
            frequency_hz, amplitude / drive, amplitude, quantity="receptance"
        )
        gain = receptance.to(self.map.quantity).gain
        return self.map.quantity, gain * np.exp(1j * self._phase())

    def _form(self, forms: tuple[tuple[str, ...], ...]) -> tuple[str, ...] | None:
        """Return the form whose columns are all in the table; the map decides between several."""
        mapped = [f for f in forms if self.map.roles.keys() >= {*f}]
        complete = [f for f in mapped or forms if all(self.has(role) for role in f)]
        complete = [f for f in complete if f[0] in self.map.roles] or complete
        if len(complete) > 1:
            raise ValidationError(
                f"both {' and '.join(complete[0])} and {' and '.join(complete[1])} are there; "
                f"name one of them in {argument('columns')}"
            )
        return complete[0] if complete else None

    def _factor(self, role: str) -> tuple[Quantity, float, bool]:
        """Return the quantity given by a column's unit, the SI factor, and whether it is in dB."""
        unit = self.unit(role, self.required(role))
        per_drive = _per_drive(unit.text) if self.map.drive_factor is not None else None
        if per_drive is not None:  # such as m/V, converted to m/N by the factor in N/V
            drive_kind, text, power = per_drive
            kind, factor = self.kind(role, parse_unit(text))
            value, self.factor_uncertainty = self.force_per(drive_kind)
            return cast(Quantity, kind), factor * value**power, unit.decibel
        kind, factor = self.kind(role, unit)
        if self.map.quantity not in (None, kind):
            raise UnitError(
                f"{self.source.name}: the {role} in [{unit.text}] is {kind}, not "
                f"{self.map.quantity}"
            )
        return cast(Quantity, kind), factor, unit.decibel

    def _part(self, role: str) -> tuple[Quantity, FloatArray]:
        """Return the quantity and the SI values of a gain, or of a real or imaginary part."""
        channel = self.required(role)
        quantity, factor, decibel = self._factor(role)
        values = self.numbers(role, channel)
        if decibel or role == "gain_db":
            self.source.require(np.abs(values) < 1000.0, channel, "a level within 1000 dB")
            return quantity, factor * 10.0 ** (values / 20.0)
        if role == "gain":
            self.source.require(values >= 0.0, channel, "a gain >= 0")
        return quantity, factor * values

    def _phase(self) -> FloatArray:
        channel = self.required("phase")
        values = self.numbers("phase", channel)
        _, factor = self.kind("phase", self.unit("phase", channel))
        check_phase_unit(values, factor != 1.0, channel.name, self.warn_rows)
        return values * factor

    def _errors(self, quantity: Quantity, response: ComplexArray) -> dict[str, Any]:
        dof, form = self.channel("dof"), self._form(_ERROR_FORMS)
        errors: dict[str, Any] = {
            "covariance": None if form is None else self._covariance(form, quantity, response),
            "dof": None if dof is None else self.source.numbers(dof, infinite=True),
        }
        for level in ("amplitude", "drive"):
            errors[f"{level}_std"] = self.si(f"{level}_std")
            cross = [self.si(f"covariance_{level}_{part}", quantity) for part in ("real", "imag")]
            if all(part is not None for part in cross):
                errors[f"{level}_covariance"] = np.stack(cross, -1)
        return errors

    def _covariance(
        self, form: tuple[str, ...], quantity: Quantity, response: ComplexArray
    ) -> NDArray[np.float64]:
        columns = [self.si(role, quantity) for role in form]
        ri = np.zeros(response.shape)
        match form:
            case ("std",):
                rr = ii = columns[0] ** 2
            case ("real_std", "imag_std"):
                rr, ii = columns[0] ** 2, columns[1] ** 2
            case ("gain_std", "phase_std"):
                radial, tangential = columns[0] ** 2, (np.abs(response) * columns[1]) ** 2
                c, s = np.cos(np.angle(response)), np.sin(np.angle(response))
                rr, ii = radial * c**2 + tangential * s**2, radial * s**2 + tangential * c**2
                ri = (radial - tangential) * c * s
            case _:
                rr, ri, ii = columns
        return np.stack([np.stack([rr, ri], -1), np.stack([ri, ii], -1)], -2)

    def _labels(self, role: str, stated: str | float | None) -> Any:
        channel = self.channel(role)
        if channel is None:
            return stated
        if channel.values.dtype.kind == "U":
            return np.atleast_1d(channel.values)
        return self.source.numbers(channel)

    def _controlled(self, force_only: bool) -> Any:
        controlled = self.map.controlled
        if isinstance(controlled, Mapping):
            label = str(self._labels("level", self.level))
            matches = [w for w in CONTROLLED if fnmatch.fnmatchcase(label, controlled.get(w, ""))]
            if len(matches) != 1:
                raise ValidationError(
                    f"level {label!r} matches {'both patterns' if matches else 'no pattern'} of "
                    f"controlled: {dict(controlled)}"
                )
            return matches[0]
        if controlled is None and (channel := self.channel("controlled")) is not None:
            words = np.char.strip(np.atleast_1d(channel.values).astype(str))
            self.source.require(np.isin(words, CONTROLLED), channel, "displacement or force")
            return words
        if controlled is None:
            controlled = "force" if force_only else "displacement"
            self.notes.append(f"controlled: {controlled}, as the table does not say")
        return controlled

    def _quality(self, n: int) -> dict[str, NDArray[Any]]:
        """Return columns without a role as covariates, with the types of an earlier save."""
        kinds = self.source.metadata.get("quality", {})
        covariates = {
            name: self._typed(self.source.find(name), kind) for name, kind in kinds.items()
        }
        for channel in self.source.channels:
            has_role = channel.name in self.used or channel.short is not None  # of another level
            if has_role or channel.name in covariates or channel.content.shape != (n,):
                continue
            numeric = channel.kind in "biuf" and np.isfinite(channel.values).all()
            if numeric and not any(map(channel.is_called, RESPONSE_COLUMNS.values())):
                covariates[channel.name] = channel.values
        self.used |= covariates.keys()
        return covariates

    def _typed(self, channel: RawChannel, kind: str) -> NDArray[Any]:
        """Return a column of a text file in the type it was saved from."""
        values = channel.values
        if kind == "b" and values.dtype.kind == "U":
            return np.asarray(np.char.lower(values) == "true")
        if kind in "iuf" and values.dtype.kind == "U":
            values = self.source.from_text(channel)
        if kind in "iu":
            self.source.require(values % 1 == 0, channel, "a whole number")
        types: dict[str, type] = {"b": np.bool_, "i": np.int64, "u": np.uint64, "f": np.float64}
        return np.asarray(values, dtype=types.get(kind, np.str_))


def _per_drive(text: str) -> tuple[str, str, int] | None:
    """Return kind of drive, unit with N instead of V or A, and power of the drive factor."""
    forms = [("", text, 0)]
    for kind, symbol in (("voltage", "V"), ("current", "A")):
        forms += [(kind, f"({text})*{symbol}/N", -1), (kind, f"({text})*N/{symbol}", 1)]
    form = next((f for f in forms if RESPONSE_COLUMNS["gain"].accepts(f[1], "the gain")), None)
    return form if form and form[2] else None  # None for a unit of the six quantities
