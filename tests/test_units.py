"""Units as laboratories write them, against factors worked out by hand or defined by law."""

import contextlib
import math
import subprocess
import sys
from typing import Any

import numpy as np
import pint
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dahl_ident.errors import UnitError
from dahl_ident.units import (
    DRIVE_KINDS,
    MOTION_KINDS,
    QUANTITIES,
    SI_UNITS,
    Unit,
    factor_to,
    kind_of,
    parse_quantity,
    parse_unit,
    si_unit,
)

POUND_FORCE = 0.45359237 * 9.80665  # international avoirdupois pound, standard gravity


FACTORS: dict[float, str] = {  # texts apart by commas
    1.0: "m,m/s2,m/s^2,m/s**2,m s⁻²,m s^-2,Nm,N m,N·m,N-m,N.m,sec,HZ,Newtons,Volts,1",
    1e-6: "um,µm,μm,(mm/s)/kN",
    1e-3: "mm/s²,mrad,ms,mV",
    1e3: "kN*m,N/mm,kHz",
    0.0254: "in,in/s",
    25.4e-6: "mil,mils",
    9.80665: "kgf,g_n",
    math.pi / 180: "deg,°,Deg,º",
    2 * math.pi / 60: "rpm",
    POUND_FORCE: "lbf",
    1000 * POUND_FORCE: "kip",
    POUND_FORCE * 0.0254: "lbf-in,in-lbf",
}


@pytest.mark.parametrize(
    ("text", "factor"), [(t, factor) for factor, texts in FACTORS.items() for t in texts.split(",")]
)
@pytest.mark.versions
def test_factors(text, factor):
    assert parse_unit(text).factor == pytest.approx(factor, rel=1e-14)


MARKERS: dict[tuple[str | None, float], str] = {
    (None, 1.0): "um",
    ("zero to peak", 1.0): "um pk,um peak,um 0-p,um zero-to-peak,mm 0p",
    ("rms", math.sqrt(2)): "um rms,Vrms,m_RMS,um (rms)",
    ("peak to peak", 0.5): "mm pp,mVpp,mm p-p,mm pk-pk,mm peak-to-peak,mm (p-p)",
}


@pytest.mark.parametrize(
    ("text", "meaning"), [(t, known) for known, texts in MARKERS.items() for t in texts.split(",")]
)
def test_amplitude_markers(text, meaning):
    unit = parse_unit(text)
    assert (unit.marker, unit.to_peak) == meaning


@pytest.mark.parametrize(
    "text", ["dB re 1 N/m", "dB re N/m", "dB N/m", "db re. 1 N/m", "dB re 1N/m"]
)
def test_decibels_keep_their_reference(text):
    unit = parse_unit(text)
    assert unit.decibel
    assert kind_of(unit, QUANTITIES, "gain")[0] == "dynamic_stiffness"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not a unit"),
        ("furlongs per fortnight!", "is not a unit"),
        ("blorp", "not a known unit"),
        ("3 m", "is not a unit"),
        ("m^22", "is not a unit"),
        ("9^9^9", "is not a unit"),
        ("10**1000000000*m", "is not a unit"),
        ("x" * 100, "is not a unit"),
        ("m**m", "is not a unit"),
        ("/", "not a known unit"),
        ("__class__", "not a known unit"),
        ("dB", "does not say what 0 dB is"),
        ("Grad", "ambiguous: grad is a degree in German and a gon elsewhere; write deg or gon"),
        ("grad/s", "ambiguous"),
    ],
)
def test_what_is_no_unit(text, message):
    with pytest.raises(UnitError, match=message):
        parse_unit(text)


@given(st.text(max_size=70))
def test_any_text_is_a_unit_or_a_unit_error(text):
    try:
        unit = parse_unit(text)
    except UnitError:
        return
    assert unit.factor > 0.0
    assert np.isfinite(unit.factor)


@given(
    st.lists(
        st.sampled_from(
            ["m", "s", "N", "kg", "^2", "^-1", "/", "*", " ", "(", ")", "1", "9", "pp"]
        ),
        max_size=12,
    )
)
def test_any_combination_of_symbols_ends(parts):
    with contextlib.suppress(UnitError):
        assert isinstance(parse_unit("".join(parts)), Unit)


def test_a_mil_is_a_length_and_no_angle():
    assert kind_of(parse_unit("mils pp"), ("displacement",), "x")[1] == "translation"


@pytest.mark.parametrize("kind", SI_UNITS)
def test_si_units_are_their_own_kind(kind):
    for motion, text in zip(("translation", "rotation"), SI_UNITS[kind], strict=True):
        found = kind_of(parse_unit(text), (kind,), "it")
        assert found[0] == kind
        assert found[2] == pytest.approx(1.0, rel=1e-15)
        if SI_UNITS[kind][0] != SI_UNITS[kind][1]:
            assert found[1] == motion
            assert si_unit(kind, found[1]) == text


def test_the_six_quantities_are_told_by_their_units():
    """No two of the twelve units have the same dimension."""
    for kind in QUANTITIES:
        for text in SI_UNITS[kind]:
            assert kind_of(parse_unit(text), QUANTITIES, "gain")[0] == kind


@pytest.mark.parametrize(
    ("text", "kinds", "expected"),
    [
        ("mm", MOTION_KINDS, ("displacement", "translation", 1e-3)),
        ("deg", MOTION_KINDS, ("displacement", "rotation", math.pi / 180)),
        ("in/s", MOTION_KINDS, ("velocity", "translation", 0.0254)),
        ("g", MOTION_KINDS, ("acceleration", "translation", 9.80665)),
        ("g rms", MOTION_KINDS, ("acceleration", "translation", 9.80665)),
        ("g/N", QUANTITIES, ("accelerance", "translation", 9.80665)),
        ("1/kg", QUANTITIES, ("accelerance", "translation", 1.0)),
        ("N m", QUANTITIES, ("dynamic_stiffness", "rotation", 1.0)),
        ("N m/deg", QUANTITIES, ("dynamic_stiffness", "rotation", 180 / math.pi)),
        ("V", DRIVE_KINDS, ("voltage", "translation", 1.0)),
        ("rad/s", ("frequency", "angular_frequency"), ("angular_frequency", "translation", 1.0)),
        ("Hz", ("frequency", "angular_frequency"), ("frequency", "translation", 1.0)),
    ],
)
def test_kinds(text, kinds, expected):
    kind, motion, factor = kind_of(parse_unit(text), kinds, "it")
    assert (kind, motion) == expected[:2]
    assert factor == pytest.approx(expected[2], rel=1e-14)


def test_misfits_name_what_was_expected():
    with pytest.raises(
        UnitError, match=r"force has the unit \[lb\].* N or N m \(pound-force is lbf"
    ):
        kind_of(parse_unit("lb"), ("force",), "force")
    with pytest.raises(UnitError, match=r"x has the unit \[%\]; expected .* m or rad or m/s"):
        kind_of(parse_unit("%"), MOTION_KINDS, "x")
    with pytest.raises(UnitError, match=r"variance has the unit \[m\]; .* \(N/m\)\^2"):
        factor_to(parse_unit("m"), "(N/m)^2", "variance")


def test_quantities_in_words():
    assert parse_quantity("0.2 N", DRIVE_KINDS, "drive") == (0.2, "force", "translation")
    value, kind, motion = parse_quantity("-3e1um rms", MOTION_KINDS, "amplitude")
    assert value == pytest.approx(-3e-5 * math.sqrt(2))
    assert (kind, motion) == ("displacement", "translation")
    for text in ("N", "0.2", "0,2 N", "a lot"):
        with pytest.raises(UnitError, match="expected a number and its unit, such as"):
            parse_quantity(text, DRIVE_KINDS, "drive")


COMMON = ("A", "Hz", "N", "V", "m", "rad", "s", "um", "mm", "cm", "kN", "mV", "kg", "kHz", "deg")
REGISTRY: Any = pint.UnitRegistry()


@given(
    st.lists(
        st.tuples(st.sampled_from(["*", "/", " "]), st.sampled_from(COMMON), st.integers(-2, 3)),
        min_size=1,
        max_size=4,
    ),
    st.booleans(),
)
@pytest.mark.versions
def test_common_units_are_read_as_pint_reads_them(parts, bracket):
    text = "".join(f"{sign}{name}{f'^{p}' if p not in (0, 1) else ''}" for sign, name, p in parts)
    text = f"m/({text[1:]})" if bracket else text[1:]
    expected = REGISTRY.Quantity(1.0, REGISTRY.parse_units(text)).to_base_units()
    found = parse_unit(text)
    assert found.factor == pytest.approx(expected.magnitude, rel=1e-13)
    assert dict(found.dimension) == {k: float(v) for k, v in expected.unit_items()}


def test_common_units_are_read_without_loading_pint():
    code = (
        "import sys; from dahl_ident.units import *; kind_of(parse_unit('mm'), MOTION_KINDS, '');"
        "kind_of(parse_unit('kN/mm'), QUANTITIES, ''); print('pint' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "False\n"
