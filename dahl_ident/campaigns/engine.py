"""Runs jobs in one of three places, a few at a time, and ends whatever becomes of the place.

Processes of this machine, an executor that was given, or a Dask scheduler. Each fit has a limit of
time and of memory (:mod:`dahl_ident.campaigns.worker`). A place that does not answer is waited
for, but not for ever.
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
_LOOK = 1.0  # s between looks at a worker that sent no row
_ANSWER = 5.0  # s in which a scheduler answers
_TIMES_MEDIAN, _LEAST = 10.0, 60.0
_LEAST_MEMORY = 2.0
"""GB that a fit may always have where no limit was given; what is loaded takes some tenths."""
_FIRST, _KNOWN = 600.0, 3
"""Limit of time, s, until this number of fits says how long a fit takes."""
_RECENT = 1001  # fits whose median time is taken


class LostError(DataError):
    """The place where jobs are done is gone; rows that came before are good."""


class Limits:
    """How long a fit may take, s, and how much memory it may use, GB."""

    def __init__(
        self,
        timeout: float | None = None,
        memory: float | None = None,
        earlier: Iterable[float] = (),
    ) -> None:
        self._timeout, self.memory = timeout, memory
        self._took = deque(earlier, _RECENT)

    @property
    def seconds(self) -> float:
        """The time that was given, or ten times the median of the fits so far."""
        if self._timeout is not None:
            return self._timeout
        if len(self._took) < _KNOWN:
            return _FIRST
        return max(_LEAST, _TIMES_MEDIAN * median(self._took))

    def note(self, row: Row) -> None:
        """Count a fit that has ended; one that failed says nothing about the time of others."""
        if row["status"] != "failed":
            self._took.append(row["seconds"])


class Place:
    """An executor that somebody else made and ends; of its state only rows are known."""

    connections = 1  # how often it was connected to; what was under way on an earlier one is lost
    answers_in_between = False  # whether it may be asked while jobs are under way

    def __init__(self, workers: int, executor: Executor) -> None:
        self.workers, self._executor = workers, executor

    def submit(self, job: Job, seconds: float, memory: float | None) -> Future[Row]:
        """Begin a job."""
        try:
            return self._executor.submit(worker.do_within, job, seconds, memory)
        except RuntimeError as exc:  # among them BrokenExecutor
            raise LostError(f"{self} takes no jobs any more: {exc}") from exc

    def answers(self) -> bool:
        """Return whether the place is known to work; asked when no row came for a while."""
        return False

    def close(self) -> None:
        """Give back what the place holds."""

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
        """Return that it works."""
        return True

    def close(self) -> None:
        """End processes, but for one that the next campaign may use."""
        self._executor.shutdown(wait=False, cancel_futures=True)
        worker.end_busy()
        self._executor.shutdown(wait=True)
        worker.end_idle(keep=1)


class Scheduler(Place):
    """A Dask scheduler; a lost connection is made again."""

    answers_in_between = True

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
        return library("distributed", "dask").Client(self._address, timeout=2.0 * _ANSWER)

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
        """Begin a job on a worker; what a broken connection says is not the end of the place."""
        return self._executor.submit(worker.do_within, job, seconds, memory)

    def answers(self) -> bool:
        """Return whether the scheduler has workers; connect again where the connection is lost."""
        try:
            if self._client.status != "running":
                client = self._connected()
                self.close()
                self._client, self._executor = client, client.get_executor(pure=False)
                self.connections += 1
            cores = self._client.sync(self._client.scheduler.ncores, callback_timeout=_ANSWER)
        except Exception:  # whatever a library says about a connection that is broken
            return False
        return bool(cores)

    def close(self) -> None:
        """End the connection."""
        with contextlib.suppress(Exception):
            self._client.close(timeout=_ANSWER)

    def __str__(self) -> str:
        return f"the scheduler {self._address}, or all of its workers,"


def run_jobs(
    jobs: Iterable[tuple[_Tag, Job]], place: Place, limits: Limits, patience: float = PATIENCE
) -> Iterator[tuple[_Tag, Row]]:
    """Yield the row of each job as it is completed; jobs are read as they are needed.

    Raises LostError where the place does not answer for `patience` seconds.
    """
    waiting, again = iter(jobs), list[tuple[_Tag, Job]]()
    under_way: dict[Future[Row], tuple[tuple[_Tag, Job], float]] = {}
    heard, connections, exhausted = time.monotonic(), place.connections, False
    while True:
        while len(under_way) < _WAITING * place.workers and not (exhausted and not again):
            one = again.pop() if again else next(waiting, None)
            if one is None:
                exhausted = True
                break
            try:
                seconds = limits.seconds
                under_way[place.submit(one[1], seconds, limits.memory)] = one, seconds
            except LostError:
                raise
            except Exception:  # a connection that broke between two looks at it
                again.append(one)
                break
        if exhausted and not under_way and not again:
            return
        if not under_way:
            time.sleep(_LOOK)
        came = False
        for future in wait(under_way, timeout=_LOOK, return_when=FIRST_COMPLETED).done:
            one, _ = under_way.pop(future)
            try:
                row = future.result()
            except (CancelledError, BrokenExecutor):  # the place broke, whatever the job
                again.append(one)
                continue
            except Exception as exc:  # raised by the executor, which gave the job up
                text = " ".join(str(exc).split())
                row = failed(f"the worker was lost, and the job given up: {text}", retry=True)
            came = True
            limits.note(row)
            yield one[0], row
        most = patience
        if not place.answers_in_between:
            most += max((seconds for _, seconds in under_way.values()), default=0.0)
        if came or place.answers():
            heard = time.monotonic()
        elif time.monotonic() - heard > most:
            raise LostError(f"{place} has not answered for {most:.3g} s")
        if place.connections != connections:
            connections = place.connections
            again += [one for one, _ in under_way.values()]
            under_way.clear()


def default_workers() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
