"""Small changes in the code that the tests should notice: which of them survive.

``python -m benchmarks.mutants`` changes one operator, number or condition at a time in a copy of
the project, runs the tests that are responsible, and prints every change that passed them all.
The source tree itself is never touched. Name files to restrict the run; ``--sample 30`` tries that
many changes of each file, drawn at random with a fixed seed.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESPONSIBLE = {
    "dahl_ident/noise.py": ("test_noise.py", "test_problem.py", "test_diagnostics_coverage.py"),
    "dahl_ident/extraction/sine_fit.py": (
        "test_extraction_sine_fit.py",
        "test_extraction_line_noise.py",
    ),
    "dahl_ident/extraction/line_noise.py": ("test_extraction_line_noise.py",),
    "dahl_ident/extraction/block_means.py": ("test_extraction_block_means.py",),
    "dahl_ident/extraction/joined_points.py": (
        "test_extraction_record.py",
        "test_extraction_sources.py",
    ),
    "dahl_ident/extraction/segment_bounds.py": ("test_extraction_segment_bounds.py",),
    "dahl_ident/diagnostics/variance_components.py": ("test_diagnostics_budget.py",),
    "dahl_ident/diagnostics/budget.py": ("test_diagnostics_budget.py",),
    "dahl_ident/diagnostics/error_sources.py": (
        "test_diagnostics_budget.py",
        "test_diagnostics_bands.py",
    ),
    "dahl_ident/diagnostics/goodness.py": ("test_diagnostics_goodness.py",),
    "dahl_ident/diagnostics/prediction_error.py": ("test_diagnostics_bands.py",),
}
"""Files to change, and the tests that should notice."""
_TOOL = (
    str(Path(sys.executable).parent / "uvx"),
    "--quiet",
    "--from",
    "cosmic-ray>=8.4",
    "cosmic-ray",
)
_CHANGES = (
    "NumberReplacer",
    "AddNot",
    "ReplaceAndWithOr",
    "ReplaceOrWithAnd",
    "ReplaceTrueWithFalse",
    "ReplaceFalseWithTrue",
    "ReplaceUnaryOperator_Delete_USub",
    "ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|Pow_Mul)",
    "ReplaceComparisonOperator_(Lt_Gt|Gt_Lt|LtE_Gt|GtE_Lt|Eq_NotEq|NotEq_Eq)",
)
"""Kinds of change; others are refused by the type checker or change nothing a test could see."""
_COPIED = (
    "dahl_ident",
    "benchmarks",
    "datasets",
    "tests",
    "docs",
    "notebooks",
    "stubs",
    "README.md",
)


def survivors(
    module: str, tests: Sequence[str], sample: int | None = None
) -> tuple[list[str], int]:
    """Return the changes of one file that its tests let pass, and how many were tried.

    Parameters
    ----------
    module : str
        The file, relative to the project's root.
    tests : sequence of str
        Test files in ``tests/``.
    sample : int, optional
        How many of the changes to try, drawn at random; all by default.

    Returns
    -------
    survivors : list of str
        One a surviving change: place, kind of change and the changed line.
    tried : int
        Number of changes that ran.
    """
    with tempfile.TemporaryDirectory(prefix="mutants_") as folder:
        tree = Path(folder)
        for name in (*_COPIED, "pyproject.toml"):
            source = ROOT / name
            copy = shutil.copytree if source.is_dir() else shutil.copy2
            copy(source, tree / name)
        command = [
            sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider",
            *(f"tests/{t}" for t in tests),
        ]  # fmt: skip
        subprocess.run(command, cwd=tree, check=True, stdout=subprocess.DEVNULL)
        others = f"^core/(?!({'|'.join(_CHANGES)})$).*"
        config = (
            f"[cosmic-ray]\nmodule-path = {module!r}\ntimeout = 120.0\n"
            f"test-command = {' '.join(command)!r}\n"
            "[cosmic-ray.distributor]\nname = 'local'\n"
            f"[cosmic-ray.filters.operators-filter]\nexclude-operators = ['{others}']\n"
        )
        (tree / "mutants.toml").write_text(config)
        _run(tree, "init", "mutants.toml", "session.sqlite")
        _run(tree, "session.sqlite", "mutants.toml", tool=(*_TOOL[:-1], "cr-filter-operators"))
        if sample is not None:
            _keep(tree / "session.sqlite", sample)
        _run(tree, "exec", "mutants.toml", "session.sqlite")
        entries = [json.loads(line) for line in _run(tree, "dump", "session.sqlite").splitlines()]
    lines = (ROOT / module).read_text().splitlines()
    ran = [(work, result) for work, result in entries if result["worker_outcome"] == "normal"]
    found = []
    for work, result in ran:
        if result["test_outcome"] != "survived":
            continue
        change = work["mutations"][0]
        row, column = change["start_pos"]
        kind = change["operator_name"].removeprefix("core/")
        found.append(f"{module}:{row}:{column} {kind}: {lines[row - 1].strip()}")
    return found, len(ran)


def _keep(session: Path, sample: int) -> None:
    """Leave ``sample`` of the changes that the filter let through, the same ones every time."""
    with closing(sqlite3.connect(session)) as store, store:
        rows = store.execute(
            "SELECT job_id FROM mutation_specs"
            " WHERE job_id NOT IN (SELECT job_id FROM work_results)"
            " ORDER BY start_pos_row, start_pos_col, operator_name, occurrence"
        ).fetchall()
        left_out = random.Random(1).sample(rows, max(len(rows) - sample, 0))
        for table in ("mutation_specs", "work_items"):
            store.executemany(f"DELETE FROM {table} WHERE job_id = ?", left_out)


def _run(tree: Path, *arguments: str, tool: Sequence[str] = _TOOL) -> str:
    done = subprocess.run([*tool, *arguments], cwd=tree, check=True, capture_output=True, text=True)
    return done.stdout


def main() -> None:
    """Print the survivors of the named files, or of all."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("files", nargs="*", default=list(RESPONSIBLE))
    parser.add_argument("--sample", type=int, help="changes to try in each file (all by default)")
    chosen = parser.parse_args()

    def tried_out(module: str) -> tuple[list[str], int]:
        return survivors(module, RESPONSIBLE[module], chosen.sample)

    with ThreadPoolExecutor(2) as pool:
        for module, (found, tried) in zip(
            chosen.files, pool.map(tried_out, chosen.files), strict=True
        ):
            print(f"{module}: {tried} changes, {len(found)} survived", flush=True)
            print("".join(f"  {line}\n" for line in found), end="", flush=True)


if __name__ == "__main__":
    main()
