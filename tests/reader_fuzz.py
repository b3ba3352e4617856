"""Damaged files of every format: each is read right, or refused, and nothing else happens.

    python -m tests.reader_fuzz --mutants 400 --seeds 1 2 3

damages a good record of each format at random and prints how many of the files were accepted
without and with a warning, refused, crashed the reader (an error that is not this package's, or
the end of its process), hung (10 s of processor time), took more than 2 GB, or were silently
wrong. Some of the damage is to bytes: silently wrong is what has samples missing, added, changed
or shifted in time, where the file shows it, and neither a warning nor a note says so. The rest is
what happens in laboratories: another header in the middle, a change of unit, a block twice, holes,
a sensor that sticks. There a fit judges: silently wrong is a usable fit with wrong values.
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
from collections.abc import Callable, Sequence
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.io import savemat

from dahl_ident.data import Record, inspect, read_record, readers
from dahl_ident.elements import Dahl
from dahl_ident.errors import DahlIdentError
from dahl_ident.results import fit

OUTCOMES = (
    "accepted", "with warning", "refused", "crashed", "hung", "above 2 GB", "silently wrong",
)  # fmt: skip
BAD = OUTCOMES[3:]
SECONDS, BYTES = 10, 2_000_000_000
_WAITING = 6  # times as long on the clock, where other processes take the processor
N = 64
TIME = np.arange(N) / 128.0
LAW = Dahl(f_max=5.0, sigma=2e4, alpha=1.0)
NOISE = np.random.default_rng(5).standard_normal((2, N))
X = 1e-3 * (0.7 + TIME) * np.sin(8 * np.pi * TIME + 0.1) + 1e-7 * NOISE[0]
F = LAW.force(X) + 2e-3 * NOISE[1]
WRONG = 0.03, 6.0  # of a value, and standard errors, by which a usable fit may be off
COLUMNS = {"time": "time [s]", "displacement": "x [m]", "force": "F [N]"}
_TEXT = ("csv", "semicolon", "lvm", "json", "uff")
_COUNTED = ("lvm", "uff")  # texts that say how many samples they hold
_CHECKED = ("csv.gz", "csv.bz2", "npz", "hdf5 packed", "matlab packed", "xlsx")  # have check sums
_WITH_HEADERS = ("csv", "semicolon", "csv.gz", "csv.bz2", "lvm", "json", "xlsx")
_LABORATORY = 0.35  # of the mutants; the rest have damaged bytes
_ODD = (b"nan", b"1e400", b"", b"#", b"_", b"[", b'"', b",", b"\x00", b"9" * 400, b"-9999", b"\n\n")
_SIZES = (0, 1, 2**31 - 1, 2**32 - 1, 2**31, 2**16, 63, 65)


Columns = Any  # of shape (3, n): time, motion, force
_HEADER = ("time [s]", "x [m]", "F [N]")
ENDINGS = {
    "csv": ".csv", "semicolon": ".txt", "csv.gz": ".csv.gz", "csv.bz2": ".csv.bz2",
    "lvm": ".lvm", "json": ".json", "tdms": ".tdms", "uff": ".uff", "npz": ".npz", "npy": ".npy",
    "parquet": ".parquet", "hdf5": ".h5", "hdf5 packed": ".h5", "matlab": ".mat",
    "matlab packed": ".mat", "matlab 4": ".mat", "xlsx": ".xlsx",
}  # fmt: skip


def written(name: str, columns: Columns, second: tuple[int, Sequence[str]] | None = None) -> bytes:
    """Return the file of a format; in some, a second header stands above one of the rows."""
    t, x, f = columns
    named = {"time": t, "x": x, "F": f}
    frame = pd.DataFrame(dict(zip(_HEADER, columns, strict=True)))
    rows = [[*_HEADER], *frame.to_numpy().tolist()]
    if second is not None:
        rows.insert(1 + second[0], [*second[1]])
    match name:
        case "csv":
            return _text(rows, ",", ".")
        case "semicolon":
            return _text(rows, ";", ",")
        case "csv.gz":
            return gzip.compress(_text(rows, ",", "."), mtime=0)
        case "csv.bz2":
            return bz2.compress(_text(rows, ",", "."))
        case "lvm":
            return _lvm(columns, second)
        case "json":
            return json.dumps(rows if second else frame.to_dict("list")).encode()
        case "tdms":
            return _tdms(x, f)
        case "uff":
            return _uff(t, x, f)
        case "npz":
            return _saved(lambda b: np.savez(b, **named))
        case "npy":
            table = np.empty(t.size, dtype=[(key, "f8") for key in named])
            for key, values in named.items():
                table[key] = values
            return _saved(lambda b: np.save(b, table))
        case "parquet":
            return _saved(lambda b: frame.to_parquet(_kept_open(b)))
        case "hdf5":
            return _hdf5(named, {})
        case "hdf5 packed":
            return _hdf5(named, {"compression": "gzip", "fletcher32": True})
        case "xlsx":
            sheet = pd.DataFrame(rows)
            return _saved(lambda b: sheet.to_excel(b, index=False, header=False))
        case _:
            options: dict[str, Any] = {
                "matlab packed": {"do_compression": True},
                "matlab 4": {"format": "4"},
            }
            save: Any = savemat
            return _saved(lambda b: save(b, named, **options.get(name, {})))


def _text(rows: list[list[Any]], separator: str, mark: str) -> bytes:
    lines = (
        separator.join(c if isinstance(c, str) else repr(c).replace(".", mark) for c in row)
        for row in rows
    )
    return ("\n".join(lines) + "\n").encode()


def _kept_open(buffer: io.BytesIO) -> io.BytesIO:
    buffer.close = lambda: None  # type: ignore[method-assign]  # writers close it
    return buffer


def _saved(write: Callable[[io.BytesIO], Any]) -> bytes:
    buffer = io.BytesIO()
    write(buffer)
    return buffer.getvalue()


def _lvm(columns: Columns, second: tuple[int, Sequence[str]] | None) -> bytes:
    parts = "LabVIEW Measurement\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tOne\n"
    parts += "***End_of_Header***\n"
    at, other = (None, ()) if second is None else second
    ends = [0, columns.shape[1]] if at is None else [0, at, columns.shape[1]]
    for start, stop in pairwise(ends):
        labels = [h.strip(' "').split(" [") for h in (other if start else _HEADER)]
        units = "\t".join(label[1][:-1] for label in labels[1:] if len(label) > 1)
        names = "\t".join(label[0] for label in labels[1:])
        parts += f"\nChannels\t2\nSamples\t{stop - start}\t{stop - start}\nY_Unit_Label\t{units}\n"
        parts += f"X_Dimension\tTime\tTime\n***End_of_Header***\nX_Value\t{names}\tComment\n"
        rows = columns[:, start:stop].T.tolist()
        parts += "".join(f"{t!r}\t{x!r}\t{f!r}\n" for t, x, f in rows)
    return parts.encode()


def _tdms(x: Any, f: Any) -> bytes:
    nptdms: Any = importlib.import_module("nptdms")
    wave = {"wf_increment": 1 / 128.0}
    channels = [
        nptdms.ChannelObject("rig", "x", x, {"unit_string": "m", **wave}),
        nptdms.ChannelObject("rig", "F", f, {"unit_string": "N", **wave}),
    ]
    buffer = io.BytesIO()
    with nptdms.TdmsWriter(buffer) as writer:
        writer.write_segment(channels)
    return buffer.getvalue()


def uff_function(data: Any, x: Any, kind: int, numerator: int, **changes: Any) -> dict[str, Any]:
    """Return one data set 58 for pyuff."""
    return {
        "type": 58, "func_type": kind, "rsp_node": 1, "rsp_dir": 3, "ref_node": 2, "ref_dir": 3,
        "data": data, "x": x, "id1": "test", "rsp_ent_name": "rig", "ref_ent_name": "rig",
        "abscissa_spacing": 1, "abscissa_spec_data_type": 18 if kind == 4 else 17,
        "ordinate_spec_data_type": numerator,
        "orddenom_spec_data_type": 13 if kind == 4 else 0, **changes,
    }  # fmt: skip


def write_uff(path: Path, *sets: dict[str, Any]) -> Path:
    """Write a universal file."""
    pyuff: Any = importlib.import_module("pyuff")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # pyuff leaves files open
        pyuff.UFF(str(path)).write_sets(list(sets), mode="overwrite")
        gc.collect()
    return path


def _uff(t: Any, x: Any, f: Any) -> bytes:
    sets = [
        uff_function(values, t, 1, kind, ordinate_axis_units_lab=unit)
        for values, kind, unit in ((x, 8, "m"), (f, 13, "N"))
    ]
    with tempfile.TemporaryDirectory() as folder:
        return write_uff(Path(folder) / "run.uff", *sets).read_bytes()


def _hdf5(named: dict[str, Any], options: dict[str, Any]) -> bytes:
    h5py: Any = importlib.import_module("h5py")
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as root:
        for unit, (name, values) in zip("smN", named.items(), strict=True):
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


def laboratory(rng: np.random.Generator, name: str) -> tuple[str, bytes]:
    """Return a file with damage as laboratories do it, and the kind of damage."""
    kinds = ["unit switch", "hole", "stuck"] + ["block twice"] * (name != "tdms")
    kind = str(rng.choice(kinds + ["second header"] * 3 * (name in _WITH_HEADERS)))
    columns = np.array([TIME, X, F])
    first = 1 if kind == "second header" else 8  # that show what the unit was
    a, length = int(rng.integers(first, N - first)), int(rng.integers(8, 32))
    block = slice(a, a + length if rng.random() < 0.5 else N)
    row = int(rng.integers(1, 3))
    if kind == "unit switch":
        columns[int(rng.integers(3)), block] *= float(rng.choice([1e3, 1e-3]))
    elif kind == "hole":
        columns[[[row], [1, 2]][int(rng.integers(2))], a : a + length] = 0.0
    elif kind == "stuck":
        columns[row, a : a + length] = columns[row, a]
    elif kind == "block twice":
        columns = np.concatenate([columns[:, : a + length], columns[:, a:]], axis=1)
    else:
        variants: dict[str, Callable[[], Sequence[str]]] = {
            "unit": lambda: _in_unit(columns, a, 1, 1e3, "x [mm]"),
            "unit of force": lambda: _in_unit(columns, a, 2, 1e-3, "F [kN]"),
            "swapped": lambda: _swapped(columns, a),
            "case": lambda: [h.upper() if h[0] != "t" else h.title() for h in _HEADER],
            "blanks": lambda: [f" {h} " for h in _HEADER],
            "quotes": lambda: [f'"{h}"' for h in _HEADER],
            "same": lambda: _HEADER,
        }
        variant = str(rng.choice(list(variants)))
        return f"second header, {variant}", written(name, columns, (a, variants[variant]()))
    return kind, written(name, columns)


def _in_unit(columns: Columns, a: int, row: int, factor: float, label: str) -> Sequence[str]:
    columns[row, a:] *= factor
    return [label if i == row else h for i, h in enumerate(_HEADER)]


def _swapped(columns: Columns, a: int) -> Sequence[str]:
    columns[1:, a:] = columns[:0:-1, a:].copy()
    return [_HEADER[0], _HEADER[2], _HEADER[1]]


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

    def __init__(self, parsed: Callable[[Any, str | None], Any]) -> None:
        self.parsed = parsed
        self.key: tuple[str, ...] | None = None
        self.found: Any = None

    def __call__(self, file: Any, sheet: str | None) -> Any:
        key = (file.name, file.sha256, str(sheet))
        if key != self.key:
            self.key = self.found = None  # an HDF5 file stays open as long as it is kept
            try:
                self.found = self.parsed(file, sheet)
            except DahlIdentError as exc:
                self.found = exc
            self.key = key
        if isinstance(self.found, DahlIdentError):
            raise self.found
        return self.found


def judge(path: Path, name: str, kind: str) -> str:
    """Read one file as a user would, and say what came out."""
    prefix = "data." if path.suffix == ".npy" else ""
    ways: list[dict[str, Any]] = [{}, {"columns": {k: prefix + v for k, v in COLUMNS.items()}}]
    outcome, warned = "refused", False
    for options in ways:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                record = read_record(path, **options)
            except DahlIdentError as exc:
                if isinstance(exc.__cause__, MemoryError):
                    return "above 2 GB"
                if "is damaged" in str(exc):  # whatever the columns are called
                    return "refused"
                continue
        outcome = "accepted"
        known = record.provenance or {}  # a file that is parsed once warns once
        # a file of an earlier case, closed late, is not a doubt about this one
        told = [w for w in said if not issubclass(w.category, ResourceWarning)]
        doubts = [*told, *known.get("warnings", ())]
        notes = [n for n in known.get("notes", ()) if "not used" not in n]
        warned |= bool(doubts or notes)
        if not doubts and not notes and _is_wrong(record, name, kind):
            return "silently wrong"
    with contextlib.suppress(DahlIdentError), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        repr(inspect(path))
    return "with warning" if warned and outcome == "accepted" else outcome


def _is_wrong(record: Record, name: str, kind: str) -> bool:
    """Return whether samples are missing, added, changed or shifted, where the file shows it."""
    if kind.startswith(LABORATORY):
        return _misleads(record)
    if record.n != N:  # a table in text has no count: whole lines may go or come
        return name not in ("csv", "semicolon", "json") or visible(name, kind)
    if not visible(name, kind):
        return False
    pairs = ((record.time, TIME), (record.motion_samples, X), (record.force_samples, F))
    return not all(np.allclose(found, good, rtol=1e-5, atol=1e-9) for found, good in pairs)


LABORATORY = ("unit switch", "hole", "stuck", "block twice", "second header")


def _misleads(record: Record) -> bool:
    """Return whether a fit to the record looks usable, and has wrong values."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found = fit(record, Dahl(alpha=1.0), throw=False)
        except DahlIdentError:
            return False
    if said or not found.status.usable:
        return False
    share, errors = WRONG
    return any(
        abs(found.params[p].value - true)
        > max(share * true, errors * (found.params[p].stderr or 0))
        for p, true in (("f_max", 5.0), ("sigma", 2e4))
    )


class _StoppedError(BaseException):
    """Reading takes too long; no reader may take this for damage."""


def _work(pipe: Connection) -> None:
    """Judge files until there are no more; the process may die of one."""
    with contextlib.suppress(ImportError):
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + BYTES, used + BYTES))

    def stop(*_: Any) -> None:
        raise _StoppedError

    readers._parsed = ParsedOnce(readers._parsed)
    signal.signal(signal.SIGALRM, stop)
    signal.signal(signal.SIGPROF, stop)
    with tempfile.TemporaryDirectory() as folder:
        while (task := pipe.recv()) is not None:
            name, content, kind = task
            path = Path(folder) / f"run{ENDINGS[name]}"
            path.unlink(missing_ok=True)  # a library may still have the last one open
            path.write_bytes(content)
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            signal.alarm(_WAITING * SECONDS)
            try:
                outcome, why = judge(path, name, kind), ""
            except _StoppedError:
                outcome, why = "hung", ""
            except MemoryError:
                outcome, why = "above 2 GB", ""
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
    suffix, content = ENDINGS[name], files()[name]
    rng = np.random.default_rng([seed, sum(name.encode())])
    counts: Counter[str] = Counter()
    bad: list[str] = []
    for i in range(mutants):
        if rng.random() < _LABORATORY:
            kind, damaged = laboratory(rng, name)
        else:
            kind, damaged = mutant(rng, content, name in _TEXT)
        outcome, why = reader.judge(name, damaged, kind)
        counts[outcome] += 1
        if outcome in BAD:
            bad.append(f"{name}, seed {seed}, mutant {i} ({kind}): {outcome} {why}")
            if keep:
                (keep / f"{name.replace(' ', '_')}_{seed}_{i}{suffix}").write_bytes(damaged)
    return counts, bad


def main() -> int:
    """Print the table; the status is 1 where one of its last four columns is not zero."""
    parser = argparse.ArgumentParser(description="Damage files and read them.")
    parser.add_argument("--mutants", type=int, default=400, help="files for each format and seed")
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3])
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
        counts: Counter[str] = Counter()
        for seed in arguments.seeds:
            found, bad = fuzz(name, arguments.mutants, seed, reader, arguments.keep)
            counts += found
            failures += bad
        write(f"{name:<15}" + "".join(f"{counts[o]:>16}" for o in OUTCOMES) + "\n")
        sys.stdout.flush()
        total += counts
    write(f"{'all':<15}" + "".join(f"{total[o]:>16}" for o in OUTCOMES) + "\n")
    write("".join(f"{line}\n" for line in failures[:40]))
    reader.close()
    return bool(failures)


@functools.cache
def files() -> dict[str, bytes]:
    """Return a good file of each format, made once."""
    return {name: written(name, np.array([TIME, X, F])) for name in ENDINGS}


if __name__ == "__main__":
    sys.exit(main())
