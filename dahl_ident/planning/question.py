"""The arguments of a plan, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dahl_ident.arrays import non_negative_array, positive_number
from dahl_ident.elements import Element
from dahl_ident.elements.element import as_model
from dahl_ident.errors import ValidationError
from dahl_ident.planning.candidates import BenchLimits, CycleNoise
from dahl_ident.planning.knowledge import Knowledge
from dahl_ident.planning.motion_information import RecordedForce
from dahl_ident.planning.trajectories import KINDS, PlannedMotion


@dataclass(frozen=True)
class PlanRequest:
    """The arguments of :func:`plan` in checked form; `recorded` only for motions in time."""

    knowledge: Knowledge
    limits: BenchLimits
    controlled: str
    noise: CycleNoise
    wanted: dict[str, float]
    numbers: bool
    scatter: float
    runs: int | None
    costs: dict[str, float]
    larger: Any
    suspects: dict[str, float]
    recorded: RecordedForce | None = None
    motions: str | tuple[PlannedMotion, ...] = ()


def noise_of(given: float | Mapping[str, float] | None, knowledge: Knowledge) -> CycleNoise:
    """Return the noise of one cycle, as given or from the earlier data."""
    if given is None:
        if knowledge.row_noise is None:
            raise ValidationError(
                "plan: the noise is unknown before any data; give noise=0.01 (of ln gain and phase "
                "in one cycle), or its parts: relative, force in N, displacement in m"
            )
        return CycleNoise(knowledge.row_noise * float(np.sqrt(knowledge.row_cycles)))
    if not isinstance(given, Mapping):
        return CycleNoise(positive_number(given, "noise"))
    unknown = sorted(set(given) - {"relative", "force", "displacement"})
    if unknown:
        raise ValidationError(
            f"noise has {', '.join(unknown)}; expected relative, force and displacement"
        )
    parts = {n: float(non_negative_array(v, f"noise[{n!r}]")) for n, v in given.items()}
    if not any(parts.values()):
        raise ValidationError("noise is zero; one cycle would determine everything")
    return CycleNoise(**{"relative": 0.0, **parts})


def motions_asked(candidates: Any) -> str | tuple[PlannedMotion, ...]:
    """Return the motions in time among the candidates' forms, empty for sines."""
    if isinstance(candidates, str):
        if candidates not in KINDS:
            raise ValidationError(
                f"candidates is {candidates!r}; expected a number, pairs of level and frequency, "
                f"motions, or one of {', '.join(KINDS)}"
            )
        return candidates
    if isinstance(candidates, int):
        return ()
    try:
        listed = tuple(candidates)
    except TypeError:
        raise ValidationError(
            f"candidates is {candidates!r}; expected a number, pairs of level and frequency, a "
            f"list of motions, or one of {', '.join(KINDS)}"
        ) from None
    moving = [getattr(one, "kind", None) in KINDS for one in listed]
    if any(moving) and not all(moving):
        raise ValidationError("candidates holds motions and others; plan one or the other")
    return listed if any(moving) else ()


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
            f"noise is {noise!r}; of motions in time give that of a force sample alone, its "
            "standard deviation in N, such as {'force': 0.001}"
        )
    return RecordedForce(positive_number(noise["force"], "noise['force']"), rate)


def targets_of(target: Any) -> tuple[dict[str, float], bool]:
    """Return quantities with the uncertainty wanted, and whether numbers were given."""
    if target is None:
        return {}, False
    if isinstance(target, str):
        return {target: 1.0}, False
    if isinstance(target, Mapping):
        found = {str(n): positive_number(u, f"target[{n!r}]") for n, u in target.items()}
        for name, u in found.items():
            if u >= 1.0:
                raise ValidationError(
                    f"target[{name!r}] is {u:g}; expected a relative uncertainty below 1: 0.02 is "
                    "2 %"
                )
        return found, bool(found)
    return {str(name): 1.0 for name in target}, False


def larger_model(
    knowledge: Knowledge, larger: Element | None, suspects: Mapping[str, float] | None
) -> Any:
    """Return the model in which suspected parameters are free; None where there are none."""
    if not suspects:
        if larger is not None:
            raise ValidationError("larger is given without suspects; name its parameters there")
        return None
    for name, u in suspects.items():
        positive_number(u, f"suspects[{name!r}]")
    model = as_model(larger) if larger is not None else knowledge.model
    unknown = sorted(set(suspects) - {p.name for p in model.parameters})
    if unknown:
        raise ValidationError(
            f"suspects names {', '.join(unknown)}, which {model!r} does not have; give larger=, a "
            "model that has them"
        )
    same = {p.name for p in model.parameters} & set(knowledge.names)
    return model.with_free([*suspects, *same])
