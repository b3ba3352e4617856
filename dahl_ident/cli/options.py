"""Common options, how several of them are declared once, and options from a TOML file.

A command takes a dataclass of options as one argument; :func:`with_option_groups` presents its
fields to Typer as single options and combines them again before the command runs.

A TOML file has, for example, the standard options of a laboratory. Options outside of tables apply
to every command that has them; a table named after a command applies to that command only. An
unknown name is refused, so that a misspelt option cannot silently leave a default in place. An
option that may be given several times is a list, or, if it assigns values to names, a table such as
``[sample.prior]`` with ``f_max = [0.01, 1]`` and ``mass = "norm(0.3, 0.001)"``.
"""

from __future__ import annotations

import functools
import inspect
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_type_hints

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD
from dahl_ident.cli.values import number
from dahl_ident.errors import DataError, ModelError, UnitError, ValidationError, choices


def take_options(ctx: typer.Context, path: Path | None) -> Path | None:
    """Read the options that are not given on the command line from a TOML file."""
    if path is None:
        return None
    from dahl_ident.data.storage import read_text

    try:
        content = tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as exc:
        raise DataError(f"{path} is not a TOML file of options: {exc}") from exc
    command = ctx.info_name or ""
    tables = {
        name: {k.replace("-", "_"): v for k, v in options.items()}
        for name, options in content.items()
        if isinstance(options, dict)
    }
    shared = {k.replace("-", "_"): v for k, v in content.items() if k not in tables}
    every: Mapping[str, Any] = getattr(ctx.find_root().command, "commands", {})
    commands = {name: {p.name for p in c.params} - {"config"} for name, c in every.items()}
    common = {p.name for c in every.values() for p in c.params if p.param_type_name == "option"}
    known = commands.get(command, set())
    _refuse_unknown(path, "no command is called", tables, commands.keys())
    for name, options in tables.items():
        _refuse_unknown(path, f"{name} has no option", options, commands[name])
    _refuse_unknown(path, "no command has the option", shared, common - {"config"})
    chosen = {k: v for k, v in shared.items() if k in known} | tables.get(command, {})
    parameters = ctx.command.params
    several = {p.name for p in parameters if getattr(p, "multiple", False) or p.nargs != 1}
    ctx.default_map = {k: _typed(v, several=k in several) for k, v in chosen.items()}
    return path


def _typed(value: Any, *, several: bool) -> Any:
    """Return a value as it would be typed, bounds as ``low:high``; `several` values as a list."""
    if isinstance(value, dict):
        value = [
            f"{name}={':'.join(map(str, item)) if isinstance(item, list) else item}"
            for name, item in value.items()
        ]
    each = value if isinstance(value, list) else [value]
    words = [item if isinstance(item, bool) else str(item) for item in each]
    if several:
        return words
    return ",".join(map(str, words)) if isinstance(value, list) else words[0]


def _refuse_unknown(path: Path, what: str, names: Iterable[str], known: Collection[str]) -> None:
    unknown = sorted(set(names) - set(known))
    if unknown:
        raise DataError(
            f"{path}: {what} {', '.join(unknown)}; there are {choices(sorted(known), *unknown)}"
        )


def option(
    help_text: str,
    *names: str,
    one_of: str = "",
    unit: str = "",
    panel: str | None = None,
    **how: Any,
) -> Any:
    """Return an option of Typer.

    `one_of` are its values, such as ``"lm|scipy"``, which the shell completes; an option with a
    `unit` takes a number in SI, or one with its unit.
    """
    if one_of:
        values = one_of.split("|")

        def check(value: str | None) -> str | None:
            if value is not None and value not in values:
                raise typer.BadParameter(f"{value!r} is not one of {choices(values, value)}")
            return value

        how |= {"callback": check, "autocompletion": starting(values)}
    if unit:

        def parse(text: str) -> float:
            try:
                return number("it", str(text), unit)
            except (ModelError, UnitError) as exc:
                raise typer.BadParameter(str(exc)) from exc

        how |= {"parser": parse, "metavar": f"<{unit}>"}
    return typer.Option(*names, help=help_text, rich_help_panel=panel, **how)


OutputFile = Annotated[
    str | None, option("File to write; - is standard output, as CSV.", "--output", "-o")
]
Seed = Annotated[int, option("Seed of the random numbers.")]


def setting(help_text: str, default: Any = None, *names: str, **how: Any) -> Any:
    """Return the field of a group for an option; its panel in the help is that of the group."""
    return field(default=default, metadata={"option": partial(option, help_text, *names, **how)})


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Return `command` with the fields of its dataclass arguments as separate options."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name not in groups:
            parameters.append(parameter.replace(annotation=hints[name]))
            continue
        group = groups[name]
        types = get_type_hints(group)
        for item in fields(group):
            declared = item.metadata["option"]
            panel = {"panel": group.panel} | declared.keywords
            declared = Annotated[types[item.name], declared(**panel)]
            parameters.append(
                parameter.replace(name=item.name, default=item.default, annotation=declared)
            )

    @functools.wraps(command)
    def run(**typed: Any) -> None:
        built = {
            name: group(**{f.name: typed.pop(f.name) for f in fields(group)})
            for name, group in groups.items()
        }
        command(**typed, **built)

    parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in parameters]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined] # typer reads it
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def starting(names: Iterable[str]) -> Callable[[str], list[str]]:
    """Return a function that completes the beginning of a word."""
    return lambda incomplete: [name for name in names if name.startswith(incomplete)]


def steady_setting(default: str | None = "exact") -> Any:
    """Return the option that says how the response to a controlled force is predicted."""
    help_text = "Response to a force that is held: exact, or 'describing function' (sine assumed)."
    return setting(help_text, default, one_of="exact|describing function")


def controlled_setting(default: str | None = "displacement") -> Any:
    """Return the option for the controlled quantity."""
    help_text = "Controlled quantity: displacement or force."
    return setting(help_text, default, one_of="displacement|force")


def _silence(quiet: bool) -> bool:
    console.session.quiet = quiet
    return quiet


@dataclass(frozen=True)
class General:
    """The options of every command."""

    panel: ClassVar[str | None] = None
    json: bool = setting("Print JSON.", False, "--json")
    quiet: bool = setting(
        "Print only errors, and what is written to standard output (-).",
        False,
        "--quiet",
        "-q",
        callback=_silence,
    )
    config: Path | None = setting(
        "TOML file of options; a table named after a command, such as \\[fit], applies to "
        "that command only. The command line has precedence.",
        is_eager=True,
        callback=take_options,
    )


@dataclass(frozen=True)
class Laws:
    """Laws of the user."""

    panel: ClassVar[str] = "Model"
    laws: list[Path] | None = setting(
        "Python file with laws of your own, which --element then knows by kind or class name. "
        "The file is run: give only files that you trust. Repeatable."
    )

    def run(self) -> None:
        """Run the files, so that models can name the laws in them."""
        for file in self.laws or ():
            from dahl_ident.elements.law_files import load_laws

            load_laws(file)


@dataclass(frozen=True)
class Writing:
    """The treatment of existing files."""

    panel: ClassVar[str | None] = None
    overwrite: bool = setting("Replace existing files.", False, "--overwrite")

    def check(
        self,
        outputs: Sequence[str | Path | None],
        inputs: Sequence[str] = (),
        *,
        json: bool = False,
    ) -> None:
        """Refuse outputs that would destroy files, before any work is done.

        Raises
        ------
        ValidationError
            If an output is one of the inputs, or several outputs are standard output.
        DataError
            If an output exists and may not be replaced, or its folder does not exist.
        """
        from dahl_ident.data.storage import refuse_existing

        places = [str(output) for output in outputs if output is not None]
        if places.count(STANDARD) + json > 1:
            raise ValidationError(
                "more than one output goes to standard output, - and --json included; give files "
                "for all but one"
            )
        read = {Path(file).resolve() for file in inputs if file != STANDARD}
        for place in map(Path, (place for place in places if place != STANDARD)):
            if place.resolve() in read:
                raise ValidationError(
                    f"{place} is an input and would be overwritten; give the output another name"
                )
            refuse_existing(place, overwrite=self.overwrite)
            if not place.parent.is_dir():
                raise DataError(
                    f"{place}: there is no folder {place.parent}; make it, or give another place"
                )
