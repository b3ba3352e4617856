"""Do intervals of posteriors hold where noise is not the only error.

``python -m benchmarks.posteriors`` draws tables of :mod:`benchmarks.uncertainty`, integrates the
posterior of each with noise alone and with every source of the budget, and counts in how many the
central 95.45 % intervals hold the truth. Every table counts, whatever its verdict.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks.uncertainty import (
    SEED,
    Cell,
    Draw,
    several_days,
    shared_by_level,
    unmodelled,
    wrong_exponent,
)
from dahl_ident import Dahl, fit, posterior

TABLES = 100
LIMITS = (0.02275, 0.97725)
TOLERANCE = 1e-3  # of the probability: a hundredth of what chance leaves of a coverage
LINEAR = Dahl(alpha=1.0)


def cells() -> list[Cell]:
    """Return what is drawn; where the exponent is not what is wrong, it is given."""

    def right() -> Draw:
        return wrong_exponent(1.0, 0.1, 10.0)

    return [
        Cell("the model is right, exponent given", right(), model=LINEAR),
        Cell("the model is right", right()),
        Cell("three days, f_max off by 2 %", several_days("f_max", 0.02), model=LINEAR),
        Cell("three days, gain off by 2 %", several_days("gain", 0.02), model=LINEAR),
        Cell("eight levels with errors in common", shared_by_level, model=LINEAR),
        Cell("exponent 0.8", wrong_exponent(0.8, 0.1, 10.0)),
        Cell("mass worth 0.3 % of sigma", unmodelled("mass", 0.003), model=LINEAR),
    ]


def coverage(cell: Cell, tables: int, seed: int = SEED) -> dict[str, tuple[float, float, float]]:
    """Return coverage of f_max and sigma, and median length of f_max's, by what is counted."""
    found = {}
    stream = sum(map(ord, cell.name))
    for uncertainty in ("noise", "combined"):
        inside, lengths = np.zeros((tables, 2), dtype=bool), np.zeros(tables)
        for index in range(tables):
            data, truth = cell.draw(np.random.default_rng([seed, stream, index]))
            grid = posterior(
                fit(data, cell.model, throw=False),
                method="grid",
                uncertainty=uncertainty,
                tolerance=TOLERANCE,
            )
            for i, (name, value) in enumerate(zip(("f_max", "sigma"), truth, strict=True)):
                low, high = grid.quantile(name, LIMITS)
                inside[index, i] = low <= value <= high
                lengths[index] = high - low if i == 0 else lengths[index]
        share = inside.mean(axis=0)
        found[uncertainty] = float(share[0]), float(share[1]), float(np.median(lengths))
    return found


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--tables", type=int, default=TABLES)
    parser.add_argument("--only", default="", help="part of the names of the cells to judge")
    parser.add_argument("--write", type=Path, default=None, help="page to write")
    arguments = parser.parse_args()
    lines = [
        "# Intervals of posteriors",
        "",
        __doc__.split("\n\n", 1)[1].strip() if __doc__ else "",
        "",
        "| cell | tables | noise alone: f_max, sigma | combined: f_max, sigma | length |",
        "|---|---|---|---|---|",
    ]
    for cell in cells():
        if arguments.only not in cell.name:
            continue
        found = coverage(cell, arguments.tables)
        shares = [", ".join(f"{100.0 * v:.0f}" for v in one[:2]) for one in found.values()]
        longer = found["combined"][2] / found["noise"][2]
        lines.append(
            f"| {cell.name} | {arguments.tables} | {shares[0]} | {shares[1]} | {longer:.2f} |"
        )
        print(lines[-1], flush=True)
    lines += [
        "",
        "Coverage in percent; length: that of f_max's combined interval over that with noise "
        "alone (median).",
        "",
    ]
    if arguments.write is not None:
        arguments.write.write_text("\n".join(lines))


if __name__ == "__main__":
    main()
