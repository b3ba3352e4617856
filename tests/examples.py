"""Run the examples in Markdown pages and the notebooks, and keep what they print and draw.

``python -m tests.examples`` renews the outputs of the README, the how-to pages and the notebooks,
or of the files that are named; the tests compare them. Without names the pictures of the page
of ``dahl-ident app`` are renewed as well. A ``python`` block goes on where the one
before it on its page ended; a ``bash`` block runs in the same folder, with this environment's
programs first. Of a notebook what is printed is compared; pictures are not.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
_COLOURS = 256  # of a stored picture
BLOCK = re.compile(r"^```(python|bash)\n(.*?)^```\n(?:\n```output\n.*?^```\n)?", re.DOTALL | re.M)


def pages() -> list[Path]:
    """Return the pages that hold examples."""
    candidates = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [page for page in candidates if BLOCK.search(page.read_text("utf-8"))]


def notebooks() -> list[Path]:
    """Return the notebooks in reading order."""
    return sorted((ROOT / "notebooks").glob("*.ipynb"))


def executed(notebook: Path, folder: Path) -> dict[str, Any]:
    """Return a notebook with the outputs that its cells have now.

    Parameters
    ----------
    notebook : Path
        The file.
    folder : Path
        Where it runs and leaves its files.
    """
    import nbformat
    from nbclient import NotebookClient

    content = nbformat.read(notebook, as_version=4)
    where = {"metadata": {"path": str(folder)}}
    NotebookClient(content, timeout=300, record_timing=False, resources=where).execute()
    content.metadata.pop("language_info")  # the version of Python
    content.metadata["language_info"] = {"name": "python"}
    for cell in content.cells:
        if cell.cell_type == "code":
            cell.outputs = [_smaller(one) for one in cell.outputs if not _compiles(one)]
    text = nbformat.writes(content)
    return dict(json.loads(text))


def _compiles(output: dict[str, Any]) -> bool:
    """Return whether an output says that the engine is compiled; refuse others on stderr."""
    if output.get("name") != "stderr":
        return False
    assert output["text"].startswith("compiling the engine"), output["text"]
    return True


def _smaller(output: dict[str, Any]) -> dict[str, Any]:
    """Return an output with its picture in 256 colours: half the size."""
    from PIL import Image

    data = output.get("data", {})
    if "image/png" in data:
        few = io.BytesIO()
        with Image.open(io.BytesIO(base64.b64decode(data["image/png"]))) as picture:
            picture.convert("RGB").quantize(_COLOURS).save(few, "png", optimize=True)
        data["image/png"] = base64.b64encode(few.getvalue()).decode("ascii")
    return output


def printed(notebook: dict[str, Any]) -> list[str]:
    """Return what each cell prints, without the words that stand for its pictures."""
    return [
        "".join(
            "".join(one.get("text", one.get("data", {}).get("text/plain", "")))
            for one in cell.get("outputs", [])
            if "image/png" not in one.get("data", {})
        )
        for cell in notebook["cells"]
    ]


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


def main(names: list[str]) -> None:
    """Renew the files that are named, or all."""
    if not names:
        where = os.environ | {"DAHL_IDENT_PICTURES": str(ROOT / "docs" / "images")}
        test = [sys.executable, "-m", "pytest", "-q", "tests/test_app.py", "-k", "accessible"]
        subprocess.run(test, cwd=ROOT, env=where, check=True)
    chosen = [Path(name).resolve() for name in names] or [*pages(), *notebooks()]
    for each in chosen:
        with tempfile.TemporaryDirectory() as scratch:
            if each.suffix == ".ipynb":
                text = json.dumps(executed(each, Path(scratch)), indent=1, ensure_ascii=False)
                each.write_text(text + "\n", encoding="utf-8")
            else:
                each.write_text(renewed(each, Path(scratch)), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
