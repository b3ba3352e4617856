"""What a person calls a row of a table: its frequency, its level, its harmonic, its run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.units import engineering, shown_unit


def row_names(data: FrequencyResponse, rows: Sequence[int]) -> list[str]:
    """Return the names of rows, such as "1 Hz, 0.67 mm, harmonic 3".

    Rows of one name have their number behind it.

    Examples
    --------
    >>> data = FrequencyResponse([1.0, 1.0, 2.0], [3.0, 2.0, 2.0], [6.7e-4, 6.7e-4, 2e-3])
    >>> row_names(data, [0, 2])
    ['1 Hz, 670 µm (row 0)', '2 Hz, 2 mm']
    """
    if not len(rows):
        return []
    every = [_name(data, row) for row in range(data.n)]
    count = Counter(every)
    return [f"{every[r]} (row {r})" if count[every[r]] > 1 else every[r] for r in rows]


def _name(data: FrequencyResponse, row: int) -> str:
    driven = data.drive is not None and data.controlled[row] == "force"
    size = data.drive if driven or data.amplitude is None else data.amplitude
    unit = shown_unit("N" if size is data.drive else "m", data.motion)
    parts = [f"{data.frequency_hz[row]:.4g} Hz"]
    if size is not None:
        parts.append(engineering(float(size[row]), unit))
    harmonic = int(data.harmonic[row])
    if harmonic != 1:
        parts.append(f"harmonic {harmonic}" if harmonic else "mean force")
    if data.level is not None and data.level.dtype.kind == "U":
        parts.append(f"level {data.level[row]}")
    if data.run is not None and len(data.runs or ()) > 1:
        parts.append(f"run {data.run[row]}")
    return ", ".join(parts)
