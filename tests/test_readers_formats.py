"""Files other than text, each written by the library of its format and read back."""

import gzip
import importlib
import json
import re
import sys
import zipfile
from inspect import signature
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from dahl_ident.data import Record, inspect, read_frequency_response, read_record
from dahl_ident.errors import DataError, DataWarning, MissingDependencyError, UnitError

pytestmark = pytest.mark.versions

h5py: Any = importlib.import_module("h5py")
openpyxl: Any = importlib.import_module("openpyxl")

TIME = np.arange(64) / 128.0
X = 1e-3 * np.sin(8 * np.pi * TIME)
F = 5.0 * np.cos(8 * np.pi * TIME)
FREQUENCY = np.array([10.0, 12.5, 15.0])
RECEPTANCE = np.array([1e-4 - 2e-4j, -3e-5 - 5e-4j, -4e-4 - 1e-5j])


def assert_the_run(record, rtol=1e-14):
    for name, expected in (("time", TIME), ("displacement", X), ("force", F)):
        size = np.abs(expected).max()
        np.testing.assert_allclose(getattr(record, name), expected, rtol=rtol, atol=rtol * size)


def cells():
    return [[t, x, f] for t, x, f in zip(TIME, X * 1e3, F / 1e3, strict=True)]


HEADER = ["time [s]", "x [mm]", "F [kN]"]


def frame():
    return pd.DataFrame(cells(), columns=HEADER)


class TestExcel:
    def book(self, path, *, sheets=("run",), top=()):
        book = openpyxl.Workbook()
        book.remove(book.worksheets[0])
        for name in sheets:
            sheet = book.create_sheet(name)
            for row in [*top, HEADER, *cells()]:
                sheet.append(row)
        book.create_sheet("notes").append(["measured on a Friday"])
        book.save(path)
        return path

    def test_sheets(self, tmp_path):
        path = self.book(tmp_path / "run.xlsx", sheets=("a", "b"))
        with pytest.raises(DataError, match="sheets a, b hold tables; name one with sheet='a'"):
            read_record(path)
        assert_the_run(read_record(path, sheet="b"))
        with pytest.raises(DataError, match="no sheet 'c'; there are a, b, notes"):
            read_record(path, sheet="c")
        with pytest.raises(DataError, match="no table of numbers on notes"):
            read_record(path, sheet="notes")

    def test_text_in_a_cell(self, tmp_path):
        path = self.book(tmp_path / "run.xlsx", top=[["rig"]])
        book = openpyxl.load_workbook(path)
        book["run"]["B5"] = "broken"
        book.save(path)
        with pytest.raises(DataError, match="sheet 'run', row 5, column 'x': 'broken' is not"):
            read_record(path)
        book["run"]["B5"] = None
        book.save(path)
        with pytest.raises(DataError, match="row 5, column 'x': the cell is empty or NaN"):
            read_record(path)

    def test_a_sheet_with_a_chart_alone(self, tmp_path):
        path = self.book(tmp_path / "run.xlsx", top=[["Rig", None, "5"], [None, None, None]])
        book = openpyxl.load_workbook(path)
        book.create_chartsheet("picture", 0)
        book.save(path)
        assert_the_run(read_record(path))
        with pytest.raises(DataError, match="no sheet 'picture'; there are run"):
            read_record(path, sheet="picture")

    def test_a_changed_digit(self, tmp_path):
        path, plain = self.book(tmp_path / "run.xlsx"), tmp_path / "plain.xlsx"
        with zipfile.ZipFile(path) as packed, zipfile.ZipFile(plain, "w") as stored:
            for name in packed.namelist():
                stored.writestr(name, packed.read(name))
        data = plain.read_bytes()
        plain.write_bytes(data.replace(b"<v>0.0", b"<v>0.1", 1))
        assert plain.read_bytes() != data
        with pytest.raises(DataError, match=r"the check sum of xl/worksheets/sheet\d.xml differs"):
            read_record(plain)


class TestParquet:
    def test_a_named_index_is_a_column(self, tmp_path):
        frame = pd.DataFrame({"x [mm]": X * 1e3, "F [kN]": F / 1e3})
        frame.index = pd.Index(TIME, name="time [s]")
        frame.to_parquet(tmp_path / "run.parquet")
        assert_the_run(read_record(tmp_path / "run.parquet"))

    def test_nullable_numbers(self, tmp_path):
        table = frame().convert_dtypes()
        table.to_parquet(tmp_path / "run.parquet")
        assert_the_run(read_record(tmp_path / "run.parquet"))
        table.loc[3, "x [mm]"] = pd.NA
        table.to_parquet(tmp_path / "run.parquet")
        with pytest.raises(DataError, match="row 4, column 'x': the cell is empty or NaN"):
            read_record(tmp_path / "run.parquet")

    def test_filters_behind_the_columns(self, tmp_path):
        pq: Any = pytest.importorskip("pyarrow.parquet")
        if "bloom_filter_options" not in signature(pq.write_table).parameters:
            pytest.skip("this release of Arrow writes no Bloom filters")
        table = frame()
        arrow: Any = pytest.importorskip("pyarrow").Table.from_pandas(table)
        wanted = {"x [mm]": {"ndv": 100}}
        pq.write_table(arrow, tmp_path / "run.parquet", bloom_filter_options=wanted)
        assert_the_run(read_record(tmp_path / "run.parquet"))

    @pytest.mark.parametrize("at", [4, 600, -1])
    def test_added_bytes(self, at, tmp_path):
        path = tmp_path / "run.parquet"
        table = frame()
        table.to_parquet(path, compression=None)
        data = path.read_bytes()
        end = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
        start = end if at < 0 else at
        path.write_bytes(data[:start] + bytes(8) + data[start:])
        pq: Any = importlib.import_module("pyarrow.parquet")
        if at < 0 and pq.ParquetFile(path).metadata.row_group(0).column(0).file_offset:
            pytest.skip("this release of Arrow writes bytes of its own there")
        with pytest.raises(DataError, match=r"8 bytes belong to no column|cannot be read"):
            read_record(path)


def matlab_content():
    levels = [
        {"f": FREQUENCY, "H": RECEPTANCE * k, "u0": np.full(3, float(k)), "name": f"level {k}"}
        for k in (1, 2, 3)
    ]
    return {
        "rig": {"run": {"t": TIME, "x": X * 1e3, "F": F[:, None] / 1e3}, "fs": 128.0},
        "sweep": {"levels": np.array(levels, dtype=object), "note": "checked"},
        "cells": np.array([FREQUENCY, np.array(["text"])], dtype=object),
        "table": np.column_stack([TIME, X * 1e3, F / 1e3]),
        "flag": np.array([True, False]),
    }


def write_v73(path):
    """The same content as MATLAB lays it out in HDF5: transposed, structs as groups."""
    with h5py.File(path, "w", userblock_size=512) as root:
        refs = root.create_group("#refs#")

        def put(group, name, value, kind=b"double"):
            if isinstance(value, str):
                value, kind = np.array([[ord(c)] for c in value], dtype=np.uint16), b"char"
            array = np.atleast_2d(value)
            if array.dtype.kind == "c":
                pairs = np.empty(array.shape, dtype=[("real", "f8"), ("imag", "f8")])
                pairs["real"], pairs["imag"] = array.real, array.imag
                array = pairs
            group.create_dataset(name, data=array).attrs["MATLAB_class"] = np.bytes_(kind)

        def references(group, name, values, cell):
            found = []
            for i, value in enumerate(values):
                put(refs, f"{name}{i}", value)
                found.append(refs[f"{name}{i}"].ref)
            item = group.create_dataset(
                name, data=np.array([found], dtype=h5py.ref_dtype), dtype=h5py.ref_dtype
            )
            if cell:
                item.attrs["MATLAB_class"] = np.bytes_(b"cell")

        content = matlab_content()
        run = root.create_group("rig/run")
        for name, value in content["rig"]["run"].items():
            put(run, name, value)
        put(root["rig"], "fs", 128.0)
        levels = root.create_group("sweep/levels")
        for name in ("f", "H", "u0", "name"):
            references(levels, name, [level[name] for level in content["sweep"]["levels"]], False)
        put(root["sweep"], "note", "checked")
        references(root, "cells", [FREQUENCY, "text"], True)
        put(root, "table", content["table"].T)
        put(root, "flag", np.array([1, 0], dtype=np.uint8), b"logical")
        empty = root.create_dataset("nothing", data=np.zeros(2, dtype=np.uint64))
        empty.attrs["MATLAB_empty"] = 1
    data = bytearray(path.read_bytes())
    data[: len(b"MATLAB 7.3 MAT-file")] = b"MATLAB 7.3 MAT-file"
    path.write_bytes(bytes(data))
    return path


@pytest.fixture(params=["v5", "v7", "v7.3"])
def matlab(request, tmp_path):
    path = tmp_path / "lab.mat"
    if request.param == "v7.3":
        return write_v73(path)
    savemat(path, matlab_content(), do_compression=request.param == "v7")
    return path


class TestMatlab:
    def test_paths_into_structs(self, matlab):
        run = {"time": "rig.run.t [s]", "displacement": "rig.run.x [mm]", "force": "rig.run.F [kN]"}
        assert_the_run(read_record(matlab, columns=run))

    def test_columns_of_a_matrix(self, matlab):
        units = {"time": "s", "displacement": "mm", "force": "kN"}
        columns = {role: {"column": f"table[:,{i}]", "unit": unit}
                   for i, (role, unit) in enumerate(units.items())}  # fmt: skip
        assert_the_run(read_record(matlab, columns=columns))

    def test_one_struct_of_an_array(self, matlab):
        names = {"frequency": "f [Hz]", "response": "H [m/N]", "drive": "u0 [N]"}
        columns = {role: f"sweep.levels[2].{name}" for role, name in names.items()}
        data = read_frequency_response(matlab, columns=columns)
        np.testing.assert_allclose(data.response, 3 * RECEPTANCE)
        assert data.levels == []

    def test_all_structs_of_an_array(self, matlab):
        columns = {
            "frequency": "sweep.levels[*].f [Hz]",
            "response": "sweep.levels[*].H [m/N]",
            "drive": {"column": "sweep.levels[*].u0", "unit": "N"},
            "controlled": {"force": "*0?", "displacement": "*[12]?"},
        }
        data = read_frequency_response(matlab, columns=columns)
        assert data.levels == ["levels[0]", "levels[1]", "levels[2]"]
        assert data.controlled.tolist() == ["force"] * 3 + ["displacement"] * 6
        np.testing.assert_allclose(data.response, (RECEPTANCE * np.array([[1], [2], [3]])).ravel())
        columns["controlled"] = {"force": "*0?"}
        with pytest.raises(DataError, match=r"'levels\[1\]' matches no pattern of controlled"):
            read_frequency_response(matlab, columns=columns)

    def test_contents(self, matlab):
        contents = inspect(matlab)
        names = {c.name: c for c in contents.channels}
        assert names["rig.run.t"].shape == (64,)
        assert names["rig.fs"].range == "128"
        assert names["cells[0]"].range == "10 to 15"
        assert names["sweep.levels[1].name"].range == "'level 2'"
        assert "nothing" not in names
        assert 'column = "sweep.levels[*].H"' not in contents.column_map  # H is not a usual name

    def test_single_numbers_are_no_channels_of_a_record(self, tmp_path):
        content = {"T": 0.25, "f": 4.0, "time": TIME, "x": X, "F": F}
        savemat(tmp_path / "a.mat", content)
        proposed = inspect(tmp_path / "a.mat").column_map
        assert re.findall(r'column = "(\w+)"', proposed) == ["time", "x", "F"]
        assert "even, 64 samples" in inspect(tmp_path / "a.mat").sampling

    def test_the_map_proposed_for_an_array_of_records_reads_the_first(self, tmp_path):
        runs = np.zeros((1, 2), [(name, object) for name in ("time", "x", "F")])
        for factor, run in zip((1.0, 2.0), runs.flat, strict=True):
            run["time"], run["x"], run["F"] = TIME, factor * X, factor * F
        savemat(tmp_path / "runs.mat", {"run": runs})
        text = inspect(tmp_path / "runs.mat").column_map
        for unit in ("s", "m", "N"):
            text = text.replace('unit = ""', f'unit = "{unit}"', 1)
        (tmp_path / "columns.toml").write_text(text)
        assert_the_run(read_record(tmp_path / "runs.mat", columns=tmp_path / "columns.toml"))

    def test_no_such_path(self, matlab):
        with pytest.raises(DataError, match=r"no column is called 'rig.run.q'; there are .*rig"):
            read_record(matlab, time="rig.run.q", displacement="rig.run.x", force="rig.run.F")
        with pytest.raises(DataError, match=r"nothing matches 'sweep.\*.f'"):
            read_frequency_response(matlab, columns={"frequency": "sweep.*.f"})
        names = {"frequency": "sweep.levels[*].f", "response": "sweep.level*[0].H"}
        with pytest.raises(DataError, match=r"same levels; only one .* levels\[1\], levels\[2\]"):
            read_frequency_response(matlab, columns=names)

    def test_lengths_and_units(self, matlab):
        run = {"displacement": "rig.run.x [mm]", "force": "rig.run.F [kN]"}
        with pytest.raises(UnitError, match=r"column 'rig.run.t' has no unit"):
            read_record(matlab, columns=run)
        run |= {"time": "rig.run.t [s]", "force": "cells[0] [N]"}
        with pytest.raises(DataError, match="differ in length: displacement 64, time 64, force 3"):
            read_record(matlab, columns=run)

    def test_nan_names_its_index(self, tmp_path):
        savemat(tmp_path / "a.mat", {"t": TIME, "x": np.where(TIME[9] == TIME, np.nan, X), "F": F})
        with pytest.raises(DataError, match="index 9, column 'x': the cell is empty or NaN"):
            read_record(tmp_path / "a.mat", time="t [s]", displacement="x [m]", force="F [N]")

    def test_nothing_of_use(self, tmp_path):
        (tmp_path / "a.mat").write_bytes(b"\x07\x08\x00" * 99)
        with pytest.raises(DataError, match="the file is damaged or not a MATLAB file"):
            read_record(tmp_path / "a.mat")
        savemat(tmp_path / "a.mat", {"cube": np.zeros((3, 4, 5))})
        message = r"no vector or matrix of numbers; cube \(\(3, 4, 5\), float64\) is not used"
        with pytest.raises(DataError, match=message):
            read_record(tmp_path / "a.mat")


class TestHdf5:
    def test_datasets_with_units(self, tmp_path):
        with h5py.File(tmp_path / "run.h5", "w") as root:
            for name, values, unit in (("time", TIME, "s"), ("x", X * 1e3, "mm"), ("F", F, b"N")):
                root.create_dataset(f"rig/{name}", data=values).attrs["units"] = unit
        assert_the_run(read_record(tmp_path / "run.h5"))
        with h5py.File(tmp_path / "run.h5", "a") as root:
            root["rig/displacement [mm]"] = X * 1e3
            root["rig/displacement (deg)"] = X
            root["rig/position (mm)"] = X * 1e3
        with pytest.raises(DataError, match=r"2 columns .* write one of rig/displacement"):
            read_record(tmp_path / "run.h5", displacement="displacement")
        assert_the_run(read_record(tmp_path / "run.h5", displacement="position"))

    def test_compound(self, tmp_path):
        rows = np.array(list(zip(TIME, X, F, strict=True)), dtype=[(n, "f8") for n in "txF"])
        with h5py.File(tmp_path / "run.h5", "w") as root:
            root["data"] = rows
        run = {"time": "data.t [s]", "displacement": "data.x [m]", "force": "data.F [N]"}
        assert_the_run(read_record(tmp_path / "run.h5", columns=run))


class TestOpenDocument:
    def test_sheet(self, tmp_path):
        row = "<table:table-row>{}</table:table-row>"
        text = '<table:table-cell office:value-type="string"><text:p>{}</text:p></table:table-cell>'
        number = '<table:table-cell office:value-type="float" office:value="{!r}"/>'
        rows = [row.format("".join(text.format(n) for n in ("time [s]", "x [mm]", "F [kN]")))]
        rows += [row.format("".join(number.format(float(v)) for v in line)) for line in cells()]
        spaces = " ".join(
            f'xmlns:{n}="urn:oasis:names:tc:opendocument:xmlns:{n}:1.0"'
            for n in ("office", "table", "text")
        )
        content = (
            f"<office:document-content {spaces}><office:body><office:spreadsheet>"
            f'<table:table table:name="run">{"".join(rows)}</table:table>'
            "</office:spreadsheet></office:body></office:document-content>"
        )
        with zipfile.ZipFile(tmp_path / "run.ods", "w") as archive:
            archive.writestr("mimetype", "application/vnd.oasis.opendocument.spreadsheet")
            archive.writestr("content.xml", content)
            archive.writestr("META-INF/manifest.xml", "<manifest/>")
        assert_the_run(read_record(tmp_path / "run.ods"))
        assert_the_run(read_record(tmp_path / "run.ods", sheet="run"))


class TestHostileFiles:
    """Files that claim more than they hold; each is refused before memory or time go."""

    def test_a_sheet_with_a_cell_in_its_last_corner(self, tmp_path):
        book = openpyxl.Workbook()
        book.worksheets[0].append(["time [s]", "x [mm]"])
        book.worksheets[0]["XFD1048576"] = 1
        book.save(tmp_path / "far.xlsx")
        with pytest.raises(DataError, match="the workbook is damaged, or too large"):
            read_record(tmp_path / "far.xlsx")

    def test_whole_numbers_of_any_size(self, tmp_path):
        book = openpyxl.Workbook()
        for row in [["time [s]", "x [mm]", "F [N]"], [0, 1, 1], [1, 987654321, 2]]:
            book.worksheets[0].append(row)
        book.save(tmp_path / "small.xlsx")
        with (
            zipfile.ZipFile(tmp_path / "small.xlsx") as small,
            zipfile.ZipFile(tmp_path / "run.xlsx", "w") as large,
        ):
            for name in small.namelist():
                large.writestr(name, small.read(name).replace(b"987654321", b"9" * 400))
        with pytest.raises(DataError, match="row 3, column 'x'"):
            read_record(tmp_path / "run.xlsx")

    def test_hdf5_of_exabytes(self, tmp_path):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            for name in ("time", "displacement", "force"):
                item = file.create_dataset(name, (1 << 58,), "f8", chunks=(1024,))
                item.attrs["unit"] = {"time": "s", "displacement": "m", "force": "N"}[name]
        with pytest.raises(DataError, match=r"would take .* PB"):
            read_record(tmp_path / "a.h5")

    def test_nested_groups_and_null_references(self, tmp_path):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file.create_group("/".join("g" * 60))
        with pytest.raises(DataError, match="nested deeper than 32 levels"):
            inspect(tmp_path / "a.h5")
        path = write_v73(tmp_path / "run.mat")
        with h5py.File(path, "a") as file:
            null = file.create_dataset("empty", (1, 2), h5py.ref_dtype)
            null.attrs["MATLAB_class"] = np.bytes_("cell")
        assert len(inspect(path).channels) > 5

    def test_nested_parquet(self, tmp_path):
        table = frame()
        table["list"] = [[1, 2]] * len(table)
        table["struct"] = pd.Series([{"a": 1}] * len(table), dtype=object)
        table.to_parquet(tmp_path / "run.parquet")
        record = read_record(tmp_path / "run.parquet")
        assert_the_run(record)
        assert "struct (struct<a: int64>) is not used" in repr(record)

    @pytest.mark.parametrize("content", [
        "[" * 100_000, '{"a": ' * 50_000, "1" * 10_000, '{"a": 1}',
        '{"time [s]":[0,1],"x [m]":[0,1],"F [N]":[0,1],"F [N]":[1,2]}',
    ])  # fmt: skip
    def test_json_that_is_no_table(self, tmp_path, content):
        (tmp_path / "a.json").write_text(content)
        with pytest.raises(DataError):
            read_record(tmp_path / "a.json")

    def test_bytes_behind_an_npy_array(self, tmp_path):
        np.save(tmp_path / "a.npy", np.arange(8.0))
        data = (tmp_path / "a.npy").read_bytes() + bytes(8)
        (tmp_path / "a.npy").write_bytes(data)
        (tmp_path / "a.npy.gz").write_bytes(gzip.compress(data))
        for name in ("a.npy", "a.npy.gz"):
            with pytest.raises(DataError, match="damaged: 8 bytes behind its array"):
                read_record(tmp_path / name)

    def test_an_archive_that_unpacks_to_more_than_its_limit(self, tmp_path):
        with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("x.npy", bytes(300_000_000))
        with pytest.raises(DataError, match=r"the content would take 300 MB, and the file has"):
            read_record(tmp_path / "a.npz")

    def test_objects_in_npz_are_not_run(self, tmp_path):
        np.savez(tmp_path / "a.npz", a=np.array([{"x": 1}], dtype=object))
        with pytest.raises(DataError, match="the file is damaged: Object arrays cannot be loaded"):
            read_record(tmp_path / "a.npz")


class TestDictionaries:
    @pytest.mark.parametrize(
        "content",
        [
            {"time [s]": TIME, "x [mm]": X * 1e3, "F [kN]": F / 1e3},
            {"time": TIME, "x": X * 1e3, "F": F / 1e3,
             "units": {"time": "s", "x": "mm", "F": "kN"}},
            {n: {"values": v, "unit": u} for n, v, u in (
                ("time", TIME, "s"), ("x", X, "m"), ("F", F, "N"))},
            {"columns": HEADER, "data": cells()},
            [dict(zip(("time [s]", "x [mm]", "F [kN]"), row, strict=True)) for row in cells()],
            [HEADER, *cells()],
            {"columns": ["time", "x", "F"], "units": ["s", "mm", "kN"], "rows": cells()},
            {"units": {"x": "mm", "F": "kN", "time": "s"},
             "data": [dict(zip(("time", "x", "F"), row, strict=True)) for row in cells()]},
            [{"name": n, "values": v, "unit": u} for n, v, u in (
                ("time", TIME, "s"), ("x", X, "m"), ("F", F, "N"))],
            {n: {str(i): row[k] for i, row in enumerate(cells())}  # as pandas writes it
             for k, n in enumerate(("time [s]", "x [mm]", "F [kN]"))},
            [{"name": "x", "data": X, "fs": 128.0, "unit_str": "m"},
             {"name": "F", "data": F, "fs": 128, "unit_str": "N"}],
        ],
    )  # fmt: skip
    def test_json(self, tmp_path, content):
        (tmp_path / "run.json").write_text(json.dumps(content, default=lambda a: a.tolist()))
        assert_the_run(read_record(tmp_path / "run.json"))

    def test_npz_and_npy(self, tmp_path):
        named: dict[str, Any] = {"time [s]": TIME, "x [mm]": X * 1e3, "F [N]": F}
        np.savez(tmp_path / "run.npz", **named)
        assert_the_run(read_record(tmp_path / "run.npz"))
        np.save(tmp_path / "run.npy", np.column_stack([TIME, X, F]))
        names = {"time": "data[:,0] [s]", "displacement": "data[:,1] [m]", "force": "data[:,2] [N]"}
        assert_the_run(read_record(tmp_path / "run.npy", columns=names))
        rows = np.array(list(zip(TIME, X, F, strict=True)), dtype=[(n, "f8") for n in "txF"])
        np.save(tmp_path / "run.npy", rows)
        names = {"time": "t [s]", "displacement": "x [m]", "force": "F [N]"}
        assert_the_run(read_record(tmp_path / "run.npy", columns=names))

    def test_sdypy_there_and_back(self):
        record = Record(TIME, displacement=X, force=F)
        assert_the_run(read_record(record.to_sdypy()))
        uneven = Record(TIME**2 + 1.0, velocity=X, drive=F)
        back = read_record(uneven.to_sdypy())
        np.testing.assert_array_equal(back.time, uneven.time)
        np.testing.assert_array_equal(back.velocity, X)
        assert back.drive_unit == "V"

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"fs": None}, "has fs = None and no time"),
            ({"data": np.ma.array(range(64), mask=X < 0)}, "row 18, column 'x': the cell is empty"),
            ({"name": "F"}, "several channels are called F"),
            ({"time": [0.0, 1.0], "fs": None}, "64 values at 2 times"),
            ({"fs": 100.0}, "sampled at different times"),
            ({"data": np.zeros((3, 3))}, "expected a list of numbers"),
        ],
    )
    def test_sdypy_refusals(self, change, message):
        channels = [{"name": n, "data": v, "fs": 128.0, "unit_str": u}
                    for n, v, u in (("x", X, "m"), ("F", F, "N"))]  # fmt: skip
        with pytest.raises(DataError, match=message):
            read_record([channels[0] | change, channels[1]])


class TestWrongExtension:
    @pytest.mark.parametrize(
        ("name", "content", "message"),
        [
            ("a.csv", b"\x89HDF\r\n\x1a\n123", "extension .csv says a text table, .* is HDF5"),
            ("a.xlsx", b"t,x\n1,2\n", "extension .xlsx says an Excel workbook, .* a text table"),
            ("a.h5", b"PAR1xxx", "extension .h5 says HDF5 .*, the content is Parquet"),
            ("a.mat", b"t,x\n1,2\n", "extension .mat says MATLAB .*, the content is a text table"),
            ("a.mat", b"TDSm....", "extension .mat says MATLAB .*, the content is NI TDMS"),
            ("a.tdms", b"    -1\n    58\n", "the content is a universal file"),
            ("a.uff", b"LabVIEW Measurement\n", "the content is LabVIEW LVM"),
            ("a.csv", b"PK\x03\x04....", "the content is a ZIP archive"),
            ("a.xls", b"\xd0\xcf\x11\xe0....", "Excel 97 workbook is not read; save it as .xlsx"),
            ("a.foo", b"PK\x03\x04....", "a ZIP archive is not read"),
        ],
    )
    def test_content_decides(self, tmp_path, name, content, message):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=message):
            inspect(tmp_path / name)

    def test_unknown_extensions_are_read_by_content(self, tmp_path):
        savemat(tmp_path / "run.mat", {"t": TIME, "x": X, "F": F})
        (tmp_path / "run.mat").rename(tmp_path / "run.bin")
        run = {"time": "t [s]", "displacement": "x [m]", "force": "F [N]"}
        assert_the_run(read_record(tmp_path / "run.bin", columns=run))


@pytest.mark.parametrize(
    ("module", "extra", "name", "content"),
    [
        ("python_calamine", "excel", "a.xlsx", b"PK\x03\x04 xl/workbook"),
        ("pyarrow", "parquet", "a.parquet", b"PAR1"),
        ("pyuff", "uff", "a.uff", b"    -1\n    58\n"),
        ("nptdms", "tdms", "a.tdms", b"TDSm"),
    ],
)
def test_missing_packages_are_named(tmp_path, monkeypatch, module, extra, name, content):
    (tmp_path / name).write_bytes(content)
    monkeypatch.setitem(sys.modules, module, None)
    message = rf"{module} is needed .* pip install 'dahl_ident\[{extra}\]'"
    with pytest.raises(MissingDependencyError, match=message):
        inspect(tmp_path / name)


def test_errors_name_the_level(tmp_path):
    levels = [{"f": FREQUENCY, "u": [1.0, 1.0, v], "H": RECEPTANCE} for v in (1.0, -1.0)]
    savemat(tmp_path / "a.mat", {"s": np.array(levels, dtype=object)})
    columns = {"frequency": "s[*].f [Hz]", "drive": "s[*].u [N]", "response": "s[*].H [m/N]"}
    with pytest.raises(DataError, match=r"a.mat, level s\[1\], index 2, column .*: found -1"):
        read_frequency_response(tmp_path / "a.mat", columns=columns)


def test_doubts_name_indices(tmp_path):
    savemat(tmp_path / "a.mat", {"f": FREQUENCY, "u": np.ones(3), "H": RECEPTANCE.conj()})
    columns = {"frequency": "f [Hz]", "drive": "u [N]", "response": "H [m/N]"}
    with pytest.raises(DataError, match="creates energy"):
        read_frequency_response(tmp_path / "a.mat", columns=columns)
    savemat(tmp_path / "a.mat", {"f": FREQUENCY, "u": np.ones(3), "H": RECEPTANCE * [1, 1, -1j]})
    with pytest.warns(DataWarning, match="creates energy: index 2"):
        read_frequency_response(tmp_path / "a.mat", columns=columns)


@pytest.mark.parametrize(("name", "value"), [("Ts", 0.01), ("fs", 100.0)])
def test_a_sample_rate_in_the_file_is_proposed(tmp_path, name, value):
    path = tmp_path / "run.mat"
    savemat(path, {name: value, "x": np.sin(np.arange(50.0)), "F": np.arange(50.0)})
    assert "# sample_rate = 100  # Hz, " in inspect(path).column_map
