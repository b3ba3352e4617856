"""Time two ways of doing one thing in turn, so that a drifting clock speed cancels."""

from __future__ import annotations

import resource
import statistics
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

_SIZE = ("size", "smaller")


@dataclass(frozen=True)
class Row:
    """One comparison: `ours` and `peer` for the same work, in seconds (or `unit` "B" or "%").

    `target` is the bound on the ratio ours/peer (at most), or on peer/ours where `faster`.
    """

    work: str
    ours: float
    peer: float
    peer_name: str
    target: float
    faster: bool = False
    unit: str = "s"

    @property
    def ratio(self) -> float:
        """ours/peer, or peer/ours where `faster`."""
        return self.peer / self.ours if self.faster else self.ours / self.peer

    @property
    def reached(self) -> bool:
        """Whether the target holds."""
        return self.ratio >= self.target if self.faster else self.ratio <= self.target


def median_of_pairs(
    ours: Callable[[], object], peer: Callable[[], object], repeats: int = 7
) -> tuple[float, float]:
    """Return the median seconds of each, run in turn `repeats` times after one warm-up."""
    ours()
    peer()
    mine, theirs = [], []
    for _ in range(repeats):
        mine.append(seconds(ours))
        theirs.append(seconds(peer))
    return statistics.median(mine), statistics.median(theirs)


def seconds(work: Callable[[], object]) -> float:
    """Return the processor time of one call, s, with that of the processes it waits for."""
    start = _processor_time()
    work()
    return _processor_time() - start


def _processor_time() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def peak_bytes(work: Callable[[], object]) -> int:
    """Return the most memory that one call holds at a time, its result included."""
    work()
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def print_table(title: str, rows: list[Row]) -> None:
    """Print the comparisons as a Markdown table."""
    print(as_table(title, rows))


def as_table(title: str, rows: list[Row]) -> str:
    """Return the comparisons as a Markdown table."""
    lines = [
        f"\n## {title}\n",
        "| work | ours | peer | peer is | ratio | to reach | reached |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        noun, less = {"s": ("time", "faster"), "%": ("width", "narrower")}.get(row.unit, _SIZE)
        sign, unit = (">=", f"x {less}") if row.faster else ("<=", f"x the {noun}")
        lines.append(
            f"| {row.work} | {_pretty(row.ours, row.unit)} | {_pretty(row.peer, row.unit)} "
            f"| {row.peer_name} "
            f"| {row.ratio:.3g} {unit} | {sign} {row.target:g} "
            f"| {'yes' if row.reached else 'NO'} |"
        )
    return "\n".join(lines)


def _pretty(value: float, unit: str) -> str:
    if unit == "%":
        return f"{value:.2g} %"
    for factor, prefix in ((1e-6, "M"), (1e-3, "k"), (1.0, ""), (1e3, "m"), (1e6, "u")):
        if value * factor >= 1.0:
            return f"{value * factor:.3g} {prefix}{unit}"
    return f"{value * 1e9:.3g} n{unit}"
