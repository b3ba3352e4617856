"""Small changes in the code that the tests should notice: which of them survive.

``python -m benchmarks.mutants --sample 150 --seed 1`` changes one operator, number or condition at
a time in a copy of the project, runs the tests that are responsible for its room, and prints every
change that passed them all. The changes are drawn at random from all that are possible. Names of
rooms or files restrict the draw; ``--sample 0`` tries every change.
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
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
RESPONSIBLE = {
    "diagnostics": ("diagnostics_*", "verdicts", "intervals", "held_out", "comparison"),
    "problem": ("problem", "prediction_derivatives", "sensors", "noise", "record_*"),
    "engine": ("engine", "forced_motion", "steady_state", "every_law"),
    "fitting": ("fitting*", "cold_records", "ipopt", "record_fit"),
    "extraction": ("extraction_*",),
}
"""Rooms to change, and the tests that should notice: ``tests/test_NAME.py``."""
_COPIED = ("dahl_ident", "benchmarks", "datasets", "tests", "stubs", "README.md", "pyproject.toml")
_LIMIT = 600  # s of processor time of one run; a change that makes a loop endless is noticed
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
            node.ops[0] = _SWAPPED[type(op)]()  # type: ignore[call-overload]
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


def tests_of(module: str) -> list[str]:
    """Return the responsible tests; those that name the file come first."""
    room, stem = Path(module).parts[1], Path(module).stem
    names = [f"test_{name}.py" for name in RESPONSIBLE[room]]
    files = {path: None for name in names for path in sorted((ROOT / "tests").glob(name))}
    ordered = sorted(
        files, key=lambda path: (stem not in path.read_text("utf-8"), stem not in path.stem)
    )
    return [str(path.relative_to(ROOT)) for path in ordered]


def survivor(tree: Path, change: Change) -> str | None:
    """Make one change in a copy of the project, run its tests; return the change if they pass."""
    source = (ROOT / change.module).read_text("utf-8")
    parsed = ast.parse(source)
    node = list(_code(parsed))[change.node]
    _change(node)
    (tree / change.module).write_text(ast.unparse(parsed), "utf-8")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider"]
    environment = os.environ | {"PYTHONPATH": str(tree), "XDG_CACHE_HOME": str(tree / "cache")}
    try:
        status = subprocess.run(
            [*command, *tests_of(change.module)],
            cwd=tree, env=environment, stdout=subprocess.DEVNULL, check=False,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (_LIMIT, _LIMIT)),
        ).returncode  # fmt: skip
    finally:
        (tree / change.module).write_text(source, "utf-8")
    if status != 0:
        return None
    line = int(node.lineno)  # type: ignore[attr-defined]  # statements and expressions have it
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
        survived = 0
        for number, change in enumerate(drawn, 1):
            text = survivor(tree, change)
            survived += text is not None
            print(f"{number}/{len(drawn)} {text or change.module + ' noticed'}", flush=True)
    share = 100.0 * (1.0 - survived / max(len(drawn), 1))
    print(f"{len(drawn)} of {possible} changes, {survived} survived: {share:.0f} % noticed")


if __name__ == "__main__":
    main()
