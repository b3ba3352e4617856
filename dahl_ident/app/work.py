"""The files of a piece of work, and its jobs: what was uploaded, what was said of it, every run.

::

    2026-11-24-1/
      work.json       title, names of the files as uploaded, what the forms say
      data/           the files
      columns.toml    what their columns are
      report.toml     laboratory, instruments, calibrations
      run-1/          job.json, output of each step, fit.json, report.html, report.pdf, ...

Nothing is replaced but the forms' own files: a new fit is a new run. What takes time is a job:
commands one after the other in child processes, which can be stopped.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from dahl_ident.app.commands import JobStep
from dahl_ident.data.storage import write_whole
from dahl_ident.errors import DataError

_LONGEST = 60  # letters of a stored name
_ENDING = re.compile(r"(\.[A-Za-z0-9]{1,8}){1,2}$")
_IDENTITY = re.compile(r"\d{4}-\d\d-\d\d-\d+")
_USABLE = (0, 3)  # exit status of commands whose output says whether the result may be used
_RUNNING, _ENDED, _FAILED, _CANCELLED = "running", "ended", "failed", "cancelled"


def new_folder(root: Path, stem: str, first: int = 1) -> Path:
    """Make and return the next free folder of a name and a number."""
    for number in itertools.count(first):
        folder = root / f"{stem}-{number}"
        with suppress(FileExistsError):  # of an earlier one, or of another tab
            folder.mkdir()
            break
    return folder


class Work:
    """One piece of work in its folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def all(cls, root: Path) -> list[Work]:
        """Return what is in a folder, the newest first."""
        folders = [path for path in root.iterdir() if (path / "work.json").is_file()]
        return [cls(path) for path in sorted(folders, key=lambda p: -p.stat().st_mtime)]

    @classmethod
    def named(cls, root: Path, name: str) -> Work | None:
        """Return a piece of work by its folder's name; None where there is none."""
        if not _IDENTITY.fullmatch(name) or not (root / name / "work.json").is_file():
            return None
        return cls(root / name)

    @classmethod
    def create(cls, root: Path) -> Work:
        """Make a folder for a new piece of work."""
        folder = new_folder(root, time.strftime("%Y-%m-%d"))
        (folder / "data").mkdir()
        work = cls(folder)
        work.save(title="", files=[], reading={}, model={}, report={}, confirmed=False)
        return work

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.name

    @property
    def state(self) -> dict[str, Any]:
        """What ``work.json`` holds."""
        stored: dict[str, Any] = json.loads((self.folder / "work.json").read_text("utf-8"))
        return stored

    def save(self, **changes: Any) -> None:
        """Write changes of the state."""
        place = self.folder / "work.json"
        state = (self.state if place.exists() else {}) | changes
        write_whole(place, json.dumps(state, indent=1).encode(), overwrite=True)

    def write(self, name: str, text: str) -> None:
        """Write a file that a form fills; without text there is none."""
        if text:
            write_whole(self.folder / name, text.encode(), overwrite=True)
        else:
            (self.folder / name).unlink(missing_ok=True)

    def add(self, name: str, content: IO[bytes]) -> None:
        """Store an uploaded file; one of the same name is kept as well."""
        stored = self._free_place(name)
        with stored.open("xb") as out:
            shutil.copyfileobj(content, out, 1 << 20)
        state = self.state
        same = sum(file["uploaded"] == name for file in state["files"])
        shown = f"{name} ({same + 1})" if same else name
        entry = {"name": shown, "uploaded": name, "stored": f"data/{stored.name}"}
        files = [*state["files"], entry]
        self.save(files=files, title=state["title"] or name)

    def _free_place(self, name: str) -> Path:
        """Return where a file is stored: under what of its name is letters and digits."""
        last = re.split(r"[/\\]", name)[-1]
        ending = _ENDING.search(last)
        stem = last[: ending.start()] if ending else last
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_-")[:_LONGEST] or "file"
        kept = ending.group() if ending else ""
        for number in range(1, 10_000):
            place = self.folder / "data" / f"{plain}{f'_{number}' * (number > 1)}{kept}"
            if not place.exists():
                return place
        raise DataError(f"there are too many files of the name {name!r}; begin another work")

    @property
    def files(self) -> list[str]:
        """The stored files, relative to the folder."""
        return [str(file["stored"]) for file in self.state["files"]]

    def in_users_words(self, text: str) -> str:
        """Return a text of a command with the files' names as they were uploaded."""
        shown = {Path(file["stored"]).name: str(file["name"]) for file in self.state["files"]}
        names = "|".join(re.escape(name) for name in sorted(shown, key=len, reverse=True))
        pattern = rf"(?<![\w./-])(?:data/)?({names})(?!\w)"
        return re.sub(pattern, lambda match: shown[match[1]], text) if names else text

    def runs(self) -> list[Path]:
        """Return the folders of the runs, the last one first."""
        runs = [path for path in self.folder.glob("run-*") if (path / "job.json").is_file()]
        return sorted(runs, key=lambda path: -int(path.name[4:]))

    def new_run(self) -> Path:
        """Make the folder of the next run."""
        numbers = [int(path.name[4:]) for path in self.folder.glob("run-*")]
        return new_folder(self.folder, "run", 1 + max(numbers, default=0))


class Jobs:
    """The jobs of one server, by their folders."""

    def __init__(self) -> None:
        self._children: dict[Path, subprocess.Popen[bytes]] = {}
        self._running: dict[Path, dict[str, Any]] = {}
        self._lock = threading.Lock()
        self._seconds: dict[tuple[str, ...], float] = {}

    def start(self, folder: Path, steps: Sequence[JobStep], directory: Path) -> None:
        """Begin the commands of a job, in a directory; what becomes of them stands in a folder."""
        job = {
            "status": _RUNNING, "step": 0, "began": time.time(), "error": "",
            "steps": [{"title": step.title, "words": step.words} for step in steps],
        }  # fmt: skip
        with self._lock:
            self._running[folder] = job
        _save(folder, job)
        threading.Thread(target=self._run, args=(folder, job, directory), daemon=True).start()

    def _run(self, folder: Path, job: dict[str, Any], directory: Path) -> None:
        for number, step in enumerate(job["steps"]):
            job["step"], job["step_began"] = number, time.time()
            output, errors = (folder / f"{number}.{kind}" for kind in ("out", "err"))
            with output.open("wb") as out, errors.open("wb") as err:
                with self._lock:
                    if job["status"] != _RUNNING:
                        break
                    child = self._children[folder] = subprocess.Popen(
                        [sys.executable, "-m", "dahl_ident.cli", *step["words"]],
                        cwd=directory, stdin=subprocess.DEVNULL, stdout=out, stderr=err,
                        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "100"},
                    )  # fmt: skip
                status = child.wait()
            if job["status"] != _RUNNING:
                break
            if status not in _USABLE:
                job["status"], job["error"] = _FAILED, _text(errors)
                break
            self._seconds[_like(step)] = time.time() - job["step_began"]
        else:
            job["status"] = _ENDED
        job["seconds"] = time.time() - job["began"]
        _save(folder, job)
        with self._lock:
            self._running.pop(folder, None)
            self._children.pop(folder, None)

    def cancel(self, folder: Path) -> None:
        """Stop a job, if it runs."""
        with self._lock:
            job, child = self._running.get(folder), self._children.get(folder)
            if job is not None:
                job["status"] = _CANCELLED
            if child is not None and child.poll() is None:
                child.terminate()

    def stop(self) -> None:
        """Stop all jobs."""
        for folder in list(self._running):
            self.cancel(folder)

    def state(self, folder: Path) -> dict[str, Any]:
        """Return what became of a job; one that an earlier server left has been interrupted."""
        job = self._running.get(folder)
        if job is None:
            job = json.loads((folder / "job.json").read_text("utf-8"))
            if job["status"] == _RUNNING:
                job |= {"status": _CANCELLED, "error": "The server was stopped meanwhile."}
            return {**job, "left": None}
        return {**job, "seconds": time.time() - job["began"], "left": self._left(job)}

    def _left(self, job: dict[str, Any]) -> float | None:
        """Return the time left if the steps take as long as before; None where one is new."""
        took = [self._seconds.get(_like(step)) for step in job["steps"][job["step"] :]]
        if None in took:
            return None
        spent: float = time.time() - job.get("step_began", job["began"])
        return max(0.0, math.fsum(one for one in took if one is not None) - spent)

    def is_running(self, folder: Path) -> bool:
        """Return whether a job runs in a folder, or in one below."""
        return any(folder == one or folder in one.parents for one in list(self._running))


def _like(step: dict[str, Any]) -> tuple[str, ...]:
    """Return what steps that take about the same time have in common: the command and files."""
    words = [word for word in step["words"] if not word.startswith("run-")]
    return tuple(words[: words.index("--element")] if "--element" in words else words)


def output(folder: Path, number: int) -> str:
    """Return what a step of a job printed."""
    return _text(folder / f"{number}.out")


def _text(path: Path) -> str:
    return path.read_text("utf-8", errors="replace").strip() if path.exists() else ""


def _save(folder: Path, job: dict[str, Any]) -> None:
    write_whole(folder / "job.json", json.dumps(job).encode(), overwrite=True)
