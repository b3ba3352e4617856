"""``dahl-ident plan`` and ``simulate``: what to measure next, and data with known truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import changed, refuse, write_data, write_picture
from dahl_ident.cli.estimate import saved_fit
from dahl_ident.cli.model import (
    DAHL_PARAMETERS,
    ELEMENT_HELP,
    LINEAR_PARAMETERS,
    ModelOptions,
    model_of,
    stated,
)
from dahl_ident.cli.options import (
    General,
    Laws,
    OutputFile,
    Seed,
    Writing,
    controlled_setting,
    option,
    setting,
    steady_setting,
    with_option_groups,
)
from dahl_ident.cli.values import ends, number, numbers
from dahl_ident.errors import ModelError, UnitError, ValidationError

if TYPE_CHECKING:
    from dahl_ident.elements import Element
    from dahl_ident.synthetic import Experiment

_UNITS = {
    "frequency": "Hz",
    "displacement": "m",
    "force": "N",
    "speed": "m/s",
    "acceleration": "m/s^2",
}
_RANGE = "the highest value, or lowest:highest"
# default levels: lowest and highest over displacement or force at the knee, and their number (15
# in a decade, as in the shipped data sets)
_LEVEL_RANGE = (0.1, 10.0)
_NUM_LEVELS = 30


@dataclass(frozen=True)
class Bench:
    """The limits of the bench and the times that it needs."""

    panel: ClassVar[str] = "Bench"
    frequency: str | None = setting(f"Frequency, 5Hz: {_RANGE}; not needed for trapezoids.")
    displacement: str | None = setting(f"Displacement amplitude, 1mm: {_RANGE}.")
    force: str | None = setting(f"Force amplitude, 0.2N: {_RANGE}.")
    speed: str | None = setting("Highest speed, 50mm/s.")
    acceleration: str | None = setting("Highest acceleration, 1m/s^2.")
    time: float | None = setting("Total time, 10min.", unit="s")
    controlled: str = controlled_setting()
    steady: str | None = steady_setting(None)
    motion: str | None = setting(
        "Plan motions in time, for a fit of records: trapezoid or multisine; without it, settled "
        "sines.",
        one_of="trapezoid|multisine",
    )
    noise: str | None = setting(
        "Noise of one cycle: '1 %', or 'relative=0.01,force=1mN,displacement=0.1um'; of a "
        "force sample with --motion: force=1mN."
    )
    scatter: float | None = setting(
        "Scatter of gain and phase between runs, '2 %'; by default that of the fit.", unit="1"
    )
    num_runs: int | None = setting("Number of runs; by default the best one.")
    change_over: float = setting("Time from one level to the next.", 1.0, unit="s")
    between_runs: float = setting("Additional time for each run.", 0.0, unit="s")

    def limits(self) -> dict[str, Any]:
        """Return the limits that are stated."""
        limits = {
            "frequency_hz" if name == "frequency" else name: ends(name, text, _UNITS[name])
            for name, text in stated(self, *_UNITS).items()
        }
        return limits | stated(self, "time")


@dataclass(frozen=True)
class Aim:
    """The targets, and prior knowledge."""

    panel: ClassVar[str] = "Aim"
    target: list[str] | None = setting(
        "Relative standard uncertainty to be met in the least time, f_max=0.02 or "
        "f_max/sigma=0.02, or an expanded one, 'U(f_max)=0.04'; a name alone is given the least "
        "uncertainty within --time. Repeatable; by default all parameters."
    )
    ranges: list[str] | None = setting(
        "Range of a parameter with 95 % probability, f_max=0.05:0.2N; repeatable."
    )
    suspects: list[str] | None = setting(
        "Parameter that the model may need, and its target uncertainty, alpha=0.1; repeatable."
    )

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``plan``."""
        targets = [text.partition("=") for text in self.target or []]
        uncertainties = {name: number(name, value, "1") for name, equal, value in targets if equal}
        if uncertainties and len(uncertainties) < len(targets):
            raise ValidationError(
                "target has names with and without a number; give every one its uncertainty, or "
                "none"
            )
        ranges = dict(_pair("ranges", text) for text in self.ranges or [])
        suspects = dict(_pair("suspects", text) for text in self.suspects or [])
        return {
            "target": uncertainties or [name for name, _, _ in targets] or None,
            "ranges": {name: ends(f"ranges of {name}", text) for name, text in ranges.items()},
            "suspects": {name: number(name, t, "1") for name, t in suspects.items()} or None,
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
    table: Annotated[Path | None, option("File for the table of levels, .csv.")] = None,
    waveform: Annotated[
        Path | None, option("File for the waveform of one run for the exciter, .csv.")
    ] = None,
    sample_rate: Annotated[
        float | None,
        option("Sample rate of the waveform, and of the records of --motion.", unit="Hz"),
    ] = None,
    picture: Annotated[
        Path | None,
        option("File for a plot of uncertainty against bench time, .png, .svg or .pdf."),
    ] = None,
) -> None:
    """Plan the next measurement: levels, frequencies and cycles, or motions in time.

    Example: dahl-ident plan --frequency 5Hz --displacement 0.1:10mm --ranges f_max=0.05:0.2N
    --ranges sigma=15:60 --noise 0.01 --target f_max=0.01 --target sigma=0.01
    """
    from dahl_ident.data.storage import write_whole
    from dahl_ident.planning import plan as make_plan

    laws.run()
    writing.check([table, waveform, picture], [] if fit is None else [fit], json=general.json)
    if sample_rate is None and (waveform is not None or bench.motion is not None):
        raise ValidationError("--waveform and --motion need --sample-rate, Hz; give it")
    if sample_rate is not None and waveform is None and bench.motion is None:
        raise ValidationError("--sample-rate needs --waveform or --motion; give one of them")
    kind: dict[str, Any] = {"steady": bench.steady}
    if bench.motion is not None:
        kind = {"candidates": bench.motion, "sample_rate": sample_rate}
    result = make_plan(
        _fit_or_model(fit, model),
        limits=bench.limits(),
        noise=_noise(bench.noise),
        scatter=bench.scatter,
        runs=bench.num_runs,
        controlled=bench.controlled,
        change_over=bench.change_over,
        between_runs=bench.between_runs,
        seed=seed,
        **kind,
        **aim.keywords(),
    )
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
    reason = result.undetermined[0] if result.undetermined else "the plan does not meet a target"
    console.finish(result.reached, reason)


def _fit_or_model(fit: str | None, options: ModelOptions) -> Any:
    """Return the saved fit, or else the model of the options."""
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
    """Return a relative noise, or noise by name, as ``plan`` takes it."""
    if text is None:
        return None
    if "=" not in text:
        return number("noise", text, "1")
    parts = [_pair("noise", part) for part in text.split(",")]
    return {name: number(f"noise {name}", value, _UNITS.get(name, "1")) for name, value in parts}


@dataclass(frozen=True)
class PlantOptions:
    """The true plant: friction, and linear elements in parallel."""

    panel: ClassVar[str] = "Model"
    f_max: float | None = setting("Friction force.", unit="N")
    sigma: float | None = setting("Contact stiffness.", unit="N/m")
    alpha: float | None = setting("Exponent; 1 if left out.")
    element: list[str] | None = setting(ELEMENT_HELP)
    mass: float | None = setting("Add a mass.", unit="kg")
    damping: float | None = setting("Add a damper.", unit="N s/m")
    stiffness: float | None = setting("Add a spring.", unit="N/m")

    def plant(self) -> Element:
        """Return the plant."""
        dahl = stated(self, *DAHL_PARAMETERS)
        missing = [name for name in ("f_max", "sigma") if name not in dahl]
        if missing and not self.element:
            raise ValidationError(
                f"no value for {' and '.join(missing)}; a simulation needs --f-max and --sigma, "
                "or --element"
            )
        return model_of(self.element, dahl, stated(self, *LINEAR_PARAMETERS))


@dataclass(frozen=True)
class Excitation:
    """A stepped sine; other excitations need an experiment file."""

    panel: ClassVar[str] = "Excitation"
    levels: str | None = setting(
        "Amplitudes, 0.1,1mm or low:high:count; by default 30 around the knee."
    )
    frequency: str = setting("Frequencies, in the same form.", "1Hz")
    controlled: str = controlled_setting()
    order: str = setting(
        "given, ascending, descending or random.",
        "given",
        one_of="given|ascending|descending|random",
    )
    settling_periods: int = setting("Before measuring.", 10)
    num_periods: int = setting("Measured.", 5)
    steady: str = steady_setting()
    record: bool = setting("Waveforms, not a table.", False, "--record")


@dataclass(frozen=True)
class Errors:
    """Noise: relative in a table, absolute in a record."""

    panel: ClassVar[str] = "Errors"
    displacement_std: str = setting(
        "Displacement noise: of a table a share, '0.5 %'; of samples 0.1um.", "0"
    )
    force_std: str = setting("Force noise: of a table a share, '0.5 %'; of samples 5mN.", "0")

    def noise_std(self, channel: str, unit: str) -> float:
        """Return the standard deviation of a channel, relative if the unit is 1."""
        text = getattr(self, f"{channel}_std")
        try:
            return number(channel, text, unit)
        except (ModelError, UnitError) as exc:
            expected = f"the noise of samples, such as 5e-6 or 5u{unit}"
            if unit == "1":
                expected = "a share of the response, such as 0.005 or '0.5 %'; of samples: --record"
            raise ValidationError(f"--{channel}-std is {text!r}; expected {expected}") from exc


@with_option_groups
def simulate(
    general: General,
    laws: Laws,
    plant: PlantOptions,
    excitation: Excitation,
    errors: Errors,
    writing: Writing,
    experiment: Annotated[
        str | None, typer.Argument(help="Experiment file, .toml or .json, instead of options.")
    ] = None,
    seed: Seed = 1,
    output: OutputFile = None,
) -> None:
    """Simulate an experiment; without an output file, print its description.

    Example: dahl-ident simulate --f-max 0.1 --sigma 30 --force-std '1 %' -o synthetic.csv
    """
    from dahl_ident.arrays import whole_number
    from dahl_ident.synthetic import Experiment
    from dahl_ident.synthetic import simulate as run

    laws.run()
    whole_number(seed, "seed", 0, math.inf)
    writing.check([output], [] if experiment is None else [experiment], json=general.json)
    if experiment is None:
        definition = _experiment(plant, excitation, errors)
    else:
        refuse(
            changed(plant, excitation, errors),
            f"together with {experiment}, which describes the whole experiment; leave one of them "
            "out",
        )
        definition = Experiment.read(experiment)
    if output is None:
        console.write(definition.to_json() if general.json else definition.to_toml())
        return
    with console.busy("simulating") as update:
        data = run(definition, seed=seed, progress=lambda done: update(done, 1.0))
    write_data(data, output, overwrite=writing.overwrite)


def _experiment(plant: PlantOptions, excitation: Excitation, errors: Errors) -> Experiment:
    from dahl_ident.synthetic import Acquisition, Channel, Experiment, SteppedSine, Table

    truth = plant.plant()
    settings: dict[str, Any] = dict(vars(excitation))
    frequency, steady, as_record = map(settings.pop, ("frequency", "steady", "record"))
    controlled = excitation.controlled
    levels = excitation.levels or _default_levels(truth, controlled)
    settings["levels"] = _numbers("levels", levels, _UNITS[controlled])
    steps = SteppedSine(**settings, frequencies_hz=_numbers("frequency", frequency, "Hz"))
    if not as_record:
        stds = errors.noise_std("displacement", "1"), errors.noise_std("force", "1")
        return Experiment(truth, steps, table=Table(*stds, steady=steady))
    sensors = Acquisition(
        displacement=Channel(noise_std=errors.noise_std("displacement", "m")),
        force=Channel(noise_std=errors.noise_std("force", "N")),
    )
    return Experiment(truth, steps, sensors)


def _default_levels(truth: Element, controlled: str) -> str:
    """Return levels of displacement or force around the knee of the friction."""
    import numpy as np

    from dahl_ident.elements.element import as_model

    laws = [e for e in as_model(truth).elements if not e.is_linear]
    knees = np.array([[float(knee) for knee in e.knee(e.known_values())] for e in laws])
    if controlled == "force":
        # bounds of the fundamental, which for a square wave is 4/pi times its amplitude
        limits = [0.25 * np.pi * float(e.force_bounds(e.known_values())[1]) for e in laws]
        knees = np.array([[sum(limits)] * 2])
    low, high = (knees[:, 0].min(), knees[:, 1].max()) if laws else (0.0, 0.0)
    if not (np.isfinite([low, high]).all() and 0.0 < low <= high):
        raise ValidationError("the plant has no knee, around which levels would be; give --levels")
    return f"{_LEVEL_RANGE[0] * low}:{_LEVEL_RANGE[1] * high}:{_NUM_LEVELS}"


def _numbers(name: str, text: str, unit: str) -> list[float]:
    """Return the numbers of ``1,2,5mm``, or of ``low:high:count`` with logarithmic spacing."""
    import numpy as np

    try:
        if ":" not in text:
            return numbers(name, text, unit, sep=",")
        bounds, _, count = text.rpartition(":")
        low, high = numbers(name, bounds, unit)
        return [float(v) for v in np.geomspace(low, high, int(count))]
    except (ModelError, ValueError) as exc:
        raise ValidationError(
            f"{name} is {text!r}; expected numbers such as 0.1,1mm, or low:high:count"
        ) from exc
