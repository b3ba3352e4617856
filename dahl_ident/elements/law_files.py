"""Laws by their kinds, and Python files in which users define laws.

A file becomes a module whose name is made from its path and content, so that it can neither hide
another module nor be mistaken for an earlier version of itself. It is run once in each process. An
element whose class comes from a file is pickled with the file's content, so that any process can
unpickle it.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
import traceback
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

from dahl_ident.data.storage import read_text
from dahl_ident.elements.law_checks import check_declarations, is_of_package
from dahl_ident.errors import DahlIdentError, ModelError

if TYPE_CHECKING:
    from dahl_ident.elements.element import Element


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

KINDS: dict[str, type[Element]] = {}
"""Every element class by its name in files and on the command line."""


def register(cls: type[Element]) -> None:
    """Enter a class under its kind; a file that is run again replaces its own classes."""
    other = KINDS.get(cls.kind)
    if other and _origin(other) != _origin(cls):
        raise ModelError(
            f"{cls.__name__} has the kind {cls.kind!r}, which {other.__module__}."
            f"{other.__qualname__} has already; choose another"
        )
    KINDS[cls.kind] = cls


def _origin(cls: type) -> tuple[str, str]:
    return source_path(cls) or cls.__module__, cls.__qualname__


def class_named(name: str) -> type[Element] | None:
    """Return the class with this kind, or else with this name; None if there is none."""
    named = [cls for cls in KINDS.values() if cls.__name__ == name]
    return KINDS.get(name) or (named[0] if len(named) == 1 else None)


def load_laws(path: str | Path) -> tuple[type[Element], ...]:
    """Run a Python file, register the laws that it defines by their kinds, and return them.

    Parameters
    ----------
    path : path
        A Python file with subclasses of ``Friction`` or ``Element``. The file is run: give only
        files that you trust.

    Returns
    -------
    tuple of type
        In the order of the file. The kind of a class without a `kind` is its name.

    Raises
    ------
    DataError
        If the file cannot be read.
    ModelError
        If it fails, defines no law, or a law has the kind of another one.
    ValidationError
        If a law's parameters are not declared as they should be.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import mkdtemp
    >>> file = Path(mkdtemp()) / "my_laws.py"
    >>> _ = file.write_text('''
    ... import dahl_ident as di
    ... class Hardening(di.Friction):
    ...     parameters = (di.Parameter("sigma", "N/m", "stiffness", lower=0.0, transform="log"),)
    ...     def slope(self, force, direction, velocity, values):
    ...         return values[0] * (2 + direction * force / (1 + abs(force)))
    ... ''')
    >>> [law.kind for law in load_laws(file)]
    ['Hardening']
    """
    return run_file(LawFile(str(Path(path).resolve()), read_text(path, "the file of laws")))


def run_file(file: LawFile) -> tuple[type[Element], ...]:
    """Return the laws of a file, which is run unless this process has run it already."""
    from dahl_ident.elements.element import Element

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
    laws: tuple[Any, ...] = tuple(
        value
        for value in vars(sys.modules[name]).values()
        if isinstance(value, type)
        and issubclass(value, Element)
        and value.__module__ == name
        and not inspect.isabstract(value)
    )
    if not laws:
        raise ModelError(
            f"{file.path} defines no law; expected a subclass of di.Friction with parameters and "
            "slope"
        )
    for law in laws:
        if not law.__dict__.get("kind"):
            law.kind = law.__name__
        check_declarations(law)
        register(law)
    return laws


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


def empty_element(file: LawFile, name: str) -> Any:
    """Return an element without attributes, of a class that a file defines, for pickle to fill."""
    if file.module not in _FILES:
        run_file(file)
    return object.__new__(attrgetter(name)(sys.modules[file.module]))


def user_laws(elements: Iterable[Element]) -> list[type[Element]]:
    """Return the classes of a model's laws that a user has written, also of those behind gaps."""
    laws = (type(part) for element in elements for part in (element, *element.inner_elements))
    return list(dict.fromkeys(law for law in laws if not is_of_package(law)))


def describe_laws(elements: Iterable[Element]) -> list[dict[str, Any]]:
    """Return where the laws of a model that a user has written are defined, as plain data."""
    descriptions = []
    for law in user_laws(elements):
        file = file_of(law)
        description = {
            "kind": law.kind,
            "class": law.__qualname__,
            "module": Path(file.path).stem if file else law.__module__,
            "file": source_path(law),
        }
        descriptions.append(description)
    return descriptions


def require_laws(laws: Sequence[Mapping[str, Any]], holder: str) -> None:
    """Raise ModelError if a law that :func:`describe_laws` described is not registered."""
    for law in laws:
        if law["kind"] not in KINDS:
            file = law["file"] or "an interactive session, which no file holds"
            raise ModelError(
                f"{holder} has the law {law['kind']!r}, which is not known here: the class "
                f"{law['class']} of {file}; import {law['module']} first, or give that file with "
                "--laws on the command line"
            )
