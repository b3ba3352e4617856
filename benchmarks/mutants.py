"""Small changes in the code that the tests should notice: which of them survive.

``python -m benchmarks.mutants --sample 150 --seed 1`` changes one operator, number or condition at
a time in a copy of the project, and prints every change that its tests did not notice: those that
are responsible for its room, of them those that execute the line. The changes are drawn at random
from all that are possible. Names of rooms or files restrict the draw; ``--sample 0`` tries every
change.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import pytest
from coverage import CoverageData

ROOT = Path(__file__).resolve().parent.parent
RESPONSIBLE = {
    "diagnostics": (
        "diagnostics_*", "verdicts", "intervals", "held_out", "comparison", "record_*",
        "mean_force_rows", "measured_dampers", "maxwell_slip",
    ),
    "problem": (
        "problem", "sensors", "noise", "record_*", "driven_plants", "harmonics_of_motion",
        "mean_force_rows", "backbone", "fitting", "sweeps",
    ),
    "engine": (
        "engine", "forced_motion", "steady_state", "every_law*", "law_contract", "law_checks",
        "driven_*", "limit_cycles",
    ),
    "fitting": (
        "fitting*", "cold_records", "ipopt", "record_*", "driven_plants", "sweeps", "every_law*",
        "measured_dampers",
    ),
    "extraction": ("extraction_*",),
}  # fmt: skip
"""Rooms to change, and the tests that should notice: ``tests/test_NAME.py``."""
_COPIED = ("dahl_ident", "benchmarks", "datasets", "tests", "stubs", "README.md", "pyproject.toml")
_LIMIT = 1800  # s of processor time of one run; a change that makes a loop endless is noticed
_SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.Lt: ast.Gt,
    ast.Gt: ast.Lt,
    ast.LtE: ast.GtE,
    ast.GtE: ast.LtE,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
}


class Executed(NamedTuple):
    """One run of the tests: who executes which line, and the s that each test takes."""

    lines: CoverageData
    seconds: defaultdict[str, float]


class Change(NamedTuple):
    """One change of one file: the node's index in the order of the walk."""

    module: str
    node: int


def _code(tree: ast.AST) -> Iterator[ast.AST]:
    """Walk a tree without type annotations and what only the type checker reads."""
    yield tree
    for name, value in ast.iter_fields(tree):
        if name in {"annotation", "returns"}:
            continue
        for part in value if isinstance(value, list) else [value]:
            typing = isinstance(part, ast.If) and ast.unparse(part.test) == "TYPE_CHECKING"
            if isinstance(part, ast.AST) and not typing:
                yield from _code(part)


def _change(node: ast.AST) -> bool:
    """Change one node in place; return whether there is a change for it."""
    match node:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in _SWAPPED:
            node.op = _SWAPPED[type(op)]()  # type: ignore[assignment]  # of one kind each
        case ast.Compare(ops=[op, *_]) if type(op) in _SWAPPED:
            node.ops[0] = _SWAPPED[type(op)]()  # type: ignore[call-overload]  # as above
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
            node.test = ast.UnaryOp(ast.Not(), test)
        case ast.UnaryOp(op=ast.USub()):
            node.op = ast.UAdd()
        case ast.Constant(value=bool(value)):
            node.value = not value
        case ast.Constant(value=int(value) | float(value)):
            node.value = value + 1
        case _:
            return False
    return True


def changes(module: str) -> list[Change]:
    """Return all changes of one file, named relative to the project's root."""
    nodes = list(_code(ast.parse((ROOT / module).read_text("utf-8"))))
    return [Change(module, i) for i, node in enumerate(nodes) if _change(node)]


def responsible(room: str) -> list[str]:
    """Return the test files of a room."""
    names = [f"test_{name}.py" for name in RESPONSIBLE[room]]
    return [f"tests/{p.name}" for name in names for p in sorted((ROOT / "tests").glob(name))]


def executed(tree: Path, rooms: Iterable[str]) -> Executed:
    """Run the responsible tests once in a copy of the project."""
    settings = tree / "contexts.ini"
    settings.write_text("[run]\ndynamic_context = test_function\nsource = dahl_ident\n", "utf-8")
    files = {file: None for room in rooms for file in responsible(room)}
    command = ["-m", "coverage", "run", f"--rcfile={settings}", "--data-file=contexts", "-m"]
    command += ["pytest", "-q", "-n", "0", "--junitxml=seconds.xml", *files]
    if _run(tree, command, None) != 0:
        raise SystemExit("the tests fail without a change; mend them first")
    data = CoverageData(str(tree / "contexts"))
    data.read()
    seconds: defaultdict[str, float] = defaultdict(float)
    for case in ElementTree.parse(tree / "seconds.xml").iter("testcase"):
        _, file, *classes = str(case.get("classname")).split(".")
        test = [*classes, str(case.get("name")).partition("[")[0]]
        seconds[f"tests/{file}.py::{'::'.join(test)}"] += float(case.get("time", 0.0))
    return Executed(data, seconds)


def tests_of(module: str, line: int, tree: Path, run: Executed) -> list[str]:
    """Return the responsible tests that execute a line, the quickest first.

    All of them for what is compiled, or executed on import or by a fixture: who needs that is not
    known. Of a test that is defined within a function, all of its file.
    """
    files = responsible(Path(module).parts[1])
    contexts = run.lines.contexts_by_lineno(str(tree / module)).get(line, [])
    names = [name.split(".") for name in contexts if name]
    tests = {
        f"tests/{file}.py" + ("" if "<locals>" in test else "::" + "::".join(test))
        for _, file, *test in names
    }
    chosen = [test for test in tests if test.partition("::")[0] in files]
    return sorted(chosen, key=lambda test: (run.seconds[test], test)) or files


def _run(tree: Path, command: list[str], limit: int | None) -> int:
    """Run Python in a copy of the project, with a limit of processor time in s."""
    environment = os.environ | {"PYTHONPATH": str(tree), "XDG_CACHE_HOME": str(tree / "cache")}

    def bound() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))

    return subprocess.run(
        [sys.executable, *command, "-p", "no:cacheprovider"],
        cwd=tree, env=environment, stdout=subprocess.DEVNULL, check=False, preexec_fn=bound,
    ).returncode  # fmt: skip


def survivor(tree: Path, change: Change, run: Executed) -> str | None:
    """Make one change in a copy of the project, run its tests; return the change if they pass."""
    source = (ROOT / change.module).read_text("utf-8")
    parsed = ast.parse(source)
    node = list(_code(parsed))[change.node]
    line = int(node.lineno)  # type: ignore[attr-defined]  # statements and expressions have it
    _change(node)
    (tree / change.module).write_text(ast.unparse(parsed), "utf-8")
    tests = [change.module, *tests_of(change.module, line, tree, run)]  # the examples first
    try:
        status = _run(tree, ["-m", "pytest", "-x", "-q", "-n", "0", *tests], _LIMIT)
    finally:
        (tree / change.module).write_text(source, "utf-8")
    if status in {pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED}:
        raise SystemExit(f"these tests do not run: {' '.join(tests)}")
    if status != 0:
        return None
    return f"{change.module}:{line} {type(node).__name__}: {source.splitlines()[line - 1].strip()}"


def main() -> None:
    """Print the survivors of a sample of changes."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument(
        "places", nargs="*", default=["diagnostics", "problem", "engine", "fitting"]
    )
    parser.add_argument("--sample", type=int, default=150, help="how many changes; 0 for all")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    modules = [
        str(path.relative_to(ROOT))
        for place in chosen.places
        for path in (
            [ROOT / place] if "." in place else sorted((ROOT / "dahl_ident" / place).rglob("*.py"))
        )
    ]
    drawn = [change for module in modules for change in changes(module)]
    possible = len(drawn)
    if 0 < chosen.sample < possible:
        drawn = random.Random(chosen.seed).sample(drawn, chosen.sample)
    with tempfile.TemporaryDirectory(prefix="mutants_") as folder:
        tree = Path(folder)
        for name in _COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
            copy(ROOT / name, tree / name)
        run = executed(tree, {Path(change.module).parts[1] for change in drawn})
        survived = 0
        for number, change in enumerate(drawn, 1):
            text = survivor(tree, change, run)
            survived += text is not None
            print(f"{number}/{len(drawn)} {text or change.module + ' noticed'}", flush=True)
    share = 100.0 * (1.0 - survived / max(len(drawn), 1))
    print(f"{len(drawn)} of {possible} changes, {survived} survived: {share:.0f} % noticed")


if __name__ == "__main__":
    main()
