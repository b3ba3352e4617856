"""The command-line reference, made from the commands themselves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective
from typer.main import get_command

from dahl_ident.cli.app import app as program


def setup(app: Any) -> dict[str, Any]:
    """Add the directive ``commands``."""
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


class Commands(SphinxDirective):
    """One section a command: what it does, its arguments and its options."""

    def run(self) -> list[Any]:
        """Return the sections."""
        lines = StringList(list(described()), source="dahl-ident --help")
        return list(self.parse_text_to_nodes("\n".join(lines), allow_section_headings=True))


def described() -> Iterator[str]:
    """Yield the reference in reStructuredText, line by line."""
    for name, command in get_command(program).commands.items():  # type: ignore[attr-defined]  # a group
        title = f"dahl-ident {name}"
        yield from (title, "-" * len(title), "")
        for paragraph in (command.help or "").split("\n\n"):
            text = " ".join(paragraph.split())
            if text.startswith("Example: "):
                yield from ("Example::", "", f"    {text.removeprefix('Example: ')}", "")
            else:
                yield from (_plain(text), "")
        for parameter in command.params:
            if not getattr(parameter, "hidden", False):
                yield from (f"``{_usage(parameter)}``", f"    {_explained(parameter)}", "")


def _usage(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return str(parameter.name).upper()
    names = ", ".join([*parameter.opts, *parameter.secondary_opts])
    return names if parameter.is_flag else f"{names} {_value(parameter)}"


def _value(parameter: Any) -> str:
    """Return the word for an option's value, such as TEXT; releases of Typer keep it apart."""
    if parameter.metavar:
        return str(parameter.metavar)
    kind = getattr(parameter, "type", None)
    if kind is not None:
        return str(kind.name).upper()
    return {"int": "INTEGER", "float": "NUMBER", "Path": "PATH"}.get(
        getattr(parameter.type_descriptor.annotation, "__name__", ""), "TEXT"
    )


def _explained(parameter: Any) -> str:
    default = parameter.default
    shown = isinstance(default, (str, int, float)) and not isinstance(default, bool)
    text = _plain(" ".join((getattr(parameter, "help", "") or "").split()))
    return f"{text} Default: ``{default}``." if shown and str(default) else text or "\\-"


def _plain(text: str) -> str:
    """Return text in which nothing is taken for markup."""
    return "".join(f"\\{c}" if c in "\\*`_|" else c for c in text)
