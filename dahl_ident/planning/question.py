"""The question of a plan: the limits of the bench, the noise, and the quantities to determine."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, non_negative_array, positive_array, positive_number
from dahl_ident.diagnostics.confidence_levels import coverage_factor
from dahl_ident.elements import Element, Model
from dahl_ident.elements.element import as_model
from dahl_ident.errors import ValidationError, argument, choices, spelled
from dahl_ident.planning.knowledge import Knowledge
from dahl_ident.planning.trajectories import KINDS, PlannedMotion

RESPONSE = "response"
_POWER = re.compile(r"(?P<name>[A-Za-z_]\w*)(?:\^(?P<power>-?\d+(?:\.\d+)?))?")
_EXPANDED = re.compile(r"U\((?P<quantity>.+)\)")


def limit(name: str) -> str:
    """Return how the user gives a limit of the bench, for messages."""
    return spelled(f"limits[{name!r}]", f"--{name.removesuffix('_hz')}")


@dataclass(frozen=True)
class BenchLimits:
    """Lowest and highest values, zero-to-peak, SI units, and the total time, s."""

    displacement: tuple[float, float] = (0.0, np.inf)
    force: tuple[float, float] = (0.0, np.inf)
    speed: tuple[float, float] = (0.0, np.inf)
    acceleration: tuple[float, float] = (0.0, np.inf)
    frequency_hz: tuple[float, float] = (0.0, np.inf)
    time: float = np.inf

    @classmethod
    def of(cls, limits: Mapping[str, Any] | None) -> BenchLimits:
        """Return the limits of a mapping."""
        if not isinstance(limits, Mapping):
            raise ValidationError(
                "limits: expected a mapping, such as {'displacement': 1e-3, 'frequency_hz': 5, "
                f"'time': 600}}, got {limits!r}"
            )
        known = cls.__dataclass_fields__
        unknown = sorted(set(limits) - set(known))
        if unknown:
            raise ValidationError(
                f"limits has {', '.join(map(str, unknown))}; expected some of {', '.join(known)}"
            )
        checked: dict[str, Any] = {}
        for name, value in limits.items():
            if name == "time":
                checked[name] = positive_number(value, limit(name))
                continue
            ends = positive_array(value, limit(name))
            pair = [0.0, float(ends)] if ends.ndim == 0 else ends.tolist()
            if len(pair) != 2 or not pair[0] <= pair[1]:
                raise ValidationError(
                    f"{limit(name)} is {value!r}; expected the highest value, or the lowest "
                    "below the highest"
                )
            checked[name] = tuple(pair)
        return cls(**checked)

    @property
    def stated(self) -> tuple[str, ...]:
        """Names of the limits that were given, except time."""
        return tuple(n for n, e in vars(self).items() if n != "time" and e != (0.0, np.inf))


@dataclass(frozen=True)
class CycleNoise:
    """Noise of one cycle: of ln gain and phase, and of both parts of force, N, and displacement."""

    relative: float
    force: float = 0.0
    displacement: float = 0.0

    def variance(self, force: FloatArray, amplitude: FloatArray) -> FloatArray:
        """Return the variance of ln gain and of phase in one cycle."""
        return np.asarray(
            self.relative**2 + (self.force / force) ** 2 + (self.displacement / amplitude) ** 2
        )


@dataclass(frozen=True)
class RecordedForce:
    """White noise of each sample of force in a record, N, and the samples a second."""

    noise: float
    sample_rate: float


@dataclass(frozen=True)
class PlanRequest:
    """The checked arguments of a plan; `recorded` and `motions` are those of motions in time.

    `target` has the standard uncertainty of each quantity, or 1 if only names were given, in which
    case `has_numbers` is False.
    """

    knowledge: Knowledge
    limits: BenchLimits
    target: dict[str, float]
    has_numbers: bool
    costs: dict[str, float]
    controlled: str = "displacement"
    noise: CycleNoise = field(default_factory=lambda: CycleNoise(0.0))
    scatter: float = 0.0
    runs: int | None = 1
    larger: Model | None = None
    suspects: dict[str, float] = field(default_factory=dict)
    recorded: RecordedForce | None = None
    motions: str | tuple[PlannedMotion, ...] = ()


def noise_of_cycle(noise: float | Mapping[str, float] | None, knowledge: Knowledge) -> CycleNoise:
    """Return the noise of one cycle, as given or from the earlier data."""
    if noise is None:
        if knowledge.row_noise is None:
            reason, other = "the noise is unknown before any data", ""
            if knowledge.sample_noise is not None:
                reason = "a fit of records has the noise of a sample, not of one cycle of a sine"
                trapezoid = argument("candidates", "trapezoid", option="motion")
                other = f"; or plan motions in time ({trapezoid}), of which it is known"
            raise ValidationError(
                f"plan: {reason}; give {argument('noise', 0.01)} (of ln gain and phase in one "
                f"cycle), or its parts: relative, force in N, displacement in m{other}"
            )
        return CycleNoise(knowledge.row_noise * float(np.sqrt(knowledge.row_cycles)))
    if not isinstance(noise, Mapping):
        return CycleNoise(positive_number(noise, "noise"))
    unknown = sorted(set(noise) - {"relative", "force", "displacement"})
    if unknown:
        raise ValidationError(
            f"noise has {', '.join(unknown)}; expected relative, force and displacement"
        )
    parts = {n: float(non_negative_array(v, f"noise[{n!r}]")) for n, v in noise.items()}
    if not any(parts.values()):
        raise ValidationError("noise is zero; one cycle would determine everything")
    return CycleNoise(**{"relative": 0.0, **parts})


def recorded_force(
    noise: float | Mapping[str, float] | None, sample_rate: float | None, knowledge: Knowledge
) -> RecordedForce:
    """Return the noise of a record's force, as given or from earlier records."""
    if sample_rate is None:
        raise ValidationError("plan: motions in time need sample_rate, the samples a second, Hz")
    rate = positive_number(sample_rate, "sample_rate")
    if noise is None:
        if knowledge.sample_noise is None:
            raise ValidationError(
                "plan: the noise of the force is unknown; give the standard deviation of a force "
                "sample, N, in noise"
            )
        return RecordedForce(knowledge.sample_noise, rate)
    if not isinstance(noise, Mapping) or set(noise) != {"force"}:
        raise ValidationError(
            f"noise is {noise!r}; for motions in time, give only the standard deviation of a force "
            "sample in N, such as {'force': 0.001}"
        )
    return RecordedForce(positive_number(noise["force"], "noise['force']"), rate)


def motions_among(candidates: Any) -> str | tuple[PlannedMotion, ...]:
    """Return the motions in time that `candidates` has; empty for sines."""
    if isinstance(candidates, int):
        return ()
    if isinstance(candidates, str) and candidates in KINDS:
        return candidates
    if isinstance(candidates, str) or not np.iterable(candidates):
        raise ValidationError(
            f"candidates is {candidates!r}; expected a number, pairs of level and frequency, a "
            f"list of motions, or one of {', '.join(KINDS)}"
        )
    listed = tuple(candidates)
    are_motions = [isinstance(candidate, PlannedMotion) for candidate in listed]
    if any(are_motions) and not all(are_motions):
        raise ValidationError("candidates holds motions and others; plan either of them")
    return listed if any(are_motions) else ()


def target_of(target: Any) -> tuple[dict[str, float], bool]:
    """Return quantities with their target uncertainty, and whether numbers were given."""
    if not isinstance(target, Mapping):
        names = () if target is None else (target,) if isinstance(target, str) else target
        return {str(name): 1.0 for name in names}, False
    checked = {str(n): positive_number(u, f"target[{n!r}]") for n, u in target.items()}
    for name, u in checked.items():
        if u >= 1.0:
            raise ValidationError(
                f"target[{name!r}] is {u:g}; expected a relative uncertainty below 1: 0.02 is 2 %"
            )
    return checked, bool(checked)


def larger_model(
    knowledge: Knowledge, larger: Element | None, suspects: Mapping[str, float] | None
) -> Model | None:
    """Return the model in which suspected parameters are free; None if there are none."""
    if not suspects:
        if larger is not None:
            raise ValidationError("larger is given without suspects; name its parameters there")
        return None
    for name, u in suspects.items():
        positive_number(u, f"suspects[{name!r}]")
    model = as_model(larger) if larger is not None else knowledge.model
    names = {p.name for p in model.parameters}
    unknown = sorted(set(suspects) - names)
    if unknown:
        raise ValidationError(
            f"suspects names {', '.join(unknown)}, which {model!r} does not have; give a model "
            "that has them, in Python as larger="
        )
    return model.with_free([*suspects, *(names & set(knowledge.names))])


# Quantities: parameters, products of their powers, U(...) of either, the predicted response


def is_expanded(name: str) -> bool:
    """Return whether a quantity is an expanded uncertainty, ``U(...)``."""
    return _EXPANDED.fullmatch(name) is not None


def least_factor(name: str) -> float:
    """Return the least coverage factor of an expanded uncertainty; 1 for others."""
    return coverage_factor(np.inf) if is_expanded(name) else 1.0


def powers_of(expression: str, names: tuple[str, ...]) -> FloatArray:
    """Return the power of each parameter in a product such as ``sigma^2/f_max``."""
    text = expression.replace(" ", "")
    expanded = _EXPANDED.fullmatch(text)
    product = expanded["quantity"] if expanded else text
    powers = np.zeros(len(names))
    for i, part in enumerate(product.split("/")):
        for factor in part.split("*"):
            match = _POWER.fullmatch(factor)
            if match is None:
                raise ValidationError(
                    f"target is {expression!r}; expected a parameter, or a product of powers such "
                    "as 'sigma^2/f_max'"
                )
            name = match["name"]
            if name not in names:
                raise ValidationError(
                    f"target names {name!r}; expected a product of powers, such as 'f_max/sigma', "
                    f"of {choices(names, name)}"
                )
            powers[names.index(name)] += float(match["power"] or 1.0) * (-1.0 if i else 1.0)
    return powers
