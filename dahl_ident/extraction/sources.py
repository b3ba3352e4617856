"""Extraction of one or many records, from memory or from files."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from glob import glob
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import whole_number
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.readers import record_pieces, refuse_repeated, run_names
from dahl_ident.data.rows import labelled
from dahl_ident.errors import DataError, ValidationError, name_options, names_options
from dahl_ident.extraction.cycles import Mode
from dahl_ident.extraction.from_record import record_response
from dahl_ident.extraction.phasors import Settings
from dahl_ident.units import percent

PathLike = str | Path
Columns = Mapping[str, Any] | str | Path
Records = Record | PathLike | Sequence[Record | PathLike] | Mapping[str, Record | PathLike]
_PATTERN = re.compile(r"[*?\[]")
_PIECE = 10_000_000  # samples: about 0.6 GB while they are extracted


def extract(
    records: Records,
    *,
    columns: Columns | None = None,
    frequency: float | None = None,
    mode: Mode = "auto",
    num_periods: int | None = None,
    settling_periods: int | None = None,
    harmonics: Sequence[int] | None = None,
    controlled: str = "displacement",
    level: ArrayLike | None = None,
    min_share: float = 0.6,
    jobs: int = 1,
) -> FrequencyResponse:
    """Turn recorded waveforms into dynamic stiffness with covariance and verdicts.

    The record is split into segments of constant amplitude and frequency; rests and ramps are
    left out. Each segment gives one point: the fundamental of force over that of displacement,
    N = F_1/X_1, and a row for each further harmonic, F_k/X_1. Cycles with a transient from the
    previous level are left out as far as needed. A continuous sweep gives a series of points.

    Parameters
    ----------
    records : Record, path, sequence or mapping
        Waveforms of motion and force, sampled anyhow. Velocity and acceleration are integrated
        at the fitted frequency. A path is a file, or a pattern such as ``"day1/*.csv"``; of
        several records, in a list or a mapping of names to them, each becomes a `run`, called
        by its name in the mapping or by that of its file. A long file is read and extracted in
        pieces of 10,000,000 samples (of HDF5, TDMS, Parquet and npy the rest stays on the
        disk); a level across a cut is one point, less the cycle that the cut goes through.
    columns : mapping or path of a TOML file, optional
        Column map for files, as :func:`dahl_ident.read_record` takes it.
    frequency : float, optional
        Excitation frequency, Hz, where it is known; the whole record is then read at it. Left
        out: found, and estimated for each segment together with the phasors.
    mode : {"auto", "steps", "sweep"}, default "auto"
        What the record holds: levels one after another, or a continuous sweep of amplitude or
        frequency. "auto" takes whichever there is more of.
    num_periods : int, optional
        Periods of each segment that are used, settling ones among them: the last ones. In a
        sweep, those of a window. Default: all of a segment.
    settling_periods : int, optional
        Leading periods of `num_periods` that are left out. Default: as many as the transient of
        friction needs, judged from the decaying mean of the force.
    harmonics : sequence of int, optional
        Which harmonics become rows, 0 (the mean force) to 9; fewer where the sampling cannot
        separate them. Default: 1, 3, 5, 7, 9, and 0, 2, 4, 6, 8 as well where the force is
        asymmetric, which a warning says. 1 alone where the force was controlled, since the
        displacement then has harmonics of its own; if others are given, those are the rows:
        X_k/F_1, in a table of receptance.
    controlled : {"displacement", "force"}, default "displacement"
        What the laboratory held constant. Where it is the force, the transient is looked for in the
        displacement's mean.
    level : str or float, optional
        Nominal label of the records.
    min_share : float, default 0.6
        Share of the power, offset and drift apart, that the fundamental has at least, in motion
        and in force. Lower it for a sine buried in noise.
    jobs : int, default 1
        Processes among which several records are divided.

    Returns
    -------
    FrequencyResponse
        Dynamic stiffness with `covariance`, `dof`, `amplitude_std` and `amplitude_covariance`; of
        harmonics of the displacement receptance, with `drive_std` and `drive_covariance`.
        The covariance is such that ``d' C^-1 d / 2`` follows F(2, dof). Its `quality` columns:

        ``settled``
            Whether the bias left by the transient is within a standard error.
        ``bias_real``, ``bias_imag``
            That bias as estimated, in the response's unit; it is not subtracted. In a sweep
            with half of what the response changes in a cycle, a bound of how far it lags.
        ``more_periods``
            Settling periods that are missing at least; 0 in a sweep that is too fast.
        ``num_periods``, ``settling_periods``
            Periods of the segment, and how many leading ones were left out.
        ``covariance_from``
            "cycles", or "spectrum" with fewer than four: an estimate from farther from the
            harmonics.
        ``start_time``, ``end_time``
            First and last sample used, s.
        ``displacement_share``, ``force_share``
            The fundamental's share of the power of the motion channel and of the force.
        ``displacement_distortion``, ``force_distortion``
            Harmonics 2 to 9 of displacement and force over the fundamental.
        ``asymmetry``
            Even harmonics 2 to 8 of the force over its fundamental; 0 where noise or the
            displacement's own even harmonics explain them, and in a sweep.
        ``displacement_steps``, ``force_steps``
            Amplitude in steps of the sensor; infinite where no steps show.
        ``displacement_clipped``, ``force_clipped``
            Share of samples that stand still at the highest or lowest value.
        ``verdict``
            "good", or what speaks against the point; a loss below zero among it.

    Raises
    ------
    ExtractionError
        If the motion is not a sine; or no segment is usable: too short, motion or force not
        dominated by one sine, less motion than the sensor's step, or `frequency` not that of the
        motion, so that its phase drifts. If only some are usable, a warning lists the others and
        why.
    ValidationError
        If an argument is out of range, or the record has only a drive without a factor.
    DataError
        If a file cannot be read, or no file matches a pattern.

    Notes
    -----
    The sine fit is that of IEEE Std 1057 with harmonics. Its covariance is taken from what does
    not repeat between the harmonics, plus errors that do: rounding to sensor steps where no
    noise dithers it, and harmonics above half the sampling rate, which alias onto lower ones (the
    size of the measured ones is extrapolated to them; with a hundred samples per cycle this is
    negligible, and if the sampling is too slow to measure any the verdict says so). Rows of other
    harmonics, which belong to a sine, add what the displacement's own harmonics change in them:
    about the stiffness times their size. The covariance holds for white and for 1/f noise. The
    uncertainty of a record's `drive_factor` is common to all points and not part of it. A hum
    during rests that is a clean sine in both channels is taken for a level; give `frequency` then.

    Examples
    --------
    >>> from dahl_ident.elements import Dahl
    >>> friction = Dahl(f_max=0.1, sigma=30.0)
    >>> t = np.arange(4000) / 200.0
    >>> x = 0.004 * np.sin(2.0 * np.pi * 1.25 * t)
    >>> rng = np.random.default_rng(0)
    >>> force = friction.force(x) + 1e-4 * rng.standard_normal(t.size)
    >>> data = extract(Record(t, displacement=x, force=force), harmonics=[1])
    >>> N, exact = data.response[0], friction.describing_function(data.amplitude[0])
    >>> f"{N:.2f}", f"{exact:.2f}", str(data.quality["verdict"][0])
    ('19.74+9.72j', '19.74+9.72j', 'good')
    """
    how = locals().copy()
    for name in ("records", "columns", "level", "jobs"):
        del how[name]
    reading = {} if columns is None else {"columns": columns}
    named = _named(records)
    if isinstance(records, Mapping):
        return extract_all([FileTask(r, name, level, reading) for name, r in named], how, jobs)
    tasks = [FileTask(source, None, level, reading) for _, source in named]
    return extract_all(tasks, how, jobs, [str(name) for name, _ in named])


@dataclass(frozen=True)
class FileTask:
    """One record or file, the labels of its points, and the words with which it is read."""

    source: Record | PathLike
    run: str | None
    level: ArrayLike | None
    reading: Mapping[str, Any]


def extract_all(
    tasks: Sequence[FileTask], how: Mapping[str, Any], jobs: int = 1, names: Sequence[str] = ()
) -> FrequencyResponse:
    """Return the points of all tasks in one table; `how` holds the other words of `extract`."""
    stated = {name: value for name, value in how.items() if value is not None}
    if how.get("controlled") == "force":
        stated.setdefault("harmonics", (1,))
    settings = Settings(**stated)
    refuse_repeated([task.source for task in tasks])
    jobs = min(whole_number(jobs, "jobs", 1), len(tasks))
    if jobs == 1:
        parts = [_extracted(task, settings) for task in tasks]
    else:
        # a forked copy of a process with threads may hang: the workers start afresh
        with ProcessPoolExecutor(
            jobs, get_context("spawn"), initializer=name_options, initargs=(names_options(),)
        ) as pool:
            parts = []
            for part, messages in pool.map(_extracted_apart, tasks, repeat(settings)):
                parts.append(part)
                for message in messages:
                    warnings.warn(message, stacklevel=3)
    parts = labelled(parts, names) if names and len(parts) > 1 else parts
    data = parts[0] if len(parts) == 1 else FrequencyResponse.concatenate(parts)
    return data if how.get("harmonics") is not None else _without_needless_rows(data)


def _extracted_apart(task: FileTask, settings: Settings) -> tuple[FrequencyResponse, list[str]]:
    """Return the points of a task and its warnings, which another process cannot show."""
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        data = _extracted(task, settings)
    return data, [str(warning.message) for warning in shown]


def _extracted(task: FileTask, settings: Settings) -> FrequencyResponse:
    if isinstance(task.source, Record):
        records: Iterable[Record] = [task.source]
    else:
        records = record_pieces(task.source, _PIECE, **task.reading)
    return record_response(records, settings, task.level, task.run)


def _named(records: Records) -> list[tuple[str | None, Record | PathLike]]:
    """Return each record or file with its run; one alone has none."""
    if isinstance(records, Record):
        return [(None, records)]
    if isinstance(records, Mapping):
        named: list[tuple[str | None, Record | PathLike]] = []
        for name, source in records.items():
            files = _files(source)
            if len(files) != 1:
                raise ValidationError(
                    f"records[{name!r}] names {len(files)} files; expected one record or file "
                    "for each name"
                )
            named.append((str(name), files[0]))
    else:
        alone = isinstance(records, str | Path)
        sources = [records] if isinstance(records, str | Path) else records
        files = [file for source in sources for file in _files(source)]
        if alone and files == [str(records)]:
            return [(None, files[0])]
        named = list(zip(_labels(files), files, strict=True))
    if not named:
        raise ValidationError("records is empty; expected at least one record or file")
    return named


def _files(source: Record | PathLike) -> list[Record | PathLike]:
    """Return a record by itself, or the files that a path or pattern names."""
    if isinstance(source, Record):
        return [source]
    if not isinstance(source, str | Path):
        raise ValidationError(
            f"records holds a {type(source).__name__}; expected records, paths or patterns"
        )
    return [*matching(str(source))]


def matching(pattern: str) -> list[str]:
    """Return the files that a pattern matches, in order; a path without one by itself."""
    if not _PATTERN.search(pattern) or Path(pattern).exists():
        return [pattern]
    files = sorted(glob(pattern, recursive=True))  # noqa: PTH207 # may be absolute
    if not files:
        raise DataError(f"{pattern}: no file matches this pattern")
    return files


def _labels(sources: Sequence[Record | PathLike]) -> list[str]:
    """Return a run for each: the name of its file, or its number."""
    files = [(s.provenance or {}).get("file") if isinstance(s, Record) else s for s in sources]
    numbers = [f"record {i + 1}" for i in range(len(files))]
    labels = [str(file or number) for file, number in zip(files, numbers, strict=True)]
    labels = run_names(labels) if all(files) else labels
    return labels if len(set(labels)) == len(labels) else numbers


def _without_needless_rows(data: FrequencyResponse) -> FrequencyResponse:
    """Return the odd harmonics alone where the force is symmetric, and say so where it is not."""
    even = data.harmonic % 2 == 0
    if not even.any():
        return data
    first = data.harmonic == data.harmonic.min()
    asymmetry = data.quality["asymmetry"][first]
    if not asymmetry.any():
        return data.select(rows=~even)
    warnings.warn(
        f"the force is asymmetric in {np.count_nonzero(asymmetry)} of {asymmetry.size} "
        f"points: even harmonics are up to {percent(asymmetry.max())} of the fundamental; "
        "rows of the mean force (k = 0) and of even harmonics hold it",
        stacklevel=3,
    )
    return data
