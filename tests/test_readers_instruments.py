"""Files of analysers and data loggers: universal files, NI TDMS, LabVIEW's text."""

import importlib
import re
from typing import Any

import numpy as np
import pytest

from dahl_ident.data import inspect, read_frequency_response, read_record
from dahl_ident.errors import DataError, UnitError
from tests.reader_fuzz import uff_function, write_uff
from tests.test_readers_formats import FREQUENCY, RECEPTANCE, TIME, F, X, assert_the_run

pytestmark = pytest.mark.versions

SI = {"type": 164, "units_code": 1, "units_description": "SI", "temp_mode": 1,
      "length": 1.0, "force": 1.0, "temp": 1.0, "temp_offset": 273.15}  # fmt: skip
MILLIMETRES = {**SI, "units_code": 5, "length": 1e3, "force": 1e3}
CHANNELS = [SI, uff_function(X, TIME, 1, 8), uff_function(F, TIME, 1, 13, rsp_node=2)]


class TestUniversalFile:
    @pytest.mark.parametrize("binary", [0, 1])
    def test_frequency_response(self, tmp_path, binary):
        data = self.read(tmp_path, SI, uff_function(RECEPTANCE, FREQUENCY, 4, 8, binary=binary))
        assert data.quantity == "receptance"
        np.testing.assert_allclose(data.response, RECEPTANCE, rtol=1e-11)
        np.testing.assert_allclose(data.frequency_hz, FREQUENCY)

    def read(self, folder, *sets, drive="1 N", **options):
        return read_frequency_response(write_uff(folder / "a.unv", *sets), drive=drive, **options)

    @pytest.mark.parametrize(
        ("numerator", "quantity"), [(8, "receptance"), (11, "mobility"), (12, "accelerance")]
    )
    def test_data_types_and_unit_systems(self, tmp_path, numerator, quantity):
        """Millimetres over millinewtons are metres over newtons."""
        function = uff_function(-1j * RECEPTANCE, FREQUENCY, 4, numerator)
        data = self.read(tmp_path, MILLIMETRES, function, passive=False)
        assert data.quantity == quantity
        np.testing.assert_allclose(data.response, -1j * RECEPTANCE, rtol=1e-11)

    def test_labels_come_first(self, tmp_path):
        units = {"ordinate_axis_units_lab": "mm", "orddenom_axis_units_lab": "N"}
        data = self.read(tmp_path, SI, uff_function(RECEPTANCE, FREQUENCY, 4, 8, **units))
        np.testing.assert_allclose(data.response, 1e-3 * RECEPTANCE, rtol=1e-11)

    def test_directions_turn_the_sign(self, tmp_path):
        data = self.read(tmp_path, SI, uff_function(-RECEPTANCE, FREQUENCY, 4, 8, rsp_dir=-3))
        np.testing.assert_allclose(data.response, RECEPTANCE, rtol=1e-11)
        assert "FRF 1:-Z/2:+Z: sign turned, as its directions say" in data.provenance["notes"]

    def test_rotation(self, tmp_path):
        function = uff_function(RECEPTANCE, FREQUENCY, 4, 8, rsp_dir=6, ref_dir=6)
        pound = 4.4482216152605
        inches = {**SI, "units_code": 7, "length": 1 / 0.0254, "force": 1 / pound}
        data = self.read(tmp_path, inches, function, drive="1 N m")
        assert data.motion == "rotation"
        np.testing.assert_allclose(data.response, RECEPTANCE / (pound * 0.0254), rtol=1e-11)

    def test_several_functions(self, tmp_path):
        functions = [uff_function(k * RECEPTANCE, FREQUENCY, 4, 8, rsp_node=k) for k in (1, 2)]
        path = write_uff(tmp_path / "a.uff", SI, *functions)
        with pytest.raises(DataError, match=r"2 columns may be the response: FRF 1:\+Z/2:\+Z"):
            read_frequency_response(path, drive="1 N")
        data = read_frequency_response(path, drive="1 N", columns={"response": "FRF 2:+Z/2:+Z"})
        np.testing.assert_allclose(data.response, 2 * RECEPTANCE, rtol=1e-11)

    def test_time_records(self, tmp_path):
        path = write_uff(tmp_path / "run.uff", *CHANNELS)
        assert_the_run(read_record(path), rtol=1e-10)

    def test_units_outside_ascii(self, tmp_path):
        label = {"ordinate_axis_units_lab": "m/s2", "orddenom_axis_units_lab": "N"}
        path = write_uff(tmp_path / "a.uff", uff_function(RECEPTANCE, FREQUENCY, 4, 12, **label))
        path.write_bytes(path.read_bytes().replace(b"m/s2", "m/s²".encode("cp1252")))
        data = read_frequency_response(path, drive="1 N", passive=False)
        assert data.quantity == "accelerance"

    def test_other_data_sets_are_passed_without_a_word(self, tmp_path, capsys):
        path = write_uff(tmp_path / "a.uff", uff_function(RECEPTANCE, FREQUENCY, 4, 8))
        group: list[list[Any]] = [[1, 0, 0, 0, 0, 0, 0, 1], ["left side"], [8, 110, 0, 0]]
        lines = ["".join(f"{cell:>10}" for cell in row) for row in group]
        with path.open("a") as file:
            file.write("\n".join(["    -1", "  2467", *lines, "    -1", ""]))
        inspect(path)
        assert not capsys.readouterr().out

    def test_refusal(self, tmp_path):
        function = uff_function(RECEPTANCE, FREQUENCY, 4, 8)
        with pytest.raises(UnitError, match=r"column 'FRF 1:\+Z/2:\+Z' has no unit"):
            self.read(tmp_path, function)
        with pytest.raises(DataError, match=r"units code 1 means m, a length factor of 1, .* 39"):
            self.read(tmp_path, {**SI, "length": 39.37}, function)
        with pytest.raises(DataError, match=r"no frequency response or time record .* \[164\]"):
            self.read(tmp_path, SI)
        with pytest.raises(DataError, match=r"data sets \[58\] with function types \[2\]"):
            self.read(tmp_path, uff_function(abs(RECEPTANCE), FREQUENCY, 2, 8))
        path = write_uff(tmp_path / "d.uff", SI, {**function, "binary": 1})
        path.write_bytes(path.read_bytes()[:-40])
        with pytest.raises(DataError, match=r"damaged|cut off|no frequency response"):
            read_frequency_response(path, drive="1 N")

    def test_damage_names_its_data_set(self, tmp_path):
        path = write_uff(tmp_path / "run.uff", *CHANNELS)
        before, last = path.read_bytes().rsplit(b"    58", 1)
        path.write_bytes(before + b"    58" + last.replace(b".", b"x"))
        with pytest.raises(DataError, match=r"data set 3 of 3 \(type 58\) .* is damaged: "):
            read_record(path)


class TestTdms:
    def write(self, path, **properties):
        nptdms: Any = importlib.import_module("nptdms")
        wave = {"wf_increment": 1 / 128.0, "wf_start_offset": 0.0, **properties}
        channels = [
            nptdms.ChannelObject("rig", "displacement", X * 1e3, {"unit_string": "mm", **wave}),
            nptdms.ChannelObject("rig", "force", F, {"NI_UnitDescription": "N", **wave}),
        ]
        with nptdms.TdmsWriter(str(path)) as writer:
            writer.write_segment(channels)
        return path

    def test_units_in_the_channels_names(self, tmp_path):
        nptdms: Any = importlib.import_module("nptdms")
        wave = {"wf_increment": 1 / 128.0}
        with nptdms.TdmsWriter(str(tmp_path / "run.tdms")) as writer:
            writer.write_segment([
                nptdms.ChannelObject("rig", "Displacement (mm)", X * 1e3, wave),
                nptdms.ChannelObject("rig", "Force [N]", F, wave),
            ])  # fmt: skip
        assert_the_run(read_record(tmp_path / "run.tdms"))
        assert_the_run(read_record(tmp_path / "run.tdms", displacement="rig/Displacement (mm)"))

    def test_without_timing(self, tmp_path):
        path = self.write(tmp_path / "run.tdms", wf_increment=0.0)
        with pytest.raises(DataError, match=r"no column holds the time; there are rig/disp"):
            read_record(path)
        assert_the_run(read_record(path, sample_rate=128.0))

    def test_bytes_between_the_samples(self, tmp_path):
        path = self.write(tmp_path / "run.tdms")
        data = path.read_bytes()
        path.write_bytes(data[:-100] + bytes(8) + data[-100:])
        with pytest.raises(DataError, match=rf"bytes behind segment \d, from byte {len(data)} on"):
            read_record(path)


LVM = """LabVIEW Measurement
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t{mark}
Multi_Headings\tYes
X_Columns\tOne
Time_Pref\tAbsolute
***End_of_Header***

Channels\t2
Samples\t64\t64
Y_Unit_Label\tmm\tN
X_Dimension\tTime\tTime
X0\t0\t0
Delta_X\t0{mark}0078125\t0{mark}0078125
***End_of_Header***
X_Value\tdisplacement\tforce\tComment
"""


def lvm_rows(form="{t!r}\t{mm!r}\t{f!r}"):
    return [
        form.format(t=t, mm=x * 1e3, um=x * 1e6, f=f)
        for t, x, f in zip(TIME.tolist(), X.tolist(), F.tolist(), strict=True)
    ]


def lvm_text(rows):
    return LVM.format(mark=".") + "\n".join(rows) + "\n"


class TestLvm:
    def test_decimal_commas(self, tmp_path):
        text = LVM.format(mark=",") + "\n".join(lvm_rows()).replace(".", ",") + "\n"
        (tmp_path / "run.lvm").write_text(text)
        assert_the_run(read_record(tmp_path / "run.lvm"))

    def test_labels_outside_utf_8_with_units_in_them(self, tmp_path):
        head = LVM.format(mark=".").replace("Y_Unit_Label\tmm\tN\n", "")
        head = head.replace("displacement\tforce", "Verlängerung (µm)\tforce (Newtons)")
        text = head + "\n".join(lvm_rows("{t!r}\t{um!r}\t{f!r}")) + "\n"
        (tmp_path / "run.lvm").write_text(text, encoding="cp1252")
        assert_the_run(read_record(tmp_path / "run.lvm", displacement="Verlängerung"), 1e-12)

    def test_without_and_with_many_x_columns(self, tmp_path):
        head = LVM.format(mark=".")
        none = head.replace("X_Columns\tOne", "X_Columns\tNo")
        many = head.replace("X_Columns\tOne", "X_Columns\tMulti").replace(
            "X_Value\tdisplacement\tforce", "X_Value\tdisplacement\tX_Value\tforce"
        ).replace("Channels\t2", "Channels\t2\t\t")  # fmt: skip
        for text, form in ((none, "\t{mm!r}\t{f!r}"), (many, "{t!r}\t{mm!r}\t{t!r}\t{f!r}")):
            (tmp_path / "run.lvm").write_text(text + "\n".join(lvm_rows(form)) + "\n")
            assert_the_run(read_record(tmp_path / "run.lvm"))


class TestLvmStrictly:
    def read(self, tmp_path, text):
        (tmp_path / "run.lvm").write_text(text)
        return read_record(tmp_path / "run.lvm")

    def test_every_sample_is_there(self, tmp_path):
        assert_the_run(self.read(tmp_path, lvm_text(lvm_rows())))
        with pytest.raises(DataError, match="60 samples where its header says 64"):
            self.read(tmp_path, lvm_text(lvm_rows()[:60]))

    def test_glued_and_blank_lines(self, tmp_path):
        rows = lvm_rows()
        glued = [*rows[:5], rows[5] + rows[6], *rows[7:]]
        with pytest.raises(DataError, match=r"line \d+: 5 fields; expected the 3|is not a number"):
            self.read(tmp_path, lvm_text(glued))
        blank = [*rows[:5], "", *rows[5:]]
        with pytest.raises(DataError, match=r"behind a blank line|5 samples where"):
            self.read(tmp_path, lvm_text(blank))
        head = re.sub(r"Samples.*\n", "", LVM.format(mark="."))
        with pytest.raises(DataError, match="numbers behind a blank line"):
            self.read(tmp_path, head + "\n".join(blank) + "\n")

    @pytest.mark.parametrize("count", ["6_4", "\u00b2", "1" * 30])
    def test_what_is_no_number_of_samples(self, tmp_path, count):
        with pytest.raises(DataError, match="is not a number of samples"):
            self.read(tmp_path, lvm_text(lvm_rows()).replace("\t64\t64", f"\t{count}\t64"))

    @pytest.mark.parametrize("odd", ["1_000", "0x10", "1,5", "--"])
    def test_what_is_no_number(self, tmp_path, odd):
        rows = lvm_rows()
        rows[3] = f"{TIME[3]}\t{odd}\t1"
        with pytest.raises(DataError, match=f"'{odd}' is not a number"):
            self.read(tmp_path, lvm_text(rows))
