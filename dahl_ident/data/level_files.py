"""Several files in one table: a run each, or a level each of one run.

A level that was measured in a file of its own is no run of its own: how such files differ is what
the levels are for, and scatter between runs cannot be told from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.frequency_response import FrequencyResponse

_SAME = 1.1  # ratio up to which drives or amplitudes are one level


def labelled(parts: Sequence[FrequencyResponse], names: Sequence[str]) -> list[FrequencyResponse]:
    """Return the tables of several files with their names as levels, or else as runs."""
    if any(part.run is not None for part in parts) or not _one_level_each(parts):
        return [
            part if part.run is not None else replace(part, run=np.full(part.n, name))
            for part, name in zip(parts, names, strict=True)
        ]
    return [
        part if part.level is not None else replace(part, level=np.full(part.n, name))
        for part, name in zip(parts, names, strict=True)
    ]


def _one_level_each(parts: Sequence[FrequencyResponse]) -> bool:
    """Return whether each table holds one level, and no two the same."""
    if all(part.level is not None for part in parts):
        labels = [set(np.asarray(part.level).tolist()) for part in parts]
        return max(map(len, labels)) == 1 and len(set.union(*labels)) == len(parts)
    if any(part.level is not None for part in parts):
        return False
    held = [_held(part) for part in parts]
    for sizes in zip(*held, strict=True):
        known = [size for size in sizes if size is not None]
        if len(known) < len(parts):
            continue
        middle = np.sort([np.median(size) for size in known])
        one_each = all(size.max() < _SAME * size.min() for size in known)
        if one_each and np.all(middle[1:] > _SAME * middle[:-1]):
            return True
    return False


def _held(part: FrequencyResponse) -> tuple[FloatArray | None, FloatArray | None]:
    """Return the sizes of force and displacement of all points."""
    first = part.select(rows=part.harmonic == 1) if (part.harmonic == 1).any() else part
    gain = first.to("dynamic_stiffness").gain
    drive, amplitude = first.drive, first.amplitude
    if drive is None and amplitude is not None:
        drive = amplitude * gain
    if amplitude is None and drive is not None:
        amplitude = drive / gain
    return drive, amplitude
