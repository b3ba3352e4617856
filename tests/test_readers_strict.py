"""What files of laboratories get wrong is refused, or named; what they mean is understood."""

import gzip
import importlib
import io
import json
import os
import re
import socket
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.data import inspect, read_frequency_response, read_record
from dahl_ident.errors import DataError, DataWarning, ValidationError
from tests import reader_fuzz
from tests.reader_fuzz import ENDINGS, NOISE, TIME, F, X

COLUMNS = np.array([TIME, X, F])
DAHL = di.Dahl(f_max=5.0, sigma=2e4, alpha=1.0)
DAHL_FREE = di.Dahl(alpha=1.0)
MAP: dict[str, Any] = {"displacement": "x", "force": "F"}
NAMED: dict[str, Any] = {
    "time": "column 1 [s]", "displacement": "column 2 [m]", "force": "column 3 [N]"
}  # fmt: skip


def place(folder, name, content):
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def csv(columns, header="time [s],x [m],F [N]"):
    rows = (",".join(map(repr, row)) for row in np.asarray(columns).T.tolist())
    return "\n".join([header, *rows]) + "\n"


class TestSecondHeaders:
    @pytest.mark.parametrize("header", [
        ("time [s]", "x [mm]", "F [N]"), ("time [s]", "F [N]", "x [m]"),
        ("Time [s]", "X [m]", "F [N]"), (" time [s] ", " x [m] ", " F [N] "),
        ('"time [s]"', '"x [m]"', '"F [N]"'),
    ])  # fmt: skip
    @pytest.mark.parametrize(
        "name", ["csv", "semicolon", "csv.gz", "csv.bz2", "lvm", "json", "xlsx"]
    )
    @pytest.mark.parametrize("row", [20])
    def test_of_records(self, name, header, row, tmp_path):
        content = reader_fuzz.written(name, COLUMNS, (row, header))
        with pytest.raises(DataError):
            read_record(place(tmp_path, f"run{ENDINGS[name]}", content), **MAP)

    def test_of_tables(self, tmp_path):
        rows = "1,5,30,1\n1,6,29,2\n1,7,28,3\n1,8,27,3\n"
        head = "frequency_hz,amplitude [um],gain [N/m],phase_deg\n"
        text = head + rows + head.replace("um", "mm") + 3 * rows
        with pytest.raises(DataError, match=r"line 2 is a row of numbers like those from .*line 7"):
            read_frequency_response(place(tmp_path, "t.csv", text))

    @pytest.mark.parametrize("line", [
        "time [s],x [mm],F [N]", "time [s],F [N],x [m]", "# time [s],x [mm],F [N]", "[s],[mm],[N]",
        "time (s),x (mm),F (N)",
    ])  # fmt: skip
    @pytest.mark.parametrize("at", [0, 1])
    def test_above_the_numbers(self, line, at, tmp_path):
        lines = csv(COLUMNS).splitlines()
        lines.insert(1 if line.startswith("[") else at, line)
        with pytest.raises(DataError, match=r"several lines .* name the columns|more than one hea"):
            read_record(place(tmp_path, "run.csv", "\n".join(lines)), **MAP)

    @pytest.mark.parametrize(
        "line", ["time (s),x (m),F (N)", "[s],[m],[N]", "# made by hand, x, F"]
    )
    def test_that_agree_are_one(self, line, tmp_path):
        lines = csv(COLUMNS).splitlines()
        lines.insert(1, line)
        record = read_record(place(tmp_path, "run.csv", "\n".join(lines)), **MAP)
        np.testing.assert_array_equal(record.motion_samples, X)


class TestOtherFiles:
    @pytest.fixture(params=["pipe", "device", "socket", "folder"])
    def irregular(self, request, tmp_path):
        path = tmp_path / "x.csv"
        if request.param == "pipe":
            os.mkfifo(path)
        elif request.param == "device":
            path = Path("/dev/zero")
        elif request.param == "folder":
            path.mkdir()
        else:
            with socket.socket(socket.AF_UNIX) as found:
                found.bind(str(path))
        return path

    def test_are_refused_at_once(self, irregular, request, tmp_path, run):
        kind = request.node.callspec.params["irregular"]
        good = place(tmp_path, "good.csv", csv(COLUMNS))
        ways: list[Callable[[], Any]] = [
            lambda: read_record(irregular), lambda: read_frequency_response(irregular),
            lambda: inspect(irregular), lambda: read_record(good, columns=irregular),
            lambda: di.extract(irregular), lambda: di.FitResult.load(irregular),
        ]  # fmt: skip
        message = f"is a {kind}; (expected a file|give the path of a file in it)"
        for way in ways:
            with pytest.raises(DataError, match=message):
                way()
        assert f"is a {kind}" in run.refused("fit", good, "--record", "--config", irregular)


class TestHdf5:
    def file(self, folder, x):
        h5py: Any = importlib.import_module("h5py")
        path = folder / "run.h5"
        with h5py.File(path, "w") as root:
            root.create_dataset("time", data=TIME).attrs["unit"] = "s"
            root.create_dataset("F", data=F).attrs["unit"] = "N"
            x(root).attrs["unit"] = "m"
        return path

    def test_values_of_other_files_are_refused(self, tmp_path):
        h5py: Any = importlib.import_module("h5py")
        (tmp_path / "raw").write_bytes(X.tobytes())
        outside = [(str(tmp_path / "raw"), 0, X.nbytes)]
        layout = h5py.VirtualLayout(X.shape, "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "none.h5"), "x", X.shape)
        ways: dict[str, Callable[[Any], Any]] = {
            "in an external file": lambda r: r.create_dataset("x", X.shape, "f8", external=outside),
            "virtual": lambda r: r.create_virtual_dataset("x", layout),
        }
        for what, x in ways.items():
            with pytest.raises(DataError, match=f"the values of x are {what}"):
                read_record(self.file(tmp_path, x))

    def test_packed_values_are_unpacked(self, tmp_path):
        def x(root):
            stored = np.round((X - 1e-4) / 1e-7).astype("i2")
            stored[7] = -999
            found = root.create_dataset("x", data=stored)
            found.attrs["scale_factor"] = np.array([1e-7])
            found.attrs["add_offset"] = 1e-4
            found.attrs["_FillValue"] = np.int16(-999)
            return found

        path = self.file(tmp_path, x)
        with pytest.raises(DataError, match=r"index 7, column 'x': the cell is empty or NaN"):
            read_record(path)
        found = read_record(path, missing="drop").motion_samples
        np.testing.assert_allclose(found, np.delete(X, 7), atol=6e-8)

    def test_added_bytes_are_noticed(self, tmp_path):
        path = self.file(tmp_path, lambda root: root.create_dataset("x", data=X))
        content = path.read_bytes()
        path.write_bytes(content[:3000] + b"\0" * 8 + content[3000:])
        size = len(content)
        with pytest.raises(DataError, match=rf"has {size + 8} bytes, but its header says {size}"):
            read_record(path)

    def test_each_of_many_objects_is_looked_at_once(self, tmp_path, monkeypatch):
        def x(root):
            for i in range(200):
                root.create_dataset(f"{i}/d", data=np.arange(3.0)).attrs["unit"] = "mm"
            return root.create_dataset("x", data=X)

        path = self.file(tmp_path, x)
        objects: Any = importlib.import_module("h5py").h5o
        look = Mock(side_effect=objects.get_info)
        monkeypatch.setattr(objects, "get_info", look)
        assert read_record(path).n == TIME.size
        assert 400 < look.call_count < 410


class TestSize:
    @pytest.mark.parametrize("cell", ["1" * 30_000 + "x", "(" + " " * 30_000 + "x", "1," * 15_000])
    def test_long_cells_end(self, cell, tmp_path):
        lines = csv(COLUMNS).splitlines()
        lines[30] = f'{TIME[29]!r},"{cell}",1.0'
        path = place(tmp_path, "run.csv", "\n".join(lines))
        with pytest.raises(DataError):
            read_record(path)
        lines[0] = lines[0].replace("x [m]", f'"{cell}"')
        place(tmp_path, "run.csv", "\n".join(lines[:30]))
        with pytest.raises(DataError):
            read_record(path)

    @pytest.mark.parametrize(
        ("name", "head", "row", "end"),
        [
            ("run.csv.gz", b"t [s],x [m],F [N]\n", b"0,1,1\n", b""),
            ("run.json.gz", b"[", b"[1,1],", b"[1,1]]"),
            ("run.json.gz", b'{"t": [', b"1,", b"1]}"),
            ("run.lvm.gz", b"LabVIEW Measurement\n***End_of_Header***\n\n***End_of_Header***\n"
             b"X_Value\tx\n", b"1\t1\n", b""),
        ],
    )  # fmt: skip
    def test_archives_within_the_limit(self, name, head, row, end, tmp_path):
        content = head + row * ((130_000_000 - len(head)) // len(row)) + end
        path = place(tmp_path, name, gzip.compress(content, 1))
        with pytest.raises(DataError, match=r"would take .* at most 134 MB are read from it"):
            read_record(path)

    def test_comments_without_end(self, tmp_path):
        content = csv(COLUMNS).encode() + b"#\n" * 1_000_000
        with pytest.raises(DataError, match="more than 20000 comments stand among the numbers"):
            read_record(place(tmp_path, "run.csv.gz", gzip.compress(content, 1)))

    def test_one_long_word_does_not_widen_all(self, tmp_path):
        text = "run,x [m]\n" + f"{'a' * 5000},1\n" + "b,2\n" * 200_000
        with pytest.raises(DataError, match="takes more memory than is available"):
            inspect(place(tmp_path, "run.csv", text))

    def test_no_memory_is_one_line(self, tmp_path, monkeypatch, run):
        def full(*_, **__):
            raise MemoryError

        path = place(tmp_path, "run.csv", csv(COLUMNS))
        monkeypatch.setattr(di.data.record.Record, "__init__", full)
        done = run("fit", path, "--record")
        assert (done.status, done.err.count("\n")) == (1, 1)
        monkeypatch.setattr("dahl_ident.data.readers.text_table.read_text_table", full)
        with pytest.raises(DataError, match="takes more memory than is available"):
            read_record(path)

    def test_numbers_beyond_all_floats(self, tmp_path):
        text = json.dumps({"time [s]": [0, 1], "x [m]": [1, 10**400], "F [N]": [1, 2]})
        with pytest.raises(DataError, match="is not a number"):
            read_record(place(tmp_path, "run.json", text))

    def test_waveforms_of_nothing(self):
        t = np.arange(400) / 100.0
        x = 1e-203 * np.sin(9.0 * t)
        with pytest.raises(ValidationError, match="no sample of displacement is above 1e-203"):
            di.extract(di.Record(t, displacement=x, force=np.cos(9.0 * t)))


class TestDoubts:
    def named(self, folder, columns, message):
        with pytest.warns(DataWarning, match=message):
            record = read_record(place(folder, "run.csv", csv(columns)))
        assert re.search(message, (record.provenance or {})["warnings"][0])

    @pytest.mark.parametrize(("rows", "message"), [
        ([1], "the motion repeats one value while the force goes on, from line 32"),
        ([2], "the force repeats one value while the motion goes on, from line 32"),
        ([1, 2], "motion and force are 0 for a while, from line 32"),
    ])  # fmt: skip
    def test_holes(self, rows, message, tmp_path):
        columns = COLUMNS.copy()
        columns[rows, 30:45] = 0.0
        self.named(tmp_path, columns, message)

    @pytest.mark.parametrize("places", [slice(30, 45), slice(None)])
    def test_a_motion_that_sticks(self, places, tmp_path):
        columns = COLUMNS.copy()
        columns[1, places] = columns[1, 30]
        self.named(tmp_path, columns, "the motion repeats one value while the force goes on")

    @pytest.mark.parametrize("row", [0, 1, 2])
    @pytest.mark.parametrize("factor", [1e3, 1e-3])
    def test_a_unit_that_switches(self, row, factor, tmp_path):
        columns = COLUMNS.copy()
        columns[row, 30:] *= factor
        if row == 0:
            columns[0, 30:] = columns[0, 29] + (TIME[30:] - TIME[29]) * factor
        self.named(tmp_path, columns, r"1000 times larger or smaller from line (30|31|32) \(1 ")

    @pytest.mark.parametrize("row", [1, 2])
    @pytest.mark.parametrize("factor", [1e3, 1e-3])
    def test_a_unit_that_switches_anywhere(self, row, factor, tmp_path):
        t = np.arange(200) / 200.0
        x = 1e-3 * (0.7 + t) * np.sin(6 * np.pi * t + 0.1)
        columns = np.array([t, x, DAHL.force(x)])
        columns[1:] += [[1e-7], [2e-3]] * np.random.default_rng(3).standard_normal((2, t.size))
        named = 0
        for at in range(10, 190, 3):
            changed = columns.copy()
            changed[row, at:] *= factor
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                read_record(place(tmp_path, "run.csv", csv(changed)))
            named += any("1000 times larger or smaller" in str(w.message) for w in said)
        assert named >= 42  # of 60; where a signal passes zero it is too small to tell

    def test_good_records_raise_none(self, tmp_path):
        t = np.arange(4000) / 100.0
        level = np.repeat([1e-5, 1e-2, 2e-3, 0.0], 1000)
        x = level * np.sin(2.0 * np.pi * t)
        for law in (di.Dahl(0.1, 30.0), di.Backlash(di.Dahl(0.1, 30.0), 1e-3)):
            for noise in (0.0, 1e-6):
                force = law.force(x) + noise * np.random.default_rng(0).standard_normal(t.size)
                assert read_record(place(tmp_path, "run.csv", csv([t, x, force]))).n == t.size

    def test_channels_that_start_apart_or_together(self, tmp_path):
        nptdms: Any = importlib.import_module("nptdms")
        start = np.datetime64("2026-03-01T12:00:00")

        def written(later):
            channels = [
                nptdms.ChannelObject("rig", name, values, {
                    "unit_string": unit, "wf_increment": 1 / 128.0, "wf_start_time": begun
                })
                for name, values, unit, begun in (
                    ("x", X, "m", start), ("F", F, "N", start + later)
                )
            ]  # fmt: skip
            with nptdms.TdmsWriter(tmp_path / "run.tdms") as writer:
                writer.write_segment(channels)
            return tmp_path / "run.tdms"

        with (
            pytest.warns(DataWarning, match=r"start at different times, up to 0\.5 s apart"),
            pytest.raises(DataError, match="2 columns may be the time"),
        ):
            read_record(written(np.timedelta64(500, "ms")))
        assert read_record(written(np.timedelta64(20, "us"))).n == TIME.size

    def test_times_and_the_header_that_disagree(self, tmp_path):
        text = reader_fuzz.written("lvm", COLUMNS).decode()
        text = text.replace("Channels\t2", "Channels\t2\nX0\t0\t0\nDelta_X\t0.001\t0.001")
        with pytest.warns(DataWarning, match=r"steps of 0.0078125, and .* Delta_X = 0.001"):
            read_record(place(tmp_path, "run.lvm", text))

    def test_a_member_twice(self, tmp_path):
        path = place(tmp_path, "run.npz", reader_fuzz.written("npz", COLUMNS))
        buffer = io.BytesIO()
        np.save(buffer, 2.0 * X)
        with warnings.catch_warnings(), zipfile.ZipFile(path, "a") as archive:
            warnings.simplefilter("ignore")
            archive.writestr("x.npy", buffer.getvalue())
        with pytest.raises(DataError, match="two arrays are called 'x'"):
            read_record(path)


class TestUnderstood:
    def is_the_record(self, record):
        for found, good in ((record.time, TIME), (record.displacement, X), (record.force, F)):
            np.testing.assert_allclose(np.asarray(found), good)

    def test_json_of_rows(self, tmp_path):
        rows = COLUMNS.T.tolist()
        path = place(tmp_path, "run.json", json.dumps(rows))
        self.is_the_record(read_record(path, **NAMED))
        with pytest.raises(DataError, match="no header line"):
            read_record(path)
        labelled = [dict(zip(("time", "displacement", "force"), row, strict=True)) for row in rows]
        units = {"time units": "s", "displacement units": "m", "force_unit": "N"}
        path = place(tmp_path, "run.json", json.dumps({"data": labelled} | units))
        self.is_the_record(read_record(path))

    def test_lvm_with_one_header(self, tmp_path):
        text = reader_fuzz.written("lvm", COLUMNS).decode()
        text = text.replace("Separator\tTab", "Separator\tTab\nMulti_Headings\tNo")
        text = text.replace("Samples\t64\t64", "Samples\t16\t16")
        self.is_the_record(read_record(place(tmp_path, "run.lvm", text)))
        cut = "".join(text.splitlines(keepends=True)[:-55])
        with pytest.raises(DataError, match="9 samples where its header says 16"):
            read_record(place(tmp_path, "run.lvm", cut))

    @pytest.mark.parametrize("rate", [300.0, 800.0])
    def test_rounded_times_are_even(self, rate, tmp_path):
        t = np.arange(600) / rate
        columns = [np.round(t, 3), np.sin(20.0 * t), np.cos(20.0 * t)]
        record = read_record(place(tmp_path, "run.csv", csv(columns)))
        assert record.uniform
        assert record.sample_rate == pytest.approx(rate, rel=1e-4)
        assert "rounded to 0.001" in (record.provenance or {})["notes"][0]
        lost = np.delete(columns, 300, axis=1)
        assert not read_record(place(tmp_path, "run.csv", csv(lost))).uniform
        stamps = [f"12:00:{s:06.3f}" for s in t.tolist()]
        rows = zip(stamps, columns[1].tolist(), columns[2].tolist(), strict=True)
        text = "time,x [m],F [N]\n" + "".join(f"{a},{b!r},{c!r}\n" for a, b, c in rows)
        assert read_record(place(tmp_path, "run.csv", text)).uniform

    def test_of_two_motions_the_displacement(self, tmp_path):
        columns = [*COLUMNS, np.gradient(X, TIME)]
        path = place(tmp_path, "run.csv", csv(columns, "time [s],x [m],F [N],velocity [m/s]"))
        record = read_record(path)
        self.is_the_record(record)
        assert "displacement is used, and not velocity" in (record.provenance or {})["notes"]
        assert read_record(path, velocity="velocity").motion_channel == "velocity"

    def test_the_friction_of_a_tribometer(self, tmp_path):
        columns = [TIME, X, 0.0 * F + 10.0, F]
        text = csv(columns, "Time [s],Stroke [m],Normal Force [N],Friction Force [N]")
        found = inspect(place(tmp_path, "run.csv", text)).column_map
        assert '[force]\ncolumn = "Friction Force"' in found

    def test_two_columns_without_a_header(self, tmp_path, run):
        path = place(tmp_path, "run.csv", csv(COLUMNS[1:]).partition("\n")[2])
        words = ("--displacement", "column 1 [m]", "--force", "column 2 [N]", "--sample-rate", 128)
        done = run("fit", path, "--record", "--alpha", "1", *words)
        assert done.status == 0
        assert "f_max" in done.out
        refused = run.refused("fit", path, *words[:2])
        assert "--displacement is given without --record" in refused

    def test_uneven_records_are_cut_and_resampled(self, tmp_path):
        t = np.arange(600) / 100.0
        x = 1e-2 * np.sin(2.0 * np.pi * t) * (1.0 + t) / 7.0
        force = di.Dahl(0.1, 30.0, alpha=1.0).force(x) + 2.0 * np.gradient(x, t)
        kept = np.delete(np.arange(600), [50, *range(100, 140), 333, 334])
        path = place(tmp_path, "run.csv", csv(np.array([t, x, force])[:, kept]))
        record = read_record(path)
        free = di.Dahl(alpha=1.0) + di.Damper()
        with pytest.warns(DataWarning) as warned:
            fit = di.fit(record, free)
        said = [str(one.message) for one in warned]
        assert "nothing is known from 0.99 to 1.4 s; 2 parts are fitted, each from" in said[0]
        assert "from 1.4 to 5.99 s are not evenly spaced; resampled at 100 Hz" in said[2]
        assert fit.params["damping"].value == pytest.approx(2.0, rel=0.05)
        assert "not evenly spaced" in fit.verdict
        assert "nothing is known from 0.99 to 1.4 s" in fit.verdict
        with pytest.warns(DataWarning, match="2 parts are fitted"):
            parts = di.fit(record, di.Dahl(alpha=1.0), throw=False).data
        assert [part.n for part in parts] == [99, 458]
        assert di.fit(record, di.Spring(), throw=False).data[0].n == kept.size

    def test_a_table_without_a_frequency(self, tmp_path, run):
        A = np.geomspace(1e-4, 4e-3, 8)
        N = np.array([complex(DAHL.describing_function(a)) for a in A])
        columns = [A, np.abs(N), np.degrees(np.angle(N))]
        path = place(tmp_path, "t.csv", csv(columns, "amplitude [m],gain [N/m],phase_deg"))
        data = read_frequency_response(path)
        assert di.fit(data, di.Dahl()).params["f_max"].value == pytest.approx(5.0)
        saved = read_frequency_response(data.save(tmp_path / "saved.csv"))
        for table in (data, saved, di.FrequencyResponse.concatenate([data, saved])):
            with pytest.raises(DataError, match="no frequency, on which the force of Damper dep"):
                di.fit(table, di.Dahl() + di.Damper())
        known = read_frequency_response(path, frequency=2.0)
        assert (known.frequency_hz == 2.0).all()
        assert di.fit(known, di.Dahl() + di.Damper(), throw=False).success
        assert run("fit", path, "--damping", "free").status == 1
        assert "f_max" in run("fit", path, "--damping", "free", "--frequency", 2.0).out
        with pytest.raises(DataError, match="holds the frequency too"):
            read_frequency_response(tmp_path / "saved.csv", frequency=1.0)

    def test_rotation_stays_rotation(self, tmp_path):
        path = place(tmp_path, "run.csv", csv(COLUMNS, "time [s],angle [rad],torque [N m]"))
        record = read_record(path, displacement="angle")
        fit = di.fit(record, di.Dahl(alpha=1.0))
        units = {"f_max": "N m", "sigma": "N m/rad", "offset": "N m"}
        assert {name: fit.params[name].unit for name in units} == units
        assert fit.budget()["sigma"].unit == "N m/rad"
        assert {q.name: q.unit for q in fit.derived()}["x_c"] == "rad"
        assert fit.plot("loop").get_xlabel() == "displacement [rad]"
        page = di.report(fit, tmp_path / "report.md").read_text()
        assert "N m/rad" in page
        assert "N/m" not in page
        elastic = DAHL.force(1e-3 * X) + 1e-4 * NOISE[1]
        stuck = di.Record(TIME, displacement=1e-3 * X, force=elastic, motion="rotation")
        short = di.fit(stuck, DAHL_FREE)
        assert " rad after a reversal" in short.verdict
        A = np.geomspace(1e-4, 3e-2, 12)
        N = di.Dahl(0.1, 30.0, alpha=1.0).describing_function(A)
        table = di.FrequencyResponse(np.ones(12), N, A, motion="rotation")
        compared = str(di.compare_models(di.fit(table, DAHL_FREE, noise="relative")))
        assert "energy a cycle at 0.0001 rad" in compared
        translation = di.Record(TIME, displacement=X, force=F)
        with pytest.raises(DataError, match="some records are of translation"):
            di.fit([record, translation], di.Dahl())

    def test_versions_of_saved_fits_are_whole_numbers(self):
        for data in (di.Record(TIME, displacement=X, force=F), di.load_dataset("noisy")):
            fit = di.fit(data, DAHL_FREE)
            for version in (True, 1.0, "1", 0):
                content = json.loads(fit.to_json()) | {"schema_version": version}
                with pytest.raises(DataError, match="schema version"):
                    type(fit).from_json(json.dumps(content))


@pytest.mark.parametrize("column", ["num_periods", "bias_real"])
def test_a_measure_of_quality_that_is_not_a_number_is_named(tmp_path, column):
    path = tmp_path / "levels.csv"
    table: Any = di.load_dataset("noisy")
    quality = {"num_periods": np.arange(table.n), "bias_real": np.linspace(0.0, 1.0, table.n)}
    replace(table, quality=quality).save(path)
    comment, header, first, *others = path.read_text().splitlines()
    cells = dict(zip(header.split(","), first.split(","), strict=True)) | {column: "five"}
    path.write_text("\n".join([comment, header, ",".join(cells.values()), *others]))
    with pytest.raises(DataError, match=f"line 3, column '{column}': 'five' is not a number"):
        di.read_frequency_response(path)
