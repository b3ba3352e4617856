"""The shipped data sets: what each teaches, how it was made, and what it can determine.

Each consists of a data file and a JSON file that declares it.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

from dahl_ident.data import FrequencyResponse, Record, read_frequency_response, read_record
from dahl_ident.errors import DataError, choices
from dahl_ident.synthetic.experiment import Experiment

_PACKAGE = Path(__file__).parents[1]  # the folder dahl_ident
_FOLDERS = (_PACKAGE / "datasets" / "synthetic", _PACKAGE.parent / "datasets" / "synthetic")


@dataclass(frozen=True)
class DataSet:
    """One shipped data set, as its JSON file declares it.

    `identifiable` are the parameters that the data determine (standard deviation of the logarithm
    below 0.25), `not_identifiable` the others, which a fit must report. `caution` is the flaw of
    the data that an analysis must report, or an empty string.
    """

    name: str
    experiment: Experiment
    seed: int
    teaches: str
    identifiable: tuple[str, ...]
    not_identifiable: tuple[str, ...]
    caution: str

    @classmethod
    def of(cls, declared: dict[str, Any]) -> DataSet:
        """Return the data set that a JSON file declares."""
        values = {f.name: declared[f.name] for f in fields(cls)}
        values |= {name: tuple(v) for name, v in values.items() if isinstance(v, list)}
        return cls(**values | {"experiment": Experiment.from_dict(declared["experiment"])})

    @property
    def kind(self) -> str:
        """Kind of data: "frequency_response" or "record"."""
        return "record" if self.experiment.table is None else "frequency_response"

    @property
    def file(self) -> str:
        """Name of the data file."""
        return f"{self.name}.csv.gz" if self.kind == "record" else f"{self.name}.csv"


@cache
def data_sets() -> dict[str, DataSet]:
    """Return every shipped data set by its name, in the order of their seeds."""
    files = sorted(datasets_directory().glob("*.json"))
    sets = [DataSet.of(json.loads(file.read_text(encoding="utf-8"))) for file in files]
    return {data_set.name: data_set for data_set in sorted(sets, key=lambda s: s.seed)}


def load_dataset(name: str) -> FrequencyResponse | Record:
    """Return a synthetic data set by name.

    Parameters
    ----------
    name : str
        Tables: "clean", "noisy", "microslip", "gross_slip", "alpha_2", "fig_7_plant",
        "fig_7_describing_function", "frf_levels", "outliers", "delayed". Records: "unsettled",
        "quantised", "plant_recording", "play_and_two_limits", "sweep_plant".

    Returns
    -------
    FrequencyResponse or Record
        Its provenance holds the content of the accompanying JSON file: the true parameters (truth),
        the experiment and seed that made it, what it teaches, which parameters it determines.

    Raises
    ------
    DataError
        If there is no such data set, or its file is not the one that was shipped.

    Examples
    --------
    >>> data = load_dataset("noisy")
    >>> data.n, data.provenance["truth"]["f_max"]
    (30, 0.1)
    """
    folder = datasets_directory()
    known = sorted(p.stem for p in folder.glob("*.json"))
    if name not in known:
        raise DataError(f"there is no data set {name!r}; there are {choices(known, name)}")
    sidecar_file = folder / f"{name}.json"
    sidecar: dict[str, Any] = json.loads(sidecar_file.read_text(encoding="utf-8"))
    file = folder / sidecar["file"]
    content = file.read_bytes() if file.is_file() else b""
    if hashlib.sha256(content).hexdigest() != sidecar["sha256"]:
        raise DataError(
            f"{file} is not the file that was shipped: its SHA-256 differs from the one in "
            f"{sidecar_file.name}; install the package again"
        )
    if sidecar["kind"] == "record":
        return replace(read_record(file), provenance=sidecar)
    return replace(read_frequency_response(file), provenance=sidecar)


def datasets_directory() -> Path:
    """Return the folder of the data sets: in the installed package, or next to it in a checkout."""
    for folder in _FOLDERS:
        if folder.is_dir():
            return folder
    raise DataError(
        f"the synthetic data sets are in none of {', '.join(map(str, _FOLDERS))}; install the "
        "package again"
    )
