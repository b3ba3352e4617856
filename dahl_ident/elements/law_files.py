"""Laws by their kinds, and files in which users define some: run once, taken along by pickles.

A file becomes a module of a name made from its path and content, so that it can neither hide
another module nor be mistaken for an earlier version of itself. An element whose class comes from a
file is pickled with the file's content: whichever process unpickles it has the law.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Iterable, Mapping, Sequence
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
        Where it was read from.
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
"""Files that were run, by the names of their modules."""

KINDS: dict[str, type[Element]] = {}
"""Every element class by the name that files and the command line know it by."""


def register(cls: type[Element]) -> None:
    """Make a class known by its kind; a file that is run again replaces its own classes."""
    known = KINDS.get(cls.kind)
    home, known_home = (known and (source_path(c) or c.__module__) for c in (cls, known or cls))
    if known and (known_home, known.__qualname__) != (home, cls.__qualname__):
        raise ModelError(
            f"{cls.__name__} has the kind {cls.kind!r}, which {known.__module__}."
            f"{known.__qualname__} has already; choose another"
        )
    KINDS[cls.kind] = cls


def class_named(name: str) -> type[Element] | None:
    """Return the class with this kind, or else with this name; None if there is none."""
    named = [cls for cls in KINDS.values() if cls.__name__ == name]
    return KINDS.get(name) or (named[0] if len(named) == 1 else None)


def load_laws(path: str | Path) -> tuple[type[Element], ...]:
    """Run a Python file, and return the laws that it defines; they are known by their kinds.

    Parameters
    ----------
    path : path
        A Python file with subclasses of ``Friction`` or ``Element``. The file is run: give only
        files that you trust.

    Returns
    -------
    tuple of type
        In the order of the file. A class without a `kind` has its name as kind.

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
    return run(LawFile(str(Path(path).resolve()), read_text(path, "the file of laws")))


def run(file: LawFile) -> tuple[type[Element], ...]:
    """Return the laws of a file, which is run where this process has not done it yet."""
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
        if isinstance(value, type) and issubclass(value, Element) and value.__module__ == name
        and not inspect.isabstract(value)
    )  # fmt: skip
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
    """Return the line of a file where it failed, such as ":12"."""
    number = exc.lineno if isinstance(exc, SyntaxError) else None
    trace = exc.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == path:
            number = trace.tb_lineno
        trace = trace.tb_next
    return "" if number is None else f", line {number}"


def file_of(law: type) -> LawFile | None:
    """Return the file of a law that was loaded from one."""
    return _FILES.get(law.__module__)


def source_path(law: type) -> str | None:
    """Return the path of the file in which a law is defined, however it was loaded."""
    path = getattr(sys.modules.get(law.__module__), "__file__", None)
    return None if path is None else str(Path(path).resolve())


def restored(file: LawFile, name: str) -> Any:
    """Return an element without its content, of a class that a file defines."""
    if file.module not in _FILES:
        run(file)
    cls: Any = sys.modules[file.module]
    for part in name.split("."):
        cls = getattr(cls, part)
    return object.__new__(cls)


def user_laws(elements: Iterable[Element]) -> list[type[Element]]:
    """Return the classes of a model's laws that are not this package's; those behind gaps too."""
    both = (type(part) for element in elements for part in (element, *element.inner_elements))
    return list(dict.fromkeys(law for law in both if not is_of_package(law)))


def describe_laws(elements: Iterable[Element]) -> list[dict[str, Any]]:
    """Return what to import for the laws of a model that are not this package's, as plain data."""
    descriptions = []
    for law in user_laws(elements):
        path, file = source_path(law), file_of(law)
        module = Path(file.path).stem if file else law.__module__
        about = {"kind": law.kind, "class": law.__qualname__, "module": module, "file": path}
        descriptions.append(about)
    return descriptions


def require_laws(laws: Sequence[Mapping[str, Any]], holder: str) -> None:
    """Refuse to go on without the laws that :func:`describe_laws` described."""
    for law in laws:
        if law["kind"] not in KINDS:
            file = law["file"] or "an interactive session, which no file holds"
            raise ModelError(
                f"{holder} has the law {law['kind']!r}, which is not known here: the class "
                f"{law['class']} of {file}; import {law['module']} first, or give that file with "
                "--laws on the command line"
            )
