"""The bar that a long chain shows: how far it is, and how far it has to go."""

import re

import dahl_ident as di
from tests.bayes_cases import friction_table


def test_a_chain_moves_the_bar_to_its_end(monkeypatch):
    from rich import progress

    seen: list[tuple[float, float | None]] = []
    update = progress.Progress.update

    def remember(self, task, **given):
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


def test_the_bar_shows_the_time_that_is_left(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as on a terminal
    monkeypatch.setenv("COLUMNS", "100")
    di.posterior(friction_table(), di.Dahl(), seed=1, steps=100, progress=True, uncertainty="noise")
    shown = capsys.readouterr()
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.out + shown.err)
    assert re.search(r"sampling .*100/100 \d:\d\d:\d\d", plain)
