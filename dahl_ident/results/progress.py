"""Progress of chains and long fits on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dahl_ident.bayes.chain import LENGTH, Chain, ChainSettings, Convergence, Listener
from dahl_ident.progress import spinner
from dahl_ident.units import counted, percent


def expected_steps(settings: ChainSettings, verdict: Convergence | None) -> int | None:
    """Return the expected total number of steps; None before the first verdict."""
    if settings.steps is not None:
        return settings.steps
    if verdict is None or not verdict.usable:
        return None
    kept = verdict.steps - verdict.discard
    needed = max(LENGTH * verdict.tau.max(), kept * settings.ess / verdict.ess.min())
    return min(int(verdict.discard + needed) + 1, settings.max_steps)


@contextmanager
def progress_bar(settings: ChainSettings) -> Iterator[Listener]:
    """Yield a listener that updates a bar."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (TextColumn("sampling"), BarColumn(), MofNCompleteColumn(), Remaining())
    console = Console(stderr=True, force_jupyter=False)  # standard output is for results
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("sampling", total=settings.steps)

        def update(chain: Chain, verdict: Convergence | None) -> None:
            total = expected_steps(settings, verdict)
            steps = chain.steps
            bar.update(task, completed=steps, total=None if total is None else max(total, steps))

        yield update


@contextmanager
def fit_progress() -> Iterator[Callable[[int, float], None]]:
    """Yield a function that shows evaluations and unexplained share of variance after 2 s."""
    with spinner("fitting") as show:
        yield lambda evaluations, share: show(
            f": {counted(evaluations, 'evaluation')}, {percent(share**0.5, 3)} rms left"
        )


@contextmanager
def grid_progress() -> Iterator[Callable[[int], None]]:
    """Yield a function that shows the number of points after 2 s."""
    with spinner("integrating") as show:
        yield lambda points: show(f": {counted(points, 'point')}")
