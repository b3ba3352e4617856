"""``dahl-ident plan``: which levels to measure next, from a model with ranges or a saved fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import write_picture
from dahl_ident.cli.distributions import ends, number
from dahl_ident.cli.estimation import saved_fit
from dahl_ident.cli.model import ModelOptions
from dahl_ident.cli.options import (
    General,
    Laws,
    Seed,
    Writing,
    controlled_option,
    in_panel,
    one_of,
    quantity,
    steady_option,
    with_option_groups,
)
from dahl_ident.errors import ValidationError

_LIMITS = {
    "frequency": "Hz", "displacement": "m", "force": "N", "speed": "m/s", "acceleration": "m/s^2",
}  # fmt: skip
_BENCH = "Bench"
_RANGE = "the highest value, or lowest:highest"


_bench, _aim = in_panel(_BENCH), in_panel("Aim")


@dataclass(frozen=True)
class Bench:
    """The limits of the bench and the times that it needs."""

    frequency: Annotated[
        str | None, _bench(f"Frequency, 5Hz: {_RANGE}; not needed for trapezoids.")
    ] = None
    displacement: Annotated[str | None, _bench(f"Displacement amplitude, 1mm: {_RANGE}.")] = None
    force: Annotated[str | None, _bench(f"Force amplitude, 0.2N: {_RANGE}.")] = None
    speed: Annotated[str | None, _bench("Highest speed, 50mm/s.")] = None
    acceleration: Annotated[str | None, _bench("Highest acceleration, 1m/s^2.")] = None
    time: Annotated[float | None, quantity("Total time, 10min.", "s", _BENCH)] = None
    controlled: Annotated[str, controlled_option(_BENCH)] = "displacement"
    steady: Annotated[str | None, steady_option(_BENCH)] = None
    motion: Annotated[
        str | None,
        one_of(
            "Plan motions in time, for a fit of records: trapezoid or multisine; without it, "
            "settled sines.",
            _BENCH,
            "trapezoid|multisine",
        ),
    ] = None
    noise: Annotated[
        str | None,
        _bench(
            "Noise of one cycle: '1 %', or 'relative=0.01,force=1mN,displacement=0.1um'; of a "
            "force sample with --motion: force=1mN."
        ),
    ] = None
    scatter: Annotated[
        float | None,
        quantity(
            "Scatter of gain and phase between runs, '2 %'; by default that of the fit.",
            "1",
            _BENCH,
        ),
    ] = None
    num_runs: Annotated[int | None, _bench("Number of runs; by default the best one.")] = None
    change_over: Annotated[float, quantity("Time from one level to the next.", "s", _BENCH)] = 1.0
    between_runs: Annotated[float, quantity("Additional time for each run.", "s", _BENCH)] = 0.0

    def limits(self) -> dict[str, Any]:
        """Return the limits that were given."""
        stated: dict[str, Any] = {
            "frequency_hz" if name == "frequency" else name: ends(name, text, unit)
            for name, unit in _LIMITS.items()
            if (text := getattr(self, name)) is not None
        }
        return stated if self.time is None else {**stated, "time": self.time}

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
        _aim("Range of a parameter with 95 % probability, f_max=0.05:0.2N; repeatable."),
    ] = None
    suspects: Annotated[
        list[str] | None,
        _aim("Parameter that may be needed, and the uncertainty wanted for it, alpha=0.1."),
    ] = None

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``plan``."""
        wanted = [text.partition("=") for text in self.target or []]
        shares = {name: number(name, value, "1") for name, sign, value in wanted if sign}
        if shares and len(shares) < len(wanted):
            raise ValidationError(
                "target has names with and without a number; give every one its uncertainty, or "
                "none"
            )
        ranges = dict(_pair("ranges", text) for text in self.ranges or [])
        suspects = dict(_pair("suspects", text) for text in self.suspects or [])
        return {
            "target": shares or [name for name, _, _ in wanted] or None,
            "ranges": {n: ends(f"ranges of {n}", text) for n, text in ranges.items()},
            "suspects": {n: number(n, text, "1") for n, text in suspects.items()} or None,
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
        float | None, quantity("Sample rate of the waveform, and of the records of --motion.", "Hz")
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(help="File for a plot of uncertainty against bench time, .png, .svg or .pdf."),
    ] = None,
) -> None:
    """Plan the next measurement: levels, frequencies and cycles, or motions in time.

    Example: dahl-ident plan --frequency 5Hz --displacement 0.1:10mm --ranges f_max=0.05:0.2N
    --ranges sigma=15:60 --noise 0.01 --target f_max=0.01 --target sigma=0.01
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

    if fit is not None:
        if options != ModelOptions():
            raise ValidationError(
                "a saved fit has its model and sensors; leave out the options that describe them"
            )
        return saved_fit(fit)
    keywords = options.keywords()
    if not keywords["sensors"].are_exact:
        raise ValidationError("a plan before any data takes the sensors as exact; leave them out")
    return as_model(keywords["model"]).with_free(keywords["free"])


def _pair(option: str, text: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not sign:
        raise ValidationError(f"{option} is {text!r}; expected a name and a value, f_max=0.1")
    return name.strip(), value


def _noise(text: str | None) -> Any:
    if text is None or "=" not in text:
        return None if text is None else number("noise", text, "1")
    parts = [_pair("noise", part) for part in text.split(",")]
    return {name: number(f"noise {name}", value, _LIMITS.get(name, "1")) for name, value in parts}
