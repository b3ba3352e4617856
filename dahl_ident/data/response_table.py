"""From the columns of a table to a frequency response.

A row holds a frequency, an amplitude or a drive, and a response: ``real`` and ``imag``,
``gain`` or ``gain_db`` with ``phase``, or complex numbers; where amplitude and drive are both
there, ``phase`` alone will do. The unit of the response says which quantity it is: N/m is a
dynamic stiffness, (m/s^2)/N an accelerance. Amplitudes may be those of a velocity or an
acceleration; they are divided by the angular frequency, and the phase stays that of the
response. Standard deviations without a unit have that of their column.
"""

from __future__ import annotations

import contextlib
import fnmatch
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import SMALLEST, ComplexArray, FloatArray, positive_number
from dahl_ident.data.column_map import Binding, ColumnMap, by_level, per_frequency
from dahl_ident.data.columns import CONTROLLED, RECORD_COLUMNS, RESPONSE_COLUMNS
from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.data.plausibility import (
    check_drive,
    check_energy,
    check_phase_size,
    check_phase_unit,
)
from dahl_ident.data.raw_columns import Channel, Source, plain
from dahl_ident.data.tabular import ASSUMED, listed
from dahl_ident.errors import DataError, UnitError, ValidationError
from dahl_ident.units import (
    DRIVE_KINDS,
    MECHANICAL_KINDS,
    MOTION_KINDS,
    QUANTITIES,
    Quantity,
    factor_to,
    kind_of,
    parse_quantity,
    parse_unit,
)

_FORMS = (("response",), ("real", "imag"), ("gain", "phase"), ("gain_db", "phase"))
_NUMBER = r"([0-9.]+(?:[eE][-+]?[0-9]+)?)"
_SWEEP = re.compile(rf"\s*{_NUMBER} to {_NUMBER} Hz, (log|linear)\s*")
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
    """What a user says about a whole table; see :func:`read_frequency_response`."""

    frequency: float | None = None
    amplitude: str | None = None
    drive: str | None = None
    level: str | float | None = None
    run: str | None = None
    frequency_hz: tuple[float, float] | None = None
    passive: bool = True


def response_from(
    source: Source, columns: ColumnMap, options: ResponseOptions
) -> FrequencyResponse:
    """Return the frequency response that a source holds, all its levels in one table.

    Raises
    ------
    DataError, UnitError
        Naming file, row and column.
    """
    source = replace(source, channels=tuple(map(_as_gain, source.channels)))
    source, options = _with_stated(source, columns, options)
    if columns.sweep is not None:
        source = _with_frequencies(source, columns.sweep)
    whole = Binding(source, columns, RESPONSE_COLUMNS)
    if source.runs:
        whole.doubt(f"the header is repeated in the file: read as {len(source.runs) + 1} runs")
    parts = []
    for label, one in by_level(source, columns).items():
        if label is not None:
            options = replace(options, level=label)
        named = source if label is None else replace(source, name=f"{source.name}, level {label}")
        table = _Table(named, one, options)
        parts.append(table.response())
        whole.used |= table.bound.used
        whole.notes += table.bound.notes
        of = "" if label is None else f"level {label}: "
        whole.doubts += [f"{of}{text}" for text in table.bound.doubts]
    data = parts[0] if len(parts) == 1 else FrequencyResponse.concatenate(parts)
    assumed = {"frequency": ASSUMED} if _UNKNOWN_FREQUENCY in whole.notes else {}
    return replace(data, provenance=whole.provenance() | assumed)


def _as_gain(channel: Channel) -> Channel:
    """Return an "amplitude" in the unit of a response as what it is, a gain."""
    if plain(channel.short or channel.name) in RESPONSE_COLUMNS["amplitude"].names and channel.unit:
        with contextlib.suppress(UnitError):
            kind_of(parse_unit(channel.unit), QUANTITIES, channel.name)
            return replace(channel, role="gain")
    return channel


def _with_stated(
    source: Source, columns: ColumnMap, options: ResponseOptions
) -> tuple[Source, ResponseOptions]:
    """Take the level that the file's header states, where neither a column nor the user does.

    Where it states both, the displacement was held, and the drive followed it.
    """
    names = {*RESPONSE_COLUMNS["drive"].names, *RESPONSE_COLUMNS["amplitude"].names}
    known = {"drive", "amplitude"} & columns.roles.keys() or any(
        c.role is None and plain(c.short or c.name) in names for c in source.channels
    )
    stated = dict(source.stated)
    if "amplitude" in stated:
        stated.pop("drive", None)
    elif "drive" in stated and columns.drive_factor is None:
        _, kind, _ = parse_quantity(stated["drive"], DRIVE_KINDS, "drive")
        stated = stated if kind == "force" else {}
    if known or options.drive or options.amplitude or not stated:
        return source, options
    notes = [f"{role} {text}, as the file's header states" for role, text in stated.items()]
    held = replace(options, drive=stated.get("drive"), amplitude=stated.get("amplitude"))
    return replace(source, notes=(*source.notes, *notes)), held


def _with_frequencies(source: Source, sweep: str) -> Source:
    """Return a source with the frequencies of a sweep, one for each row."""
    found = _SWEEP.fullmatch(sweep)
    if found is None:
        raise DataError(
            f"{source.name}: sweep is {sweep!r}; expected the first and the last frequency and "
            "their spacing, such as '1 to 100 Hz, log' or '0 to 800 Hz, linear'"
        )
    names = RESPONSE_COLUMNS["frequency"].names
    known = [c for c in source.channels if plain(c.short or c.name) in names]
    if known:
        raise DataError(
            f"{source.name}: sweep={sweep!r} is given, and column {known[0].name!r} holds the "
            "frequency too; leave out one of them"
        )
    first, last = (float(text) for text in found.groups()[:2])
    rows, log = source.channels[0].size, found[3] == "log"
    if rows < 2 or not (first > 0.0 if log else first >= 0.0) or not first < last < np.inf:
        raise DataError(
            f"{source.name}: sweep is {sweep!r} for {rows} rows; expected rising frequencies"
        )
    axis = (np.geomspace if log else np.linspace)(first, last, rows)
    frequency = Channel("frequency", axis, "Hz", "frequency")
    note = f"frequencies from the sweep stated, {sweep}"
    return replace(source, channels=(*source.channels, frequency), notes=(*source.notes, note))


class _Table:
    """One table with one column for each role."""

    def __init__(self, source: Source, columns: ColumnMap, options: ResponseOptions) -> None:
        self.options = options
        self.bound = Binding(source, columns, RESPONSE_COLUMNS)
        self.factor_uncertainty = 0.0
        self._within_range()

    def response(self) -> FrequencyResponse:
        bound, source = self.bound, self.bound.source
        frequency_hz = self._frequency()
        amplitude = self._amplitude(frequency_hz)
        drive = self._drive(frequency_hz)
        if amplitude is None and drive is None:
            raise DataError(
                f"{source.name}: neither an amplitude nor a drive is given; friction answers "
                "every amplitude differently. Name a column with columns={'amplitude': ...} "
                "(inspect proposes a column map), or give drive='0.2 N' or amplitude='5 um' for "
                "the whole file"
            )
        harmonic = self._whole_numbers("harmonic")
        if bound.has("damping_ratio"):
            quantity, response, errors = self._backbone(frequency_hz, amplitude)
        else:
            quantity, response = self._response(frequency_hz, amplitude, drive)
            self._refuse_zero(response, harmonic)
            errors = self._errors(quantity, response)
            if harmonic is not None:
                _make_real(response, errors, harmonic == 0)
        options = self.options
        try:
            data = FrequencyResponse(
                frequency_hz,
                response,
                amplitude,
                drive,
                level=self._labels("level", self._stated_level),
                run=self._labels("run", options.run),
                controlled=self._controlled(drive is not None and amplitude is None),
                harmonic=1 if harmonic is None else harmonic,
                quantity=quantity,
                motion=bound.motion(),
                drive_factor_uncertainty=self._factor_uncertainty(),
                quality=self._quality(),
                **errors,
            )
        except ValidationError as exc:
            raise DataError(f"{source.name}: {exc}") from exc
        if quantity != "backbone":
            check_drive(data, bound.doubt_rows)
            check_phase_size(data, bound.doubt_rows)
            if options.passive:
                check_energy(source.name, data, bound.doubt_rows)
        return data

    def _backbone(
        self, frequency_hz: FloatArray, amplitude: FloatArray | None
    ) -> tuple[Quantity, ComplexArray, dict[str, Any]]:
        """Return damping ratios against amplitude, and their errors."""
        roles = ("damping_ratio", "frequency_std", "damping_ratio_std")
        ratio, frequency_std, ratio_std = (self._scaled(role) for role in roles)
        if amplitude is None or frequency_std is None or ratio_std is None:
            raise DataError(
                f"{self.bound.source.name}: a table of damping ratios is a backbone; expected the "
                "columns amplitude, frequency_std and damping_ratio_std in addition to frequency "
                "and damping_ratio"
            )
        try:
            data = FrequencyResponse.backbone(
                amplitude, frequency_hz, ratio,
                frequency_std=frequency_std, damping_ratio_std=ratio_std,
            )  # fmt: skip
        except ValidationError as exc:
            raise DataError(f"{self.bound.source.name}: {exc}") from exc
        errors = self._errors("backbone", data.response) | {"covariance": data.covariance}
        return "backbone", data.response, errors

    def _within_range(self) -> None:
        """Leave out the frequencies that the user does not want, before anything is judged."""
        self._refuse_waveforms()
        lengths = {c: self.bound.channel(c) for c in RESPONSE_COLUMNS}
        self.bound.same_length({r: c for r, c in lengths.items() if c is not None})
        if self.options.frequency_hz is None:
            return
        low, high = self.options.frequency_hz
        channel = self.bound.required("frequency")
        frequency_hz = self._hertz(self.bound.numbers("frequency", channel))
        keep = (frequency_hz >= low) & (frequency_hz <= high)
        if not keep.any():
            raise DataError(
                f"{self.bound.source.name}: no frequency lies from {low:g} to {high:g} Hz"
            )
        self.bound.source = self.bound.source.rows(keep)

    def _refuse_waveforms(self) -> None:
        """Say so where samples in time were given for responses."""
        source = self.bound.source
        if self.bound.has("frequency"):
            return
        held = {plain(c.short or c.name) for c in source.channels}
        motion_or_force = {n for r in (*MOTION_KINDS, "force") for n in RECORD_COLUMNS[r].names}
        if held & set(RECORD_COLUMNS["time"].names) and held & motion_or_force:
            channels = listed([c.header for c in source.channels], 5)
            raise WaveformsError(
                f"{source.name}: it holds waveforms ({channels}), and a table of responses at "
                "some frequencies was expected. If they are sine tests, make such a table with "
                "extract; any other motion is fitted as a record (on the command line --record)"
            )

    def _hertz(self, values: FloatArray) -> FloatArray:
        channel = self.bound.required("frequency")
        unit = self.bound.unit("frequency", channel)
        kind, factor = self.bound.kind("frequency", unit, ("frequency", "angular_frequency"))
        return values * factor / (2.0 * np.pi if kind == "angular_frequency" else 1.0)

    def _frequency(self) -> FloatArray:
        bound, stated = self.bound, self.options.frequency
        channel = bound.channel("frequency")
        if channel is None:
            rows = next((c for f in _FORMS for r in f if (c := bound.channel(r)) is not None), None)
            if rows is not None and stated is None and not bound.has("amplitude"):
                raise DataError(
                    f"{bound.source.name}: no column holds the frequency; name it with "
                    "columns={'frequency': ...}, or say what was swept, such as sweep='1 to 100 "
                    "Hz, log'"
                )
            if rows is None:
                bound.required("frequency")
            assert rows is not None  # else an error was raised
            if stated is None:
                bound.notes.append(_UNKNOWN_FREQUENCY)
            return np.full(
                rows.size, 1.0 if stated is None else positive_number(stated, "frequency")
            )
        if stated is not None:
            raise DataError(
                f"{bound.source.name}: frequency={stated!r} is given, and column {channel.name!r} "
                "holds the frequency too; leave out one of them"
            )
        values = bound.numbers("frequency", channel)
        self.bound.source.require(
            values >= SMALLEST, channel, "a frequency > 0; frequency_hz=(low, high) leaves rows out"
        )
        return self._hertz(values)

    def _amplitude(self, frequency_hz: FloatArray) -> FloatArray | None:
        found = self._peaks("amplitude", MOTION_KINDS, frequency_hz.shape)
        return None if found is None else per_frequency(found[1], frequency_hz, found[0])

    def _drive(self, frequency_hz: FloatArray) -> FloatArray | None:
        found = self._peaks("drive", DRIVE_KINDS, frequency_hz.shape)
        if not self._gain_per_drive():
            self.bound.refuse_idle_factor(None if found is None else found[0])
        return None if found is None else found[1] * self._force_per(found[0])

    def _peaks(
        self, role: str, kinds: tuple[str, ...], shape: tuple[int, ...]
    ) -> tuple[str, FloatArray] | None:
        """Return kind and zero-to-peak values of a column, or of the one value for the file."""
        bound, text = self.bound, getattr(self.options, role)
        channel = bound.channel(role)
        if channel is None:
            return None if text is None else self._constant(role, text, kinds, shape)
        if text is not None:
            raise DataError(
                f"{bound.source.name}: {role}={text!r} is given, and column {channel.name!r} holds "
                f"the {role} too; leave out one of them"
            )
        values = bound.numbers(role, channel)
        bound.source.require(values >= SMALLEST, channel, "a value > 0")
        unit = bound.unit(role, channel)
        kind, factor = bound.kind(role, unit, kinds)
        bound.note_peak(role, unit)
        return kind, values * factor * unit.to_peak

    def _constant(
        self, role: str, text: str, kinds: tuple[str, ...], shape: tuple[int, ...]
    ) -> tuple[str, FloatArray]:
        """Return one amplitude or drive that holds for the whole file."""
        value, kind, motion = parse_quantity(text, kinds, f"{self.bound.source.name}: {role}")
        if not 0.0 < value < np.inf:
            raise DataError(f"{self.bound.source.name}: {role} is {text!r}; expected a value > 0")
        if kind in MECHANICAL_KINDS:
            self.bound.motions[role] = motion
        return kind, np.full(shape, value)

    def _gain_per_drive(self) -> bool:
        """Return whether the response is one for a drive in V or A, such as m/V."""
        for role in ("gain", "gain_db", "real", "response"):
            channel = self.bound.channel(role)
            if channel is not None and _per_drive(self.bound.unit(role, channel).text) is not None:
                return True
        return False

    def _force_per(self, kind: str) -> float:
        """Return the force for one SI unit of the drive."""
        factor, self.factor_uncertainty = self.bound.force_per(kind)
        return factor

    def _factor_uncertainty(self) -> float:
        """Return the uncertainty of the factor that was used, or that an earlier save states."""
        saved = self.bound.source.metadata.get("drive_factor_uncertainty")
        return self.factor_uncertainty or float(saved or 0.0)

    def _response(
        self, frequency_hz: FloatArray, amplitude: FloatArray | None, drive: FloatArray | None
    ) -> tuple[Quantity, ComplexArray]:
        form = self._form(_FORMS)
        match form:
            case ("response",):
                return self._complex()
            case ("real", "imag"):
                quantity, real = self._part("real")
                other, imag = self._part("imag")
                if other != quantity:
                    raise UnitError(
                        f"{self.bound.source.name}: units disagree: real is {quantity}, imag "
                        f"{other}"
                    )
                return quantity, real + 1j * imag
            case (role, "phase"):
                quantity, gain = self._part(role)
                return quantity, gain * np.exp(1j * self._phase())
        quantity_named = self.bound.map.quantity
        if amplitude is None or drive is None or not self.bound.has("phase"):
            raise DataError(
                f"{self.bound.source.name}: no response; expected real and imag, gain (or "
                "gain_db) and phase, complex numbers, or a phase beside amplitude and drive"
            )
        if quantity_named is None:
            raise DataError(
                f"{self.bound.source.name}: the phase stands without a gain; say which quantity's "
                "it is with quantity='receptance' or another"
            )
        receptance = FrequencyResponse(
            frequency_hz, amplitude / drive, amplitude, quantity="receptance"
        )
        return quantity_named, receptance.to(quantity_named).gain * np.exp(1j * self._phase())

    def _form(self, forms: tuple[tuple[str, ...], ...]) -> tuple[str, ...] | None:
        """Return the one form whose columns are all there; the map decides between several."""
        mapped = [f for f in forms if self.bound.map.roles.keys() >= {*f}]
        found = [f for f in mapped or forms if all(self.bound.has(role) for role in f)]
        named = [f for f in found if f[0] in self.bound.map.roles]
        found = named or found
        if len(found) > 1:
            raise DataError(
                f"{self.bound.source.name}: both {' and '.join(found[0])} and "
                f"{' and '.join(found[1])} are there; name one of them in columns="
            )
        return found[0] if found else None

    def _factor(self, role: str) -> tuple[Quantity, float, bool]:
        """Return which quantity a column's unit makes it, its factor, and whether it is in dB."""
        bound = self.bound
        unit = bound.unit(role, bound.required(role))
        per_drive = _per_drive(unit.text) if bound.map.drive_factor is not None else None
        if per_drive is not None:  # such as m/V, made m/N by the factor in N/V
            drive_kind, text, power = per_drive
            kind, factor = bound.kind(role, parse_unit(text), QUANTITIES)
            value, self.factor_uncertainty = bound.force_per(drive_kind)
            return cast(Quantity, kind), factor * value**power, unit.decibel
        kind, factor = bound.kind(role, unit, QUANTITIES)
        wanted = bound.map.quantity
        if wanted is not None and kind != wanted:
            raise UnitError(
                f"{bound.source.name}: the {role} in [{unit.text}] is {kind}, not {wanted}"
            )
        return cast(Quantity, kind), factor, unit.decibel

    def _part(self, role: str) -> tuple[Quantity, FloatArray]:
        """Return the quantity and the SI values of a gain, or of a real or imaginary part."""
        channel = self.bound.required(role)
        quantity, factor, decibel = self._factor(role)
        values = self.bound.numbers(role, channel)
        if decibel or role == "gain_db":
            self.bound.source.require(np.abs(values) < 1000.0, channel, "a level within 1000 dB")
            return quantity, factor * 10.0 ** (values / 20.0)
        if role == "gain":
            self.bound.source.require(values >= 0.0, channel, "a gain >= 0")
        return quantity, factor * values

    def _complex(self) -> tuple[Quantity, ComplexArray]:
        channel = self.bound.required("response")
        quantity, factor, _ = self._factor("response")
        return quantity, factor * self.bound.source.complex_numbers(channel)

    def _phase(self) -> FloatArray:
        channel = self.bound.required("phase")
        values = self.bound.numbers("phase", channel)
        unit = self.bound.unit("phase", channel)
        _, factor = self.bound.kind("phase", unit, ("angle",))
        check_phase_unit(values, factor != 1.0, channel.name, self.bound.doubt_rows)
        return values * factor

    def _errors(self, quantity: Quantity, response: ComplexArray) -> dict[str, Any]:
        """Return the constructor's arguments on errors that the table has columns for."""
        dof, form = self.bound.channel("dof"), self._form(_ERROR_FORMS)
        errors: dict[str, Any] = {
            "covariance": None if form is None else self._covariance(form, quantity, response),
            "dof": None if dof is None else self.bound.source.numbers(dof, infinite=True),
            "amplitude_std": self._scaled("amplitude_std"),
            "drive_std": self._scaled("drive_std"),
        }
        for level in ("amplitude", "drive"):
            cross = [f"covariance_{level}_{part}" for part in ("real", "imag")]
            if all(self.bound.has(role) for role in cross):
                both = [self._scaled(role, quantity) for role in cross]
                errors[f"{level}_covariance"] = np.stack(both, -1)
        return errors

    def _covariance(
        self, form: tuple[str, ...], quantity: Quantity, response: ComplexArray
    ) -> NDArray[np.float64]:
        given = [self._scaled(role, quantity) for role in form]
        ri = np.zeros(response.shape)
        match form:
            case ("std",):
                rr = ii = given[0] ** 2
            case ("real_std", "imag_std"):
                rr, ii = given[0] ** 2, given[1] ** 2
            case ("gain_std", "phase_std"):
                along, across = given[0] ** 2, (np.abs(response) * given[1]) ** 2
                c, s = np.cos(np.angle(response)), np.sin(np.angle(response))
                rr, ii = along * c**2 + across * s**2, along * s**2 + across * c**2
                ri = (along - across) * c * s
            case _:
                rr, ri, ii = given
        return np.stack([np.stack([rr, ri], -1), np.stack([ri, ii], -1)], -2)

    def _scaled(self, role: str, quantity: str = "dynamic_stiffness") -> Any:
        """Return a column in the SI unit that it is declared with, None where there is none."""
        bound, column = self.bound, RESPONSE_COLUMNS[role]
        channel = bound.channel(role)
        if channel is None:
            return None
        unit, values = bound.unit(role, channel), bound.numbers(role, channel)
        if column.least:
            bound.source.require(values >= 0.0, channel, column.least)
        what = f"{bound.source.name}: column {channel.name!r}"
        return (
            values * factor_to(unit, column.unit_of(bound.motion(), quantity), what) * unit.to_peak
        )

    def _whole_numbers(self, role: str) -> FloatArray | None:
        channel = self.bound.channel(role)
        if channel is None:
            return None
        values = self.bound.numbers(role, channel)
        good = (values >= 0.0) & (values == np.round(values))
        self.bound.source.require(good, channel, "a whole number >= 0")
        return values

    def _refuse_zero(self, response: ComplexArray, harmonic: FloatArray | None) -> None:
        fundamental = np.ones(response.shape, bool) if harmonic is None else harmonic == 1
        zero = np.flatnonzero((np.abs(response) < SMALLEST) & fundamental)
        if zero.size:
            source = self.bound.source
            raise DataError(
                f"{source.name}, {source.row_name(int(zero[0]))}: the response is 0 "
                f"({zero.size} such rows); expected a measured value"
            )

    @property
    def _stated_level(self) -> str | float | None:
        return self.options.drive if self.options.level is None else self.options.level

    def _labels(self, role: str, stated: str | float | None) -> Any:
        """Return the labels in a column, or those stated for the whole table."""
        channel = self.bound.channel(role)
        if channel is None:
            return stated
        if channel.values.dtype.kind == "U":
            return np.atleast_1d(channel.values)
        return self.bound.source.numbers(channel)

    def _controlled(self, force_only: bool) -> Any:
        held = self.bound.map.controlled
        if isinstance(held, Mapping):
            label = str(self._labels("level", self._stated_level))
            found = [w for w in CONTROLLED if fnmatch.fnmatchcase(label, held.get(w, ""))]
            if len(found) != 1:
                raise DataError(
                    f"{self.bound.source.name}: level {label!r} matches "
                    f"{'both patterns' if found else 'no pattern'} of controlled: {dict(held)}"
                )
            return found[0]
        if held is not None:
            return held
        channel = self.bound.channel("controlled")
        if channel is not None:
            words = np.char.strip(np.atleast_1d(channel.values).astype(str))
            self.bound.source.require(np.isin(words, CONTROLLED), channel, "displacement or force")
            return words
        word = "force" if force_only else "displacement"
        self.bound.notes.append(f"controlled: {word}, as the table does not say")
        return word

    def _quality(self) -> dict[str, NDArray[Any]]:
        """Return the verdicts that an earlier save listed, in the types they had."""
        kinds = self.bound.source.metadata.get("quality", {})
        found = {name: self.bound.source.find(name) for name in kinds}
        self.bound.used |= {channel.name for channel in found.values()}
        return {name: _typed(found[name].values, kind) for name, kind in kinds.items()}


def _per_drive(text: str) -> tuple[str, str, int] | None:
    """Return the drive's kind, the unit with N for V or A, and the factor's power in it."""
    with contextlib.suppress(UnitError):
        kind_of(parse_unit(text), QUANTITIES, "the gain")
        return None  # one of the six quantities as it is
    for kind, symbol in (("voltage", "V"), ("current", "A")):
        for form, power in ((f"({text})*{symbol}/N", -1), (f"({text})*N/{symbol}", 1)):
            with contextlib.suppress(UnitError):
                kind_of(parse_unit(form), QUANTITIES, "the gain")
                return kind, form, power
    return None


def _make_real(response: ComplexArray, errors: dict[str, Any], mean: NDArray[np.bool_]) -> None:
    """Take rounding off the rows of the mean force, which are real: a phase of 180 deg, say."""
    rounding = mean & (np.abs(response.imag) <= 1e-9 * np.abs(response.real))
    response.imag[rounding] = 0.0
    if errors["covariance"] is not None:
        errors["covariance"][mean, 1, :] = 0.0
        errors["covariance"][mean, :, 1] = 0.0


def _typed(values: NDArray[Any], kind: str) -> NDArray[Any]:
    """Return a column of a text file in the type it was saved from."""
    if kind == "b" and values.dtype.kind == "U":
        return np.asarray(np.char.lower(values) == "true")
    types: dict[str, type] = {"b": np.bool_, "i": np.int64, "u": np.uint64, "f": np.float64}
    return np.asarray(values, dtype=types.get(kind, np.str_))
