"""The laws that users write: loading them from Python files, describing them, requiring them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dahl_ident.data.storage import read_text
from dahl_ident.elements.element import KINDS, Element, laws_of
from dahl_ident.elements.law_checks import is_of_package
from dahl_ident.elements.law_module import LawFile, file_of, source_path
from dahl_ident.errors import ModelError


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
    text = read_text(path, "the file of laws")
    return laws_of(LawFile(str(Path(path).resolve()), text))


def user_laws(elements: Iterable[Element]) -> list[type[Element]]:
    """Return the classes of a model's laws that users have written, including laws behind gaps."""
    laws = (type(part) for element in elements for part in (element, *element.inner_elements))
    return list(dict.fromkeys(law for law in laws if not is_of_package(law)))


def describe_laws(elements: Iterable[Element]) -> list[dict[str, Any]]:
    """Return, as plain data, where the user-written laws of a model are defined."""
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
    """Raise ModelError if a law described by :func:`describe_laws` is not registered."""
    for law in laws:
        if law["kind"] not in KINDS:
            file = law["file"] or "an interactive session, which no file holds"
            raise ModelError(
                f"{holder} has the law {law['kind']!r}, which is not known here: the class "
                f"{law['class']} of {file}; import {law['module']} first, or give that file with "
                "--laws on the command line"
            )
