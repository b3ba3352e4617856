"""Progress of chains and long fits on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dahl_ident.bayes.chain import LENGTH, Chain, ChainSettings, Convergence, Listener
from dahl_ident.progress import spinner
from dahl_ident.units import counted, percent


@contextmanager
def chain_progress(settings: ChainSettings) -> Iterator[Listener]:
    """Yield a listener that shows the number of steps, and the expected total once it is known."""
    with spinner("sampling", patience=0.0) as show:

        def update(chain: Chain, verdict: Convergence | None) -> None:
            total = settings.steps
            if total is None and verdict is not None and verdict.usable:
                kept = verdict.steps - verdict.discard
                needed = max(LENGTH * verdict.tau.max(), kept * settings.ess / verdict.ess.min())
                total = max(min(verdict.discard + int(needed) + 1, settings.max_steps), chain.steps)
            show(f" {chain.steps}/{total or '?'}", chain.steps, total)

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
