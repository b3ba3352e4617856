"""``dahl-ident plan``: which levels to measure next, from a model with ranges or a saved fit."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from dahl_ident.cli import console
from dahl_ident.cli.files import write_picture
from dahl_ident.cli.model import ModelOptions
from dahl_ident.cli.option_groups import with_option_groups
from dahl_ident.cli.options import General, Laws, Seed, Writing, one_of, steady_option
from dahl_ident.errors import ValidationError

_BENCH = "Bench"
_AIM = "Aim"
_RANGE = "the highest value, or lowest,highest"


def _bench(help_text: str) -> Any:
    return typer.Option(help=help_text, rich_help_panel=_BENCH)


def _aim(help_text: str) -> Any:
    return typer.Option(help=help_text, rich_help_panel=_AIM)


@dataclass(frozen=True)
class Bench:
    """The limits of the bench and the times that it needs."""

    frequency_hz: Annotated[
        str | None, _bench(f"Frequency, Hz: {_RANGE}; not needed for trapezoids.")
    ] = None
    displacement: Annotated[str | None, _bench(f"Displacement amplitude, m: {_RANGE}.")] = None
    force: Annotated[str | None, _bench(f"Force amplitude, N: {_RANGE}.")] = None
    speed: Annotated[str | None, _bench("Highest speed, m/s.")] = None
    acceleration: Annotated[str | None, _bench("Highest acceleration, m/s^2.")] = None
    time: Annotated[float | None, _bench("Total time, s.")] = None
    controlled: Annotated[
        str,
        typer.Option(
            help="Controlled quantity: displacement or force.",
            callback=one_of("displacement", "force"),
            rich_help_panel=_BENCH,
        ),
    ] = "displacement"
    steady: Annotated[str | None, steady_option(_BENCH)] = None
    motion: Annotated[
        str | None,
        typer.Option(
            help="Plan motions in time, for a fit of records: trapezoid or multisine; without it, "
            "settled sines.",
            callback=one_of("trapezoid", "multisine"),
            rich_help_panel=_BENCH,
        ),
    ] = None
    noise: Annotated[
        str | None,
        _bench(
            "Noise of one cycle: 0.01, or 'relative=0.01,force=1e-3,displacement=1e-7'; of a force "
            "sample with --motion: force=1e-3."
        ),
    ] = None
    scatter: Annotated[
        float | None,
        _bench("Scatter of gain and phase between runs, 0.02; by default that of the fit."),
    ] = None
    num_runs: Annotated[int | None, _bench("Number of runs; by default the best one.")] = None
    change_over: Annotated[float, _bench("Seconds from one level to the next.")] = 1.0
    between_runs: Annotated[float, _bench("Additional seconds for each run.")] = 0.0

    def limits(self) -> dict[str, Any]:
        """Return the limits that were given."""
        given: dict[str, Any] = {
            name: _ends(name, text)
            for name in ("frequency_hz", "displacement", "force", "speed", "acceleration")
            if (text := getattr(self, name)) is not None
        }
        return given if self.time is None else {**given, "time": self.time}

    def motions(self, sample_rate: float | None) -> dict[str, Any]:
        """Return the arguments of ``plan`` that motions in time, or settled ones, need."""
        if self.motion is None:
            return {"steady": self.steady}
        return {"candidates": self.motion, "sample_rate": sample_rate}


@dataclass(frozen=True)
class Aim:
    """The targets, and prior knowledge."""

    target: Annotated[
        list[str] | None,
        _aim(
            "Wanted relative standard uncertainty, f_max=0.02 or f_max/sigma=0.02, or expanded "
            "one, 'U(f_max)=0.04', in the least time; a name alone: least uncertainty in --time. "
            "Repeatable; by default all parameters."
        ),
    ] = None
    ranges: Annotated[
        list[str] | None,
        _aim("Range of a parameter with 95 % probability, f_max=0.05,0.2; repeatable."),
    ] = None
    suspects: Annotated[
        list[str] | None,
        _aim("Parameter that may be needed, and the uncertainty wanted for it, alpha=0.1."),
    ] = None

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``plan``."""
        wanted = [text.partition("=") for text in self.target or []]
        numbers = {name: _number(name, value) for name, sign, value in wanted if sign}
        if numbers and len(numbers) < len(wanted):
            raise ValidationError(
                "target has names with and without a number; give every one its uncertainty, or "
                "none"
            )
        ranges = dict(_pair("ranges", text) for text in self.ranges or [])
        suspects = dict(_pair("suspects", text) for text in self.suspects or [])
        return {
            "target": numbers or [name for name, _, _ in wanted] or None,
            "ranges": {name: _ends(name, text) for name, text in ranges.items()},
            "suspects": {name: _number(name, text) for name, text in suspects.items()} or None,
        }


@with_option_groups
def plan(
    general: General,
    laws: Laws,
    bench: Bench,
    aim: Aim,
    model: ModelOptions,
    writing: Writing,
    fit: Annotated[
        str | None,
        typer.Argument(help="Saved fit of earlier data; without it, give ranges for the model."),
    ] = None,
    seed: Seed = 0,
    table: Annotated[Path | None, typer.Option(help="File for the table of levels, .csv.")] = None,
    waveform: Annotated[
        Path | None, typer.Option(help="File for the waveform of one run for the exciter, .csv.")
    ] = None,
    sample_rate: Annotated[
        float | None,
        typer.Option(help="Sample rate of the waveform, and of the records of --motion, Hz."),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(help="File for a plot of uncertainty against bench time, .png, .svg or .pdf."),
    ] = None,
) -> None:
    """Plan the next measurement: levels, frequencies and cycles, or motions in time.

    Example: dahl-ident plan --frequency-hz 5 --displacement 1e-4,1e-2 --ranges f_max=0.05,0.2
    --ranges sigma=15,60 --noise 0.01 --target f_max=0.01 --target sigma=0.01
    """
    from dahl_ident.data.storage import write_whole
    from dahl_ident.planning import plan as make

    laws.run()
    writing.check([table, waveform, picture], [] if fit is None else [fit], json=general.json)
    if sample_rate is None and (waveform is not None or bench.motion is not None):
        raise ValidationError("--waveform and --motion need --sample-rate, Hz; give it")
    if sample_rate is not None and waveform is None and bench.motion is None:
        raise ValidationError("--sample-rate is that of --waveform or --motion; give one of them")
    result = make(
        _known(fit, model), limits=bench.limits(), noise=_noise(bench.noise), scatter=bench.scatter,
        runs=bench.num_runs, controlled=bench.controlled, change_over=bench.change_over,
        between_runs=bench.between_runs, seed=seed, **bench.motions(sample_rate), **aim.keywords(),
    )  # fmt: skip
    if table is not None:
        text = result.to_frame().to_csv(index=False)
        write_whole(table, text.encode(), overwrite=writing.overwrite)
    if waveform is not None and sample_rate is not None:
        result.write_waveform(waveform, sample_rate, overwrite=writing.overwrite)
    if picture is not None:
        write_picture(result.plot(), str(picture), overwrite=writing.overwrite)
    if general.json:
        console.write_json(result.to_dict())
    else:
        console.write_wrapped(str(result))
    missed = result.undetermined[0] if result.undetermined else "a wanted uncertainty is missed"
    console.finish(result.reached, missed)


def _known(fit: str | None, options: ModelOptions) -> Any:
    """Return the saved fit, or the model of the options."""
    from dahl_ident.elements.element import as_model
    from dahl_ident.results import FitResult
    from dahl_ident.results.record_fit import RecordFit

    if fit is not None:
        if options != ModelOptions():
            raise ValidationError(
                "a saved fit has its model and sensors; leave out the options that describe them"
            )
        return RecordFit.load(fit) if _is_of_records(fit) else FitResult.load(fit)
    given = options.keywords()
    if not given["sensors"].are_exact:
        raise ValidationError("a plan before any data takes the sensors as exact; leave them out")
    return as_model(given["model"]).with_free(given["free"])


def _is_of_records(path: str) -> bool:
    """Return whether a saved fit is one of records; False where the file is no saved fit."""
    from dahl_ident.data.storage import read_text
    from dahl_ident.results.record_fit import SCHEMA

    try:
        content = json.loads(read_text(path))
    except ValueError:
        return False
    return isinstance(content, dict) and content.get("schema") == SCHEMA


def _pair(option: str, text: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not sign:
        raise ValidationError(f"{option} is {text!r}; expected a name and a value, f_max=0.1")
    return name.strip(), value


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValidationError(f"{name} is {text!r}; expected a number, SI") from None


def _ends(name: str, text: str) -> float | list[float]:
    ends = [_number(name, part) for part in text.split(",")]
    return ends[0] if len(ends) == 1 else ends


def _noise(text: str | None) -> Any:
    if text is None or "=" not in text:
        return None if text is None else _number("noise", text)
    return {
        name: _number(name, value)
        for name, value in (_pair("noise", part) for part in text.split(","))
    }
