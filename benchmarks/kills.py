"""SIGKILLs at random moments of every command: the same command then gives the same result.

``python -m benchmarks.kills --kills 200`` runs each command once undisturbed, then kills it some
times in one folder, lets it end, and compares what it wrote with the undisturbed files. After each
kill the files that are there must be whole. Dates in reports and seconds in tables are left out.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import dahl_ident as di
from dahl_ident.data.storage import library

PROGRAM = str(Path(sys.executable).with_name("dahl-ident"))
DESTINATION = Path("docs/validation/kills.md")
IN_A_ROW = 4
"""Kills before a command may end."""
COMMANDS = {
    "datasets": "datasets noisy -o table.csv --overwrite",
    "simulate": "simulate --f-max 0.1 --sigma 30 --record -o record.csv --overwrite",
    "inspect": "inspect {}/record.csv -o columns.toml --overwrite",
    "extract": "extract {}/record.csv -o levels.csv --overwrite",
    "fit": "fit {}/table.csv --save fit.json --report fit.html --overwrite",
    "sample": "sample {}/table.csv --seed 1 --steps 300 --resume chain.h5 --report chain.html "
    "--overwrite",
    "plan": "plan {}/fit.json --frequency 5Hz --displacement 0.1:10mm --time 600 "
    "--table plan.csv --overwrite",
    "report": "report {}/table.csv -o report.pdf -o report.html -o report.json --overwrite",
    "campaign": "campaign {}/lab.toml --jobs 2 --report campaign.html --overwrite",
    "export": "export {}/fit.json --to c -o friction.h --overwrite",
    "demo": "demo -o out --overwrite",
}
_DATES = re.compile(rb"D:\d{14}\S*|\d{4}-\d\d-\d\d[T ]\d\d:\d\d[^<\"]*|/ID\s*\[<\w+><\w+>\]")
_GROWING = {"journal.jsonl", "digests.json", "chain.h5"}
"""Files that are not written at once; the first two hold seconds and times."""


def main() -> None:
    """Kill, compare, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--write", type=Path, default=DESTINATION)
    given = parser.parse_args()
    rng, rows = random.Random(1), []
    with tempfile.TemporaryDirectory() as temporary:
        inputs = Path(temporary) / "inputs"
        _prepare(inputs)
        for number, name in enumerate(given.commands):
            share = (given.kills * (number + 1)) // len(given.commands)
            share -= (given.kills * number) // len(given.commands)
            rows.append(_disturbed(name, inputs, share, rng))
            print(*rows[-1], flush=True)
    _write(given.write, rows)


def _prepare(folder: Path) -> None:
    folder.mkdir()
    data = di.load_dataset("noisy")
    data.save(folder / "table.csv")
    di.load_dataset("plant_recording").save(folder / "record.csv")
    assert isinstance(data, di.FrequencyResponse)
    di.fit(data, di.Dahl()).save(folder / "fit.json")
    for device in range(4):
        data.save(folder / f"d{device}.csv")
    (folder / "lab.toml").write_text(
        '[files]\npattern = "{device}.csv"\nkind = "response"\n[[model]]\nkind = "dahl"\n'
    )


def _disturbed(name: str, inputs: Path, kills: int, rng: random.Random) -> tuple[str, int, int]:
    """Return the command, how often it was killed, and how many results differed."""
    place = inputs.parent / name
    began = time.perf_counter()
    reference = _ended(name, inputs, place)
    duration = time.perf_counter() - began
    done = wrong = 0
    while done < kills:
        _clear(name, inputs, place)
        for _ in range(min(IN_A_ROW, kills - done)):
            run = subprocess.Popen(
                _command(name, inputs), cwd=place, start_new_session=True,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
            try:
                run.wait(rng.uniform(0.0, 1.05) * duration)
            except subprocess.TimeoutExpired:
                os.kill(run.pid, signal.SIGKILL)
                run.wait()
                done += 1
                there = _contents(name, inputs, place)
                wrong += any(reference.get(k) != v for k, v in there.items() if not _grows(k))
            else:
                _clear(name, inputs, place)
        found = _ended(name, inputs, place, clear=False)
        if found != reference:
            wrong += 1
            differ = [k for k in {*found, *reference} if found.get(k) != reference.get(k)]
            print(f"{name}: differ: {differ}", flush=True)
    return name, done, wrong


def _grows(name: str) -> bool:
    return Path(name).name in _GROWING


def _command(name: str, inputs: Path) -> list[str]:
    return [PROGRAM, *COMMANDS[name].replace("{}", str(inputs)).split()]


def _clear(name: str, inputs: Path, place: Path) -> None:
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    if name == "campaign":
        shutil.rmtree(inputs / "results", ignore_errors=True)


def _ended(name: str, inputs: Path, place: Path, *, clear: bool = True) -> dict[str, bytes]:
    if clear:
        _clear(name, inputs, place)
    run = subprocess.run(_command(name, inputs), cwd=place, capture_output=True, check=False)
    assert run.returncode in (0, 3), run.stderr.decode()
    return _contents(name, inputs, place)


def _contents(name: str, inputs: Path, place: Path) -> dict[str, bytes]:
    """Return the files that a command has written, without the times noted in them."""
    found = {}
    for folder in (place, *([inputs / "results"] if name == "campaign" else [])):
        for path in sorted(folder.rglob("*")):
            if path.is_file() and not path.name.startswith(".") and path.suffix != ".lock":
                found[str(path.relative_to(inputs.parent))] = _lasting(path)
    return found


def _lasting(path: Path) -> bytes:
    if path.name == "journal.jsonl" or path.name == "digests.json":
        return b""
    if path.suffix in (".h5", ".parquet"):
        return _numbers(path)
    if path.name == "results.csv":
        import pandas as pd

        return pd.read_csv(path).drop(columns="seconds").to_csv().encode()
    if path.suffix == ".pdf":
        return _printed(path)
    return _DATES.sub(b"", path.read_bytes())


def _printed(path: Path) -> bytes:
    """Return texts and pictures of a PDF; its pages are packed, dates included."""
    parts = []
    for page in library("pypdf").PdfReader(path).pages:
        parts.append(_DATES.sub(b"", page.extract_text().encode()))
        parts += [picture.data for picture in page.images]
    return b"\n".join(parts)


def _numbers(path: Path) -> bytes:
    if path.suffix == ".parquet":
        import pandas as pd

        return pd.read_parquet(path).drop(columns="seconds").to_csv().encode()
    try:
        with library("h5py").File(path, "r") as file:
            return b"".join(bytes(file[key][...].tobytes()) for key in sorted(file))
    except OSError:
        return b"not readable"


def _write(page: Path, rows: list[tuple[str, int, int]]) -> None:
    lines = [
        "# Kills", "",
        "`python -m benchmarks.kills` kills each command at random moments, "
        f"{IN_A_ROW} times in a row,", "repeats it until it ends, and compares its files bit by "
        "bit with those of an undisturbed run.", "",
        "| command | kills | files that were half written, or differed |", "|---|---|---|",
        *(f"| {name} | {kills} | {wrong} |" for name, kills, wrong in rows),
        f"| together | {sum(r[1] for r in rows)} | {sum(r[2] for r in rows)} |",
    ]  # fmt: skip
    page.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
