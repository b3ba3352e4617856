"""Runs jobs through an executor, a few at a time, even if workers die.

Any ``concurrent.futures`` executor can be used. If a pool of local processes breaks because one of
them died, the jobs in progress are repeated one by one, so that a job that kills its process is
identified and recorded as failed, and the others are completed.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.context import BaseContext
from typing import Any, TypeVar

from dahl_ident.campaigns.work import Job, Row, do, one_thread
from dahl_ident.errors import ValidationError

_Tag = TypeVar("_Tag")
_WAITING = 2
"""Jobs submitted for each worker: one in progress, one waiting."""
_DEATHS = 3
"""Worker deaths, with the job running alone, after which the job is taken as the cause."""


def run_jobs(
    jobs: Iterable[tuple[_Tag, Job]], workers: int, executor: Executor | None = None
) -> Iterator[tuple[_Tag, Row]]:
    """Yield the row of each job as it is completed.

    Parameters
    ----------
    jobs : iterable of (tag, Job)
        Read as they are needed, so that a million of them need little memory.
    workers : int
        Processes on this machine; with an `executor`, the number of jobs at a time.
    executor : concurrent.futures.Executor, optional
        Runs the jobs instead; it is not shut down.

    Yields
    ------
    tag, row
        In the order of completion.
    """
    if executor is not None:
        yield from _through(jobs, workers, lambda: executor)
        return
    if workers == 1:
        for tag, job in jobs:
            yield tag, do(job)
        return
    pools = _Pools()
    try:
        yield from _through(jobs, workers, lambda: pools.of(workers), pools)
    finally:
        pools.close()


class _Pools:
    """A pool of local processes, and another one when it has broken."""

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._workers = 0

    def of(self, workers: int) -> Executor:
        if self._pool is None or self._workers != workers:
            self.close()
            self._pool, self._workers = local_pool(workers), workers
        return self._pool

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None


def local_pool(workers: int) -> ProcessPoolExecutor:
    """Return a pool of processes with one numerical thread each."""
    if "forkserver" in multiprocessing.get_all_start_methods():
        context: BaseContext = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["dahl_ident.campaigns.worker", "pandas", "pint"])
    else:  # Windows
        context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=one_thread)


def _through(
    jobs: Iterable[tuple[_Tag, Job]],
    workers: int,
    executor: Callable[[], Executor],
    pools: _Pools | None = None,
) -> Iterator[tuple[_Tag, Row]]:
    waiting = iter(jobs)
    under_way: dict[Future[Row], tuple[_Tag, Job]] = {}
    exhausted = False
    while under_way or not exhausted:
        lost: list[tuple[_Tag, Job]] = []
        while not exhausted and not lost and len(under_way) < _WAITING * workers:
            try:
                tag, job = next(waiting)
            except StopIteration:
                exhausted = True
                break
            try:
                under_way[executor().submit(do, job)] = (tag, job)
            except BrokenProcessPool:
                lost.append((tag, job))
        if not lost and under_way:
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                tag, job = under_way.pop(future)
                try:
                    yield tag, future.result()
                except BrokenProcessPool:
                    lost.append((tag, job))
                except Exception as exc:  # raised by the executor, which gave the job up
                    yield tag, _died(exc)
        if not lost:
            continue
        for future, (tag, job) in under_way.items():  # all of a broken pool end at once
            try:
                yield tag, future.result()
            except BrokenProcessPool:
                lost.append((tag, job))
        under_way.clear()
        if pools is None:
            raise ValidationError("the executor's processes died; give another executor")
        pools.close()
        for tag, job in lost:
            yield tag, _alone(job, pools)


def _alone(job: Job, pools: _Pools) -> Row:
    """Return the row of a job that runs alone."""
    for _ in range(_DEATHS):
        try:
            return pools.of(1).submit(do, job).result()
        except BrokenProcessPool as exc:
            last = exc
            pools.close()
    return _died(last)


def _died(cause: Any) -> Row:
    return {
        "status": "failed",
        "error": f"the process that worked on it died {_DEATHS} times, or was given up: "
        f"{' '.join(str(cause).split())}",
        "died": True,
        "digests": [],
        "seconds": 0.0,
    }


def default_workers() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
