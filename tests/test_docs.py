"""The manual and README: examples print what they say; the reference has every public name."""

from __future__ import annotations

import doctest
import re
from operator import attrgetter
from pathlib import Path

import pytest

import dahl_ident as di
from tests.examples import pages, renewed

DOCS = Path(__file__).parents[1] / "docs"


def _explained(name: str) -> bool:
    pattern = rf"auto(?:class|function|exception):: dahl_ident\.(?:errors\.)?{name}$"
    return bool(re.search(pattern, (DOCS / "reference.md").read_text("utf-8"), re.MULTILINE))


def test_every_public_name_is_in_the_reference() -> None:
    assert [name for name in di.__all__ if not _explained(name)] == []


def _has_example(value: object) -> bool:
    parts = [value, *vars(value).values()] if isinstance(value, type) else [value]
    return any(doctest.DocTestParser().get_examples(part.__doc__ or "") for part in parts)


def test_every_public_docstring_has_an_example() -> None:
    assert [name for name in di.__all__ if not _has_example(getattr(di, name))] == []


def test_every_class_and_function_of_the_reference_has_an_example() -> None:
    page = (DOCS / "reference.md").read_text("utf-8")
    names = re.findall(r"auto(?:class|function):: dahl_ident\.(\S+)$", page, re.MULTILINE)
    assert len(names) > 60
    assert [name for name in names if not _has_example(attrgetter(name)(di))] == []


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_examples_print_what_the_page_says(page: Path, tmp_path: Path) -> None:
    assert renewed(page, tmp_path) == page.read_text("utf-8")


def test_files_that_the_manual_names_exist() -> None:
    root = DOCS.parent
    for page in DOCS.rglob("*.md"):
        for pattern in re.findall(r"`((?:tests|notebooks)/[\w*./]+)`", page.read_text("utf-8")):
            assert list(root.glob(pattern)), f"{page.name} names {pattern}"
