"""Parameters that may be needed although the model fixes or omits them, in a larger model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dahl_ident.errors import ValidationError
from dahl_ident.planning.candidates import Candidates
from dahl_ident.planning.forecast import Forecast
from dahl_ident.planning.knowledge import Knowledge, units_of
from dahl_ident.planning.question import PlanRequest

_UNKNOWN = 1e-2  # information for the search: a suspected parameter is known within a decade or so


def forecast_of_suspects(
    question: PlanRequest, knowledge: Knowledge, candidates: Candidates
) -> Forecast:
    """Return the forecast of suspected parameters in the larger model, at the draws given.

    Where displacement is controlled, the second harmonic counts in addition to the fundamental,
    because only it shows asymmetry; the noise of a harmonic's force is that of the fundamental's.
    """
    larger, suspects = question.larger, question.suspects
    assert larger is not None
    places = candidates.level, candidates.frequency_hz, candidates.controlled
    problem = knowledge.problem_at(*places, model=larger)
    drawn = dict(zip(knowledge.names, knowledge.values.T, strict=True))
    S, names, columns = len(knowledge.theta), problem.names, []
    for p in problem.parameters:
        if p.name not in drawn and p.value is None:
            raise ValidationError(
                f"the larger model has the free parameter {p.name}, about which nothing is known; "
                "give it a value there"
            )
        columns.append(drawn.get(p.name, np.full(S, p.value)))
    theta = problem.to_search(np.stack(columns, axis=-1))
    units = units_of(problem.parameters, theta)
    fundamental = problem.predict(theta)[..., None]
    even = candidates.controlled == "displacement" and any(e.answers(2) for e in larger.elements)
    rows = []
    for k in (1, 2) if even else (1,):
        one = knowledge.problem_at(*places, model=larger, harmonic=k, noise="absolute")
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = one.prediction_jacobian(theta) / fundamental
        relative[~np.isfinite(relative)] = 0.0  # within a gap there is no response
        parts = np.stack([relative.real, relative.imag], axis=2)
        rows.append(parts * units * candidates.weight)
    known = np.zeros((S, *2 * units.shape))
    if knowledge.problem is not None:
        before = knowledge.problem.like(model=larger, sensors=knowledge.sensors)
        scale = 1.0 if before.scale_known else float(knowledge.row_noise or 1.0)
        known = before.information(theta, scale) * np.outer(units, units)
    searched = known + _UNKNOWN * np.eye(units.size)
    for prior, name in zip(knowledge.prior, knowledge.names, strict=True):
        i = names.index(name)
        searched[:, i, i] += prior * units[i] ** 2
    directions = {
        name: np.broadcast_to(
            (np.eye(units.size) * units)[:, [names.index(name)]], (S, units.size, 1)
        )
        for name in suspects
    }
    candidates = replace(candidates, rows=np.concatenate(rows, axis=2))
    return Forecast(
        knowledge, candidates, known, searched, directions, question.scatter, "none", departures=0
    )
