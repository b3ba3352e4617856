"""Run every comparison: ``python -m benchmarks [--write FILE]``."""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import os
import platform
from pathlib import Path

from benchmarks.harness import as_table

TOPICS = (
    "describing_function",
    "general_dahl",
    "hysteresis",
    "time_domain",
    "compiled_laws",
    "steady_state",
    "error_bars",
    "reading",
    "extraction",
    "long_records",
    "fitting",
    "ipopt",
    "bayes",
    "command_line",
)
PACKAGES = ("numpy", "scipy", "casadi", "emcee", "control", "lmfit")


def main() -> None:
    """Print all tables, and write them to a file with ``--write``."""
    parser = argparse.ArgumentParser(description="time this package and its peers")
    parser.add_argument(
        "topics", nargs="*", default=TOPICS, help=f"topics to run: {', '.join(TOPICS)}"
    )
    parser.add_argument("--write", type=Path, help="write the tables to this Markdown file")
    arguments = parser.parse_args()
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)
    parts = [
        "# Benchmarks\n\nMeasured side by side by `make bench`; ratios carry over to "
        "other machines, times do not.\n\n"
        f"Python {platform.python_version()}, {versions}. {os.cpu_count()} processors, "
        f"load average {os.getloadavg()[0]:.1f} at the start. Times are "
        "processor times; on a busy machine they are up to twice those on an idle one."
    ]
    print(parts[0])
    for topic in arguments.topics:
        module = importlib.import_module(f"benchmarks.{topic}")
        parts.append(as_table(module.TITLE, module.run()))
        print(parts[-1], flush=True)
    if arguments.write:
        arguments.write.write_text("\n".join(parts) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
