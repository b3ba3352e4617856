"""Settings shared by all tests."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hypothesis
import pytest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tests.command_line import Runner

os.environ.setdefault("MPLBACKEND", "Agg")
# before numpy is first imported: the matrices are small, and several tests run at once
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

hypothesis.settings.register_profile("repeatable", deadline=None, derandomize=True)
hypothesis.settings.load_profile("repeatable")


def pytest_configure() -> None:
    """Load the kernels from the users' cache; collection would compile them where they lie."""
    from dahl_ident.engine.motion import kernels

    for name in ("cycle", "samples", "loop"):
        kernels(name)


@pytest.fixture(autouse=True)
def _blank_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write figures blank, which saves most of a report's time, but where a test is marked."""
    if any(map(request.node.get_closest_marker, ("pictures", "mpl_image_compare"))):
        return
    import matplotlib.figure

    drawn = matplotlib.figure.Figure.savefig

    def blank(figure: Figure, place: Any, **options: Any) -> None:
        size = (figure.get_figwidth(), figure.get_figheight())
        drawn(matplotlib.figure.Figure(size), place, **options)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", blank)


@pytest.fixture(autouse=True)
def _closed_figures() -> Iterator[None]:
    """Close the figures of a test."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture
def run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Runner:
    """Return what runs the command line, in a folder of its own."""
    from tests.command_line import Runner

    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COLUMNS", raising=False)  # that of a terminal, not of a test
    return Runner(capsys, monkeypatch)
