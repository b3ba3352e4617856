"""The public function that runs the missing fits of a campaign and writes its table.

The journal has one line for each fit, and the table is made from these lines. After a crash the
last line may be incomplete; it is dropped when the file is opened again. Only the keys and the
positions of the lines are held in memory.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeVar

from dahl_ident.arrays import positive_number, whole_number
from dahl_ident.campaigns.definition import Definition, Task, read_definition
from dahl_ident.campaigns.engine import (
    PATIENCE,
    Limits,
    Local,
    LostError,
    Place,
    Scheduler,
    default_workers,
    run_jobs,
)
from dahl_ident.campaigns.worker import Job, Row, digest_of
from dahl_ident.data.storage import (
    as_before_inert,
    inert,
    locked,
    make_folder,
    place_of,
    put_in_place,
    read_text,
    regular,
    with_texts,
    write_whole,
)
from dahl_ident.errors import DataError, ModelError, argument
from dahl_ident.version import __version__

if TYPE_CHECKING:
    import pandas as pd

    from dahl_ident.elements.law_module import LawFile

_Tag = TypeVar("_Tag")
_JOURNAL = "journal.jsonl"
_TRIAL_FITS = 3  # fits that show whether the options of a new campaign can be used at all
_ROWS_AT_ONCE = 2000  # rows held as dictionaries, which take ten times the memory of a table
_JOURNAL_ONLY = ("key", "retry", "refused")
_FIRST_COLUMNS = ("device", "run", "status", "error", "statements")


@dataclass(frozen=True)
class Campaign:
    """The results of a campaign, or after a dry run the list of fits that it would run.

    Attributes
    ----------
    folder : Path
        Holds ``results.csv``, ``results.parquet`` (with pyarrow) and ``reports/``.
    finished : tuple of str
        Fits whose results existed already, by device and run.
    to_do : tuple of str
        Fits that were missing, or whose files had changed; done unless this was a dry run.
    statuses : mapping of str to int
        Number of fits that ended with each status, "failed" included.

    Examples
    --------
    >>> print(Campaign(Path("results"), ("d1",), ("d2", "d3"), {"trusted": 2, "failed": 1}))
    1 fits finished before, 2 to do; 2 trusted, 1 failed
    """

    folder: Path
    finished: tuple[str, ...]
    to_do: tuple[str, ...]
    statuses: Mapping[str, int]

    @cached_property
    def table(self) -> pd.DataFrame:
        """The results, one row per fit."""
        import pandas as pd

        path = self.folder / "results.csv"
        if not path.exists():
            raise DataError(f"{path}: there is no table yet; run the campaign, not a dry run")
        return with_texts(pd.read_csv(path, dtype={"device": str, "run": str}), as_before_inert)

    def report(
        self,
        path: str | Path,
        *,
        covariates: Sequence[str] = (),
        order: str | None = None,
        title: str = "Campaign",
        overwrite: bool = False,
    ) -> Path:
        """Write a report on the devices: population, control charts, failures, all fits.

        Parameters
        ----------
        path : path
            Ending in ``.html`` or ``.pdf``.
        covariates, order
            As for :func:`dahl_ident.population`.
        title : str
            First line.
        overwrite : bool, default False
            Replace an existing report.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        ValidationError
            If `path` has another ending.
        DataError
            If there is no table yet, a column is missing, or the file exists and `overwrite` is
            not set.
        """
        from dahl_ident.campaigns.campaign_report import FORMATS, campaign_document
        from dahl_ident.campaigns.population import (
            USABLE,
            fewest_devices,
            population,
            with_final_status,
        )
        from dahl_ident.reporting.publish import content_of

        place = place_of(path, "a campaign's report", FORMATS)
        table = with_final_status(self.table)
        n = table.loc[table["status"].isin(USABLE), "device"].nunique()
        enough = n >= fewest_devices(covariates)
        evaluated = population(table, covariates=covariates, order=order) if enough else None
        reports = Path(os.path.relpath(self.folder / "reports", place.parent)).as_posix()
        document = campaign_document(table, evaluated, title, reports)
        write_whole(place, content_of(document, place.suffix.lower()), overwrite=overwrite)
        return place

    def __str__(self) -> str:
        counted = ", ".join(f"{count} {status}" for status, count in self.statuses.items())
        return (
            f"{len(self.finished)} fits finished before, {len(self.to_do)} to do"
            f"{f'; {counted}' if counted else ''}"
        )


def campaign(
    source: str | Path | Mapping[str, Any],
    *,
    jobs: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    timeout: float | None = None,
    memory: float | None = None,
    patience: float = PATIENCE,
    send_files: bool = False,
    dry_run: bool = False,
    redo: bool = False,
    progress: Callable[[int, int, Mapping[str, Any]], None] | None = None,
) -> Campaign:
    """Read, extract and fit the files of many devices; one row of a table for each fit.

    The key of a result is a digest of everything that it depends on: the files, the options and the
    version. When a campaign is run again, only missing fits are computed, and those whose files
    have changed.

    Parameters
    ----------
    source : path or mapping
        TOML file, or its content; see :mod:`dahl_ident.campaigns.definition`.
    jobs : int, optional
        Number of processes on this machine, with one numerical thread each; by default the number
        of processors. With an executor or a scheduler: the number of fits at a time.
    executor : concurrent.futures.Executor, optional
        Runs the fits instead.
    scheduler : str, optional
        Address of a Dask scheduler whose workers run the fits instead, ``tls://host:8786``.
    timeout : float, optional
        Seconds after which the fit of a device is stopped, reading included. By default ten times
        the median of the fits so far, at least 60 s; 600 s until three fits have ended.
    memory : float, optional
        GB that the process of a fit may use, where the system can limit it (Linux). By default
        the memory of the machine shared between the jobs, at least 2 GB; elsewhere that of the
        worker's machine.
    patience : float, default 120
        Seconds without an answer after which the scheduler or the executor is given up; for an
        executor they are counted from the end of `timeout`.
    send_files : bool, default False
        Send the contents of the files to workers that cannot access the paths.
    dry_run : bool, default False
        List what would be done, and do nothing.
    redo : bool, default False
        Allow options or version to differ from those of existing results; all fits are then
        repeated.
    progress : callable, optional
        Called after each fit with the number done, the number to do and the new row.

    Returns
    -------
    Campaign
        The location of the results, and the number of fits with each status. A device that fails is
        a row with its error.

    Raises
    ------
    DataError
        If the definition is wrong in any part; if the first fits all fail because of the options
        or the model; if options changed and `redo` is not set; if another process runs the
        same campaign; or if the scheduler or the executor does not answer any more: results until
        then are in the table, and the same call does the others.
    ModelError
        If a law of the model is defined in an interactive session, which no process can import.
    ValidationError
        If `jobs` is not a whole number of at least 1, a limit is not a positive number, no
        scheduler answers, or its workers have another version of this package.

    Notes
    -----
    Each fit runs in a separate process. If the model has laws that a script defines, that process
    runs the script again, so the script must call this under ``if __name__ == "__main__":``.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> import dahl_ident as di
    >>> from dahl_ident.synthetic import load_dataset
    >>> folder = Path(mkdtemp())
    >>> for name in ("clean", "noisy"):
    ...     _ = load_dataset(name).save(folder / f"{name}.csv")
    >>> definition = {
    ...     "files": {"pattern": f"{folder.as_posix()}/{{device}}.csv", "kind": "response"},
    ...     "model": [{"kind": "dahl"}],
    ...     "output": {"folder": f"{folder}/results"},
    ... }
    >>> campaign(definition, jobs=1).table[["device", "sigma"]].round(1).to_dict("list")
    {'device': ['clean', 'noisy'], 'sigma': [30.0, 30.0]}
    """
    definition = read_definition(source)
    for name, limit in (("timeout", timeout), ("memory", memory)):
        if limit is not None:
            positive_number(limit, name)
    workers = None if jobs is None else whole_number(jobs, "jobs", 1)
    folder, laws = definition.folder, _laws(definition)
    if dry_run:
        tasks = _by_key(definition)
        agree = _options_agree(definition, redo)
        return _before(definition, tasks, read_journal(folder / _JOURNAL)[0] if agree else ())
    make_folder(folder)
    if (table := folder / "results.csv").exists() and not (folder / _JOURNAL).exists():
        raise DataError(
            f"{definition.source}: {table} exists, and is not of a campaign; move it away, or give "
            "another folder in [output]"
        )
    lost: LostError | None = None
    with locked(folder / _JOURNAL, DataError):
        agree = _options_agree(definition, redo)
        with closing(Journal(folder / _JOURNAL)) as journal:
            limits = Limits(timeout, memory, journal.seconds)
            tasks = _by_key(definition)
            before = _before(definition, tasks, journal.places)
            missing = [key for key in tasks if key not in journal.places]
            work = ((key, _job(definition, tasks[key], send_files, laws)) for key in missing)
            if scheduler is not None:
                place: Place = Scheduler(scheduler, workers)
            elif executor is not None:
                place = Place(workers or default_workers(), executor)
            else:
                place = Local(workers or default_workers())
            with closing(place):
                done = run_jobs(work, place, limits, patience)
                if not agree:
                    done = _unless_refused(done, min(_TRIAL_FITS, len(missing)), definition.source)
                try:
                    for number, (key, row) in enumerate(done, start=1):
                        if not agree:
                            write_whole(
                                folder / "options.json", _options(definition), overwrite=True
                            )
                            agree = True
                        journal.add(key, row)
                        if progress is not None:
                            progress(number, len(missing), row)
                except LostError as exc:
                    lost = exc
            available = [key for key in tasks if key in journal.places]
            rows = zip(available, journal.rows(available), strict=True)
            statuses = write_tables((_table_row(tasks[key], row) for key, row in rows), folder)
    if lost is not None:
        raise DataError(
            f"{lost}; {len(available)} of {len(tasks)} fits are in {folder / 'results.csv'}, and "
            "the same command does the others"
        ) from lost
    return replace(before, statuses=statuses)


def _laws(definition: Definition) -> tuple[str | LawFile, ...]:
    """Return the modules and files that define the model's laws, other than this package's."""
    from dahl_ident.elements.element import model_from_description
    from dahl_ident.elements.law_files import user_laws
    from dahl_ident.elements.law_module import LawFile, file_of, source_path

    sources: dict[str | LawFile, None] = {}
    for law in user_laws(model_from_description(definition.options["model"]).elements):
        file, path = file_of(law), source_path(law)
        if path is None:
            raise ModelError(
                f"{definition.source}: the law {law.kind!r} is defined in an interactive session; "
                "put it into a file, and give that as laws"
            )
        if law.__module__ == "__main__":
            file = LawFile(path, read_text(path))
        sources[file or law.__module__] = None
    return tuple(sources)


def _unless_refused(
    done: Iterator[tuple[_Tag, Row]], trials: int, source: str
) -> Iterator[tuple[_Tag, Row]]:
    """Pass rows on; raise an error if the first `trials` all refuse the options or the model.

    One such row is not enough: the options may be wrong for the data of one device only.
    """
    first: list[tuple[_Tag, Row]] = []
    for tagged in done:
        first.append(tagged)
        errors = {row.get("error", "") for _, row in first}
        if len(errors) == 1 and all(row.get("refused") for _, row in first):
            if len(first) < trials:
                continue
            raise DataError(f"{source}: the first fits all fail: {tagged[1]['error']}")
        yield from first
        break
    yield from done


def _table_row(task: Task, row: dict[str, Any]) -> dict[str, Any]:
    row = {name: value for name, value in row.items() if name not in _JOURNAL_ONLY}
    labels = {"device": task.device} | ({"run": task.run} if task.run else {})
    return {**labels, **task.covariates, **row, "version": __version__}


def _before(definition: Definition, tasks: Mapping[str, Task], keys: Container[str]) -> Campaign:
    """Return the campaign before it runs, with the results of some keys."""
    finished = tuple(task.name for key, task in tasks.items() if key in keys)
    to_do = tuple(task.name for key, task in tasks.items() if key not in keys)
    return Campaign(definition.folder, finished, to_do, {})


def _job(
    definition: Definition, task: Task, send_files: bool, laws: tuple[str | LawFile, ...]
) -> Job:
    contents: list[bytes | None] = [None] * len(task.files)
    if send_files:
        with suppress(OSError, DataError):  # the worker then says what is wrong with the path
            contents = [regular(path).read_bytes() for path in task.files]
    files = tuple(zip(map(str, task.files), contents, strict=True))
    report = str(definition.folder / "reports" / f"{task.name}.html")
    place = report if definition.reports else None
    return Job(task.name, files, task.runs, definition.options, place, laws)


def _options(definition: Definition) -> bytes:
    content = {"version": __version__, **definition.options}
    return json.dumps(content, indent=2, sort_keys=True).encode()


def _options_agree(definition: Definition, redo: bool) -> bool:
    """Return whether the folder holds results with these options; others need `redo`."""
    path = definition.folder / "options.json"
    if not path.exists():
        return False
    try:
        before = dict(json.loads(path.read_bytes()))
    except (OSError, ValueError, TypeError) as exc:
        raise DataError(f"{path}: cannot be read: {exc}") from exc
    now = json.loads(_options(definition))
    changed = [
        f"{name} was {json.dumps(before.get(name))}, now {json.dumps(now.get(name))}"
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    ]
    if changed and not redo:
        raise DataError(
            f"{definition.source}: {'; '.join(changed)}, but {definition.folder} holds results of "
            f"the former; give another folder, or repeat all of them with {argument('redo', True)}"
        )
    return not changed


def _by_key(definition: Definition) -> dict[str, Task]:
    """Return the tasks by their keys.

    A file's digest is computed again only if its size or modification time differs from that stored
    with the last digest.
    """
    cache_path = definition.folder / "digests.json"
    try:
        cache = json.loads(cache_path.read_bytes())
    except (OSError, ValueError):
        cache = {}
    digests: dict[str, list[Any]] = {}
    tasks = {}
    for task in definition.tasks:
        file_digests = []
        for path in task.files:
            try:
                state = path.stat()
                entry = cache.get(str(path))
                if entry is None or entry[:2] != [state.st_size, state.st_mtime_ns]:
                    entry = [state.st_size, state.st_mtime_ns, digest_of(path)]
                digests[str(path)] = entry
            except (OSError, DataError):
                entry = [0, 0, "unreadable"]  # a row that says so, until it can be read
            file_digests.append(entry[2])
        tasks[definition.key([task.name, *task.runs, *file_digests], __version__)] = task
    if definition.folder.is_dir() and digests != cache:
        write_whole(cache_path, json.dumps(digests).encode(), overwrite=True)
    return tasks


class Journal:
    """The journal of one campaign: positions of lines by key, and the seconds of each fit."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.places, self.seconds, end = read_journal(path)
        try:
            self._file: IO[bytes] = path.open("r+b" if path.exists() else "w+b")
            self._file.truncate(end)
            self._file.seek(end)
        except OSError as exc:
            raise DataError(f"{path}: cannot be written: {exc.strerror or exc}") from exc

    def add(self, key: str, row: Mapping[str, Any]) -> None:
        """Append one result, and pass it to the operating system."""
        line = json.dumps({"key": key, **row}, ensure_ascii=False).encode() + b"\n"
        self.places[key] = self._file.tell()
        self._file.write(line)
        self._file.flush()

    def rows(self, keys: Iterable[str]) -> Iterator[dict[str, Any]]:
        """Yield results by key, in the order asked for."""
        with self._path.open("rb") as file:
            for key in keys:
                file.seek(self.places[key])
                yield json.loads(file.readline())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_journal(path: Path) -> tuple[dict[str, int], list[float], int]:
    """Return the position of each finished key's line, seconds, and the end of the last line.

    A fit that may have failed because of something other than its device is not finished: a process
    or a worker that died, files that a worker cannot access, a limit of time or memory.
    """
    places: dict[str, int] = {}
    seconds: list[float] = []
    end = 0
    if not path.exists():
        return places, seconds, end
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            if not line.endswith(b"\n"):
                break
            try:
                row = json.loads(line)
                if not row.get("retry"):
                    places[row["key"]] = end
                if row["status"] != "failed":
                    seconds.append(float(row["seconds"]))
            except (ValueError, KeyError, AttributeError, TypeError):
                raise DataError(
                    f"{path}: line {number} is not a result of a campaign; move the file away to "
                    "start again"
                ) from None
            end += len(line)
    return places, seconds, end


def write_tables(rows: Iterable[Mapping[str, Any]], folder: Path) -> dict[str, int]:
    """Write ``results.csv`` and, with pyarrow, ``results.parquet``; return counts of statuses."""
    import pandas as pd

    flat = ({name: _plain(value) for name, value in row.items()} for row in rows)
    blocks = iter(lambda: list(islice(flat, _ROWS_AT_ONCE)), [])
    table = pd.concat([pd.DataFrame(), *map(pd.DataFrame, blocks)], ignore_index=True)
    first = [name for name in _FIRST_COLUMNS if name in table]
    table = table[[*first, *sorted(map(str, set(table) - set(first)))]]
    is_number = pd.api.types.is_numeric_dtype
    table = table.astype({c: "float64" if is_number(table[c]) else "string" for c in table})
    writers: dict[str, Callable[[Path], object]] = {
        "results.csv": partial(inert(table).to_csv, index=False, lineterminator="\n")
    }
    if find_spec("pyarrow") is not None:
        writers["results.parquet"] = partial(table.to_parquet, engine="pyarrow", index=False)
    for name, write in writers.items():
        path = folder / name
        try:
            put_in_place(path, write)
        except OSError as exc:
            raise DataError(f"{path}: cannot be written: {exc.strerror or exc}") from exc
    return dict(Counter(table["status"].tolist())) if len(table) else {}


def _plain(value: Any) -> Any:
    """Return the value of a cell: a number or a text."""
    if isinstance(value, list):
        return " | ".join(map(str, value))
    is_count = isinstance(value, int) and not isinstance(value, bool)
    return float(value) if is_count else value
