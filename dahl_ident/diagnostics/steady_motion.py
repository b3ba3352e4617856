"""What the describing function would have made of rows whose force was controlled."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dahl_ident.data.rows import row_names
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus
from dahl_ident.fitting import Optimum

_SEEN = 1e-3  # relative difference that is worth a place


def steady_difference(optimum: Optimum) -> tuple[int, float] | None:
    """Return the row where exact and describing-function response differ most, and by how much.

    Relative to the exact one; None where no row has both.
    """
    problem = optimum.problem
    forced = problem.data.controlled == "force"
    if problem.obstacle_to_exact or not np.isfinite(optimum.values).all():
        return None
    exact, sine = (
        problem.with_steady(steady).predict(optimum.theta)
        for steady in ("exact", "describing function")
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.where(forced & np.isfinite(exact), np.abs(sine / exact - 1.0), 0.0)
    row = int(np.nanargmax(apart))
    return row, float(apart[row])


def steady_findings(optimum: Optimum) -> Iterator[Finding]:
    """Yield how driven rows were predicted, and what the other way would have been."""
    problem = optimum.problem
    forced = problem.data.controlled == "force"
    if not forced.any():
        return
    described, note = Question.DESCRIBED, VerdictStatus.TRUSTED
    if problem.is_exact:
        worst = steady_difference(optimum)
        values = {"difference": 0.0, "row": ""}
        if worst is not None and worst[1] >= _SEEN:
            (row,) = row_names(problem.data, [worst[0]])
            values = {"difference": worst[1], "row": row}
        yield Finding(described, note, "steady", values)
        return
    why = problem.obstacle_to_exact
    if not why and not problem.takes_energy(optimum.theta):
        yield Finding(described, note, "no_steady_motion")
    if why and problem.steady == "exact" and any(not e.is_linear for e in problem.model.elements):
        yield Finding(described, note, "describing_function", {"why": why})
