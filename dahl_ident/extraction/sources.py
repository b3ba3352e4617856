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
from dahl_ident.data.readers import Columns, PathLike, record_pieces, refuse_repeated, run_names
from dahl_ident.data.rows import labelled
from dahl_ident.errors import DataError, ValidationError, name_options, names_options
from dahl_ident.extraction.cycles import Mode
from dahl_ident.extraction.from_record import record_response
from dahl_ident.extraction.phasors import Settings
from dahl_ident.units import percent

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
        Waveforms of motion and force, sampled at any times. Velocity and acceleration are
        integrated at the fitted frequency. A path is a file, or a pattern such as
        ``"day1/*.csv"``. Several records, in a list or a mapping from names, each become a `run`,
        named as in the mapping or after the file. A long file is read and extracted in pieces of
        10,000,000 samples (HDF5, TDMS, Parquet and npy files stay on the disk); a level in two
        pieces is one point, without the cycle at the cut.
    columns : mapping or path of a TOML file, optional
        Column map for files, as for :func:`dahl_ident.read_record`.
    frequency : float, optional
        Excitation frequency, Hz, if it is known; the whole record is then evaluated at it. By
        default it is estimated for each segment together with the phasors.
    mode : {"auto", "steps", "sweep"}, default "auto"
        Whether the record holds successive levels, or a continuous sweep of amplitude or
        frequency. "auto" takes whichever there is more of.
    num_periods : int, optional
        Number of periods of each segment that are used, including settling periods: the last
        ones. In a sweep, periods of a window. Default: all of a segment.
    settling_periods : int, optional
        Leading periods of `num_periods` that are left out. Default: as many as the transient of
        friction needs, judged from the decaying mean of the force.
    harmonics : sequence of int, optional
        Harmonics that become rows, from 0 (the mean force) to 9; fewer if the sampling cannot
        separate them. Default: 1, 3, 5, 7, 9, and also 0, 2, 4, 6, 8 if the force is asymmetric,
        with a warning. If the force was controlled, only 1, since the displacement then has
        harmonics itself; other harmonics, if given, are rows of receptance, X_k/F_1.
    controlled : {"displacement", "force"}, default "displacement"
        The amplitude that the laboratory kept constant. If it is the force, the transient is
        looked for in the mean of the displacement.
    level : str or float, optional
        Nominal label of the records.
    min_share : float, default 0.6
        Least share of the power, without offset and drift, that the fundamental must have in
        motion and in force. Lower it for a sine buried in noise.
    jobs : int, default 1
        Number of processes among which several records are divided.

    Returns
    -------
    FrequencyResponse
        Dynamic stiffness with `covariance`, `dof`, `amplitude_std` and `amplitude_covariance`;
        for harmonics of the displacement, receptance with `drive_std` and `drive_covariance`.
        The covariance is such that ``d' C^-1 d / 2`` follows F(2, dof). Its `quality` columns:

        ``settled``
            Whether the remaining bias due to the transient is within a standard error.
        ``bias_real``, ``bias_imag``
            Estimate of that bias, in the response's unit; it is not subtracted. In a sweep it
            includes half the change of the response in a cycle, a bound of the lag.
        ``more_periods``
            Least number of settling periods that are missing; 0 in a sweep that is too fast.
        ``num_periods``, ``settling_periods``
            Periods of the segment, and how many leading ones were left out.
        ``covariance_from``
            "cycles", or "spectrum" with fewer than four cycles: an estimate from spectral lines
            farther from the harmonics.
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
            Amplitude in steps of the sensor; infinite if no steps are visible.
        ``displacement_clipped``, ``force_clipped``
            Share of samples that are constant at the highest or lowest value.
        ``verdict``
            "good", or the reasons against the point, such as a negative loss.

    Raises
    ------
    ExtractionError
        If the motion is not a sine, or no segment is usable: too short, motion or force not
        dominated by one sine, less motion than the sensor's step, or `frequency` not that of the
        motion, so that its phase drifts. If only some segments are usable, a warning gives the
        reasons for the others.
    ValidationError
        If an argument is out of range, or the record has only a drive without a factor.
    DataError
        If a file cannot be read, or no file matches a pattern.

    Notes
    -----
    The sine fit is that of IEEE Std 1057 with harmonics. Its covariance is estimated from the
    spectrum between the harmonics, plus errors that repeat in every cycle: rounding to sensor steps
    without noise as dither, and harmonics above half the sampling rate, which alias onto lower ones
    (their size is extrapolated from the measured ones; with a hundred samples per cycle this is
    negligible, and if the sampling is too slow to measure any the verdict says so). Rows of other
    harmonics, which assume a sine, include the effect of the displacement's own harmonics: about
    the stiffness times their size. The covariance is valid for white and for 1/f noise. The
    uncertainty of a record's `drive_factor` is common to all points and not included. Hum at rest
    that is a clean sine in both channels is taken for a level; give `frequency` in this case.

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
    options = locals().copy()
    for name in ("records", "columns", "level", "jobs"):
        del options[name]
    reading = {} if columns is None else {"columns": columns}
    named = _named(records)
    if reading and any(isinstance(record, Record) for _, record in named):
        raise ValidationError("columns is given for a record; expected it where the file is read")
    if isinstance(records, Mapping):
        return extract_all([FileTask(r, name, level, reading) for name, r in named], options, jobs)
    tasks = [FileTask(source, None, level, reading) for _, source in named]
    return extract_all(tasks, options, jobs, [str(name) for name, _ in named])


@dataclass(frozen=True)
class FileTask:
    """One record or file, the labels of its points, and the keywords for reading it."""

    source: Record | PathLike
    run: str | None
    level: ArrayLike | None
    reading: Mapping[str, Any]


def extract_all(
    tasks: Sequence[FileTask], options: Mapping[str, Any], jobs: int = 1, names: Sequence[str] = ()
) -> FrequencyResponse:
    """Return the points of all tasks in one table; `options` are other keywords of `extract`."""
    stated = {name: value for name, value in options.items() if value is not None}
    if options.get("controlled") == "force":
        stated.setdefault("harmonics", (1,))
    settings = Settings(**stated)
    refuse_repeated([task.source for task in tasks])
    jobs = min(whole_number(jobs, "jobs", 1), len(tasks))
    if jobs == 1:
        parts = [_extracted(task, settings) for task in tasks]
    else:
        # a fork of a process with threads may hang, so the workers are new processes
        with ProcessPoolExecutor(
            jobs, get_context("spawn"), initializer=name_options, initargs=(names_options(),)
        ) as pool:
            parts = []
            for part, messages in pool.map(_extracted_with_warnings, tasks, repeat(settings)):
                parts.append(part)
                for message in messages:
                    warnings.warn(message, stacklevel=3)
    parts = labelled(parts, names) if names and len(parts) > 1 else parts
    data = parts[0] if len(parts) == 1 else FrequencyResponse.concatenate(parts)
    return data if options.get("harmonics") is not None else _needed_harmonics(data)


def _extracted_with_warnings(
    task: FileTask, settings: Settings
) -> tuple[FrequencyResponse, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        data = _extracted(task, settings)
    return data, [str(warning.message) for warning in caught]


def _extracted(task: FileTask, settings: Settings) -> FrequencyResponse:
    if isinstance(task.source, Record):
        records: Iterable[Record] = [task.source]
    else:
        records = record_pieces(task.source, _PIECE, **task.reading)
    return record_response(records, settings, task.level, task.run)


def _named(records: Records) -> list[tuple[str | None, Record | PathLike]]:
    """Return each record or file with the name of its run; a single one has none."""
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
        if isinstance(records, str | Path) or not isinstance(records, Iterable):
            sources: Iterable[Record | PathLike] = [records]
        else:
            sources = records
        files = [file for source in sources for file in _files(source)]
        if files == [str(records)]:  # a path that is not a pattern
            return [(None, files[0])]
        named = list(zip(_labels(files), files, strict=True))
    if not named:
        raise ValidationError("records is empty; expected at least one record or file")
    return named


def _files(source: Record | PathLike) -> list[Record | PathLike]:
    """Return a list of the record itself, or of the files that a path or pattern names."""
    if isinstance(source, Record):
        return [source]
    if not isinstance(source, str | Path):
        raise ValidationError(
            f"records holds a {type(source).__name__}; expected records, paths or patterns"
        )
    return [*matching(str(source))]


def matching(pattern: str) -> list[str]:
    """Return the files that a pattern matches, in order; a path that is not a pattern as it is."""
    if not _PATTERN.search(pattern) or Path(pattern).exists():
        return [pattern]
    files = sorted(glob(pattern, recursive=True))  # noqa: PTH207 # may be absolute
    if not files:
        raise DataError(f"{pattern}: no file matches this pattern")
    return files


def _labels(sources: Sequence[Record | PathLike]) -> list[str]:
    """Return the name of each run: that of its file, or its number."""
    files = [(s.provenance or {}).get("file") if isinstance(s, Record) else s for s in sources]
    numbers = [f"record {i + 1}" for i in range(len(files))]
    labels = [str(file or number) for file, number in zip(files, numbers, strict=True)]
    labels = run_names(labels) if all(files) else labels
    return labels if len(set(labels)) == len(labels) else numbers


def _needed_harmonics(data: FrequencyResponse) -> FrequencyResponse:
    """Return only the odd harmonics if the force is symmetric; warn if it is not."""
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
