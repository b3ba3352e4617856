"""Any bytes give a valid object, or an error that this package raises on purpose."""

import contextlib
import io
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dahl_ident.data import (
    FrequencyResponse,
    inspect,
    read_frequency_response,
    read_record,
    readers,
)
from dahl_ident.errors import DahlIdentError, DataWarning
from tests import reader_fuzz

NAMES = [
    "time", "t [s]", "x [mm]", "displacement", "F [kN]", "force (N)", "drive [V]", "frequency_hz",
    "frequency [rad/s]", "amplitude [um rms]", "amplitude", "gain [N/m]", "gain_db [dB re N/m]",
    "phase_deg", "phase [rad]", "real [m/N]", "imag", "level", "harmonic", "controlled", "std",
    "dof", "[", "]", "[]", "x [", "(N", "a (b) (c)", "", '"', "#", "%", "=1+1", "nan",
]  # fmt: skip
CELLS = [
    "0", "1", "2", "-1", "1.5", "2,5", "1e3", "1e-400", "1e400", "nan", "NaN", "inf", "-inf", "",
    " ", "x", "force", "True", "0x10", "1_0", "1,000.5", '"', '"1"', "'", "#", "--", "1+2j", "\x0c",
    "٣", "−1", "½", "1d3", "\u2028", "1" * 30, "0." + "3" * 40,
]  # fmt: skip


GOOD = [
    ["time [s]", "x [mm]", "F [kN]"],
    ["t [s]", "v [in/s]", "torque [N]", "drive [V]"],
    ["frequency_hz", "amplitude [um rms]", "gain [N/m]", "phase_deg"],
    ["frequency [rad/s]", "drive [lbf]", "real [m/N]", "imag", "std"],
]


@st.composite
def tables(draw):
    """Return tables in which at most a few names, cells and lines are wrong."""
    delimiter = draw(st.sampled_from([",", ";", "\t", "|", " ", ", "]))
    header = list(draw(st.sampled_from(GOOD)))
    width = len(header)
    number = st.one_of(st.integers(1, 99).map(str), st.floats(0.1, 1e4).map(repr))
    rows = [
        [repr(i + 0.5), *draw(st.lists(number, min_size=width - 1, max_size=width - 1))]
        for i in range(draw(st.integers(0, 6)))
    ]
    for _ in range(draw(st.integers(0, 3))):
        line = draw(st.integers(-1, len(rows) - 1))
        cells = header if line < 0 else rows[line]
        place = draw(st.integers(0, len(cells) - 1)) if cells else 0
        bad = draw(st.sampled_from(NAMES if line < 0 else CELLS))
        cells[place : place + draw(st.sampled_from([1, 1, 1, 0]))] = [bad]
        if draw(st.integers(0, 9)) == 0:
            del cells[place]
    above = st.sampled_from(["# note", "", "rate,3", "% x", "\ufeff"])
    preamble = draw(st.lists(above, max_size=2))
    end = draw(st.sampled_from(["\n", "\r\n", "\r", "\n\n"]))
    lines = [*preamble, delimiter.join(header), *(delimiter.join(r) for r in rows)]
    encoding = draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]))
    return (end.join(lines) + draw(st.sampled_from(["", end]))).encode(encoding, "replace")


def check_record(record):
    assert np.isfinite(record.time).all()
    assert (np.diff(record.time) > 0.0).all()
    assert np.isfinite(record.motion_samples).all()
    assert record.motion_samples.shape == record.time.shape
    repr(record)


def check_response(data):
    assert (data.frequency_hz > 0.0).all()
    assert np.isfinite(data.response).all()
    for values in (data.amplitude, data.drive):
        assert values is None or (np.isfinite(values) & (values > 0.0)).all()
    repr(data)


def read_every_way(path):
    """Read a file in every way; only errors and warnings of this package are allowed."""
    record_map = {"time": "column 1 [s]", "displacement": "column 2 [m]", "force": "column 3 [N]"}
    ways: list[Any] = [
        lambda: check_record(read_record(path)),
        lambda: check_record(read_record(path, missing="drop", sample_rate=10.0)),
        lambda: check_record(read_record(path, columns=record_map)),
        lambda: check_response(read_frequency_response(path)),
        lambda: check_response(
            read_frequency_response(path, drive="1 N", amplitude="1 mm/s", quantity="mobility")
        ),
        lambda: repr(inspect(path)),
    ]
    for way in ways:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            with contextlib.suppress(DahlIdentError):
                way()


@pytest.fixture(autouse=True)
def _parsed_once(monkeypatch):
    monkeypatch.setattr(readers, "_parsed", reader_fuzz.ParsedOnce(readers._parsed))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@settings(max_examples=80)
@given(tables())
def test_tables_that_are_nearly_right(folder, content):
    path = folder / "table.csv"
    path.write_bytes(content)
    read_every_way(path)


@settings(max_examples=60)
@given(st.one_of(st.binary(max_size=400), st.text(max_size=200).map(lambda t: t.encode())))
def test_any_bytes(folder, content):
    path = folder / "file.txt"
    path.write_bytes(content)
    read_every_way(path)


def response_table():
    Z = 1e3 * (1.0 + 0.3j) * np.linspace(1.0, 0.5, 6)
    data = FrequencyResponse(
        np.linspace(1, 9, 6), Z, np.geomspace(1e-5, 1e-3, 6), covariance=[np.eye(2)] * 6, dof=4.0,
        level=list("abcabc"), quality={"settled": [True, False] * 3},
    )  # fmt: skip
    buffer = io.BytesIO()
    data.to_frame().to_csv(buffer, index=False)
    return buffer.getvalue()


TABLE = response_table()


@settings(max_examples=60)
@given(
    st.integers(0, len(TABLE) - 1), st.integers(0, 255), st.sampled_from(["cut", "swap", "drop"])
)
def test_one_damaged_byte(folder, place, byte, how):
    damaged = {
        "cut": TABLE[:place],
        "swap": TABLE[:place] + bytes([byte]) + TABLE[place + 1 :],
        "drop": TABLE[:place] + TABLE[place + 1 :],
    }
    path = folder / "damaged.csv"
    path.write_bytes(damaged[how])
    read_every_way(path)


def is_measured(value):
    """Return whether a number is a measured value; 9999, for example, marks a missing one."""
    size = abs(value)
    is_mark = (size > 900.0 and not f"{size:g}".strip("9.")) or size in (32767.0, 32768.0)
    return value == 0.0 or (size > 1e-30 and not is_mark)


MEASURED = st.floats(-1e6, 1e6).filter(is_measured)


@given(
    st.lists(st.tuples(MEASURED, MEASURED), min_size=2, max_size=20),
    st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", ","), ("|", "."), (" ", ",")]),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.sampled_from(["", "# made by a logger\n", "Rig 5\n\n", "rate;5\n"]),
)
def test_good_tables_are_read_to_the_last_digit(folder, rows, dialect, end, preamble):
    delimiter, mark = dialect
    lines = [f"{a!r}{delimiter}{b!r}".replace(".", mark) for a, b in rows]
    text = preamble + end.join([f"a{delimiter}b", *lines])
    path = folder / "good.csv"
    path.write_bytes(text.encode())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # such numbers repeat themselves, or jump
        record = read_record(path, displacement="a [m]", force="b [N]", sample_rate=1.0)
    np.testing.assert_array_equal(record.displacement, [a for a, _ in rows])
    np.testing.assert_array_equal(record.force, [b for _, b in rows])


# ``make fuzz`` takes thousands; a workbook and a universal file take half a second to judge
MUTANTS, FEWER = 20, {"xlsx": 4, "uff": 8}


@pytest.fixture(scope="module")
def reader():
    reader_fuzz.files()  # before the process starts: it then has the libraries
    reader = reader_fuzz.Reader()
    yield reader
    reader.close()


@pytest.mark.parametrize("name", list(reader_fuzz.files()))
def test_damaged_files_are_read_right_or_refused(name, reader):
    content = reader_fuzz.files()[name]
    assert reader.judge(name, content, "none") == ("accepted", "")
    mutants = FEWER.get(name, MUTANTS)
    counts, bad = reader_fuzz.fuzz(name, mutants, 7, reader)
    assert not bad
    assert counts["refused"] > mutants / 8
