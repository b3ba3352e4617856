"""The bar that a long chain shows: how far it is, and how far it has to go."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.bayes.chain import ChainSettings
from dahl_ident.bayes.convergence import Convergence
from dahl_ident.results.progress import expected_steps
from tests.bayes_cases import friction_table

SETTINGS = ChainSettings(128, 4, 1, None, 20000, 2000.0)


def verdict(tau: float, ess: float) -> Convergence:
    return Convergence(300, 100, np.array([tau, 2.0]), np.array([ess, 1e6]), np.ones(2), 2000.0)


def test_the_total_is_what_convergence_will_take() -> None:
    assert expected_steps(SETTINGS, None) is None
    assert expected_steps(replace(SETTINGS, steps=700), None) == 700
    # 50 autocorrelation times after 100 of warm-up, or as many as 2000 draws take
    assert expected_steps(SETTINGS, verdict(10.0, 1e5)) == 601
    assert expected_steps(SETTINGS, verdict(1.0, 100.0)) == 4101
    assert expected_steps(SETTINGS, verdict(1e4, 1.0)) == 20000
    assert expected_steps(SETTINGS, verdict(np.nan, 1.0)) is None


def test_a_chain_moves_the_bar_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    from rich import progress

    seen: list[tuple[float, float | None]] = []
    update = progress.Progress.update

    def remember(self: progress.Progress, task: Any, **given: Any) -> None:
        seen.append((given["completed"], given["total"]))
        update(self, task, **given)

    monkeypatch.setattr(progress.Progress, "update", remember)
    posterior = di.posterior(
        friction_table(), di.Dahl(), seed=1, progress=True, uncertainty="noise"
    )
    steps = [done for done, _ in seen]
    assert steps == sorted(steps)
    assert posterior.steps - steps[-1] < 60
    assert seen[0] == (50, None)
    assert all(total is None or total >= done for done, total in seen)


def test_the_bar_shows_the_time_that_is_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # as on a terminal
    monkeypatch.setenv("COLUMNS", "100")
    di.posterior(friction_table(), di.Dahl(), seed=1, steps=100, progress=True, uncertainty="noise")
    shown = capsys.readouterr()
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.out + shown.err)
    assert re.search(r"sampling .*100/100 \d:\d\d:\d\d", plain)
