"""Loading of the shipped data sets, each with its true parameters."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from dahl_ident.data import FrequencyResponse, Record, read_frequency_response, read_record
from dahl_ident.errors import DataError, choices

_PACKAGE = Path(__file__).parents[1]  # the folder dahl_ident
_PLACES = (_PACKAGE / "datasets" / "synthetic", _PACKAGE.parent / "datasets" / "synthetic")


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
    place = datasets_directory()
    sidecar_file = place / f"{name}.json"
    if not sidecar_file.is_file():
        known = choices(sorted(p.stem for p in place.glob("*.json")), name)
        raise DataError(f"there is no data set {name!r}; there are {known}")
    sidecar: dict[str, Any] = json.loads(sidecar_file.read_text(encoding="utf-8"))
    file = place / sidecar["file"]
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
    """Return where the data sets lie: in an installed package, else next to a checkout's."""
    for place in _PLACES:
        if place.is_dir():
            return place
    raise DataError(
        f"the synthetic data sets are in none of {', '.join(map(str, _PLACES))}; install the "
        "package again"
    )
