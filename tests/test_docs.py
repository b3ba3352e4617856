"""The manual and README: examples print what they say; the reference has every public name."""

import doctest
import importlib.util
import inspect
import json
import re
import shlex
from itertools import pairwise
from operator import attrgetter
from pathlib import Path

import pytest

import dahl_ident as di
from tests.examples import executed, notebooks, pages, printed, renewed

DOCS = Path(__file__).parents[1] / "docs"
REFERENCE = "".join(page.read_text("utf-8") for page in (DOCS / "reference").glob("*.md"))


def _explained(name):
    pattern = rf"auto(?:class|function|exception):: dahl_ident\.(?:\w+\.)?{name}$"
    return bool(re.search(pattern, REFERENCE, re.MULTILINE))


NAMES = [name for name in di.__all__ if not inspect.ismodule(getattr(di, name))]


def test_every_public_name_is_in_the_reference():
    assert [name for name in NAMES if not _explained(name)] == []


def _has_example(value):
    parts = [value, *vars(value).values()] if isinstance(value, type) else [value]
    return any(doctest.DocTestParser().get_examples(part.__doc__ or "") for part in parts)


def test_every_public_docstring_has_an_example():
    assert [name for name in NAMES if not _has_example(getattr(di, name))] == []


def test_every_class_and_function_of_the_reference_has_an_example():
    names = re.findall(r"auto(?:class|function):: dahl_ident\.(\S+)$", REFERENCE, re.MULTILINE)
    assert len(names) > 60
    assert [name for name in names if not _has_example(attrgetter(name)(di))] == []


@pytest.mark.manual
@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_examples_print_what_the_page_says(page, tmp_path):
    assert renewed(page, tmp_path) == page.read_text("utf-8")


@pytest.mark.manual
@pytest.mark.parametrize("notebook", notebooks(), ids=lambda notebook: notebook.stem)
def test_a_notebook_prints_what_is_stored(notebook, tmp_path):
    stored = json.loads(notebook.read_text("utf-8"))
    assert printed(executed(notebook, tmp_path)) == printed(stored)


def test_files_that_the_manual_names_exist():
    root = DOCS.parent
    for page in DOCS.rglob("*.md"):
        for pattern in re.findall(r"`((?:tests|notebooks)/[\w*./]+)`", page.read_text("utf-8")):
            assert list(root.glob(pattern)), f"{page.name} names {pattern}"


def _offline():
    spec = importlib.util.spec_from_file_location("offline", DOCS / "extensions" / "offline.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("page", "fetches"),
    [
        ('<script src="https://cdn.example/a.js"></script>', ["https://cdn.example/a.js"]),
        ('<link rel="stylesheet" href="//cdn.example/a.css">', ["//cdn.example/a.css"]),
        ('<img src="http://example/a.png">', ["http://example/a.png"]),
        ("<style>@import 'https://a/b.css'; p {background: url(//a/c.png)}</style>",
         ["https://a/b.css", "//a/c.png"]),
        ('<a href="https://example">x</a> <link rel="next" href="https://example/b.html">', []),
        ('<script src="_static/a.js?v=//1"></script> <img src="data:image/png;base64,//">', []),
    ],
)  # fmt: skip
def test_what_a_page_of_the_manual_fetches_is_found(page, fetches):
    pytest.importorskip("latex2mathml")
    assert _offline().fetched(page) == fetches


def test_the_search_quotes_the_sections_of_an_article_alone():
    pytest.importorskip("latex2mathml")
    page = (
        "<nav>All</nav><article><section id='a'><h1>A &lt; B<a class='headerlink'>#</a></h1>"
        "<p>Two  <a href='x'>words</a></p><script>no</script></section></article><nav>Next</nav>"
    )
    text = '<main role="main"><section id="a">A &lt; BTwo words</section></main>'
    assert _offline().article(page) == text


def test_formulas_of_the_manual_are_mathml():
    pytest.importorskip("latex2mathml")
    offline = _offline()
    blocks = [
        text for page in DOCS.rglob("*.md") for text in page.read_text("utf-8").split("$$")[1::2]
    ]
    assert len(blocks) > 10
    for text in blocks:
        assert offline.mathml(text, "block").startswith("<math ")
        assert "\\" not in re.sub("<[^>]*>", "", offline.mathml(text, "block")), text


def test_the_messages_of_troubleshooting_are_those_of_the_package():
    source = "".join(p.read_text("utf-8") for p in Path(di.__file__).parent.rglob("*.py"))
    flat = re.sub(r"\"\s*f?\"", "", source)  # texts over several lines
    page = (DOCS / "how_to" / "troubleshooting.md").read_text("utf-8")
    messages = re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE)
    assert len(messages) > 10
    assert [text for text in messages if text not in flat] == []


def test_every_field_of_the_metadata_is_explained():
    page = (DOCS / "how_to" / "reports.md").read_text("utf-8")
    template = Path(di.__file__).parent / "cli" / "templates" / "report.toml"
    fields = re.findall(r"^(?:\[\[)?([a-z_]+)(?:\]\])?(?: =|$)", template.read_text("utf-8"), re.M)
    assert set(fields) >= {"number", "role", "instruments", "ambient", "k"}
    assert [name for name in fields if f"`{name}`" not in page and f"[{name}]" not in page] == []


# The README: its commands and links exist. What its code prints: ``test_docs``.

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"^dahl-ident (\w+)(.*?)(?:#|$)", README, re.MULTILINE)))


@pytest.mark.parametrize(("command", "rest"), COMMANDS)
def test_commands_have_the_options_that_are_shown(command, rest, run):
    helped = run(command, "--help").out
    for option in re.findall(r"(?<=\s)--?[a-z][a-z-]*", rest):
        assert option in helped


def test_commands_read_what_the_user_has_or_an_earlier_command_wrote():
    text = README.split("## On the command line\n")[1].split("```")
    known = set(re.findall(r"`([\w*]+\.\w+)`", text[0]))
    for line in text[1].strip().splitlines():
        words = shlex.split(line, comments=True)
        written = {
            word
            for option, word in pairwise(words)
            if option in ("-o", "--save", "--report", "--resume")
        }
        files = {word for word in words if "." in word}
        assert files - written <= known, line
        known |= written


def test_make_targets_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"(?:`|^)make ([a-z][a-z-]+)", README, re.MULTILINE)) <= targets


def test_links_lead_to_files():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert "docs/images/overview.png" in links
    assert [link for link in links if not (ROOT / link).exists()] == []


# The notebooks: each opens with its aim and holds its outputs; `make docs` compares them.

LARGEST = 300_000  # bytes
NOTEBOOKS = notebooks()


def _cells(path):
    return list(json.loads(path.read_text(encoding="utf-8"))["cells"])


def test_notebooks_are_numbered_without_a_gap():
    assert [int(path.name[:2]) for path in NOTEBOOKS] == list(range(1, len(NOTEBOOKS) + 1))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_opens_with_its_aim_and_holds_its_outputs(path):
    cells = _cells(path)
    opening = "".join(cells[0]["source"])
    assert opening.startswith(f"# {int(path.name[:2])} ")
    assert "After this notebook you can" in opening
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert {output["output_type"] for cell in code for output in cell["outputs"]} == {
        "display_data", "stream",
    }  # fmt: skip
    assert any(printed({"cells": cells}))
    assert path.stat().st_size < LARGEST
