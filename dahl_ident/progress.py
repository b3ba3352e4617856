"""A line on the terminal that shows the progress of a task."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

PATIENCE = 2.0  # s before the line appears


class Show(Protocol):
    """Shows the progress of a task: words after its name, and the number of steps if known."""

    def __call__(self, words: str, done: float = 0.0, total: float | None = None) -> None:
        """Show the words, the number of steps done, and the total number."""


@contextmanager
def spinner(task: str, patience: float | None = None) -> Iterator[Show]:
    """Show on standard error, after some seconds, that a task is running, and the time elapsed.

    Standard output is for results. The yielded function reports progress; with the number of steps,
    the remaining time is shown as well.
    """
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), Remaining())
    console = Console(stderr=True, force_jupyter=False)  # plain text in notebooks too
    bar = Progress(*columns, console=console, transient=True)
    number = bar.add_task(task, total=None)

    def show(words: str, done: float = 0.0, total: float | None = None) -> None:
        bar.update(number, description=f"{task}{words}", completed=done, total=total)

    timer = threading.Timer(PATIENCE if patience is None else patience, bar.start)
    timer.daemon = True
    timer.start()
    try:
        yield show
    finally:
        timer.cancel()
        timer.join()
        bar.stop()
