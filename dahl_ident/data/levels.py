"""Levels of tests: one in each of several files, or one that a header states."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.data.record import Record
from dahl_ident.errors import UnitError, ValidationError
from dahl_ident.units import DRIVE_KINDS, MOTION_KINDS, parse_quantity

_SAME = 1.1  # ratio up to which drives or amplitudes are one level
_SAME_FREQUENCY = 1.001  # points next to each other at a sharp resonance differ by more
_NEARLY_ALL = 0.99  # of a wave's samples: noise and spikes lie beyond
_NUMBER = r"(?P<value>[0-9]+(?:[.,][0-9]+)?(?:e[-+]?[0-9]+)?)"
_UNIT = r"[^\W\d_][^;,\t\])\"']{0,20}"
_LINE = re.compile(
    rf"[\W_]*(?P<key>[a-z][a-z _.-]{{2,40}}?)\s*(?:[\[(](?P<own>{_UNIT})[\])]\s*)?[\"']?\s*"
    rf"(?:[:=;,\t]\s*|\s)[\"']?{_NUMBER}(?:[\"']?\s*[;,\t]?\s*[\[(\"']?(?P<unit>{_UNIT}))?",
    re.IGNORECASE,
)
_SUBJECTS = {
    "drive", "driving", "excitation", "source", "force", "control", "target", "reference", "test",
    "shaker", "input", "sine", "load", "torque", "displacement", "velocity", "acceleration",
    "response", "nominal",
}  # fmt: skip
_SIZES = {"level", "amplitude"}


def labelled(parts: Sequence[FrequencyResponse], names: Sequence[str]) -> list[FrequencyResponse]:
    """Return the tables of several files with their names as levels, or else as runs.

    A level measured in a file of its own is not a run: how such files differ is what levels are
    for.
    """
    runs = any(part.run is not None for part in parts) or not _one_level_each(parts)
    column = "run" if runs else "level"
    labels: list[dict[str, Any]] = [
        {} if getattr(part, column) is not None else {column: np.full(part.n, name)}
        for part, name in zip(parts, names, strict=True)
    ]
    return [replace(part, **label) for part, label in zip(parts, labels, strict=True)]


def _one_level_each(parts: Sequence[FrequencyResponse]) -> bool:
    """Return whether each table holds one level, and no two the same one at one frequency."""
    if all(part.level is not None for part in parts):
        labels = [set(np.asarray(part.level).tolist()) for part in parts]
        return max(map(len, labels)) == 1 and len(set.union(*labels)) == len(parts)
    if any(part.level is not None for part in parts):
        return False
    bands = np.array([(p.frequency_hz.min(), p.frequency_hz.max()) for p in parts])
    for sizes in zip(*map(_held, parts), strict=True):
        known = [size for size in sizes if size is not None]
        if len(known) < len(parts):
            continue
        one_each = all(size.max() < _SAME * size.min() for size in known)
        if one_each and _all_differ(np.array([np.median(size) for size in known]), bands):
            return True
    return False


def one_run(records: Sequence[Record]) -> bool:
    """Return whether each record is a sine or a sweep at one level, and no two are alike."""
    for channel in ("force_samples", "motion_samples"):
        waves = [getattr(record, channel) - getattr(record, channel).mean() for record in records]
        largest = np.array([np.quantile(np.abs(wave), _NEARLY_ALL) for wave in waves])
        sizes = np.array([np.sqrt(2.0 * np.mean(wave**2)) for wave in waves])
        keep = (sizes < _SAME * largest) & (largest < _SAME * sizes)
        halves = np.array([np.count_nonzero(np.diff(np.signbit(wave))) for wave in waves])
        rates = 0.5 * halves / [record.time[-1] - record.time[0] for record in records]
        if keep.all() and _all_differ(sizes, rates[:, None] * [_SAME**-0.5, _SAME**0.5]):
            return True
    return False


def _all_differ(sizes: FloatArray, bands: FloatArray) -> bool:
    """Return whether no two of `sizes`, (n,), agree where `bands` of frequency, (n, 2), overlap."""
    low, high = bands.T
    overlap = (low[:, None] < _SAME_FREQUENCY * high) & (low < _SAME_FREQUENCY * high[:, None])
    alike = (sizes[:, None] < _SAME * sizes) & (sizes < _SAME * sizes[:, None])
    return bool(np.count_nonzero(overlap & alike) == len(sizes))  # each with itself


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


def stated_levels(lines: Iterable[str]) -> dict[str, str]:
    """Return the drive and the amplitude that lines of a header state, if each states one only."""
    stated: dict[str, set[str]] = {}
    for line in lines:
        match = _LINE.match(line[:200])
        if match is None:
            continue
        words = set(re.split(r"[\s_.-]+", match["key"].casefold())) - {""}
        if not words <= _SUBJECTS | _SIZES or not (words & _SIZES or words == {"drive"}):
            continue
        unit = match["own"] or match["unit"] or ""
        text = f"{match['value'].replace(',', '.')} {unit.strip()}"
        try:
            _, kind, _ = parse_quantity(text, (*DRIVE_KINDS, *MOTION_KINDS), "level")
        except (UnitError, ValidationError):
            continue
        role = "drive" if kind in DRIVE_KINDS else "amplitude"
        stated.setdefault(role, set()).add(text)
    return {role: texts.pop() for role, texts in stated.items() if len(texts) == 1}
