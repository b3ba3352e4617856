"""``dahl-ident simulate``: data of the synthetic laboratory, from options or a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import changed, refuse, write_data
from dahl_ident.cli.distributions import number, numbers
from dahl_ident.cli.model import (
    ELEMENT_HELP,
    MODEL,
    OTHERS,
    elements,
    in_parallel,
    model_option,
    refuse_with_elements,
)
from dahl_ident.cli.options import (
    General,
    Laws,
    OutputFile,
    Seed,
    Writing,
    controlled_option,
    in_panel,
    one_of,
    quantity,
    steady_option,
    with_option_groups,
)
from dahl_ident.errors import ModelError, UnitError, ValidationError

if TYPE_CHECKING:
    from dahl_ident.elements import Element
    from dahl_ident.synthetic import Experiment

_EXCITATION = "Excitation"
_excitation = in_panel(_EXCITATION)
_ERRORS = "Errors"
_errors = in_panel(_ERRORS)
_UNITS = {"displacement": "m", "force": "N"}
_SPAN = (0.1, 10.0)  # of the characteristic displacement, if no levels are given
_COUNT = 30  # levels: 15 a decade, as in the shipped data sets


@dataclass(frozen=True)
class PlantOptions:
    """The true plant: friction and the elements in parallel."""

    f_max: Annotated[float | None, quantity("Friction force.", "N", MODEL)] = None
    sigma: Annotated[float | None, quantity("Contact stiffness.", "N/m", MODEL)] = None
    alpha: Annotated[float | None, model_option("Exponent; 1 if left out.")] = None
    element: Annotated[list[str] | None, model_option(ELEMENT_HELP)] = None
    mass: Annotated[float | None, quantity("Add a mass.", "kg", MODEL)] = None
    damping: Annotated[float | None, quantity("Add a damper.", "N s/m", MODEL)] = None
    stiffness: Annotated[float | None, quantity("Add a spring.", "N/m", MODEL)] = None

    def built(self) -> Element:
        """Return the plant."""
        from dahl_ident.elements import Dahl

        names = ("f_max", "sigma", "alpha")
        stated = {n: value for n in names if (value := getattr(self, n)) is not None}
        others = {n: value for n in OTHERS if (value := getattr(self, n)) is not None}
        if self.element:
            refuse_with_elements(stated)
            return in_parallel(elements(self.element), others)
        missing = [name for name in ("f_max", "sigma") if name not in stated]
        if missing:
            raise ValidationError(
                f"no value for {' and '.join(missing)}; a simulation needs --f-max and --sigma, "
                "or --element"
            )
        return in_parallel(Dahl(**stated), others)


@dataclass(frozen=True)
class Excitation:
    """A stepped sine; other excitations need an experiment file."""

    levels: Annotated[
        str | None,
        _excitation("Amplitudes, 0.1,1mm or low:high:count; by default 30 around the knee."),
    ] = None
    frequency: Annotated[str, _excitation("Frequencies, in the same form.")] = "1Hz"
    controlled: Annotated[str, controlled_option(_EXCITATION)] = "displacement"
    order: Annotated[
        str,
        one_of(
            "given, ascending, descending or random.",
            _EXCITATION,
            "given|ascending|descending|random",
        ),
    ] = "given"
    settling_periods: Annotated[int, _excitation("Before measuring.")] = 10
    num_periods: Annotated[int, _excitation("Measured.")] = 5
    record: Annotated[
        bool, typer.Option("--record", help="Waveforms, not a table.", rich_help_panel=_EXCITATION)
    ] = False


@dataclass(frozen=True)
class Errors:
    """Noise: relative in a table, absolute in a record."""

    displacement_std: Annotated[
        str, _errors("Displacement noise: of a table a share, '0.5 %'; of samples 0.1um.")
    ] = "0"
    force_std: Annotated[
        str, _errors("Force noise: of a table a share, '0.5 %'; of samples 5mN.")
    ] = "0"

    def of(self, channel: str, unit: str) -> float:
        """Return the standard deviation of a channel; a share where the unit is 1."""
        text = getattr(self, f"{channel}_std")
        try:
            return number("it", text, unit)
        except (ModelError, UnitError) as exc:
            wanted = f"the noise of samples, such as 5e-6 or 5u{unit}"
            if unit == "1":
                wanted = "a share of the response, such as 0.005 or '0.5 %'; of samples: --record"
            raise ValidationError(f"--{channel}-std is {text!r}; expected {wanted}") from exc


@dataclass(frozen=True)
class MotionOptions:
    """The steady motion of a driven plant."""

    steady: Annotated[str, steady_option(_EXCITATION)] = "exact"


@with_option_groups
def simulate(
    general: General,
    laws: Laws,
    plant: PlantOptions,
    excitation: Excitation,
    errors: Errors,
    motion: MotionOptions,
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
    whole_number(seed, "seed", 0)
    if experiment is not None:
        refuse(
            changed(plant, excitation, errors, motion),
            f"together with {experiment}, which describes the whole experiment; leave one of them "
            "out",
        )
    inputs = [] if experiment is None else [experiment]
    writing.check([output], inputs, json=general.json)
    described = (
        _experiment(plant, excitation, errors, motion)
        if experiment is None
        else Experiment.read(experiment)
    )
    if output is None:
        console.write(described.to_json() if general.json else described.to_toml())
        return
    with console.busy("simulating") as update:
        data = run(described, seed=seed, progress=lambda done: update(done, 1.0))
    write_data(data, output, overwrite=writing.overwrite)


def _experiment(
    plant: PlantOptions, excitation: Excitation, errors: Errors, motion: MotionOptions
) -> Experiment:
    from dahl_ident.synthetic import Acquisition, Channel, Experiment, SteppedSine, Table

    truth = plant.built()
    settings: dict[str, Any] = dict(vars(excitation))
    as_record = settings.pop("record")
    controlled = excitation.controlled
    settings["levels"] = _numbers(
        "levels", excitation.levels or _usual_levels(truth, controlled), _UNITS[controlled]
    )
    settings["frequencies_hz"] = _numbers("frequency", settings.pop("frequency"), "Hz")
    steps = SteppedSine(**settings)
    if not as_record:
        table = Table(errors.of("displacement", "1"), errors.of("force", "1"), **vars(motion))
        return Experiment(truth, steps, table=table)
    sensors = Acquisition(
        displacement=Channel(noise_std=errors.of("displacement", "m")),
        force=Channel(noise_std=errors.of("force", "N")),
    )
    return Experiment(truth, steps, sensors)


def _usual_levels(truth: Element, controlled: str) -> str:
    """Return levels of displacement or force around the knee of the friction."""
    import numpy as np

    from dahl_ident.elements.element import as_model

    laws = [e for e in as_model(truth).elements if not e.is_linear]
    knees = np.array([[float(knee) for knee in e.knee(e.known_values())] for e in laws])
    if controlled == "force":
        # a square wave of the friction force has a fundamental of 4/pi times it
        limits = [0.25 * np.pi * float(e.force_bounds(e.known_values())[1]) for e in laws]
        knees = np.array([[sum(limits)] * 2])
    low, high = (knees[:, 0].min(), knees[:, 1].max()) if laws else (0.0, 0.0)
    if not (np.isfinite([low, high]).all() and 0.0 < low <= high):
        raise ValidationError("the plant has no knee to place levels about; give --levels")
    return f"{_SPAN[0] * low}:{_SPAN[1] * high}:{_COUNT}"


def _numbers(name: str, text: str, unit: str) -> list[float]:
    """Return the numbers of ``1,2,5mm`` or of ``low:high:count``, evenly spread in logarithm."""
    import numpy as np

    try:
        if ":" not in text:
            return numbers(name, text, unit, sep=",")
        span, _, count = text.rpartition(":")
        low, high = numbers(name, span, unit)
        return [float(v) for v in np.geomspace(low, high, int(count))]
    except (ModelError, ValueError) as exc:
        raise ValidationError(
            f"{name} is {text!r}; expected numbers such as 0.1,1mm, or low:high:count"
        ) from exc
