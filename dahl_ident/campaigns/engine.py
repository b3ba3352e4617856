"""Runs jobs, a few at a time: in processes of this machine, in an executor, or with Dask.

Each fit has a limit of time and of memory (:mod:`dahl_ident.campaigns.worker`).
"""

from __future__ import annotations

import os
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
from contextlib import contextmanager
from itertools import islice
from typing import TypeVar

from dahl_ident.campaigns import worker
from dahl_ident.campaigns.worker import Job, Row, failed
from dahl_ident.data.storage import library
from dahl_ident.errors import DataError, ValidationError

_Tag = TypeVar("_Tag")
TIMEOUT = 600.0  # s, default limit of a fit
_WAITING = 2  # jobs submitted for each worker: one in progress, one waiting
_POLL = 1.0  # s after which waiting is interrupted, so that Windows sees the keyboard's interrupt
_CONNECT = 10.0  # s within which a scheduler must answer
_LEAST_MEMORY = 2.0  # least default limit, GB; the imported libraries take some tenths


class LostError(DataError):
    """The executor or scheduler is lost; the rows received before are valid."""


@contextmanager
def local(workers: int) -> Iterator[Executor]:
    """Yield threads that each wait for a process of this machine."""
    threads = ThreadPoolExecutor(workers)
    try:
        yield threads
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        worker.end_busy()
        threads.shutdown(wait=True)
        worker.end_idle(keep=1)  # which the next campaign can use


def local_memory(workers: int) -> float:
    """Return the share of this machine's memory for each worker, GB."""
    return max(worker.machine_memory() / workers, _LEAST_MEMORY)


@contextmanager
def dask(address: str) -> Iterator[tuple[Executor, int]]:
    """Yield the executor of a Dask scheduler, and the number of its processors."""
    distributed = library("distributed", "dask")
    try:
        client = distributed.Client(address, timeout=_CONNECT)
    except (OSError, ValueError, TypeError, RuntimeError) as exc:  # TypeError: no certificate
        raise ValidationError(f"scheduler {address}: no scheduler answers: {exc}") from exc
    try:
        yield client.get_executor(pure=False), sum(client.ncores().values()) or 1
    finally:
        client.close(timeout=_CONNECT)


def run_jobs(
    jobs: Iterable[tuple[_Tag, Job]],
    executor: Executor,
    workers: int,
    timeout: float = TIMEOUT,
    memory: float | None = None,
) -> Iterator[tuple[_Tag, Row]]:
    """Yield the row of each job as it is completed; jobs are read as they are needed.

    Raises LostError if the executor takes no jobs any more.
    """
    waiting, running = iter(jobs), dict[Future[Row], _Tag]()
    while True:
        try:
            for tag, job in islice(waiting, _WAITING * workers - len(running)):
                running[executor.submit(worker.do_within, job, timeout, memory)] = tag
        except RuntimeError as exc:  # including BrokenExecutor
            raise LostError(f"the executor takes no jobs any more: {exc}") from exc
        if not running:
            return
        for future in wait(running, timeout=_POLL, return_when=FIRST_COMPLETED).done:
            tag = running.pop(future)
            try:
                row = future.result()
            except (CancelledError, BrokenExecutor) as exc:
                raise LostError(f"the executor, or its scheduler, was lost: {exc}") from exc
            except Exception as exc:  # the executor gave up the job
                text = " ".join(str(exc).split())
                row = failed(f"the worker was lost, and the job given up: {text}", retry=True)
            yield tag, row


def default_workers() -> int:
    """Return the number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # on Linux
    return len(affinity(0)) if affinity else os.cpu_count() or 1
