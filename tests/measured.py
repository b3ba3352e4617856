"""Measurements made by others, where DAHL_IDENT_MEASURED_DATA names their folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat

import dahl_ident as di
from benchmarks.measured import FOLDER

needs_measured = pytest.mark.skipif(
    not FOLDER.is_dir(), reason="DAHL_IDENT_MEASURED_DATA names no folder of measured data"
)


def dampers(pattern: str = "*") -> list[di.Record]:
    """Return tests of the banded rotary friction damper at 30 lbf, three steady cycles in each."""
    files = sorted((FOLDER / "brfd").glob(f"band30lb_{pattern}.csv"))
    return [di.read_record(f, displacement="displacement", force="friction force") for f in files]


def cranks(pattern: str) -> list[di.Record]:
    """Return tests of the magneto-rheological damper."""
    records = []
    for file in sorted((FOLDER / "mr_damper").glob(f"ensaio{pattern}.mat")):
        content = loadmat(file)
        x, _, force = content["x_F"].T
        time = np.arange(x.size) * content["Ts"].item()
        records.append(di.Record(time, displacement=1e-3 * x, force=force))
    return records


def assert_still(tests: Sequence[Any], fitted: Callable[[Any], Any], names: Sequence[str]) -> None:
    """Check that no test left out moves an estimate by more than it states."""
    whole = fitted(tests).params
    others = [fitted([*tests[:i], *tests[i + 1 :]]).params for i in range(len(tests))]
    for name in names:
        value, u = whole[name].value, whole[name].stderr
        estimates = np.array([params[name].value for params in others])
        assert np.abs(estimates - value).max() < 3.0 * u
        jackknife = float(np.sqrt((len(tests) - 1) * np.var(estimates)))
        assert 0.5 * jackknife < u < 3.0 * jackknife
