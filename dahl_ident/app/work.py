"""The files of a piece of work (uploads, form entries, runs), and the jobs that fill them.

::

    2026-11-24-1/
      work.json       title, names of the files as uploaded, entries of the forms
      data/           the files
      columns.toml    column map of these files
      report.toml     laboratory, instruments, calibrations
      run-1/          job.json, output of each step, fit.json, report.html, report.pdf, ...

Only the files of the forms are ever replaced: a new fit is a new run. A task that takes time is a
job: successive commands in child processes, which can be stopped.
"""

from __future__ import annotations

import itertools
import json
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

_LONGEST_NAME = 60  # letters of a stored name
_ENDING = re.compile(r"(\.[A-Za-z0-9]{1,8}){1,2}$")
_IDENTITY = re.compile(r"\d{4}-\d\d-\d\d-\d+")
_SUCCESS = (0, 3)  # exit status of commands with a result; 3: not to be used, as the output says
_RUNNING, _ENDED, _FAILED, _CANCELLED = "running", "ended", "failed", "cancelled"


def new_folder(root: Path, stem: str, first: int = 1) -> Path:
    """Make and return the folder with the next free number."""
    for number in itertools.count(first):
        folder = root / f"{stem}-{number}"
        with suppress(FileExistsError):  # made earlier, or by another tab
            folder.mkdir()
            break
    return folder


class Work:
    """One piece of work in its folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def all(cls, root: Path) -> list[Work]:
        """Return all pieces of work in a folder, the newest first."""
        folders = [path for path in root.iterdir() if (path / "work.json").is_file()]
        return [cls(path) for path in sorted(folders, key=lambda p: -p.stat().st_mtime)]

    @classmethod
    def named(cls, root: Path, name: str) -> Work | None:
        """Return a piece of work by the name of its folder; None if there is none."""
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
        """The content of ``work.json``."""
        stored: dict[str, Any] = json.loads((self.folder / "work.json").read_text("utf-8"))
        return stored

    def save(self, **changes: Any) -> None:
        """Save changes of the state."""
        path = self.folder / "work.json"
        state = (self.state if path.exists() else {}) | changes
        write_whole(path, json.dumps(state, indent=1).encode(), overwrite=True)

    def write(self, name: str, text: str) -> None:
        """Write the file of a form; remove it if the text is empty."""
        if text:
            write_whole(self.folder / name, text.encode(), overwrite=True)
        else:
            (self.folder / name).unlink(missing_ok=True)

    def add(self, name: str, content: IO[bytes]) -> None:
        """Store an uploaded file; an earlier one of the same name is kept."""
        stored = self._free_path(name)
        with stored.open("xb") as out:
            shutil.copyfileobj(content, out, 1 << 20)
        state = self.state
        same = sum(file["uploaded"] == name for file in state["files"])
        shown = f"{name} ({same + 1})" if same else name
        entry = {"name": shown, "uploaded": name, "stored": f"data/{stored.name}"}
        files = [*state["files"], entry]
        self.save(files=files, title=state["title"] or name)

    def _free_path(self, name: str) -> Path:
        """Return a new path for a file, whose stem has only letters and digits of its name."""
        last = re.split(r"[/\\]", name)[-1]
        match = _ENDING.search(last)
        ending = match.group() if match else ""
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", last.removesuffix(ending)).strip("_-")
        stem = stem[:_LONGEST_NAME] or "file"
        for number in range(1, 10_000):
            path = self.folder / "data" / f"{stem}{f'_{number}' * (number > 1)}{ending}"
            if not path.exists():
                return path
        raise DataError(f"there are too many files of the name {name!r}; begin another work")

    @property
    def files(self) -> list[str]:
        """The stored files, relative to the folder."""
        return [str(file["stored"]) for file in self.state["files"]]

    def with_uploaded_names(self, text: str) -> str:
        """Return the output of a command with the names of the files as uploaded."""
        shown = {Path(file["stored"]).name: str(file["name"]) for file in self.state["files"]}
        names = "|".join(re.escape(name) for name in sorted(shown, key=len, reverse=True))
        pattern = rf"(?<![\w./-])(?:data/)?({names})(?!\w)"
        return re.sub(pattern, lambda match: shown[match[1]], text) if names else text

    def runs(self) -> list[Path]:
        """Return the folders of the runs, the latest first."""
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
        """Start the commands of a job in a directory; their output is written to a folder."""
        job = {
            "status": _RUNNING,
            "step": 0,
            "began": time.time(),
            "error": "",
            "steps": [{"title": step.title, "words": step.words} for step in steps],
        }
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
                        cwd=directory,
                        stdin=subprocess.DEVNULL,
                        stdout=out,
                        stderr=err,
                        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "100"},
                    )
                status = child.wait()
            if job["status"] != _RUNNING:
                break
            if status not in _SUCCESS:
                job["status"], job["error"] = _FAILED, _text(errors)
                break
            self._seconds[_timing_key(step)] = time.time() - job["step_began"]
        else:
            job["status"] = _ENDED
        job["seconds"] = time.time() - job["began"]
        _save(folder, job)
        with self._lock:
            self._running.pop(folder, None)
            self._children.pop(folder, None)

    def cancel(self, folder: Path) -> None:
        """Stop a job if it is running."""
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
        """Return the state of a job; one left running by an earlier server was interrupted."""
        job = self._running.get(folder)
        if job is None:
            job = json.loads((folder / "job.json").read_text("utf-8"))
            if job["status"] == _RUNNING:
                job |= {"status": _CANCELLED, "error": "The server was stopped meanwhile."}
            return {**job, "left": None}
        return {**job, "seconds": time.time() - job["began"], "left": self._remaining_time(job)}

    def _remaining_time(self, job: dict[str, Any]) -> float | None:
        """Return the remaining time if the steps take as long as before; None if one is new."""
        remaining: float = job.get("step_began", job["began"]) - time.time()
        for step in job["steps"][job["step"] :]:
            if (key := _timing_key(step)) not in self._seconds:
                return None
            remaining += self._seconds[key]
        return max(0.0, remaining)

    def is_running(self, folder: Path) -> bool:
        """Return whether a job is running in a folder, or in one below it."""
        return any(folder == one or folder in one.parents for one in list(self._running))


def _timing_key(step: dict[str, Any]) -> tuple[str, ...]:
    """Return command and files of a step: steps with the same take about the same time."""
    words = [word for word in step["words"] if not word.startswith("run-")]
    return tuple(words[: words.index("--element")] if "--element" in words else words)


def output(folder: Path, number: int) -> str:
    """Return the output of a step of a job."""
    return _text(folder / f"{number}.out")


def _text(path: Path) -> str:
    return path.read_text("utf-8", errors="replace").strip() if path.exists() else ""


def _save(folder: Path, job: dict[str, Any]) -> None:
    write_whole(folder / "job.json", json.dumps(job).encode(), overwrite=True)
