"""Python files in which users define laws, as modules.

A file becomes a module whose name is made from its path and content, so that it can neither hide
another module nor be mistaken for an earlier version of itself. It is run once in each process. An
element whose class comes from a file is pickled with the file's content, so that any process can
unpickle it.
"""

from __future__ import annotations

import hashlib
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from dahl_ident.errors import DahlIdentError, ModelError


class LawFile(NamedTuple):
    """A file that defines laws; plain data.

    Attributes
    ----------
    path : str
        The path from which it was read.
    source : str
        Its content.
    """

    path: str
    source: str

    @property
    def digest(self) -> str:
        """SHA-256 digest of the content."""
        return hashlib.sha256(self.source.encode()).hexdigest()

    @property
    def module(self) -> str:
        """Name of the module that the file becomes."""
        return f"{Path(self.path).stem}_{hashlib.sha256(repr(self).encode()).hexdigest()[:16]}"


_FILES: dict[str, LawFile] = {}
"""Files that this process has run, by the names of their modules."""


def module_of(file: LawFile) -> ModuleType:
    """Return the module that a file becomes; it is run unless this process has run it already."""
    path, name = Path(file.path), file.module
    if name not in _FILES:
        module = ModuleType(name)
        module.__file__ = file.path
        folder = str(path.parent)
        sys.modules[name], _FILES[name] = module, file
        sys.path.insert(0, folder)
        try:
            exec(compile(file.source, file.path, "exec"), module.__dict__)
        except BaseException as exc:
            del sys.modules[name], _FILES[name]
            if isinstance(exc, DahlIdentError) or not isinstance(exc, (Exception, SystemExit)):
                raise
            raise ModelError(
                f"{file.path}{_line(exc, file.path)}: {type(exc).__name__}: {exc}; expected a "
                "Python file that defines laws and can be run"
            ) from exc
        finally:
            sys.path.remove(folder)
    return sys.modules[name]


def _line(exc: BaseException, path: str) -> str:
    """Return the line of a file at which it failed, such as ", line 12"."""
    frames = traceback.extract_tb(exc.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == path]
    if not lines and isinstance(exc, SyntaxError):
        lines = [exc.lineno]
    return f", line {lines[-1]}" if lines and lines[-1] else ""


def file_of(law: type) -> LawFile | None:
    """Return the file from which a law was loaded, if it was."""
    return _FILES.get(law.__module__)


def source_path(law: type) -> str | None:
    """Return the path of the file that defines a law, loaded or imported; None if there is none."""
    path = getattr(sys.modules.get(law.__module__), "__file__", None)
    return None if path is None else str(Path(path).resolve())
