"""The shipped data sets: values, checksums, sizes and errors."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dahl_ident.errors import DataError
from dahl_ident.synthetic import load_dataset, shipped
from dahl_ident.synthetic.regenerate import main, make, readme

DATA_SETS = shipped.data_sets()
FOLDER = Path(__file__).parents[1] / "datasets" / "synthetic"
COLUMNS = (
    "frequency_hz", "response", "amplitude", "drive", "covariance", "dof", "amplitude_std",
    "amplitude_covariance", "level", "harmonic", "time", "displacement", "force",
)  # fmt: skip


@pytest.mark.parametrize("name", DATA_SETS)
def test_experiment_and_seed_give_the_shipped_values(name):
    data, made = load_dataset(name), make(DATA_SETS[name])
    assert type(data) is type(made)
    for column in COLUMNS:
        ours, theirs = getattr(data, column, None), getattr(made, column, None)
        assert (ours is None) == (theirs is None), column
        if ours is not None and theirs is not None:
            # the integration accumulates rounding errors, which differ between machines
            scale = np.max(np.abs(theirs[np.isfinite(theirs)]), initial=0.0)
            np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-8 * scale, err_msg=column)


@pytest.mark.parametrize("name", DATA_SETS)
def test_the_truth_in_a_sidecar_is_that_of_its_experiment(name):
    sidecar = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    assert sidecar["truth"] == DATA_SETS[name].experiment.truth


def test_the_folder_holds_nothing_else_and_is_small():
    files = {file.name for file in FOLDER.iterdir()}
    expected = {one.file for one in DATA_SETS.values()} | {f"{name}.json" for name in DATA_SETS}
    assert files == expected | {"README.md"}
    assert sum(file.stat().st_size for file in FOLDER.iterdir()) < 5e6


def test_the_readme_is_made_from_the_data_sets():
    assert (FOLDER / "README.md").read_text(encoding="utf-8") == readme()


def test_the_documentation_names_every_data_set():
    documented = load_dataset.__doc__ or ""
    assert all(f'"{name}"' in documented for name in DATA_SETS)


def test_regenerating_writes_the_same_files(tmp_path):
    assert main(["noisy", "unsettled", "--directory", str(tmp_path)]) == 0
    written = sorted(file.name for file in tmp_path.iterdir())
    assert written == [
        "README.md", "noisy.csv", "noisy.json", "unsettled.csv.gz", "unsettled.json",
    ]  # fmt: skip
    again = [(tmp_path / name).read_bytes() for name in written]
    main(["noisy", "unsettled", "--directory", str(tmp_path)])
    assert [(tmp_path / name).read_bytes() for name in written] == again


def test_the_command_refuses_an_unknown_name(tmp_path):
    command = [sys.executable, "-m", "dahl_ident.synthetic.regenerate", "nosiy"]
    run = subprocess.run(
        [*command, "--directory", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert run.returncode == 2
    assert "there is no data set nosiy; there are clean, noisy" in run.stderr
    assert not list(tmp_path.iterdir())


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(DataError, match=r"no data set 'nosiy'; there are alpha_2, clean, delayed"):
        load_dataset("nosiy")


def test_a_changed_or_missing_file_is_not_loaded(tmp_path, monkeypatch):
    for name in ("noisy.json", "noisy.csv"):
        (tmp_path / name).write_bytes((FOLDER / name).read_bytes())
    monkeypatch.setattr(shipped, "_FOLDERS", (tmp_path / "nowhere", tmp_path, FOLDER))
    assert load_dataset("noisy").n == 30  # from the first folder that exists
    with (tmp_path / "noisy.csv").open("a") as file:
        file.write("\n")
    with pytest.raises(DataError, match=r"noisy\.csv is not the file that was shipped"):
        load_dataset("noisy")
    (tmp_path / "noisy.csv").unlink()
    with pytest.raises(DataError, match=r"noisy\.csv is not the file that was shipped"):
        load_dataset("noisy")


def test_missing_folders_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "_FOLDERS", (tmp_path / "a", tmp_path / "b"))
    with pytest.raises(DataError, match="the synthetic data sets are in none of"):
        load_dataset("noisy")
