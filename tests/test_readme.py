"""The README: its commands and links exist. What its code prints: ``test_docs``."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"^dahl-ident (\w+)(.*?)(?:#|$)", README, re.MULTILINE)))


@pytest.mark.parametrize(("command", "rest"), COMMANDS)
def test_commands_have_the_options_that_are_shown(command, rest, run):
    helped = run(command, "--help").out
    for option in re.findall(r"(?<=\s)--?[a-z][a-z-]*", rest):
        assert option in helped


def test_make_targets_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"(?:`|^)make ([a-z][a-z-]+)", README, re.MULTILINE)) <= targets


def test_links_lead_to_files():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert "docs/images/overview.png" in links
    assert [link for link in links if not (ROOT / link).exists()] == []
