"""Runs jobs, a few at a time: in processes of this machine, in an executor, or with Dask.

Each fit has a limit of time and of memory (:mod:`dahl_ident.campaigns.worker`). If an executor or a
scheduler does not answer, the run waits for it for a limited time, and then ends.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from statistics import median
from typing import Any, TypeVar

from dahl_ident.campaigns import worker
from dahl_ident.campaigns.worker import Job, Row, failed
from dahl_ident.data.storage import library
from dahl_ident.errors import DataError, ValidationError
from dahl_ident.version import __version__

_Tag = TypeVar("_Tag")
PATIENCE = 120.0  # s without an answer after which a worker counts as lost
_WAITING = 2  # jobs submitted for each worker: one in progress, one waiting
_POLL = 1.0  # s between checks while no row arrives
_RESPONSE_TIME = 5.0  # s within which a scheduler must answer
_TIMES_MEDIAN, _LEAST_TIMEOUT = 10.0, 60.0  # default limit of time over the median; its least, s
_FIRST_TIMEOUT, _FEWEST_TIMED = 600.0, 3  # limit, s, until so many fits have ended
_RECENT = 1001  # fits whose median time is taken
_LEAST_MEMORY = 2.0  # least default limit, GB; the imported libraries take some tenths


class LostError(DataError):
    """The executor or scheduler is lost; the rows received before are valid."""


class Limits:
    """How long a fit may take, s, and how much memory it may use, GB."""

    def __init__(
        self,
        timeout: float | None = None,
        memory: float | None = None,
        earlier: Iterable[float] = (),
    ) -> None:
        self._timeout, self.memory = timeout, memory
        self._times = deque(earlier, _RECENT)

    @property
    def seconds(self) -> float:
        """The stated timeout, or ten times the median of the fits so far."""
        if self._timeout is not None:
            return self._timeout
        if len(self._times) < _FEWEST_TIMED:
            return _FIRST_TIMEOUT
        return max(_LEAST_TIMEOUT, _TIMES_MEDIAN * median(self._times))

    def note(self, row: Row) -> None:
        """Count a fit that has ended; one that failed says nothing about the time of others."""
        if row["status"] != "failed":
            self._times.append(row["seconds"])


class Place:
    """An executor that the caller made and ends; its state is known from the rows alone."""

    connections = 1  # number of connections made; jobs submitted on an earlier one are lost
    can_be_polled = False  # whether `answers` says more than False while jobs are running

    def __init__(self, workers: int, executor: Executor) -> None:
        self.workers, self._executor = workers, executor

    def submit(self, job: Job, seconds: float, memory: float | None) -> Future[Row]:
        """Begin a job."""
        try:
            return self._executor.submit(worker.do_within, job, seconds, memory)
        except RuntimeError as exc:  # including BrokenExecutor
            raise LostError(f"{self} takes no jobs any more: {exc}") from exc

    def answers(self) -> bool:
        """Return whether the place is known to work; called when no row arrives for a while."""
        return False

    def close(self) -> None:
        """Release the resources that the place holds."""

    def __str__(self) -> str:
        return "the executor"


class Local(Place):
    """Processes of this machine, each behind a thread that waits for it."""

    def __init__(self, workers: int) -> None:
        super().__init__(workers, ThreadPoolExecutor(workers))

    def submit(self, job: Job, seconds: float, memory: float | None) -> Future[Row]:
        """Begin a job with its share of the memory."""
        share = memory or max(worker.machine_memory() / self.workers, _LEAST_MEMORY)
        return super().submit(job, seconds, share)

    def answers(self) -> bool:
        """Return True: these threads always work."""
        return True

    def close(self) -> None:
        """End all processes except one, which the next campaign can use."""
        self._executor.shutdown(wait=False, cancel_futures=True)
        worker.end_busy()
        self._executor.shutdown(wait=True)
        worker.end_idle(keep=1)


class Scheduler(Place):
    """A Dask scheduler; a lost connection is restored."""

    can_be_polled = True

    def __init__(self, address: str, workers: int | None = None) -> None:
        self._address = address
        try:
            self._client = self._connected()
        except (OSError, ValueError, TypeError, RuntimeError) as exc:  # TypeError: no certificate
            raise ValidationError(f"scheduler {address}: no scheduler answers: {exc}") from exc
        count = workers or sum(self._client.ncores().values()) or 1
        super().__init__(count, self._client.get_executor(pure=False))
        self._refuse_other_versions()

    def _connected(self) -> Any:
        return library("distributed", "dask").Client(self._address, timeout=2.0 * _RESPONSE_TIME)

    def _refuse_other_versions(self) -> None:
        def installed() -> str:  # inside a function, so that its code goes to the workers
            try:
                from dahl_ident.version import __version__ as version
            except ImportError:
                return "no dahl_ident"
            return f"dahl_ident {version}"

        here = f"dahl_ident {__version__}"
        differing = {w: v for w, v in self._client.run(installed).items() if v != here}
        if differing:
            where, version = next(iter(differing.items()))
            self._client.close()
            raise ValidationError(
                f"scheduler {self._address}: {len(differing)} workers differ from this process, "
                f"which has {here}: {where} has {version}; install the same version everywhere"
            )

    def submit(self, job: Job, seconds: float, memory: float | None) -> Future[Row]:
        """Begin a job on a worker; errors of a broken connection are not converted to LostError."""
        return self._executor.submit(worker.do_within, job, seconds, memory)

    def answers(self) -> bool:
        """Return whether the scheduler has workers; reconnect if the connection is lost."""
        try:
            if self._client.status != "running":
                client = self._connected()
                self.close()
                self._client, self._executor = client, client.get_executor(pure=False)
                self.connections += 1
            cores = self._client.sync(
                self._client.scheduler.ncores, callback_timeout=_RESPONSE_TIME
            )
        except Exception:  # any error of a broken connection
            return False
        return bool(cores)

    def close(self) -> None:
        """End the connection."""
        with contextlib.suppress(Exception):
            self._client.close(timeout=_RESPONSE_TIME)

    def __str__(self) -> str:
        return f"the scheduler {self._address}, or all of its workers,"


def run_jobs(
    jobs: Iterable[tuple[_Tag, Job]], place: Place, limits: Limits, patience: float = PATIENCE
) -> Iterator[tuple[_Tag, Row]]:
    """Yield the row of each job as it is completed; jobs are read as they are needed.

    Raises LostError if the place does not answer for `patience` seconds.
    """
    waiting, repeated = iter(jobs), list[tuple[_Tag, Job]]()
    running: dict[Future[Row], tuple[tuple[_Tag, Job], float]] = {}
    last_answer, connections, exhausted = time.monotonic(), place.connections, False
    while True:
        while len(running) < _WAITING * place.workers and not (exhausted and not repeated):
            tagged = repeated.pop() if repeated else next(waiting, None)
            if tagged is None:
                exhausted = True
                break
            try:
                seconds = limits.seconds
                running[place.submit(tagged[1], seconds, limits.memory)] = tagged, seconds
            except LostError:
                raise
            except Exception:  # the connection broke since the last check
                repeated.append(tagged)
                break
        if exhausted and not running and not repeated:
            return
        if not running:
            time.sleep(_POLL)
        received = False
        for future in wait(running, timeout=_POLL, return_when=FIRST_COMPLETED).done:
            tagged, _ = running.pop(future)
            try:
                row = future.result()
            except (CancelledError, BrokenExecutor):  # not the fault of the job
                repeated.append(tagged)
                continue
            except Exception as exc:  # the executor gave up the job
                text = " ".join(str(exc).split())
                row = failed(f"the worker was lost, and the job given up: {text}", retry=True)
            received = True
            limits.note(row)
            yield tagged[0], row
        timeout = patience
        if not place.can_be_polled:
            timeout += max((seconds for _, seconds in running.values()), default=0.0)
        if received or place.answers():
            last_answer = time.monotonic()
        elif time.monotonic() - last_answer > timeout:
            raise LostError(f"{place} has not answered for {timeout:.3g} s")
        if place.connections != connections:
            connections = place.connections
            repeated += [tagged for tagged, _ in running.values()]
            running.clear()


def default_workers() -> int:
    """Return the number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # on Linux
    return len(affinity(0)) if affinity else os.cpu_count() or 1
