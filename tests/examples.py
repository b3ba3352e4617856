"""Run the examples in Markdown pages and put what they print below them.

``python -m tests.examples`` renews the printed outputs of the README and the how-to pages; the
tests compare them. A ``python`` block goes on where the one before it on its page ended; a
``bash`` block runs in the same folder, with this environment's programs first.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```(python|bash)\n(.*?)^```\n(?:\n```output\n.*?^```\n)?", re.DOTALL | re.M)


def pages() -> list[Path]:
    """Return the pages that hold examples."""
    candidates = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [page for page in candidates if BLOCK.search(page.read_text("utf-8"))]


def renewed(page: Path, folder: Path) -> str:
    """Return the page's text with the outputs that its examples print now.

    Parameters
    ----------
    page : Path
        The Markdown file.
    folder : Path
        Where the examples run and leave their files.
    """
    names: dict[str, object] = {}

    def run(block: re.Match[str]) -> str:
        language, code = block[1], block[2]
        printed = _run_python(code, page, names) if language == "python" else _run_bash(code)
        output = f"\n```output\n{printed}```\n" if printed else ""
        return f"```{language}\n{code}```\n{output}"

    with contextlib.chdir(folder):
        return BLOCK.sub(run, page.read_text("utf-8"))


def _run_python(code: str, page: Path, names: dict[str, object]) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, page.name, "exec"), names)
    return printed.getvalue()


def _run_bash(code: str) -> str:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    without_terminal = {k: v for k, v in os.environ.items() if k != "COLUMNS"}
    done = subprocess.run(
        ["bash", "-eu", "-c", code],
        env=without_terminal | {"PATH": path, "NO_COLOR": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode:
        raise AssertionError(f"ended with status {done.returncode}:\n{code}\n{done.stdout}")
    return done.stdout


if __name__ == "__main__":
    for each in pages():
        with tempfile.TemporaryDirectory() as scratch:
            each.write_text(renewed(each, Path(scratch)), encoding="utf-8")
