"""Units of files and user input, and their conversion to SI.

Besides the factor, a unit shows whether a motion is a displacement, a velocity or an acceleration,
translation or rotation, and which standard quantity a response is. Units are never guessed.

The six standard quantities of ISO 7626-1 are R = s^p Z^q, with Z = F/X the dynamic stiffness,
s = j omega and q = 1 or -1, so that Z = s^(-p q) R^q.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.errors import UnitError, ValidationError

if TYPE_CHECKING:
    import pint

Motion = Literal["translation", "rotation"]
Quantity = Literal[
    "receptance",
    "mobility",
    "accelerance",
    "dynamic_stiffness",
    "mechanical_impedance",
    "apparent_mass",
    "backbone",
]
Dimension = tuple[tuple[str, float], ...]
Marker = Literal["zero to peak", "rms", "peak to peak"]

# SI unit of each kind, for translation and for rotation.
SI_UNITS: dict[str, tuple[str, str]] = {
    "displacement": ("m", "rad"),
    "velocity": ("m/s", "rad/s"),
    "acceleration": ("m/s^2", "rad/s^2"),
    "force": ("N", "N m"),
    "receptance": ("m/N", "rad/(N m)"),
    "mobility": ("m/(N s)", "rad/(N m s)"),
    "accelerance": ("m/(N s^2)", "rad/(N m s^2)"),
    "dynamic_stiffness": ("N/m", "N m/rad"),
    "mechanical_impedance": ("N s/m", "N m s/rad"),
    "apparent_mass": ("kg", "kg m^2"),
    "backbone": ("1", "1"),
    "voltage": ("V", "V"),
    "current": ("A", "A"),
    "force_per_voltage": ("N/V", "N m/V"),
    "force_per_current": ("N/A", "N m/A"),
    "time": ("s", "s"),
    "frequency": ("Hz", "Hz"),
    "angular_frequency": ("rad/s", "rad/s"),
    "angle": ("rad", "rad"),
    "number": ("1", "1"),
}
MOTIONS: tuple[Motion, ...] = get_args(Motion)
_ROTATION = {"N/m^2": "N m/rad^2", "N/s": "N m/s"} | dict(SI_UNITS.values())
QUANTITIES: tuple[Quantity, ...] = tuple(q for q in get_args(Quantity) if q != "backbone")
"""The six standard quantities, each a quotient of force and motion; a backbone is not."""
MOTION_KINDS = ("displacement", "velocity", "acceleration")
DRIVE_KINDS = ("force", "voltage", "current")
MECHANICAL_KINDS = (*MOTION_KINDS, "force", *QUANTITIES, "force_per_voltage", "force_per_current")

_TO_PEAK: dict[Marker, float] = {"zero to peak": 1.0, "rms": np.sqrt(2.0), "peak to peak": 0.5}
_MARKERS: tuple[tuple[Marker, str], ...] = (
    ("rms", r"r\.?m\.?s\.?|eff"),
    ("peak to peak", r"pk-pk|pkpk|p-p|pp|peak[- ]to[- ]peak|peak[- ]peak"),
    ("zero to peak", r"zero[- ]to[- ]peak|zero[- ]peak|0-?pk?|0-peak|zp|pk|peak"),
)
_MARKER = re.compile(
    "(?:^|[\\s_,(]|(?<=\\w))(?:" + "|".join(f"({p})" for _, p in _MARKERS) + r")\)?\s*$", re.I
)
_DECIBEL = re.compile(r"^\s*dB\b(?:\s*re\.?\s*(?:1(?![\d./]))?)?\s*", re.I)
# Spellings of laboratories that pint does not know, or interprets differently.
_SPELLINGS = {"sec": "s", "deg": "deg", "rad": "rad", "hz": "Hz", "mil": "thou", "mils": "thou"}
_SPELLINGS |= {"vdc": "V", "vac": "V"}
_JOINED = re.compile(r"\b([kmu]?N)(m?[ms])(?![A-Za-z])")  # such as kNm, Nmm and Ns
_PREFIXES = {-9: "n", -6: "\u00b5", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
_AMBIGUOUS = {"grad": "a degree in German and a gon elsewhere; write deg or gon"}
# Units of nearly every file, read without pint, which takes most of a second to load.
_FORCE = (("kilogram", 1.0), ("meter", 1.0), ("second", -2.0))
_VOLT = (("ampere", -1.0), ("kilogram", 1.0), ("meter", 2.0), ("second", -3.0))
_COMMON: dict[str, tuple[float, Dimension]] = {
    "1": (1.0, ()),
    "deg": (math.pi / 180.0, (("radian", 1.0),)),
    "\N{DEGREE SIGN}": (math.pi / 180.0, (("radian", 1.0),)),
    "cm": (1e-2, (("meter", 1.0),)),
    "kg": (1.0, (("kilogram", 1.0),)),
    "kHz": (1e3, (("second", -1.0),)),
    "Hz": (1.0, (("second", -1.0),)),
} | {
    prefix + symbol: (factor, dimension)
    for prefix, factor in {"u": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3}.items()
    for symbol, dimension in {
        "A": (("ampere", 1.0),),
        "N": _FORCE,
        "V": _VOLT,
        "m": (("meter", 1.0),),
        "rad": (("radian", 1.0),),
        "s": (("second", 1.0),),
    }.items()
}
_COMMON_PART = re.compile(
    r"(\s*[*/]\s*|\s+|)(?:\(([^()]+)\)|([A-Za-z]+|\N{DEGREE SIGN}|1\b))(?:\^(-?\d))?"
)
_TOKEN = re.compile(r"[A-Za-zµμ°%Ω_]\w*|\b1\b|(?<![\d(])\^-?\d(?!\d)|[*/() ]")
_LONGEST_UNIT = 60  # characters; longer text in brackets is not a unit


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit as written, and its value in SI units without the marker of an amplitude.

    `dimension` has the exponents of the SI base units and the radian, sorted by name.
    """

    text: str
    factor: float
    dimension: Dimension
    marker: Marker | None = None
    decibel: bool = False

    @property
    def to_peak(self) -> float:
        """Factor from amplitudes in this unit to zero-to-peak; 1 if the text does not say."""
        return _TO_PEAK[self.marker or "zero to peak"]


def parse_unit(text: str) -> Unit:
    """Read a unit such as ``"um rms"`` or ``"(m/s^2)/N"``.

    Products are written with a space, ``*``, a dot or a hyphen; powers as ``m/s^2``, ``m/s2`` or
    ``m/s²``; amplitudes are marked ``rms``, ``pp`` or ``pk`` at the end; decibels are ``dB`` with
    the reference unit. ``g`` is the gram and ``g_n`` the acceleration; ``g`` is read as ``g_n``
    only if :func:`kind_of` expects an acceleration.

    Examples
    --------
    >>> unit = parse_unit("um rms")
    >>> f"{unit.factor:g}", unit.marker
    ('1e-06', 'rms')
    """
    symbols = text.strip()
    if len(symbols) > 2 * _LONGEST_UNIT:
        raise UnitError(
            f"[{symbols[:_LONGEST_UNIT]}...] is not a unit: it has {len(symbols)} characters"
        )
    decibel = _DECIBEL.match(symbols)
    if decibel:
        symbols = symbols[decibel.end() :]
    marker: Marker | None = None
    match = _MARKER.search(symbols)
    if match:
        marker = next(m for (m, _), g in zip(_MARKERS, match.groups(), strict=True) if g)
        symbols = symbols[: match.start()]
    if decibel and not symbols:
        raise UnitError(
            f"[{text}] does not say what 0 dB is; give the reference, such as [dB re N/m]"
        )
    factor, dimension = _root(_normalised(symbols, text), text)
    return Unit(text.strip(), factor, dimension, marker, decibel is not None)


def kind_of(unit: Unit, kinds: tuple[str, ...], what: str) -> tuple[str, Motion, float]:
    """Return which of `kinds`, keys of `SI_UNITS`, a unit belongs to, its motion and its SI value.

    `what` names the object that has the unit, for the message.

    Examples
    --------
    >>> kind_of(parse_unit("mm/N"), QUANTITIES, "gain")
    ('receptance', 'translation', 0.001)
    >>> kind_of(parse_unit("lbf-in"), ("force",), "force")[:2]
    ('force', 'rotation')
    """
    for candidate in _meanings(unit):
        for kind in kinds:
            for motion, si in zip(MOTIONS, SI_UNITS[kind], strict=True):
                dimension, expected = candidate.dimension, parse_unit(si).dimension
                if kind in MECHANICAL_KINDS and kind not in MOTION_KINDS:
                    # a rotary stiffness may be in N m or N m/rad
                    dimension, expected = map(_without_angle, (dimension, expected))
                if dimension == expected:
                    return kind, motion, candidate.factor
    units = " or ".join(dict.fromkeys(u for kind in kinds for u in SI_UNITS[kind]))
    raise UnitError(
        f"{what} has the unit [{unit.text}]; expected a unit of the dimension of {units}"
        + (" (pound-force is lbf, kilogram-force kgf)" if "force" in kinds else "")
    )


def factor_to(unit: Unit, si: str, what: str) -> float:
    """Return the value of one `unit` in the SI unit `si`, with angles as pure numbers."""
    dimension = _without_angle(parse_unit(si).dimension)
    for candidate in _meanings(unit):
        if _without_angle(candidate.dimension) == dimension:
            return candidate.factor
    raise UnitError(f"{what} has the unit [{unit.text}]; expected one of the dimension of {si}")


def si_unit(kind: str, motion: Motion = "translation") -> str:
    """Return the SI unit of a kind as printed after numbers."""
    return SI_UNITS[kind][motion == "rotation"]


def engineering(value: float, unit: str) -> str:
    """Return a number with an SI prefix, such as ``3.33 mm``; compound units have no prefix."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g} {unit}".strip()
    power, unit = prefix([value], unit)
    return f"{value / power:.3g} {unit}".strip()


def prefix(values: Iterable[float], unit: str) -> tuple[float, str]:
    """Return the power of ten of the prefix that suits the median number, and the prefixed unit."""
    sizes = sorted(abs(v) for v in values if v != 0.0 and math.isfinite(v))
    if not sizes or unit not in ("N", "m", "s", "Hz", "J", "rad"):
        return 1.0, unit
    shown = float(f"{sizes[len(sizes) // 2]:.3g}")  # 999.7 nm is 1 um
    exponent = 3 * math.floor(math.log10(shown) / 3.0)
    if exponent not in _PREFIXES:
        return 1.0, unit
    return 10.0**exponent, f"{_PREFIXES[exponent]}{unit}"


def shown_unit(unit: str, motion: Motion) -> str:
    """Return the unit of a parameter, declared for translation, as written for `motion`."""
    return _ROTATION.get(unit, unit) if motion == "rotation" else unit


def parse_quantity(text: str, kinds: tuple[str, ...], what: str) -> tuple[float, str, Motion]:
    """Read a number with its unit, such as ``"0.2 N"`` or ``"5 um rms"``.

    Returns its SI value (zero to peak for an amplitude), its kind and its motion.

    Examples
    --------
    >>> parse_quantity("20 um pp", ("displacement",), "amplitude")
    (..., 'displacement', 'translation')
    """
    match = re.fullmatch(
        r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d.,].*)", text.strip()
    )
    if not match:
        raise UnitError(f"{what} is {text!r}; expected a number and its unit, such as '0.2 N'")
    try:
        unit = parse_unit(match[2])
    except UnitError as exc:
        raise UnitError(f"{what} is {text!r}: {exc}") from exc
    kind, motion, factor = kind_of(unit, kinds, what)
    return float(match[1]) * factor * unit.to_peak, kind, motion


def _normalised(text: str, written: str) -> str:
    """Return a unit as written by a laboratory in a form that pint can read safely."""
    superscripts = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
    text = text.replace("º", "°")
    out = re.sub(r"[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+", lambda m: "^" + m[0].translate(superscripts), text.strip())
    out = re.sub(r"[·⋅×]", "*", out).replace("**", "^")
    out = re.sub(r"(?<=[A-Za-z°])[-.](?=[A-Za-z])", "*", out)
    out = re.sub(r"(?<=[A-Za-z])(-?\d)", r"^\1", out)
    out = re.sub(r"[A-Z][a-z]{3,}", lambda m: m[0].lower(), out)  # Newtons, Volts
    out = re.sub(r"[A-Za-z]+", lambda m: _SPELLINGS.get(m[0].casefold(), m[0]), out)
    out = _JOINED.sub(r"\1*\2", out)
    if not out or len(out) > _LONGEST_UNIT or _TOKEN.sub("", out):
        raise UnitError(
            f"[{written}] is not a unit; expected one such as [m], [um rms], [kN], [m/s^2] or "
            "[N m/rad]"
        )
    for word in _AMBIGUOUS.keys() & set(re.findall(r"[a-z]+", out)):
        raise UnitError(f"[{written}] is ambiguous: {word} is {_AMBIGUOUS[word]}")
    return out


def percent(share: float, digits: int = 2, *, sign: bool = False) -> str:
    """Return a ratio as text, such as ``"9.2 %"``, with a plus sign if `sign` is set."""
    rounded = float(f"{100.0 * share:.{digits}g}")
    return f"{rounded:{'+' if sign else ''}g} %" if math.isfinite(share) else "-"


def counted(number: float, noun: str) -> str:
    """Return a number of things as text: ``"1 row"``, ``"2 rows"``, ``"3 degrees of freedom"``."""
    head, of, tail = noun.partition(" of ")
    return f"{number} {head}{'' if number == 1 else 's'}{of}{tail}"


def _common(text: str) -> tuple[float, Dimension] | None:
    """Read a product or quotient of common units; None for any other text."""
    text = text.strip()
    factor, powers, at = 1.0, dict[str, float](), 0
    while at < len(text):
        match = _COMMON_PART.match(text, at)
        if match is None or bool(match[1]) != bool(at):
            return None
        part = _common(match[2]) if match[2] else _COMMON.get(match[3])
        if part is None:
            return None
        power = int(match[4] or 1) * (-1 if "/" in match[1] else 1)
        factor *= part[0] ** power
        for name, exponent in part[1]:
            powers[name] = powers.get(name, 0.0) + power * exponent
        at = match.end()
    return factor, tuple(sorted((name, p) for name, p in powers.items() if p))


@cache
def _registry() -> pint.UnitRegistry[Any]:
    import pint

    registry: pint.UnitRegistry[Any] = pint.UnitRegistry()
    registry.define("g_n = standard_gravity")
    return registry


@cache
def _root(text: str, written: str) -> tuple[float, Dimension]:
    """Return the factor to SI base units and their exponents."""
    common = _common(text)
    if common is not None:
        return common
    registry = _registry()
    try:
        base: Any = registry.Quantity(1.0, registry.parse_units(text)).to_base_units()
    except Exception as exc:  # pint raises tokeniser, attribute and arithmetic errors alike
        raise UnitError(f"[{written}] is not a known unit: {exc}") from exc
    return float(base.magnitude), tuple(sorted((k, float(v)) for k, v in base.unit_items()))


def _meanings(unit: Unit) -> list[Unit]:
    """Return the unit, and that with g as the acceleration of gravity if it contains g."""
    if not re.search(r"\bg\b", unit.text):
        return [unit]
    return [unit, parse_unit(re.sub(r"\bg\b", "g_n", unit.text))]


def _without_angle(dimension: Dimension) -> Dimension:
    return tuple(part for part in dimension if part[0] != "radian")


class QuantityForm(NamedTuple):
    """A quantity R = s^power Z^exponent."""

    power: int
    exponent: int  # 1 or -1

    @property
    def power_in_stiffness(self) -> int:
        """Power of s in Z = s^power_in_stiffness R^exponent."""
        return -self.power * self.exponent


DEFINITIONS: dict[Quantity, QuantityForm] = {
    "receptance": QuantityForm(0, -1),
    "mobility": QuantityForm(1, -1),
    "accelerance": QuantityForm(2, -1),
    "dynamic_stiffness": QuantityForm(0, 1),
    "mechanical_impedance": QuantityForm(-1, 1),
    "apparent_mass": QuantityForm(-2, 1),
}
COMPLIANCES = tuple(name for name, form in DEFINITIONS.items() if form.exponent < 0)
"""Motion over force."""
_POWERS_OF_J = (1.0 + 0.0j, 1.0j, -1.0 + 0.0j, -1.0j)  # exact; (1j)**n is rounded


def power_of_s(omega: FloatArray, power: int) -> ComplexArray:
    """Return (j omega)^power, with an exact phase."""
    return np.asarray(_POWERS_OF_J[power % 4] * omega ** float(power))


def converted(
    response: ComplexArray, omega: FloatArray, source: Quantity, target: Quantity
) -> tuple[ComplexArray, ComplexArray]:
    """Return the response as `target`, and its complex derivative with respect to the source."""
    old, new = DEFINITIONS[source], DEFINITIONS[target]
    sign = old.exponent * new.exponent  # -1 inverts the response
    factor = power_of_s(omega, new.power - sign * old.power)
    if sign == 1:
        return response * factor, factor
    zero = np.flatnonzero(response == 0.0)
    if zero.size:
        raise ValidationError(
            f"response[{zero[0]}] is 0 ({zero.size} such rows); a {source} of 0 has no {target}"
        )
    value = factor / response
    return value, -value / response


def jacobian(derivative: ComplexArray) -> FloatArray:
    """Return the (n, 2, 2) real Jacobian, with respect to (Re, Im), of a complex derivative."""
    re, im = derivative.real, derivative.imag
    return np.stack([np.stack([re, -im], -1), np.stack([im, re], -1)], -2)


def polar_std(response: ComplexArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations of gain and of phase (rad), to first order."""
    radial = np.stack([response.real, response.imag], -1) / np.abs(response)[:, None]
    tangential = np.stack([-radial[:, 1], radial[:, 0]], -1)

    def std(direction: FloatArray) -> FloatArray:
        variance = np.einsum("ni,nij,nj->n", direction, covariance, direction)
        return np.asarray(np.sqrt(variance.clip(0.0)))

    return std(radial), std(tangential) / np.abs(response)
