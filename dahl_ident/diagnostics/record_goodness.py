"""Residuals of a fit to records: unexplained share of variance, and the worst segment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.diagnostics.formatting import percent

_SEGMENTS = 50  # the worst one is 2 % of a record


@dataclass(frozen=True)
class RecordGoodness:
    """Residuals of all records.

    Attributes
    ----------
    share_left : float
        Variance of the residuals over that of the measured output.
    rms : float
        Root mean square of the residuals, in the output's unit.
    worst_record, worst_start, worst_stop, worst_rms : int and float
        The segment, a fiftieth of a record, with the largest residuals: record (from 1), times in
        s, and its root mean square.
    correlation : float
        Of residuals of neighbouring samples.
    """

    share_left: float
    rms: float
    worst_record: int
    worst_start: float
    worst_stop: float
    worst_rms: float
    correlation: float
    n_records: int

    @property
    def worst_text(self) -> str:
        """The worst segment in words."""
        which = f" of record {self.worst_record}" if self.n_records > 1 else ""
        return (
            f"most between {self.worst_start:.4g} and {self.worst_stop:.4g} s{which}, where the "
            f"residuals are {self.worst_rms / self.rms if self.rms else 0.0:.2g} times larger"
        )

    @property
    def details(self) -> list[str]:
        """The numbers as text."""
        return [
            f"unexplained share of variance {self.share_left:.3g} "
            f"({percent(self.share_left**0.5)} rms)",
            f"residuals {self.rms:.3g} rms; {self.worst_text}",
            f"correlation of neighbouring residuals {self.correlation:.2f}",
        ]


def record_goodness(
    records: Sequence[Record], measured: Sequence[FloatArray], residuals: Sequence[FloatArray]
) -> RecordGoodness:
    """Return the statistics of the residuals of records.

    Parameters
    ----------
    records : sequence of Record
    measured, residuals : sequence of ndarray
        Output and measured minus predicted output of each.

    Returns
    -------
    RecordGoodness

    Examples
    --------
    >>> t = np.arange(100.0)
    >>> record = Record(t, displacement=t, force=np.sin(t))
    >>> print(record_goodness([record], [np.sin(t)], [0.1 * np.sin(t)]).details[0])
    unexplained share of variance 0.01 (10 % rms)
    """
    variance = sum(float(np.sum((y - y.mean()) ** 2)) for y in measured)
    together = np.concatenate(list(residuals))
    worst = (0, 0.0, 0.0, -1.0)
    for number, (record, e) in enumerate(zip(records, residuals, strict=True), 1):
        width = max(1, e.size // _SEGMENTS)
        sums = np.concatenate([[0.0], np.cumsum(e**2)])
        mean = (sums[width:] - sums[:-width]) / width
        place = int(np.argmax(mean))
        if mean[place] > worst[3]:
            stop = float(record.time[min(place + width, e.size) - 1])
            worst = (number, float(record.time[place]), stop, float(mean[place]))
    products = sum(float(e[1:] @ e[:-1]) for e in residuals)
    total = float(together @ together)
    return RecordGoodness(
        total / variance,
        float(np.sqrt(total / together.size)),
        worst[0],
        worst[1],
        worst[2],
        float(np.sqrt(worst[3])),
        products / total if total else 0.0,
        len(records),
    )
