"""Fits of records without a start: ``python -m benchmarks.cold_records --write PAGE.md``.

The cases of `tests/cold_records.py`, several seeds each. An independent solver makes every record.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import dahl_ident as di
from dahl_ident.errors import DahlIdentError
from tests import cold_records as cold
from tests.cold_records import Case

SEEDS = 6
CASES: dict[str, Callable[[int], Case]] = {
    **{f"Dahl, driven, sigma {s:g} N/m": partial(cold.driven_dahl, s) for s in (300.0, 3e3, 3e4)},
    **{
        f"Backlash, gap {g:g} x_c, force measured": partial(cold.backlash, g)
        for g in (0.5, 2.0, 6.0)
    },
    "LuGre, driven": cold.lugre,
    "Maxwell slip, driven": cold.maxwell_slip,
    "Iwan, driven": cold.iwan,
    **{
        f"{name}, free decay, {known} known": partial(cold.free_decay, name, known)
        for name in cold.DECAYS
        for known in ("mass", "spring")
    },
}
_HEAD = """# Records from a cold start

Made by `python -m benchmarks.cold_records --write docs/validation/cold_records.md`. Records of
motions that an independent solver integrated, with noise (0.1 % of the displacement, 0.5 % of a
measured force), are fitted without any start. Deviations from the truth are in standard
uncertainties u, of all free parameters and seeds together. Solved: the status is usable.

| case | seeds | solved | within 2 u | within 3 u | largest | time, s |
|---|---|---|---|---|---|---|
"""


def row(name: str, make_case: Callable[[int], Case]) -> str:
    """Return the row of one case, with the deviations of all seeds and free parameters."""
    deviations, solved, seconds = [], 0, 0.0
    for seed in range(SEEDS):
        case = make_case(seed)
        start = time.process_time()
        try:
            fit = di.fit(case.record, case.model, throw=False)
        except DahlIdentError:
            deviations.append(np.inf)
        else:
            solved += fit.status.usable
            for true in case.truth.parameters:
                estimate = fit.params[true.name]
                if estimate.vary and estimate.stderr:
                    error = estimate.value - float(true.value or 0.0)
                    deviations.append(error / estimate.stderr)
        seconds += time.process_time() - start
    size = np.abs(deviations)
    return (
        f"| {name} | {SEEDS} | {solved} | {np.mean(size < 2.0):.0%} | {np.mean(size < 3.0):.0%} | "
        f"{size.max():.1f} u | {seconds / SEEDS:.2f} |"
    )


def main() -> None:
    """Print the table, or write it into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", type=Path)
    page = parser.parse_args().write
    rows = []
    for name, make_case in CASES.items():
        rows.append(row(name, make_case))
        print(rows[-1], flush=True)
    if page is not None:
        page.write_text(_HEAD + "\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
