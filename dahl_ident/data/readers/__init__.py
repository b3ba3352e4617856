"""Readers that turn the usual laboratory files into frequency responses or records.

Formats are recognised by their content. What a file does not contain, such as a unit, comes from a
column map or from keywords, or is an error; every assumption is noted in the result.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dahl_ident.data.column_map import SETTINGS, column_map
from dahl_ident.data.columns import one_of
from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.data.raw_columns import RawFile
from dahl_ident.data.readers.file import FORMATS, File, open_file
from dahl_ident.data.readers.inspection import FileContents, contents
from dahl_ident.data.record import Record
from dahl_ident.data.record_table import record_from, record_size
from dahl_ident.data.response_table import ResponseOptions, response_from
from dahl_ident.data.rows import labelled
from dahl_ident.data.storage import plain_data
from dahl_ident.errors import DahlIdentError, DataError, DataWarning, ValidationError, argument
from dahl_ident.units import Quantity

if TYPE_CHECKING:
    import pandas as pd
    from typing_extensions import TypeIs

__all__ = ["FileContents", "inspect", "read_frequency_response", "read_record"]

PathLike = str | Path
Columns = Mapping[str, Any] | str | Path


def read_frequency_response(
    path: PathLike | Sequence[PathLike] | pd.DataFrame,
    *,
    columns: Columns | None = None,
    quantity: Quantity | None = None,
    frequency: float | None = None,
    sweep: str | None = None,
    amplitude: str | None = None,
    drive: str | None = None,
    drive_factor: str | None = None,
    drive_factor_uncertainty: float | None = None,
    level: str | float | None = None,
    level_from_name: str | None = None,
    run: str | None = None,
    controlled: str | Mapping[str, str] | None = None,
    frequency_hz: tuple[float, float] | None = None,
    sheet: str | None = None,
    passive: bool = True,
) -> FrequencyResponse:
    r"""Read a table of complex response, or several of them into one.

    Parameters
    ----------
    path : path, sequence of paths, or pandas.DataFrame
        Files; ``"-"`` is standard input. A table in memory has its units in its column names.
    columns : mapping or path of a TOML file, optional
        Column map: which column is ``frequency``, ``amplitude``, ``drive``, ``gain``, ``phase``,
        ``real``, ``imag`` and so on, with unit, sign and factor where the file does not say
        them. Columns that bear these names need no map.
    quantity : str, optional
        Which of the six standard quantities the response is; by default it follows from the unit.
    frequency : float, optional
        Hz, for a table that does not say it. Without it such a table can be used with
        rate-independent laws only.
    sweep : str, optional
        Frequencies of all rows, for a table without a column of them, as some analysers write it:
        ``"1:100Hz log"`` or ``"0:800Hz linear"``.
    amplitude, drive : str, optional
        One displacement (velocity, acceleration) or force amplitude for the whole file, such
        as ``"5 um rms"`` or ``"0.2 N"``. Braces are filled from the file's name: see
        `level_from_name`.
    drive_factor : str, optional
        Force for one unit of a drive in V or A, such as ``"12.5 N/V"``.
    drive_factor_uncertainty : float, optional
        Its relative standard uncertainty; all rows share it, so the table carries it in addition to
        the covariance.
    level : str or float, optional
        Label for all rows.
    level_from_name : str, optional
        Regular expression on the file's name; its first group is the level. Together with
        ``drive="{level} N"`` it is the drive as well; a named group fills its own braces.
    run : str, optional
        Label of the run, for all rows; braces are filled as in `drive`.
        Without it a column ``run``, ``test``, ``file`` or ``day`` is taken, and of several files
        each is a run under its own name, or a level if each holds one level that no other holds.
    controlled : {"displacement", "force"} or mapping, optional
        The controlled quantity; a mapping gives a pattern of level labels for each.
    frequency_hz : (low, high), optional
        Read this range only.
    sheet : str, optional
        Sheet of an Excel workbook.
    passive : bool
        Whether to refuse a table that creates energy as a whole. Turn it off only for
        structures with a motor in the loop.

    Returns
    -------
    FrequencyResponse
        With provenance and the assumptions that were made.

    Raises
    ------
    DataError, UnitError
        Naming file, row and column, and what to do.
    MissingDependencyError
        If the format needs a package that is not installed.

    Warns
    -----
    DataWarning
        Where values can be used but look wrong; it lists the rows.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import mkdtemp
    >>> table = Path(mkdtemp()) / "pivot.csv"
    >>> _ = table.write_text(
    ...     "frequency_hz,amplitude [um pp],gain [N/mm],phase_deg\n1,20,5,10\n1,40,4,20\n"
    ... )
    >>> read_frequency_response(table).amplitude
    array([1.e-05, 2.e-05])
    """
    entries = {name: value for name, value in locals().items() if name in SETTINGS}
    if level is not None and level_from_name is not None:
        raise ValidationError("level and level_from_name are both given; leave out one of them")
    if isinstance(path, (str, Path)) or is_frame(path) or not isinstance(path, Iterable):
        paths = [path]
    else:
        paths = [*path]
    if not paths:
        raise DataError("no file to read; expected at least one path")
    refuse_repeated(paths)
    mapped = column_map(columns, **entries)
    parts = []
    for one in paths:
        groups = groups_in_name(one, level_from_name)
        options = ResponseOptions(
            frequency=frequency,
            amplitude=_filled("amplitude", amplitude, groups, one),
            drive=_filled("drive", drive, groups, one),
            level=groups.get("level", level),
            run=_filled("run", run, groups, one),
            frequency_hz=frequency_hz,
            passive=passive,
        )
        stated = _options_given(columns=columns, **entries, sheet=sheet, **vars(options))
        part = response_from(open_source(one, sheet, stated), mapped, options)
        for name, label, labels in (("level", level, part.level), ("run", options.run, part.run)):
            if label is not None and labels is not None and any(v != label for v in labels):
                raise DataError(
                    f"{one}: {argument(name, label)} is given, but the table has its own {name}s; "
                    "leave it out"
                )
        parts.append(part)
    if len(parts) == 1:
        saved = (parts[0].provenance or {}).get("origin") if is_frame(paths[0]) else None
        return parts[0] if saved is None else replace(parts[0], provenance=saved)
    try:
        return FrequencyResponse.concatenate(labelled(parts, run_names(paths)))
    except ValidationError as exc:
        raise DataError(f"the files do not make one table: {exc}") from exc


def read_record(
    path: PathLike | pd.DataFrame | Sequence[Mapping[str, Any]],
    *,
    columns: Columns | None = None,
    time: str | Mapping[str, Any] | None = None,
    displacement: str | Mapping[str, Any] | None = None,
    velocity: str | Mapping[str, Any] | None = None,
    acceleration: str | Mapping[str, Any] | None = None,
    force: str | Mapping[str, Any] | None = None,
    drive: str | Mapping[str, Any] | None = None,
    drive_factor: str | None = None,
    drive_factor_uncertainty: float | None = None,
    sample_rate: float | None = None,
    sheet: str | None = None,
    missing: Literal["error", "drop"] = "error",
) -> Record:
    r"""Read sampled waveforms of motion and force.

    Parameters
    ----------
    path : path, pandas.DataFrame, or list of dict
        File; ``"-"`` is standard input. A table in memory has its units in its column names. A
        list of dictionaries is SDyPy's time series: ``name``, ``data``, ``unit_str`` and ``fs``
        or ``time`` for each channel.
    columns : mapping or path of a TOML file, optional
        Column map of the roles below.
    time, displacement, velocity, acceleration, force, drive : str or mapping, optional
        Name of a column, with its unit in brackets where the file does not say it
        (``"x [mm]"``), or a table as in a column map. Exactly one motion is read.
    drive_factor : str, optional
        Force for one unit of a drive in V or A, such as ``"12.5 N/V"``.
    drive_factor_uncertainty : float, optional
        Its relative standard uncertainty.
    sample_rate : float, optional
        Hz, for files without a time column.
    sheet : str, optional
        Sheet of an Excel workbook.
    missing : {"error", "drop"}
        Whether samples with an empty or NaN cell are refused, or left out as gaps in time.

    Returns
    -------
    Record
        With provenance and the assumptions that were made.

    Raises
    ------
    DataError, UnitError
        Naming file, row and column, and what to do.
    MissingDependencyError
        If the format needs a package that is not installed.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import mkdtemp
    >>> run = Path(mkdtemp()) / "run.csv"
    >>> _ = run.write_text("t;LVDT;F\ns;mm;kN\n0,0;1,5;2\n0,1;1,6;3\n")
    >>> read_record(run, displacement="LVDT").force
    array([2000., 3000.])
    """
    return next(record_pieces(samples=None, **locals()))


def record_pieces(
    path: PathLike | pd.DataFrame | Sequence[Mapping[str, Any]],
    samples: int | None,
    *,
    columns: Columns | None = None,
    sheet: str | None = None,
    missing: Literal["error", "drop"] = "error",
    **roles: Any,
) -> Iterator[Record]:
    """Yield a record in pieces of at most so many `samples`, each read only when asked for."""
    one_of(missing, "missing", ("error", "drop"))
    if roles.get("time") is not None and roles.get("sample_rate") is not None:
        raise ValidationError("time and sample_rate are both given; leave out one of them")
    source = open_source(path, sheet, _options_given(columns=columns, sheet=sheet, **roles))
    mapped = column_map(columns, **roles)
    n = 0 if samples is None else record_size(source, mapped)
    pieces = 1 if samples is None else max(1, -(-n // samples))
    if pieces == 1:
        yield record_from(source, mapped, missing)
        return
    for start, stop in pairwise(i * n // pieces for i in range(pieces + 1)):
        channels = (c.part(slice(start, stop)) if c.size == n else c for c in source.channels)
        row_name = partial(lambda first, row: source.row_name(first + row), start)
        part = replace(source, channels=tuple(channels), row_name=row_name)
        record = record_from(part, mapped, missing)
        if mapped.sample_rate is not None:
            record = replace(record, time=record.time + start / mapped.sample_rate)
        yield record


def is_frame(path: Any) -> TypeIs[pd.DataFrame]:
    """Return whether this is a table in memory, without importing pandas."""
    return hasattr(path, "iloc")


def inspect(path: PathLike, *, sheet: str | None = None) -> FileContents:
    r"""List the contents of a file, and propose a column map for it.

    Parameters
    ----------
    path : path
        File; ``"-"`` is standard input.
    sheet : str, optional
        Sheet of an Excel workbook.

    Returns
    -------
    FileContents
        Prints as a list of channels with shapes, units and ranges, the sampling and its gaps,
        and the proposed map in TOML.

    Raises
    ------
    DataError
        If the file cannot be read.
    MissingDependencyError
        If the format needs a package that is not installed.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import mkdtemp
    >>> run = Path(mkdtemp()) / "run.csv"
    >>> _ = run.write_text("time [s],x [mm],F [kN]\n0,1,2\n0.1,2,3\n0.2,1,2\n")
    >>> inspect(run).sampling
    '10 Hz, even, 3 samples in 0.2 s'
    """
    return contents(open_source(path, sheet))


def open_source(
    path: PathLike | pd.DataFrame | Sequence[Mapping[str, Any]],
    sheet: str | None = None,
    options: Mapping[str, Any] | None = None,
) -> RawFile:
    """Return the channels of a file of any format, with the user's options."""
    if is_frame(path) or (isinstance(path, Iterable) and not isinstance(path, str)):
        from dahl_ident.data.readers.tables import dictionary_source, frame_source

        source = frame_source(path) if is_frame(path) else dictionary_source(path)
        return replace(source, options=options or {})
    file = open_file(path)
    if sheet is not None and file.format not in ("excel", "ods"):
        raise DataError(
            f"{file.name}: {argument('sheet', sheet)} is given, but the file is not a workbook"
        )
    source = _parsed(file, sheet)
    for message in source.warnings:
        warnings.warn(f"{file.name}: {message}", DataWarning, stacklevel=3)
    return replace(source, options=options or {})


def _parsed(file: File, sheet: str | None) -> RawFile:
    form = FORMATS[file.format]
    module, _, name = form.reader.partition(".")
    read = getattr(import_module(f"{__name__}.{module}"), name)  # each imported when first used
    try:
        source: RawFile = read(file, sheet) if name == "read_workbook" else read(file)
    except DahlIdentError:
        raise
    except MemoryError as exc:
        raise DataError(
            f"{file.name}: reading takes more memory than is available; expected a smaller table. "
            "Cut the file into parts"
        ) from exc
    except Exception as exc:  # libraries raise errors of every kind on damaged files
        if not form.damaged:
            raise
        raise DataError(f"{file.name}: {form.damaged} is damaged: {exc}") from exc
    return source


def _options_given(**options: Any) -> dict[str, Any]:
    return {
        name: plain_data(value)
        for name, value in options.items()
        if value is not None and (name, value) != ("passive", True)
    }


def run_names(paths: Sequence[PathLike | pd.DataFrame]) -> list[str]:
    """Return a label for each of several files: its name, or its path where names are equal."""
    if any(is_frame(path) for path in paths):
        return [str(i + 1) for i in range(len(paths))]
    names = [Path(str(path)).name for path in paths]
    stems = [Path(name).stem for name in names]
    for labels in (stems, names):
        if len(set(labels)) == len(paths):
            return labels
    return [str(path) for path in paths]


def refuse_repeated(sources: Sequence[Any]) -> None:
    """Refuse a file that is named twice, because its rows would count twice."""
    seen: set[Path] = set()
    for source in sources:
        if isinstance(source, (str, Path)):
            try:
                resolved = Path(source).resolve()
            except ValueError as exc:
                raise DataError(f"{source!r} is not the name of a file: {exc}") from exc
            if resolved in seen:
                raise DataError(f"{source}: the file is named twice; expected each file once")
            seen.add(resolved)


def groups_in_name(path: PathLike | pd.DataFrame, expression: str | None) -> dict[str, Any]:
    """Return the groups that a regular expression finds in a file's name, including the level."""
    if expression is None:
        return {}
    name = Path(str(path)).name if not is_frame(path) else "the table"
    try:
        match = re.search(expression, name)
    except (re.error, TypeError) as exc:
        raise DataError(
            f"level_from_name {expression!r} is not a regular expression: {exc}"
        ) from exc
    if match is None or not match.re.groups:
        raise DataError(
            f"{name}: level_from_name {expression!r} finds no group in the name; put the level in "
            "round brackets, such as '([0-9.]+)N'"
        )
    groups: dict[str, Any] = {k: v for k, v in match.groupdict().items() if v is not None}
    level = str(groups.get("level", match[1]))
    try:
        return groups | {"level": float(level)}
    except ValueError:
        return groups | {"level": level}


def _filled(
    name: str, text: str | None, groups: Mapping[str, Any], path: PathLike | pd.DataFrame
) -> Any:
    """Return a text with its braces filled; not by str.format, which would reach attributes."""
    if not isinstance(text, str | None):
        raise ValidationError(f"{name} is {text!r}; expected text")
    parts = re.split(r"\{(\w+)\}", text or "")
    absent = [name for name in parts[1::2] if name not in groups]
    if absent or any(mark in part for part in parts[0::2] for mark in "{}"):
        raise DataError(
            f"{path}: {text!r} cannot be filled from the file's name: level_from_name gives "
            f"{sorted(groups) or 'nothing'}"
        )
    return text and "".join(str(groups[p]) if i % 2 else p for i, p in enumerate(parts))
