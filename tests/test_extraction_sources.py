"""Lists, patterns and mappings of records, several processes, and files read in pieces."""

import importlib
from typing import Any

import h5py  # type: ignore[import-untyped]
import numpy as np
import pandas as pd
import pytest

from dahl_ident.data import Record, inspect, read_record
from dahl_ident.data.readers import record_pieces
from dahl_ident.elements import Dahl
from dahl_ident.errors import DataError, DataWarning, ExtractionError, ValidationError
from dahl_ident.extraction import extract, sources

RATE, FREQUENCY = 200.0, 1.25
LEVELS = {"low": 1e-3, "mid": 2e-3, "high": 4e-3}
FRICTION = Dahl(f_max=0.1, sigma=30.0)


def record(amplitude, n=2000, seed=0):
    t = np.arange(n) / RATE
    x = amplitude * np.sin(2.0 * np.pi * FREQUENCY * t)
    noise = np.random.default_rng(seed).standard_normal((2, n))
    return Record(t, displacement=x + 1e-7 * noise[0], force=FRICTION.force(x) + 1e-4 * noise[1])


@pytest.fixture
def folder(tmp_path):
    for name, amplitude in LEVELS.items():
        record(amplitude).save(tmp_path / f"{name}.csv")
    return tmp_path


def test_lists_patterns_and_mappings_give_the_same_points_with_their_names(folder):
    files = [folder / f"{name}.csv" for name in sorted(LEVELS)]
    from_list = extract(files)
    from_pattern = extract(str(folder / "*.csv"))
    from_mapping = extract({name: record(LEVELS[name]) for name in sorted(LEVELS)})
    assert from_mapping.runs == ["high", "low", "mid"]
    for data in (from_list, from_pattern):  # a level in a file of its own is not a run
        assert data.levels == ["high", "low", "mid"]
        assert data.run is None
    for data in (from_list, from_pattern, from_mapping):
        for name in LEVELS:
            alone = extract(record(LEVELS[name]))
            one = data.select(run=name) if data.level is None else data.select(level=name)
            np.testing.assert_allclose(one.response, alone.response, rtol=1e-6)
            np.testing.assert_allclose(one.covariance, alone.covariance, rtol=1e-4)
    assert extract(files[0]).run is None
    assert extract([record(1e-3), record(1e-3)]).runs == ["record 1", "record 2"]


def test_processes_give_what_one_gives(folder):
    one = extract(str(folder / "*.csv"))
    two = extract(str(folder / "*.csv"), jobs=2)
    np.testing.assert_array_equal(one.response, two.response)
    assert two.runs == one.runs


def test_rows_are_the_same_for_all_records():
    """One asymmetric record brings the even harmonics into the table, for all of them."""
    skew = record(4e-3)
    force = skew.force_samples + 4e3 * skew.motion_samples**2
    asymmetric = Record(skew.time, displacement=skew.motion_samples, force=force)
    with pytest.warns(UserWarning, match="asymmetric in 1 of 2 points"):
        data = extract({"a": record(2e-3), "b": asymmetric})
    for run in ("a", "b"):
        assert data.select(run=run).harmonic.tolist() == list(range(10))


def test_what_is_no_record_and_what_is_not_there(folder):
    with pytest.raises(DataError, match=r"nothing\*\.csv: no file matches this pattern"):
        extract(str(folder / "nothing*.csv"))
    with pytest.raises(DataError, match=r"low\.csv: the file is named twice"):
        extract([folder / "low.csv", str(folder / "*.csv")])
    with pytest.raises(DataError, match="is not the name of a file: embedded null byte"):
        extract("\0")
    with pytest.raises(ValidationError, match="records is empty"):
        extract([])
    with pytest.raises(ValidationError, match="records holds a int"):
        extract([3])  # type: ignore[list-item]
    with pytest.raises(ValidationError, match=r"records\['a'\] names 3 files"):
        extract({"a": str(folder / "*.csv")})
    (folder / "noise.csv").write_text("t [s],x [m],F [N]\n" + "0,0,0\n1,1,1\n")
    with pytest.raises(ExtractionError, match=r"noise\.csv: not a sine test"):
        extract([folder / "low.csv", folder / "noise.csv"])
    with pytest.raises(ValidationError, match="jobs is 0"):
        extract(record(1e-3), jobs=0)


def saved(tmp_path, with_time):
    whole = record(2e-3, n=9000)
    path = tmp_path / "long.h5"
    with h5py.File(path, "w") as file:
        for name in ("time", "displacement", "force")[not with_time :]:
            file[name] = getattr(whole, name)
            file[name].attrs["units"] = {"time": "s", "displacement": "m", "force": "N"}[name]
    return path


@pytest.mark.parametrize("with_time", [True, False])
def test_a_long_file_comes_in_pieces_that_make_up_the_whole(tmp_path, with_time):
    path = saved(tmp_path, with_time)
    reading = {} if with_time else {"sample_rate": RATE}
    whole = read_record(path, **reading)  # type: ignore[arg-type]
    pieces = list(record_pieces(path, 4000, **reading))  # type: ignore[arg-type]
    assert [len(piece) for piece in pieces] == [3000, 3000, 3000]
    for name in ("time", "displacement", "force"):
        joined = np.concatenate([getattr(piece, name) for piece in pieces])
        np.testing.assert_allclose(joined, getattr(whole, name), rtol=0, atol=1e-12)


def stored(path, whole):
    """Save three channels in a format by the name's ending."""
    columns = {
        "time": whole.time, "displacement": whole.motion_samples, "force": whole.force_samples,
    }  # fmt: skip
    if path.suffix == ".npy":
        table = np.empty(whole.n, dtype=[(name, "f8") for name in columns])
        for name, values in columns.items():
            table[name] = values
        np.save(path, table)
    elif path.suffix == ".parquet":
        names = ["time [s]", "displacement [m]", "force [N]"]
        frame = pd.DataFrame(dict(zip(names, columns.values(), strict=True)))
        frame.to_parquet(path, row_group_size=1500)
    elif path.suffix == ".tdms":
        nptdms: Any = importlib.import_module("nptdms")
        with nptdms.TdmsWriter(str(path)) as writer:
            for start in range(0, whole.n, 5000):
                part = slice(start, start + 5000)
                writer.write_segment([
                    nptdms.ChannelObject("rig", name, values[part], {"unit_string": unit})
                    for (name, values), unit in zip(columns.items(), "smN", strict=True)
                ])  # fmt: skip
    else:
        with h5py.File(path, "w") as file:
            for (name, values), unit in zip(columns.items(), "smN", strict=True):
                file.create_dataset(name, data=values).attrs["unit"] = unit
            file["unrelated"] = np.zeros(3 * whole.n)


NAMED = {k: f"data.{k} [{u}]" for k, u in (("time", "s"), ("displacement", "m"), ("force", "N"))}


@pytest.mark.parametrize("ending", ["h5", "npy", "parquet", "tdms"])
def test_a_level_across_the_cuts_is_one_point(tmp_path, ending, monkeypatch):
    """Two levels in four pieces: the first is cut once, the second twice."""
    one, two = record(2e-3, n=9000), record(4e-3, n=15000)
    whole = Record(
        np.arange(24000) / RATE,
        displacement=np.concatenate([one.motion_samples, two.motion_samples]),
        force=np.concatenate([one.force_samples, two.force_samples]),
    )
    path = tmp_path / f"long.{ending}"
    stored(path, whole)
    reading: dict[str, Any] = {"columns": NAMED} if ending == "npy" else {}
    at_once = extract(whole)
    monkeypatch.setattr(sources, "_PIECE", 6000)
    seen: list[int] = []

    def counted(*args, **words):
        for piece in record_pieces(*args, **words):
            seen.append(piece.n)
            yield piece

    monkeypatch.setattr(sources, "record_pieces", counted)
    data = extract(path, **reading)
    assert seen == [6000] * 4
    assert data.n == at_once.n == 10
    np.testing.assert_allclose(data.amplitude, at_once.amplitude, rtol=1e-5)
    for row in range(data.n):
        error = data.response[row] - at_once.response[row]
        std = np.sqrt(0.5 * np.trace(at_once.covariance[row]))
        assert abs(error) < 0.5 * std  # the cycles at the cuts are missing
        ratio = np.trace(data.covariance[row]) / np.trace(at_once.covariance[row])
        assert 0.4 < ratio < 2.5
    used = data.quality["num_periods"] - data.quality["settling_periods"]
    expected = at_once.quality["num_periods"] - at_once.quality["settling_periods"]
    assert (used >= expected - 5).all()
    assert (used <= expected).all()
    assert set(data.quality["verdict"]) == {"good"}


def test_errors_of_joined_parts_hold(tmp_path, monkeypatch):
    """Scatter of 20 records over the stated variance; chi-square bounds of 1 in 1000."""
    exact = FRICTION.describing_function(2e-3)
    errors, stated, dof = [], [], []
    monkeypatch.setattr(sources, "_PIECE", 3000)
    for seed in range(20):
        path = tmp_path / f"{seed}.h5"
        stored(path, record(2e-3, n=9000, seed=seed))
        data = extract(path, frequency=FREQUENCY, harmonics=[1])
        assert data.n == 1
        errors.append(data.response[0] - exact)
        stated.append(np.trace(data.covariance[0]))
        dof.append(data.dof[0])
    assert 0.44 < np.mean(np.abs(errors) ** 2) / np.mean(stated) < 1.84
    assert np.mean(dof) > 60.0  # three parts of about 40 each, were they alike


def test_pieces_without_points_are_named_and_do_not_stop_the_others(tmp_path, monkeypatch):
    one = record(2e-3, n=3000)
    rest = np.zeros(3000)
    rng = np.random.default_rng(0)
    whole = Record(
        np.arange(6000) / RATE,
        displacement=np.concatenate([one.motion_samples, rest + 1e-7 * rng.standard_normal(3000)]),
        force=np.concatenate([one.force_samples, rest + 1e-4 * rng.standard_normal(3000)]),
    )
    stored(tmp_path / "part.h5", whole)
    monkeypatch.setattr(sources, "_PIECE", 3000)
    with pytest.warns(UserWarning, match=r"part\.h5: left out: "):
        data = extract(tmp_path / "part.h5", harmonics=[1])
    assert data.n == 1
    assert data.quality["end_time"][0] < 3000 / RATE


@pytest.mark.parametrize("ending", ["h5", "parquet", "tdms", "csv"])
def test_what_inspect_proposes_is_what_extract_accepts(tmp_path, ending):
    path, proposal = tmp_path / f"run.{ending}", tmp_path / "columns.toml"
    if ending == "csv":
        record(2e-3).save(path)
    else:
        stored(path, record(2e-3))
    proposal.write_text(inspect(path).column_map)
    data = extract(path, columns=proposal, harmonics=[1])
    np.testing.assert_allclose(
        data.response, extract(record(2e-3), harmonics=[1]).response, rtol=1e-5
    )


def test_a_tdms_file_that_was_appended_to_another_is_named(tmp_path):
    nptdms: Any = importlib.import_module("nptdms")
    whole = record(2e-3)
    path = tmp_path / "run.tdms"
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([
            nptdms.ChannelObject(
                "rig", name, values, {"unit_string": unit, "wf_increment": 1.0 / RATE}
            )
            for name, values, unit in (
                ("displacement", whole.motion_samples, "m"), ("force", whole.force_samples, "N"),
            )
        ])  # fmt: skip
    assert read_record(path).n == whole.n
    path.write_bytes(2 * path.read_bytes())
    with pytest.warns(DataWarning, match=r"segments 2 of the file state wf_increment again"):
        twice = read_record(path)
    assert "appended" in " ".join((twice.provenance or {})["warnings"])
