"""Rows that the extraction flagged: a fit may use them, but its numbers carry their flaws."""

from __future__ import annotations

import numpy as np

from dahl_ident.data import FrequencyResponse

_GOOD = "good"


def flagged_rows(data: FrequencyResponse) -> tuple[str, ...]:
    """Return a sentence for each kind of flaw among the fundamentals, with its rows.

    Examples
    --------
    >>> from dahl_ident.data import FrequencyResponse
    >>> data = FrequencyResponse(
    ...     [1.0, 1.0], [1.0, 2.0], [1.0, 2.0], quality={"verdict": ["good", "not settled"]}
    ... )
    >>> flagged_rows(data)
    ('row 1: not settled',)
    """
    verdicts = data.quality.get("verdict")
    if verdicts is None:
        return ()
    rows = np.flatnonzero((verdicts != _GOOD) & (data.harmonic == 1))
    return tuple(f"row {row}: {verdicts[row]}" for row in rows)
