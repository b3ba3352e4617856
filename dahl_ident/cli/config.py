"""Options from a TOML file, such as the standard options of a laboratory.

Options outside of tables apply to every command that has them; a table named after a command
applies to that command only. An unknown name is refused, so that a misspelt option cannot silently
leave a default in place. An option that may be given several times is a list, or, if it assigns
values to names, a table such as ``[sample.prior]`` with ``f_max = [0.01, 1]`` and ``mass =
"norm(0.3, 0.001)"``.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import typer

from dahl_ident.errors import DataError, choices


def take_options(ctx: typer.Context, path: Path | None) -> Path | None:
    """Read the options that are not given on the command line from a TOML file."""
    if path is None:
        return None
    from dahl_ident.data.storage import read_text

    try:
        content = tomllib.loads(read_text(path))
    except (DataError, tomllib.TOMLDecodeError) as exc:
        raise DataError(f"{path}: no TOML file of options: {exc}") from exc
    tables = {k: v for k, v in content.items() if isinstance(v, dict)}
    shared = _named({k: v for k, v in content.items() if k not in tables})
    of_command = _named(tables.get(ctx.info_name or "", {}))
    commands = _options_of_commands(ctx)
    known = commands.get(ctx.info_name or "", set())
    _refuse_unknown(path, "no command is called", tables, commands.keys())
    _refuse_unknown(path, f"{ctx.info_name} has no option", of_command, known)
    _refuse_unknown(path, "no command has the option", shared, set().union(*commands.values()))
    chosen = {k: v for k, v in shared.items() if k in known} | of_command
    several = {p.name for p in ctx.command.params if getattr(p, "multiple", False)}
    several |= {p.name for p in ctx.command.params if p.nargs != 1}
    ctx.default_map = {k: _repeated(v) if k in several else _joined(v) for k, v in chosen.items()}
    return path


def _repeated(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _joined(value: Any) -> Any:
    return ",".join(map(str, value)) if isinstance(value, list) else value


def _options_of_commands(ctx: typer.Context) -> dict[str, set[str]]:
    """Return the names of the options of every command."""
    commands: Mapping[str, Any] = getattr(ctx.find_root().command, "commands", {})
    return {
        name: {p.name for p in command.params} - {"config"} for name, command in commands.items()
    }


def _refuse_unknown(path: Path, what: str, names: Iterable[str], known: Collection[str]) -> None:
    unknown = sorted(set(names) - set(known))
    if unknown:
        raise DataError(
            f"{path}: {what} {', '.join(unknown)}; there are {choices(sorted(known), *unknown)}"
        )


def _named(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options by the names of their parameters, values as they would be typed."""
    return {k.replace("-", "_"): _typed(v) for k, v in options.items()}


def _typed(value: Any) -> Any:
    if isinstance(value, dict):
        return [f"{name}={_assigned(item)}" for name, item in value.items()]
    if isinstance(value, list):
        return [_typed(item) for item in value]
    return value if isinstance(value, bool) else str(value)


def _assigned(value: Any) -> str:
    """Return bounds as ``low:high``, anything else unchanged."""
    return ":".join(map(str, value)) if isinstance(value, list) else str(value)
