"""The files of a piece of work: what was uploaded, what was said of it, and every run.

::

    2026-11-24-1/
      work.json       title, names of the files as uploaded, what the forms say
      data/           the files
      columns.toml    what their columns are
      report.toml     laboratory, instruments, calibrations
      run-1/          job.json, output of each step, fit.json, report.html, report.pdf, ...

Nothing is replaced but the forms' own files: a new fit is a new run.
"""

from __future__ import annotations

import json
import re
import shutil
import time
from pathlib import Path
from typing import IO, Any

from dahl_ident.data.storage import write_whole
from dahl_ident.errors import DataError

_LONGEST = 60  # characters of a stored name
_ENDING = re.compile(r"(\.[A-Za-z0-9]{1,8}){1,2}$")
_IDENTITY = re.compile(r"\d{4}-\d\d-\d\d-\d+")


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
        day = time.strftime("%Y-%m-%d")
        for number in range(1, 10_000):
            folder = root / f"{day}-{number}"
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            (folder / "data").mkdir()
            work = cls(folder)
            work.save(title="", files=[], reading={}, model={}, report={}, confirmed=False)
            return work
        raise DataError(f"{root}: there are too many folders of {day}; give another folder")

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
        number = 1 + max((int(path.name[4:]) for path in self.folder.glob("run-*")), default=0)
        while True:
            folder = self.folder / f"run-{number}"
            try:
                folder.mkdir()
            except FileExistsError:  # of another tab
                number += 1
                continue
            return folder
