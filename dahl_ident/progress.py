"""A line on the terminal that shows that a task goes on."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

PATIENCE = 2.0  # s without a display


class Show(Protocol):
    """Shows how far a task is: words after its name, and where they are known the steps."""

    def __call__(self, words: str, done: float = 0.0, total: float | None = None) -> None:
        """Take the words, the number of steps done, and that of all."""


@contextmanager
def spinner(task: str) -> Iterator[Show]:
    """Show on standard error, after two seconds, that a task goes on, and for how long.

    Standard output is for results. The function that is yielded says how far the task is; with the
    number of steps the time left is shown as well.
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

    clock = threading.Timer(PATIENCE, bar.start)
    clock.daemon = True
    clock.start()
    try:
        yield show
    finally:
        clock.cancel()
        clock.join()
        bar.stop()
