"""The notebooks: each opens with its aim and holds its outputs; `make docs` compares them."""

import json

import pytest

from tests.examples import notebooks, printed

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
