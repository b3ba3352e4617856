"""The options: how files are read, which model is fitted, how the result is told."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.errors import DataError, ModelError

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse
    from dahl_ident.elements import Element

_READING = "Reading"
_MODEL = "Model"
_FREE = "free"


def _from_config(ctx: typer.Context, path: Path | None) -> Path | None:
    """Take options that the command line leaves out from a TOML file."""
    if path is None:
        return None
    try:
        given = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as exc:
        raise DataError(f"{path}: no TOML file of options: {exc}") from exc
    shared = {k: v for k, v in given.items() if not isinstance(v, dict)}
    own = given.get(ctx.info_name or "", {})
    known = {p.name for p in ctx.command.params} - {"config", None}
    options = {k.replace("-", "_"): v for k, v in own.items()}
    unknown = sorted(options.keys() - known)
    if unknown:
        raise DataError(
            f"{path}: {ctx.info_name} has no option {', '.join(unknown)}; it has "
            f"{', '.join(sorted(map(str, known)))}"
        )
    # what stands outside the commands' tables is meant for those that know it
    common = {k.replace("-", "_"): v for k, v in shared.items()}
    ctx.default_map = {k: v for k, v in common.items() if k in known} | options
    return path


Files = Annotated[list[str], typer.Argument(help="Files to read; - is standard input.")]
Seed = Annotated[int, typer.Option(help="Seed of the random numbers.")]


@dataclass(frozen=True)
class General:
    """What every command knows."""

    json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False
    config: Annotated[
        Path | None,
        typer.Option(
            is_eager=True,
            callback=_from_config,
            help="TOML file of options; a table named after the command, such as \\[fit], is for "
            "it alone. The command line wins.",
        ),
    ] = None


@dataclass(frozen=True)
class Reading:
    """How tables are read; the words of ``read_frequency_response``."""

    columns: Annotated[
        Path | None, typer.Option(help="Column map, a TOML file.", rich_help_panel=_READING)
    ] = None
    quantity: Annotated[
        str | None,
        typer.Option(
            help="What the response is, such as receptance; by default its unit tells.",
            rich_help_panel=_READING,
        ),
    ] = None
    amplitude: Annotated[
        str | None,
        typer.Option(help='Displacement amplitude, "5 um rms".', rich_help_panel=_READING),
    ] = None
    drive: Annotated[
        str | None,
        typer.Option(help='Force amplitude, "0.2 N" or "{level} N".', rich_help_panel=_READING),
    ] = None
    drive_factor: Annotated[
        str | None,
        typer.Option(help='Force for one unit of drive, "12.5 N/V".', rich_help_panel=_READING),
    ] = None
    level: Annotated[
        str | None, typer.Option(help="Label for all rows.", rich_help_panel=_READING)
    ] = None
    level_from_name: Annotated[
        str | None,
        typer.Option(
            help="Regular expression on the file's name; its group is the level.",
            rich_help_panel=_READING,
        ),
    ] = None
    controlled: Annotated[
        str | None,
        typer.Option(
            help="What the laboratory held: displacement or force.", rich_help_panel=_READING
        ),
    ] = None
    frequency_hz: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Read this range only, Hz.", rich_help_panel=_READING),
    ] = None
    sheet: Annotated[
        str | None, typer.Option(help="Sheet of an Excel workbook.", rich_help_panel=_READING)
    ] = None
    passive: Annotated[
        bool,
        typer.Option(
            help="Refuse a table that creates energy as a whole.", rich_help_panel=_READING
        ),
    ] = True

    def read(self, files: list[str]) -> FrequencyResponse:
        """Read the files into one table."""
        from dahl_ident.data import read_frequency_response

        return read_frequency_response(files, **vars(self))


@dataclass(frozen=True)
class ModelOptions:
    """Which elements, which of their parameters are known, which are free."""

    f_max: Annotated[
        str | None,
        typer.Option(help="Coulomb friction, N; estimated if left out.", rich_help_panel=_MODEL),
    ] = None
    sigma: Annotated[
        str | None,
        typer.Option(help="Rest stiffness, N/m; estimated if left out.", rich_help_panel=_MODEL),
    ] = None
    alpha: Annotated[
        str, typer.Option(help="Exponent of the Dahl model, or 'free'.", rich_help_panel=_MODEL)
    ] = "1"
    mass: Annotated[
        str | None,
        typer.Option(help="Add a mass: kg, or 'free'.", rich_help_panel=_MODEL),
    ] = None
    damping: Annotated[
        str | None,
        typer.Option(help="Add a damper: N s/m, or 'free'.", rich_help_panel=_MODEL),
    ] = None
    stiffness: Annotated[
        str | None,
        typer.Option(help="Add a spring: N/m, or 'free'.", rich_help_panel=_MODEL),
    ] = None

    def build(self) -> tuple[Element, list[str]]:
        """Return the model, and the parameters that are free against their default."""
        from dahl_ident.elements import Dahl, Damper, Mass, Spring

        f_max, sigma = _number("f_max", self.f_max), _number("sigma", self.sigma)
        alpha = _number("alpha", self.alpha)
        model: Element = Dahl(f_max, sigma, 1.0 if alpha is None else alpha)
        others = (
            ("mass", self.mass, Mass),
            ("damping", self.damping, Damper),
            ("stiffness", self.stiffness, Spring),
        )
        for name, text, element in others:
            if text is not None:
                model = model + element(_number(name, text))
        return model, ["alpha"] if alpha is None else []

    @property
    def words(self) -> list[str]:
        """The options as they are typed, for the command that repeats a result."""
        given = {k: v for k, v in vars(self).items() if v is not None and (k, v) != ("alpha", "1")}
        return [w for k, v in given.items() for w in (f"--{k.replace('_', '-')}", str(v))]


def _number(name: str, text: str | None) -> float | None:
    """Return a parameter's value, None where it is free."""
    if text is None or text == _FREE:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ModelError(f"{name} is {text!r}; expected a number in SI units, or 'free'")
    return value


def plain(value: Any) -> Any:
    """Return nested data that JSON knows: arrays as lists, complex numbers as pairs."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, complex):
        return [plain(value.real), plain(value.imag)]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
