"""A lock beside a file for one writer at a time, which is released when the process ends."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from dahl_ident.errors import DahlIdentError


@contextmanager
def locked(file: Path, error: type[DahlIdentError]) -> Iterator[None]:
    """Hold the lock ``<file>.lock``; raise `error` where another process holds it.

    On Windows there is no such lock.
    """
    if sys.platform == "win32":
        yield
        return
    import fcntl

    path = file.with_name(file.name + ".lock")
    while True:
        try:
            opened = path.open("w")
        except OSError as exc:
            raise error(f"{file} cannot be written: {exc.strerror or exc}") from exc
        with opened as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise error(
                    f"another run is writing {file}; wait for its end, or give another file"
                ) from None
            if not _is_still(path, lock):  # its last owner has removed it meanwhile
                continue
            try:
                yield  # the lock ends with the open file, whichever way the process ends
            finally:
                path.unlink(missing_ok=True)
            return


def _is_still(path: Path, file: IO[str]) -> bool:
    """Return whether an open file is the one that the path names."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False
