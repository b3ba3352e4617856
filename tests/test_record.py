"""Record: sampling checks, channels, tables and files."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dahl_ident.data import Record, read_record
from dahl_ident.errors import ValidationError

TIME = np.arange(200) / 50.0


def sine(**changes):
    arguments = {"displacement": np.sin(TIME), "force": np.cos(TIME)}
    return Record(TIME, **{**arguments, **changes})


def assert_same(one, other):
    for name in ("time", "displacement", "velocity", "acceleration", "force", "drive"):
        a, b = getattr(one, name), getattr(other, name)
        if a is None:
            assert b is None, name
        else:
            np.testing.assert_array_equal(a, b, err_msg=name, strict=True)
    for name in ("drive_unit", "drive_factor", "drive_factor_uncertainty", "motion"):
        assert getattr(one, name) == getattr(other, name), name


class TestSampling:
    def test_even(self):
        record = sine()
        assert record.n == len(record) == 200
        assert record.sample_rate == pytest.approx(50.0, rel=1e-13)
        assert record.duration == pytest.approx(199 / 50)
        assert record.uniform
        assert record.gaps.shape == (0, 2)

    def test_time_stamps_rounded_to_ten_digits_are_even(self):
        time = np.round(np.arange(5000) / 1024, 9)
        record = Record(time, velocity=np.zeros(5000), force=np.zeros(5000))
        assert record.uniform
        assert record.sample_rate == pytest.approx(1024, rel=1e-9)

    def test_gaps_do_not_count_into_the_rate(self):
        kept = np.r_[0:50, 60:150, 152:200]
        record = Record(TIME[kept], displacement=np.zeros(kept.size), force=np.zeros(kept.size))
        np.testing.assert_allclose(record.gaps, TIME[[[49, 60], [149, 152]]])
        assert record.sample_rate == pytest.approx(50.0, rel=1e-13)
        assert not record.uniform

    @given(st.integers(0, 2**32 - 1))
    def test_jitter(self, seed):
        time = TIME + np.random.default_rng(seed).uniform(-0.2, 0.2, TIME.size) / 50.0
        record = Record(time, displacement=time, force=time)
        assert not record.uniform
        assert record.gaps.size == 0
        assert record.sample_rate == pytest.approx(50.0, rel=0.01)


class TestValidation:
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"time": TIME[::-1]}, r"time\[1\] is 3.96.* after .*3.98.*199 such steps"),
            ({"time": np.where(np.arange(200) == 7, TIME[6], TIME)}, r"time\[7\] is .*\(1 such"),
            ({"time": np.where(np.arange(200) == 7, np.nan, TIME)}, r"time\[7\] is nan"),
            ({"time": [0.0]}, "at least two samples"),
            ({"displacement": None}, "exactly one of displacement, velocity, .* got none"),
            ({"velocity": TIME}, r"got \['displacement', 'velocity'\]"),
            ({"force": None}, "neither force nor drive"),
            ({"force": TIME[:9]}, r"force: expected shape \(200,\)"),
            ({"force": np.where(np.arange(200) == 3, np.inf, 1.0)}, r"force\[3\] is inf"),
            ({"drive": TIME, "drive_unit": "W"}, "drive_unit is 'W'; expected one of V, A"),
            ({"drive": TIME, "drive_factor": -1.0}, "drive_factor is -1.0"),
            ({"drive_factor_uncertainty": np.nan}, "drive_factor_uncertainty is nan"),
            ({"motion": "both"}, "motion is 'both'"),
        ],
    )
    def test_impossible_fields_are_refused(self, arguments, message):
        good = {"time": TIME, "displacement": np.sin(TIME), "force": np.cos(TIME)}
        with pytest.raises(ValidationError, match=message):
            Record(**{**good, **arguments})

    def test_read_only(self):
        record = sine()
        with pytest.raises(ValueError, match="read-only"):
            record.time[0] = 1.0

    def test_survives_pickle_and_copy(self):
        record = sine(provenance={"file": "a.csv"})
        assert_same(record, pickle.loads(pickle.dumps(record)))
        assert_same(record, copy.deepcopy(record))


class TestChannels:
    def test_force_of_a_drive_in_volts(self):
        record = Record(TIME, acceleration=TIME, drive=2 * np.ones(200), drive_factor=12.5)
        assert record.motion_channel == "acceleration"
        np.testing.assert_array_equal(record.motion_samples, TIME)
        np.testing.assert_array_equal(record.force_samples, 25.0)

    def test_a_measured_force_comes_first(self):
        record = sine(drive=TIME, drive_factor=3.0)
        np.testing.assert_array_equal(record.force_samples, np.cos(TIME))

    def test_a_drive_in_newtons_needs_no_factor(self):
        record = Record(TIME, velocity=TIME, drive=TIME, drive_unit="N")
        np.testing.assert_array_equal(record.force_samples, TIME)

    def test_a_drive_in_amperes_without_factor_is_no_force(self):
        record = Record(TIME, velocity=TIME, drive=TIME, drive_unit="A")
        with pytest.raises(ValidationError, match=r"drive is in A and has no factor; .* N/A"):
            record.force_samples  # noqa: B018


class TestTables:
    @pytest.mark.parametrize("ending", [".csv", ".csv.gz", ".tsv", ".parquet", ".h5"])
    @pytest.mark.parametrize("record", [
        sine(), sine(motion="rotation", drive=TIME / 3, drive_unit="N m"),
        sine(force=None, drive=TIME / 7, drive_factor=2.5, drive_factor_uncertainty=0.01),
        sine(drive=TIME, drive_unit="A"), sine(displacement=None, acceleration=TIME / 9),
    ])  # fmt: skip
    def test_files_lose_nothing(self, tmp_path, record, ending):
        back = read_record(record.save(tmp_path / f"run{ending}"))
        assert_same(record, back)

    def test_repr_shows_sampling_ranges_units(self):
        told = {"file": "run.csv", "notes": ["something assumed"]}
        text = repr(Record(
            np.r_[TIME[:9], TIME[12:]], velocity=np.zeros(197), drive=np.ones(197),
            drive_factor=2.0, motion="rotation", provenance=told,
        ))  # fmt: skip
        facts = (
            "197 samples of velocity in rotation", "50 Hz, uneven, 3.98 s", "gaps", "0 rad/s",
            "1 V", "2 N m/V within 0 %", "run.csv", "something assumed",
        )  # fmt: skip
        assert [fact for fact in facts if fact not in text] == []
        assert "<table>" in sine()._repr_html_()
