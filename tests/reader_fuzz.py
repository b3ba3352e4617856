"""Damaged files of every format: each is read right, or refused, and nothing else happens.

    python -m tests.reader_fuzz --mutants 2000

damages a good record of each format at random and prints how many of the files were accepted,
refused, crashed the reader (an error that is not this package's, the end of its process, or more
than 1 GB), hung (10 s of processor time), or were silently wrong: samples are missing, added,
changed or shifted in time, the file shows it, and neither a warning nor a note says so.
"""

from __future__ import annotations

import argparse
import bz2
import contextlib
import functools
import gc
import gzip
import importlib
import io
import json
import multiprocessing
import signal
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.io import savemat

from dahl_ident.data import Record, inspect, read_record, readers
from dahl_ident.data.raw_columns import Source
from dahl_ident.data.readers.file import File
from dahl_ident.errors import DahlIdentError

OUTCOMES = ("accepted", "refused", "crashed", "hung", "silently wrong")
SECONDS, BYTES = 10, 1 << 30
_WAITING = 6  # times as long on the clock, where other processes take the processor
N = 64
TIME = np.arange(N) / 128.0
X = 1e-3 * np.sin(8 * np.pi * TIME + 0.1)
F = 5.0 * np.cos(8 * np.pi * TIME + 0.2)
COLUMNS = {"time": "time [s]", "displacement": "x [m]", "force": "F [N]"}
_TEXT = ("csv", "semicolon", "lvm", "json", "uff")
_COUNTED = ("lvm", "uff")  # texts that say how many samples they hold
_CHECKED = ("csv.gz", "csv.bz2", "npz", "hdf5 packed", "matlab packed", "xlsx")  # have check sums
_ODD = (b"nan", b"1e400", b"", b"#", b"_", b"[", b'"', b",", b"\x00", b"9" * 400, b"-9999", b"\n\n")
_SIZES = (0, 1, 2**31 - 1, 2**32 - 1, 2**31, 2**16, 63, 65)


def good_files() -> dict[str, tuple[str, bytes]]:
    """Return the extension and the bytes of one good file for each format."""
    frame = pd.DataFrame({"time [s]": TIME, "x [m]": X, "F [N]": F})
    csv = frame.to_csv(index=False, lineterminator="\n").encode()
    return {
        "csv": (".csv", csv),
        "semicolon": (".txt", frame.to_csv(sep=";", decimal=",", index=False).encode()),
        "csv.gz": (".csv.gz", gzip.compress(csv, mtime=0)),
        "csv.bz2": (".csv.bz2", bz2.compress(csv)),
        "lvm": (".lvm", _lvm()),
        "json": (".json", json.dumps(frame.to_dict("list")).encode()),
        "tdms": (".tdms", _tdms()),
        "uff": (".uff", _uff()),
        "npz": (".npz", _saved(lambda b: np.savez(b, **_named()))),
        "npy": (".npy", _saved(lambda b: np.save(b, _table()))),
        "parquet": (".parquet", _saved(lambda b: frame.to_parquet(_kept_open(b)))),
        "hdf5": (".h5", _hdf5({})),
        "hdf5 packed": (".h5", _hdf5({"compression": "gzip", "fletcher32": True})),
        "matlab": (".mat", _matlab()),
        "matlab packed": (".mat", _matlab(do_compression=True)),
        "matlab 4": (".mat", _matlab(format="4")),
        "xlsx": (".xlsx", _saved(lambda b: frame.to_excel(b, index=False))),
    }


def _named() -> dict[str, Any]:
    return {"time": TIME, "x": X, "F": F}


def _table() -> Any:
    table = np.empty(N, dtype=[("time", "f8"), ("x", "f8"), ("F", "f8")])
    table["time"], table["x"], table["F"] = TIME, X, F
    return table


def _matlab(**options: Any) -> bytes:
    save: Any = savemat
    return _saved(lambda b: save(b, _named(), **options))


def _kept_open(buffer: io.BytesIO) -> io.BytesIO:
    buffer.close = lambda: None  # type: ignore[method-assign]
    return buffer


def _saved(write: Callable[[io.BytesIO], Any]) -> bytes:
    buffer = io.BytesIO()
    write(buffer)
    return buffer.getvalue()


def _lvm() -> bytes:
    head = (
        "LabVIEW Measurement\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tOne\n"
        "***End_of_Header***\n\nChannels\t2\nSamples\t64\t64\nY_Unit_Label\tm\tN\n"
        "X_Dimension\tTime\tTime\n***End_of_Header***\nX_Value\tx\tF\tComment\n"
    )
    rows = (f"{t!r}\t{x!r}\t{f!r}\n" for t, x, f in np.column_stack([TIME, X, F]).tolist())
    return (head + "".join(rows)).encode()


def _tdms() -> bytes:
    nptdms: Any = importlib.import_module("nptdms")
    wave = {"wf_increment": 1 / 128.0}
    channels = [
        nptdms.ChannelObject("rig", "x", X, {"unit_string": "m", **wave}),
        nptdms.ChannelObject("rig", "F", F, {"unit_string": "N", **wave}),
    ]
    buffer = io.BytesIO()
    with nptdms.TdmsWriter(buffer) as writer:
        writer.write_segment(channels)
    return buffer.getvalue()


def _uff() -> bytes:
    pyuff: Any = importlib.import_module("pyuff")
    sets = [
        {
            "type": 58, "func_type": 1, "rsp_node": 1, "rsp_dir": 3, "ref_node": 2, "ref_dir": 3,
            "data": values, "x": TIME, "id1": "test", "rsp_ent_name": "rig",
            "ref_ent_name": "rig", "abscissa_spacing": 1, "abscissa_spec_data_type": 17,
            "ordinate_spec_data_type": kind, "orddenom_spec_data_type": 0,
            "ordinate_axis_units_lab": unit,
        }
        for values, kind, unit in ((X, 8, "m"), (F, 13, "N"))
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        path = Path(folder) / "run.uff"
        pyuff.UFF(str(path)).write_sets(sets, mode="overwrite")
        gc.collect()
        return path.read_bytes()


def _hdf5(options: dict[str, Any]) -> bytes:
    h5py: Any = importlib.import_module("h5py")
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as root:
        for name, values, unit in (("time", TIME, "s"), ("x", X, "m"), ("F", F, "N")):
            root.create_dataset(name, data=values, **options).attrs["unit"] = unit
    return buffer.getvalue()


def mutant(rng: np.random.Generator, content: bytes, text: bool) -> tuple[str, bytes]:
    """Return a damaged copy, and the kind of damage."""
    kinds = ["flip", "size", "cut", "delete", "double", "insert", "swap", "whole twice"]
    kind = str(rng.choice(kinds + ["odd", "blank line", "odd", "number"] * text))
    n = len(content)
    # half of the damage to the first part, where headers are
    a = int(rng.integers(n) if rng.random() < 0.5 else rng.integers(min(n, 1024)))
    b = min(n, a + int(2 ** rng.uniform(0.0, 9.0)))
    data = bytearray(content)
    if kind == "flip":
        for place in rng.integers(a, b, max(1, (b - a) // 32)):
            data[place] ^= 1 << int(rng.integers(8))
    elif kind == "size":
        size = int(rng.choice(_SIZES))
        data[a : a + 4] = size.to_bytes(4, "little" if rng.random() < 0.7 else "big")
    elif kind == "cut":
        del data[a:]
    elif kind == "delete":
        del data[a:b]
    elif kind == "double":
        data[b:b] = data[a:b]
    elif kind == "insert":
        data[a:a] = rng.bytes(b - a)
    elif kind == "swap":
        c = int(rng.integers(n))
        data[a:b], data[c : c + b - a] = content[c : c + b - a], content[a:b]
    elif kind == "whole twice":
        data += content
    elif kind == "blank line":
        at = content.find(b"\n", a)
        data[at:at] = b"\n"
    elif kind == "number":
        at = content.find(b"0.", a)
        data[at : at + 3] = b"1_0"
    else:
        data[a : a + int(rng.integers(8))] = _ODD[int(rng.integers(len(_ODD)))]
    return kind, bytes(data)


def visible(name: str, kind: str) -> bool:
    """Return whether a file of this format shows this kind of damage.

    A digit or a bit that changed leaves a good file where there is no check sum; bytes that are
    gone or added do not fit the sizes that binary files give, and lines not the counts of texts.
    """
    if name in _CHECKED or kind in ("none", "whole twice", "blank line"):
        return True
    if name in _TEXT:
        return kind == "cut" and name in _COUNTED
    return kind in ("cut", "delete", "double", "insert")


class ParsedOnce:
    """Parses a file once, in however many ways it is then read."""

    def __init__(self, parsed: Callable[[File, str | None], Source]) -> None:
        self.parsed = parsed
        self.key: tuple[str, ...] | None = None
        self.found: Source | DahlIdentError | None = None

    def __call__(self, file: File, sheet: str | None) -> Source:
        key = (file.name, file.sha256, str(sheet))
        if key != self.key:
            self.key = self.found = None  # an HDF5 file stays open as long as it is kept
            try:
                self.found = self.parsed(file, sheet)
            except DahlIdentError as exc:
                self.found = exc
            self.key = key
        if isinstance(self.found, Source):
            return self.found
        assert self.found is not None  # set above
        raise self.found


def judge(path: Path, name: str, kind: str) -> str:
    """Read one file as a user would, and say what came out."""
    prefix = "data." if path.suffix == ".npy" else ""
    ways: list[dict[str, Any]] = [{}, {"columns": {k: prefix + v for k, v in COLUMNS.items()}}]
    outcome = "refused"
    for options in ways:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                record = read_record(path, **options)
            except DahlIdentError as exc:
                if "is damaged" in str(exc):  # whatever the columns are called
                    return "refused"
                continue
        outcome = "accepted"
        known = record.provenance or {}  # a file that is parsed once warns once
        said = [*said, *known.get("warnings", ())]
        notes = [n for n in known.get("notes", ()) if "not used" not in n]
        if not said and not notes and _is_wrong(record, name, kind):
            return "silently wrong"
    with contextlib.suppress(DahlIdentError), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        repr(inspect(path))
    return outcome


def _is_wrong(record: Record, name: str, kind: str) -> bool:
    """Return whether samples are missing, added, changed or shifted, where the file shows it."""
    if record.n != N:  # a table in text has no count: whole lines may go or come
        return name not in ("csv", "semicolon", "json") or visible(name, kind)
    if not visible(name, kind):
        return False
    pairs = ((record.time, TIME), (record.motion_samples, X), (record.force_samples, F))
    return not all(np.allclose(found, good, rtol=1e-5, atol=1e-9) for found, good in pairs)


def _work(pipe: Connection) -> None:
    """Judge files until there are no more; the process may die of one."""
    with contextlib.suppress(ImportError):
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + BYTES, used + BYTES))

    def stop(*_: Any) -> None:
        raise TimeoutError

    readers._parsed = ParsedOnce(readers._parsed)
    signal.signal(signal.SIGALRM, stop)
    signal.signal(signal.SIGPROF, stop)
    with tempfile.TemporaryDirectory() as folder:
        while (task := pipe.recv()) is not None:
            name, content, kind = task
            path = Path(folder) / f"run{files()[name][0]}"
            path.unlink(missing_ok=True)  # a library may still have the last one open
            path.write_bytes(content)
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            signal.alarm(_WAITING * SECONDS)
            try:
                outcome, why = judge(path, name, kind), ""
            except TimeoutError:
                outcome, why = "hung", ""
            except BaseException as exc:
                outcome, why = "crashed", f"{type(exc).__name__}: {exc}"[:300]
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.alarm(0)
            pipe.send((outcome, why))


class Reader:
    """A process that judges files, and is replaced when it dies or hangs."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("fork")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_work, args=(other,), daemon=True)
        self.process.start()
        other.close()

    def judge(self, name: str, content: bytes, kind: str) -> tuple[str, str]:
        """Return what happened, and the error if it was none of this package's."""
        self.pipe.send((name, content, kind))
        try:
            if self.pipe.poll(2 * _WAITING * SECONDS):
                outcome: tuple[str, str] = self.pipe.recv()
                return outcome
            found = ("hung", "no answer")
        except (EOFError, ConnectionError):
            found = ("crashed", "the process ended")
        self.close()
        self._start()
        return found

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def fuzz(
    name: str, mutants: int, seed: int, reader: Reader, keep: Path | None = None
) -> tuple[Counter[str], list[str]]:
    """Return how often each outcome came, and a line for each that should not."""
    suffix, content = files()[name]
    rng = np.random.default_rng([seed, sum(name.encode())])
    counts: Counter[str] = Counter()
    bad: list[str] = []
    for i in range(mutants):
        kind, damaged = mutant(rng, content, name in _TEXT)
        outcome, why = reader.judge(name, damaged, kind)
        counts[outcome] += 1
        if outcome in OUTCOMES[2:]:
            bad.append(f"{name}, seed {seed}, mutant {i} ({kind}): {outcome} {why}")
            if keep:
                (keep / f"{name.replace(' ', '_')}_{seed}_{i}{suffix}").write_bytes(damaged)
    return counts, bad


def main() -> int:
    """Print the table; the status is 1 where one of its last three columns is not zero."""
    parser = argparse.ArgumentParser(description="Damage files and read them.")
    parser.add_argument("--mutants", type=int, default=2000, help="files for each format")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--formats", nargs="*", help="some formats only")
    parser.add_argument("--keep", type=Path, help="folder for the files that went wrong")
    arguments = parser.parse_args()
    files()  # before the process that reads them: libraries set memory aside when they start
    reader = Reader()
    failures: list[str] = []
    write = sys.stdout.write
    write(f"{'format':<15}" + "".join(f"{name:>16}" for name in OUTCOMES) + "\n")
    total: Counter[str] = Counter()
    for name in files():
        if arguments.formats and name not in arguments.formats:
            continue
        counts, bad = fuzz(name, arguments.mutants, arguments.seed, reader, arguments.keep)
        write(f"{name:<15}" + "".join(f"{counts[o]:>16}" for o in OUTCOMES) + "\n")
        sys.stdout.flush()
        total += counts
        failures += bad
    write(f"{'all':<15}" + "".join(f"{total[o]:>16}" for o in OUTCOMES) + "\n")
    write("".join(f"{line}\n" for line in failures[:40]))
    reader.close()
    return bool(failures)


@functools.cache
def files() -> dict[str, tuple[str, bytes]]:
    """Return the good files, made once."""
    return good_files()


if __name__ == "__main__":
    sys.exit(main())
