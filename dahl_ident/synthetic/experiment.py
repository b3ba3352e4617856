"""Description of an experiment: mechanism, excitation, sensors and requested data.

The description is immutable, prints as TOML, and can be converted to JSON or TOML and back.
Together with a seed it determines every number of the data.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import tomli_w

from dahl_ident.data.columns import one_of
from dahl_ident.data.entries import checked
from dahl_ident.data.storage import parsed, path_of, plain_data, read_text
from dahl_ident.elements import Element
from dahl_ident.elements.element import as_model, describe_model, model_from_description
from dahl_ident.errors import DahlIdentError, DataError, ValidationError, choices
from dahl_ident.synthetic.acquisition import Acquisition, Table
from dahl_ident.synthetic.excitation import (
    AmplitudeRamp,
    Excitation,
    FrequencySweep,
    SteppedSine,
)
from dahl_ident.units import Motion

_EXCITATIONS: dict[str, type[Excitation]] = {
    "stepped_sine": SteppedSine,
    "frequency_sweep": FrequencySweep,
    "amplitude_ramp": AmplitudeRamp,
}


@dataclass(frozen=True)
class _Description:
    """An experiment as data."""

    plant: list[dict[str, Any]]
    excitation: dict[str, Any]
    acquisition: Acquisition = field(default_factory=Acquisition)
    table: Table | None = None
    motion: Motion = "translation"


@dataclass(frozen=True, eq=False)
class Experiment:
    """One run of the synthetic laboratory.

    Parameters
    ----------
    plant : Element
        The mechanism, with a value for every parameter: only friction, such as ``Dahl(0.1, 30)``,
        or a sum.
    excitation : SteppedSine, FrequencySweep or AmplitudeRamp
        The excitation.
    acquisition : Acquisition
        Sensors and recorder; ideal ones by default. Their gain, delay and anti-alias filter also
        affect a table.
    table : Table, optional
        Request for a table of responses with these errors; None for a record of waveforms.
    motion : {"translation", "rotation"}
        Whether displacement is in m or rad.

    Raises
    ------
    ModelError
        If a parameter of the plant has no value.
    ValidationError
        If a table is requested of anything but a stepped sine, or of sensors whose faults cannot
        appear in a table.

    Examples
    --------
    >>> from dahl_ident import Dahl
    >>> run = Experiment(Dahl(0.1, 30.0), SteppedSine(levels=(1e-3, 2e-3)), table=Table())
    >>> Experiment.from_json(run.to_json()) == run
    True
    """

    plant: Element
    excitation: Excitation
    acquisition: Acquisition = field(default_factory=Acquisition)
    table: Table | None = None
    motion: Motion = "translation"

    def __post_init__(self) -> None:
        object.__setattr__(self, "plant", as_model(self.plant))
        self.plant.known_values()
        one_of(self.motion, "motion", ("translation", "rotation"))
        table, excitation = self.table, self.excitation
        if table is None:
            return
        if not isinstance(excitation, SteppedSine):
            raise ValidationError(
                f"a table was requested of a {type(excitation).__name__}; only a SteppedSine "
                "has one response for each step: leave table out to record waveforms"
            )
        orders = table.harmonics
        highest = 9 if table.steady == "exact" else 1
        if excitation.controlled == "force" and (1 not in orders or max(orders) > highest):
            raise ValidationError(
                f"harmonics is {orders} where force is controlled; expected 1 among them, and none "
                f"above {highest}"
            )
        faults = self.acquisition.faults_of_records()
        if faults:
            raise ValidationError(
                f"{', '.join(faults)} cannot appear in a table; leave table out to record "
                "waveforms, or give the errors of the table in Table"
            )

    @property
    def truth(self) -> dict[str, float]:
        """The value of every parameter by name, including sensor parameters that are not ideal."""
        values = {p.name: float(p.value) for p in self.plant.parameters if p.value is not None}
        x, F = self.acquisition.displacement, self.acquisition.force
        sensors = {
            "force_gain": (F.gain, 1.0),
            "displacement_gain": (x.gain, 1.0),
            "delay": (x.delay - F.delay, 0.0),
        }
        return values | {name: v for name, (v, ideal) in sensors.items() if v != ideal}

    def to_dict(self) -> dict[str, Any]:
        """Return the description as plain data; None values are left out."""
        kinds = {cls: kind for kind, cls in _EXCITATIONS.items()}
        description = {
            "motion": self.motion,
            "plant": describe_model(self.plant),
            "excitation": {"kind": kinds[type(self.excitation)], **_stated(self.excitation)},
            "acquisition": _stated(self.acquisition),
        }
        if self.table is not None:
            description["table"] = _stated(self.table)
        return description

    @classmethod
    def from_dict(cls, description: Mapping[str, Any]) -> Experiment:
        """Return the experiment described by :meth:`to_dict`; missing values have their defaults.

        Raises
        ------
        DataError
            If a key is unknown or missing, or a value is of another type.
        """
        known = checked(_Description, description, "the experiment")
        kind = known.excitation.pop("kind", None)
        if kind not in [*_EXCITATIONS]:
            raise DataError(
                f"the excitation has the kind {kind!r}; expected one of "
                f"{choices(_EXCITATIONS, kind)}"
            )
        plant = model_from_description(known.plant, "plant")
        excitation = checked(_EXCITATIONS[kind], known.excitation, "the excitation")
        return cls(**{**vars(known), "plant": plant, "excitation": excitation})

    def to_json(self) -> str:
        """Return the description as JSON."""
        return json.dumps(self.to_dict(), indent=2)

    @classmethod
    def from_json(cls, text: str) -> Experiment:
        """Return the experiment described by a JSON text.

        Raises
        ------
        DataError
            If the text is not JSON, or not an experiment.
        """
        return cls.from_dict(parsed(json.loads, text, "the experiment is not JSON"))

    def to_toml(self) -> str:
        """Return the description as TOML."""
        return tomli_w.dumps(self.to_dict())

    @classmethod
    def from_toml(cls, text: str) -> Experiment:
        """Return the experiment described by a TOML text.

        Raises
        ------
        DataError
            If the text is not TOML, or not an experiment.
        """
        return cls.from_dict(parsed(tomllib.loads, text, "the experiment is not TOML"))

    @classmethod
    def read(cls, path: str | Path) -> Experiment:
        """Return the experiment in a file, ending in ``.toml`` or ``.json``.

        Raises
        ------
        DataError
            If the file cannot be read, or holds no experiment.
        """
        path = path_of(path, "the experiment")
        readers = {".toml": cls.from_toml, ".json": cls.from_json}
        if path.suffix not in readers:
            raise DataError(f"{path}: expected an experiment in .toml or .json")
        text = read_text(path)
        try:
            return readers[path.suffix](text)
        except DahlIdentError as exc:
            raise DataError(f"{path}: {exc}") from exc

    def __str__(self) -> str:
        return self.to_toml()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Experiment):
            return NotImplemented
        return self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash(self.to_json())


def _stated(settings: Any) -> Any:
    """Return the fields of nested dataclasses as plain data, without None, which TOML lacks."""
    stated = asdict(settings, dict_factory=lambda items: {k: v for k, v in items if v is not None})
    return plain_data(stated)
