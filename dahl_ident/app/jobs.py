"""What takes time: commands one after the other in child processes, which can be stopped."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dahl_ident.app.commands import JobStep
from dahl_ident.data.storage import write_whole

_USABLE = (0, 3)  # exit status of commands whose output says whether the result may be used
_RUNNING, _ENDED, _FAILED, _CANCELLED = "running", "ended", "failed", "cancelled"


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
