"""Generate the shipped data sets again: ``python -m dahl_ident.synthetic.regenerate``.

Each consists of a data file, a JSON file that declares it, to which the true parameters and the
SHA-256 are added, and a row in the table of the README. To add one, write a JSON file with name,
experiment, seed, teaches, identifiable, not_identifiable and caution. On one platform and version
the files are reproduced to the byte; on any platform their values agree to 1e-12.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from dataclasses import replace
from pathlib import Path

from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.synthetic.lab import simulate
from dahl_ident.synthetic.shipped import DataSet, data_sets, datasets_directory


def make(data_set: DataSet) -> Record | FrequencyResponse:
    """Return the data of a data set from its experiment and seed."""
    return simulate(data_set.experiment, seed=data_set.seed)


def write(data_set: DataSet, directory: Path) -> None:
    """Write the data file and its JSON file."""
    data = make(data_set)
    provenance = dict(data.provenance or {})
    bare = replace(data, provenance={"dataset": data_set.name})
    file = bare.save(directory / data_set.file, overwrite=True)
    names = ("teaches", "identifiable", "not_identifiable", "caution")
    sidecar = {name: getattr(data_set, name) for name in ("name", "kind", "file")}
    sidecar["sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
    sidecar |= {name: getattr(data_set, name) for name in names} | provenance
    text = json.dumps(sidecar, indent=1, ensure_ascii=False) + "\n"
    (directory / f"{data_set.name}.json").write_text(text, encoding="utf-8")


def readme() -> str:
    """Return the README of the data sets, with one row for each."""
    rows = [
        f"| `{s.name}` | {s.kind.replace('_', ' ')} | {s.teaches} "
        f"| {', '.join(s.identifiable)} | {', '.join(s.not_identifiable) or '-'} "
        f"| {s.caution or '-'} |"
        for s in data_sets().values()
    ]
    return _README.format(rows="\n".join(rows))


_README = """# Synthetic data sets

Simulated by `dahl_ident.synthetic`, so that the truth is known. Load one with
`dahl_ident.load_dataset("noisy")`; the truth is in its `provenance["truth"]`.

| name | kind | what it teaches | determines | does not determine | flaw to be named |
|---|---|---|---|---|---|
{rows}

"Determines" means: a standard deviation of the parameter's logarithm below 0.25 with every
listed parameter free (for `delayed`, the sensors' force gain and delay as well).

Each set is a CSV file with units in its headers (records packed with gzip) and a JSON file with
the true parameters, the experiment and seed that made it, the generator's version and the
SHA-256 of the CSV file. `python -m dahl_ident.synthetic.regenerate` writes all of them, and
this page.
"""


def main(arguments: list[str] | None = None) -> int:
    """Write all data sets, or the named ones, into a directory."""
    parser = argparse.ArgumentParser(description="Generate the synthetic data sets again.")
    parser.add_argument("names", nargs="*", help="all, if none is named")
    parser.add_argument("--directory", type=Path, default=None, help="where to write them")
    parsed = parser.parse_args(arguments)
    known = data_sets()
    unknown = [name for name in parsed.names if name not in known]
    if unknown:
        parser.error(f"there is no data set {', '.join(unknown)}; there are {', '.join(known)}")
    directory = parsed.directory or datasets_directory()
    for name in parsed.names or known:
        write(known[name], directory)
        sys.stdout.write(f"{directory / known[name].file}\n")
    (directory / "README.md").write_text(readme(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
