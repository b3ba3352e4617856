"""The public function that runs the missing fits of a campaign and writes its table.

The journal has one line for each fit, and the table is made from these lines. After a crash the
last line may be incomplete; it is dropped when the file is opened again.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeVar

from dahl_ident.arrays import positive_number, whole_number
from dahl_ident.campaigns.definition import Definition, Task, read_definition
from dahl_ident.campaigns.engine import (
    TIMEOUT,
    LostError,
    dask,
    default_workers,
    local,
    local_memory,
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
    with_texts,
    write_whole,
)
from dahl_ident.errors import DataError, ModelError
from dahl_ident.version import __version__

if TYPE_CHECKING:
    import pandas as pd

    from dahl_ident.elements.law_module import LawFile

_Tag = TypeVar("_Tag")
_JOURNAL = "journal.jsonl"
_TRIAL_FITS = 3  # fits that show whether the options of a new campaign can be used at all
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
    timeout: float = TIMEOUT,
    memory: float | None = None,
    dry_run: bool = False,
    progress: Callable[[int, int, Mapping[str, Any]], None] | None = None,
) -> Campaign:
    """Read, extract and fit the files of many devices; one row of a table for each fit.

    The key of a result is a digest of everything that it depends on: the files, the options and the
    version. When a campaign is run again, only missing fits are computed, and those whose files,
    options or version have changed.

    Parameters
    ----------
    source : path or mapping
        TOML file, or its content; see :mod:`dahl_ident.campaigns.definition`.
    jobs : int, optional
        Number of processes on this machine, with one numerical thread each; by default the number
        of processors. With an executor or a scheduler: the number of fits at a time.
    executor : concurrent.futures.Executor, optional
        Runs the fits instead, where the files have the same paths.
    scheduler : str, optional
        Address of a Dask scheduler whose workers run the fits instead, ``tls://host:8786``.
    timeout : float, default 600
        Seconds after which the fit of a device is stopped, reading included.
    memory : float, optional
        GB that the process of a fit may use, where the system can limit it (Linux). By default
        the memory of the machine shared between the jobs, at least 2 GB; elsewhere that of the
        worker's machine.
    dry_run : bool, default False
        List what would be done, and do nothing.
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
        or the model; if another process runs the same campaign; or if the scheduler or the
        executor is lost: results until then are in the table, and the same call does the others.
    ModelError
        If a law of the model is defined in an interactive session, which no process can import.
    ValidationError
        If `jobs` is not a whole number of at least 1, a limit is not a positive number, or no
        scheduler answers.

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
    positive_number(timeout, "timeout")
    if memory is not None:
        positive_number(memory, "memory")
    workers = None if jobs is None else whole_number(jobs, "jobs", 1)
    folder, laws = definition.folder, _laws(definition)
    place = folder / _JOURNAL
    if dry_run:
        return _before(definition, _by_key(definition), _read_journal(place)[0])
    make_folder(folder)
    if (table := folder / "results.csv").exists() and not place.exists():
        raise DataError(
            f"{definition.source}: {table} exists, and is not of a campaign; move it away, or give "
            "another folder in [output]"
        )
    lost: LostError | None = None
    with locked(place, DataError), ExitStack() as stack:
        results, end = _read_journal(place)
        tasks = _by_key(definition)
        before = _before(definition, tasks, results)
        missing = [key for key in tasks if key not in results]
        work = ((key, _job(definition, tasks[key], laws)) for key in missing)
        if scheduler is not None:
            executor, cores = stack.enter_context(dask(scheduler))
            workers = workers or cores
        workers = workers or default_workers()
        if executor is None:
            executor = stack.enter_context(local(workers))
            memory = memory or local_memory(workers)
        done = run_jobs(work, executor, workers, timeout, memory)
        if missing and not before.finished:
            done = _unless_refused(done, min(_TRIAL_FITS, len(missing)), definition.source)
        with _opened(place, end) as journal:
            try:
                for number, (key, row) in enumerate(done, start=1):
                    line = json.dumps({"key": key, **row}, ensure_ascii=False)
                    journal.write(line.encode() + b"\n")
                    journal.flush()
                    results[key] = row
                    if progress is not None:
                        progress(number, len(missing), row)
            except LostError as exc:
                lost = exc
        rows = [_table_row(tasks[key], results[key]) for key in tasks if key in results]
        statuses = _write_tables(rows, folder)
    if lost is not None:
        raise DataError(
            f"{lost}; {len(rows)} of {len(tasks)} fits are in {folder / 'results.csv'}, and "
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


def _job(definition: Definition, task: Task, laws: tuple[str | LawFile, ...]) -> Job:
    report = str(definition.folder / "reports" / f"{task.name}.html")
    place = report if definition.reports else None
    files = tuple(map(str, task.files))
    return Job(task.name, files, task.runs, definition.options, place, laws)


def _by_key(definition: Definition) -> dict[str, Task]:
    """Return the tasks by their keys."""
    tasks = {}
    for task in definition.tasks:
        digests = []
        for path in task.files:
            try:
                digests.append(digest_of(path))
            except DataError:
                digests.append("unreadable")  # a row that says so, until it can be read
        tasks[definition.key([task.name, *task.runs, *digests], __version__)] = task
    return tasks


def _opened(path: Path, end: int) -> IO[bytes]:
    """Return the journal, open for writing after its last whole line, which ends at `end`."""
    try:
        file: IO[bytes] = path.open("r+b" if path.exists() else "w+b")
        file.truncate(end)
        file.seek(end)
    except OSError as exc:
        raise DataError(f"{path}: cannot be written: {exc.strerror or exc}") from exc
    return file


def _read_journal(path: Path) -> tuple[dict[str, Row], int]:
    """Return the finished rows by key, and the end of the last whole line.

    A fit that may have failed because of something other than its device is not finished: a process
    or a worker that died, files that a worker cannot access, a limit of time or memory.
    """
    rows: dict[str, Row] = {}
    end = 0
    if not path.exists():
        return rows, end
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            if not line.endswith(b"\n"):
                break
            try:
                row = json.loads(line)
                if not row.get("retry"):
                    rows[row["key"]] = row
            except (ValueError, KeyError, AttributeError, TypeError):
                raise DataError(
                    f"{path}: line {number} is not a result of a campaign; move the file away to "
                    "start again"
                ) from None
            end += len(line)
    return rows, end


def _write_tables(rows: Sequence[Mapping[str, Any]], folder: Path) -> dict[str, int]:
    """Write ``results.csv`` and, with pyarrow, ``results.parquet``; return counts of statuses."""
    import pandas as pd

    table = pd.DataFrame([{name: _plain(value) for name, value in row.items()} for row in rows])
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
