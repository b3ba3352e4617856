"""The manual: every public name is in it, every example in it runs, every docstring has one."""

from __future__ import annotations

import contextlib
import doctest
import io
import re
from pathlib import Path

import pytest

import dahl_ident as di

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"```python\n(.*?)```(?:\n\n```output\n(.*?)```)?", re.DOTALL)
PAGES = [page for page in sorted(DOCS.glob("*.md")) if BLOCK.search(page.read_text("utf-8"))]


def _explained(name: str) -> bool:
    pattern = rf"auto(?:class|function):: dahl_ident\.{name}$"
    return bool(re.search(pattern, (DOCS / "reference.md").read_text("utf-8"), re.MULTILINE))


def test_every_public_name_is_in_the_reference() -> None:
    assert [name for name in di.__all__ if not _explained(name)] == []


def _has_example(value: object) -> bool:
    parts = [value, *vars(value).values()] if isinstance(value, type) else [value]
    return any(doctest.DocTestParser().get_examples(part.__doc__ or "") for part in parts)


def test_every_public_docstring_has_an_example() -> None:
    assert [name for name in di.__all__ if not _has_example(getattr(di, name))] == []


def test_pages_are_in_the_table_of_contents() -> None:
    index = (DOCS / "index.md").read_text("utf-8")
    listed = {
        line for block in re.findall(r"```{toctree}(.*?)```", index, re.DOTALL)
        for line in block.split()
    }  # fmt: skip
    assert {page.stem for page in DOCS.glob("*.md")} - {"index"} <= listed


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_examples_print_what_the_page_says(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for code, said in BLOCK.findall(page.read_text("utf-8")):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, page.name, "exec"), names)
        assert printed.getvalue().split() == said.split()


def test_files_that_the_manual_names_exist() -> None:
    root = DOCS.parent
    for page in DOCS.glob("*.md"):
        for pattern in re.findall(r"`(tests/[\w*./]+)`", page.read_text("utf-8")):
            assert list(root.glob(pattern)), f"{page.name} names {pattern}"
