"""A process that does fits for another one, which can stop it; and how that one holds it.

Fits run in a process of their own wherever they run: on this machine, in a thread of an executor,
on a worker of a cluster. So a fit that hangs, needs too much memory or kills its process ends as a
row, and nothing else is lost. Jobs go through standard input and rows come back through standard
output, as pickles; nothing of the calling script is imported but the files of its laws.
"""

from __future__ import annotations

import atexit
import contextlib
import math
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Iterator

from dahl_ident.campaigns.work import THREADS, Job, Row, do, failed
from dahl_ident.version import __version__

_DEATHS = 3  # deaths of a process after which its job is taken as the cause
_START = "import sys; sys.path[:] = {!r}; from dahl_ident.campaigns.worker import serve; serve()"


class _Process:
    """A process that does one job at a time."""

    def __init__(self) -> None:
        self._ended = False
        self.path = list(sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START.format(self.path)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            start_new_session=True,  # an interrupt from the keyboard is for whoever asks
            env={**os.environ, **dict.fromkeys(THREADS, "1")},
        )  # fmt: skip

    def do(self, job: Job, seconds: float, memory: float | None) -> Row | None:
        """Return the row of a job, None if the process died; it is killed after some seconds."""
        content = pickle.dumps((job, memory))
        late = threading.Event()

        def stop() -> None:
            late.set()
            self._process.kill()

        clock = threading.Timer(seconds, stop)
        clock.daemon = True
        clock.start()
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
            if not late.is_set():
                return None
            return failed(
                f"stopped after {seconds:.3g} s, the limit of time for a device; give it more with "
                "timeout= (on the command line --timeout)",
                retry=True, seconds=seconds,
            )  # fmt: skip
        finally:
            clock.cancel()
        return row

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def end(self) -> int:
        """End the process, and return how it ended."""
        self._ended = True
        self._process.kill()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):  # what it has not read
                stream.close()
        return self._process.wait()


_idle: list[_Process] = []
_busy: set[_Process] = set()


def do_within(job: Job, seconds: float, memory: float | None) -> Row:
    """Return the row of a job that may take some seconds and GB, done in a process of its own."""
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


@contextlib.contextmanager
def _borrowed() -> Iterator[_Process]:
    process = None
    while process is None and _idle:
        process = _idle.pop()
        if process.path != sys.path:  # it may not find the modules of laws
            process.end()
            process = None
    process = process or _Process()
    _busy.add(process)
    try:
        yield process
    finally:
        _busy.discard(process)
    if process.alive:
        _idle.append(process)


def end_busy() -> None:
    """End processes that are in the middle of a job."""
    for process in tuple(_busy):
        process.end()


def end_idle(keep: int = 0) -> None:
    """End processes that have nothing to do; `keep` stay for the next campaign."""
    while len(_idle) > keep:
        _idle.pop().end()


atexit.register(end_idle)


def serve() -> None:
    """Do the jobs that come through standard input, until it is closed."""
    jobs: list[tuple[Job, float | None]] = []
    there = threading.Semaphore(0)
    source, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries print to standard error, not between the rows

    def read() -> None:
        with contextlib.suppress(Exception):
            while True:
                jobs.append(pickle.load(source))
                there.release()
        os._exit(1)  # whoever asked is gone, perhaps in the middle of a job

    threading.Thread(target=read, daemon=True).start()
    while True:
        there.acquire()
        job, memory = jobs.pop()
        _limit_memory(memory)
        row = do(job)
        pickle.dump(row, answers)
        answers.flush()


def _limit_memory(gigabytes: float | None) -> None:
    """Limit the memory of this process; without a number, to that of the machine."""
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return
    wanted = gigabytes or machine_memory()
    size = resource.RLIM_INFINITY if math.isinf(wanted) else int(1e9 * wanted)
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    if most != resource.RLIM_INFINITY:
        size = most if size == resource.RLIM_INFINITY else min(size, most)
    resource.setrlimit(resource.RLIMIT_DATA, (size, most))


def machine_memory() -> float:
    """Return the memory of this machine in GB; infinite where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (AttributeError, ValueError, OSError):
        return math.inf
