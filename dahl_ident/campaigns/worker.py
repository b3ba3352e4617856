"""One fit of a campaign in a separate process: from files to a row, with limits.

Each fit has a separate process, whether it runs on this machine, in a thread of an executor or on
a worker of a cluster. A fit that hangs, needs too much memory or kills its process therefore ends
as a row, and nothing else is lost. Jobs are sent through standard input and rows returned through
standard output, as pickles. The calling script is not imported, only the files of its laws.
Numerical libraries are imported inside functions, so that this module loads quickly.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import importlib
import math
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from dahl_ident.errors import DataError, ModelError, ValidationError
from dahl_ident.version import __version__

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse
    from dahl_ident.elements.law_module import LawFile
    from dahl_ident.results import FitResult

Row = dict[str, Any]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_DEATHS = 3  # worker processes that may die on a job before the job itself is taken as the cause
_START = "import sys; sys.path[:] = {!r}; from dahl_ident.campaigns.worker import serve; serve()"


@dataclass(frozen=True)
class Job:
    """What a process needs to do one fit; plain data."""

    name: str  # device and run
    # paths, with the contents if these are sent with the job
    files: tuple[tuple[str, bytes | None], ...]
    runs: tuple[str, ...]  # label of each file
    options: Mapping[str, Any]  # of :class:`dahl_ident.campaigns.definition.Definition`
    report: str | None  # path of its report
    # modules, or files with their contents, that define laws of the model
    laws: tuple[str | LawFile, ...] = ()
    version: str = __version__  # that of the package that made the job


class UnseenError(DataError):
    """A file that cannot be read on the machine that does the fit; perhaps it can on another."""


def failed(error: str, *, retry: bool = False, refused: bool = False, seconds: float = 0.0) -> Row:
    """Return the row of a fit that failed.

    With `retry`, running the campaign again repeats it; `refused` says that the options or the
    model are wrong.
    """
    row = {"status": "failed", "error": error, "digests": [], "seconds": seconds}
    return row | {"retry": retry, "refused": refused}


def do(job: Job) -> Row:
    """Return the row of one fit; a failure is a row with the reason."""
    start = time.perf_counter()
    digests: list[str] = []
    try:
        from dahl_ident.elements.element import laws_of

        for law in job.laws:
            if isinstance(law, str):
                importlib.import_module(law)
            else:
                laws_of(law)
        row = _fitted(job, digests)
    except UnseenError as exc:
        row = failed(
            f"{exc}; where workers do not have the files, send them with send_files=True (on the "
            "command line --send-files)",
            retry=True,
        )
    except MemoryError as exc:
        row = failed(
            f"the limit of memory for a device does not suffice ({' '.join(str(exc).split())}); "
            "give it more with memory= (on the command line --memory)",
            retry=True,
        )
    except Exception as exc:  # no failure of one device may end the campaign
        refused = isinstance(exc, (ValidationError, ModelError))
        row = failed(f"{type(exc).__name__}: {' '.join(str(exc).split())}", refused=refused)
    return {**row, "digests": digests, "seconds": time.perf_counter() - start}


def _fitted(job: Job, digests: list[str]) -> Row:
    """Return the row of a fit; write its report, and append the digests of its files."""
    from dahl_ident.elements.element import model_from_description
    from dahl_ident.results import fit, posterior

    options = job.options
    with _on_disk(job, digests) as paths:
        data = _response(paths, job.runs, options)
    model = model_from_description(options["model"])
    result = fit(data, model, throw=False, **options["fit"])
    row = _row(result)
    results: list[Any] = [result]
    if options["posterior"] is not None:
        sampled = posterior(data, model, seed=0, **options["posterior"])
        results.append(sampled)
        for name, estimate in sampled.params.items():
            row[f"posterior_{name}"] = estimate.value
            row[f"u_posterior_{name}"] = estimate.stderr
    if job.report is not None:
        from dahl_ident.reporting import report

        path = Path(job.report)
        path.parent.mkdir(parents=True, exist_ok=True)
        report(results, path, title=job.name, overwrite=True)
        row["report"] = path.name
    return row


def _response(
    paths: list[Path], runs: tuple[str, ...], options: Mapping[str, Any]
) -> FrequencyResponse:
    from dahl_ident.data import read_frequency_response, read_record
    from dahl_ident.extraction import extract

    if options["kind"] == "response":
        chosen: Any = paths if len(paths) > 1 else paths[0]
        return read_frequency_response(chosen, **options["read"])
    records = {
        run: read_record(path, **options["read"]) for run, path in zip(runs, paths, strict=True)
    }
    return extract(records, **options["extract"])


@contextmanager
def _on_disk(job: Job, digests: list[str]) -> Iterator[list[Path]]:
    """Yield the paths of the files, and append their digests to a list.

    A file that was sent with the job is in a folder that is removed afterwards.
    """
    with ExitStack() as folders:
        paths = []
        for name, content in job.files:
            path = Path(name)
            if content is not None:
                folder = folders.enter_context(TemporaryDirectory(prefix="campaign_"))
                path = Path(folder) / path.name
                path.write_bytes(content)
            paths.append(path)
            digests.append(digest_of(path))
        yield paths


def digest_of(path: Path) -> str:
    """Return the SHA-256 digest of a regular file."""
    from dahl_ident.data.storage import regular

    try:
        path.stat()  # a missing file may exist on another machine
        with regular(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as exc:
        raise UnseenError(f"{path}: cannot be read: {exc.strerror or exc}") from exc


def _row(result: FitResult) -> Row:
    from dahl_ident.errors import FitError

    row: Row = {
        "status": result.status.value,
        "statements": list(result.statements),
        "assumed": list(result.assumed),
        "points": len(result.data.response),
        "runs": len(result.data.runs or ()) or 1,
    }
    for name, estimate in result.params.items():
        row[name] = estimate.value
        row[f"unit_{name}"] = estimate.unit
        if name in result.assumed and estimate.stderr is not None:
            row[f"u_{name}"] = estimate.stderr
    try:
        budget = result.budget()
    except FitError:  # no finite uncertainty; the statements say why
        return row
    for name, part in budget.items():
        row |= {f"u_{name}": part.u, f"U_{name}": part.U, f"dof_{name}": part.dof}
        for source in part.rows:
            row[f"u_{name}_{source.source.replace(' ', '_')}"] = source.u
    return row


class _Process:
    """A process that does one job at a time."""

    def __init__(self) -> None:
        self._ended = False
        self.path = list(sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START.format(self.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # an interrupt from the keyboard is for the parent process
            env={**os.environ, **dict.fromkeys(THREADS, "1")},
        )

    def do(self, job: Job, seconds: float, memory: float | None) -> Row | None:
        """Return the row of a job; None if the process died. It is killed after `seconds`."""
        content = pickle.dumps((job, memory))
        timed_out = threading.Event()

        def stop() -> None:
            timed_out.set()
            self._process.kill()

        timer = threading.Timer(seconds, stop)
        timer.daemon = True
        timer.start()
        try:
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            self._process.stdin.write(content)
            self._process.stdin.flush()
            row: Row = pickle.load(self._process.stdout)  # what this package wrote itself
        except (EOFError, OSError, ValueError, pickle.UnpicklingError):
            if self._ended:
                return failed("the campaign was ended", retry=True)
            self.end()
            if not timed_out.is_set():
                return None
            return failed(
                f"stopped after {seconds:.3g} s, the limit of time for a device; give it more with "
                "timeout= (on the command line --timeout)",
                retry=True,
                seconds=seconds,
            )
        finally:
            timer.cancel()
        return row

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def end(self) -> int:
        """End the process, and return its exit status."""
        self._ended = True
        self._process.kill()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):  # from flushing what it has not read
                stream.close()
        return self._process.wait()


_idle: list[_Process] = []
_busy: set[_Process] = set()


def do_within(job: Job, seconds: float, memory: float | None) -> Row:
    """Return the row of a job, done in a separate process with limits of time and memory (GB)."""
    if job.version != __version__:
        return failed(
            f"ValidationError: this worker has dahl_ident {__version__}, and the campaign was "
            f"started by {job.version}; install the same version in both places",
            retry=True,
        )
    for _ in range(_DEATHS):
        with _borrowed() as process:
            row = process.do(job, seconds, memory)
        if row is not None:
            return row
    return failed(f"the process that worked on it died {_DEATHS} times", retry=True)


@contextmanager
def _borrowed() -> Iterator[_Process]:
    """Yield an idle process, or a new one; it is idle again afterwards if it is alive."""
    process = _idle.pop() if _idle else _Process()
    if process.path != sys.path:  # it may not find the modules of laws
        process.end()
        process = _Process()
    _busy.add(process)
    try:
        yield process
    finally:
        _busy.discard(process)
    if process.alive:
        _idle.append(process)


def end_busy() -> None:
    """End the processes that are working on a job."""
    for process in tuple(_busy):
        process.end()


def end_idle(keep: int = 0) -> None:
    """End idle processes, except for `keep` of them, which the next campaign can use."""
    while len(_idle) > keep:
        _idle.pop().end()


atexit.register(end_idle)


def serve() -> None:
    """Do the jobs that come through standard input, until it is closed."""
    jobs: SimpleQueue[tuple[Job, float | None]] = SimpleQueue()
    source, rows = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries print to standard error, not between the rows

    def read() -> None:
        with contextlib.suppress(Exception):
            while True:
                jobs.put(pickle.load(source))
        os._exit(1)  # the parent process is gone, perhaps in the middle of a job

    threading.Thread(target=read, daemon=True).start()
    while True:
        job, memory = jobs.get()
        _limit_memory(memory)
        pickle.dump(do(job), rows)
        rows.flush()


def _limit_memory(gigabytes: float | None) -> None:
    """Limit the memory of this process; by default to that of the machine."""
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return
    limit = gigabytes or machine_memory()
    soft = resource.RLIM_INFINITY if math.isinf(limit) else int(1e9 * limit)
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard != resource.RLIM_INFINITY:
        soft = hard if soft == resource.RLIM_INFINITY else min(soft, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def machine_memory() -> float:
    """Return the memory of this machine in GB; infinity if the system does not report it."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (AttributeError, ValueError, OSError):
        return math.inf
