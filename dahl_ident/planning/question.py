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
from dahl_ident.planning.candidates import CycleNoise, Limits
from dahl_ident.planning.knowledge import Knowledge


@dataclass(frozen=True)
class Question:
    """The arguments of :func:`plan` in checked form."""

    knowledge: Knowledge
    limits: Limits
    controlled: str
    noise: CycleNoise
    wanted: dict[str, float]
    numbers: bool
    scatter: float
    runs: int | None
    costs: dict[str, float]
    larger: Any
    suspects: dict[str, float]


def noise_of(given: float | Mapping[str, float] | None, knowledge: Knowledge) -> CycleNoise:
    """Return the noise of one cycle, as given or from the earlier data."""
    if given is None:
        if knowledge.row_noise is None:
            raise ValidationError(
                "plan: the noise is unknown before any data; give noise=0.01 (of ln gain and phase "
                "in one cycle), or noise={'relative': 0.01, 'force': 1e-3, 'displacement': 1e-7}"
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


def targets_of(target: Any) -> tuple[dict[str, float], bool]:
    """Return quantities with the uncertainty wanted, and whether numbers were given."""
    if target is None:
        return {}, False
    if isinstance(target, str):
        return {target: 1.0}, False
    if isinstance(target, Mapping):
        found = {str(n): positive_number(u, f"target[{n!r}]") for n, u in target.items()}
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
