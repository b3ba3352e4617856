"""What the describing function would have made of rows whose force was controlled."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dahl_ident.data import FrequencyResponse
from dahl_ident.data.rows import row_names
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus
from dahl_ident.elements import Model
from dahl_ident.fitting import Optimum
from dahl_ident.problem.steady_rows import levels
from dahl_ident.steady_state import response
from dahl_ident.units import shown_unit

_SEEN = 1e-3  # relative difference that is worth a place
_DISTORTED = 0.05  # of a force: less changes the fundamental by well below 1 %


def steady_difference(optimum: Optimum) -> tuple[int, float] | None:
    """Return the row where exact and describing-function response differ most, and by how much.

    Relative to the exact one; None where no row has both.
    """
    problem = optimum.problem
    forced = (problem.data.controlled == "force") & (problem.data.harmonic == 1)
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


def steady_findings(optimum: Optimum, model: Model) -> Iterator[Finding]:
    """Yield how driven rows were predicted, what the other way would have been, and jumps.

    `model` has the estimates put in.
    """
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
        yield from _distorted(problem.data)
        yield from _jumps(problem.data, model)
        unstable = problem.unstable_rows(optimum.theta)
        if unstable:
            names = tuple(row_names(problem.data, unstable))
            yield Finding(described, VerdictStatus.APPROXIMATE, "unstable_rows", {"rows": names})
        return
    why = problem.obstacle_to_exact
    if not why and not problem.takes_energy(optimum.theta):
        yield Finding(described, note, "no_steady_motion")
    if why and problem.steady == "exact" and any(not e.is_linear for e in problem.model.elements):
        yield Finding(described, note, "describing_function", {"why": why})


def _distorted(data: FrequencyResponse) -> Iterator[Finding]:
    """Yield where the force is farthest from the sine for which the motion is predicted."""
    harmonics = data.quality.get("force_distortion")
    if harmonics is None:
        return
    apart = np.nan_to_num(np.where(data.controlled == "force", harmonics, 0.0))
    row = int(np.argmax(apart))
    if apart[row] > _DISTORTED:
        (name,) = row_names(data, [row])
        provenance = data.provenance or {}
        parts = provenance.get("parts", (provenance,))
        files = tuple(dict.fromkeys(str(p["file"]) for p in parts if "file" in p))
        values = {"row": name, "distortion": float(apart[row]), "files": files}
        yield Finding(Question.DESCRIBED, VerdictStatus.TRUSTED, "distorted_force", values)


def _jumps(data: FrequencyResponse, model: Model) -> Iterator[Finding]:
    """Yield at which drives, and between which frequencies, there are several stable motions."""
    if data.drive is None:
        return
    rows = np.flatnonzero((data.controlled == "force") & (data.harmonic == 1))
    f, drive = data.frequency_hz, data.drive
    sines = response(model, f[rows], drive[rows], all_roots=True, steady="describing function")
    if not (np.asarray(sines.number_of_solutions) > 1).any():
        return
    places = []
    for level in levels(drive[rows]):
        there = rows[level]
        exact = response(model, f[there], drive[there], all_roots=True)
        several = f[there[np.asarray(exact.stable).sum(axis=1) > 1]]
        if several.size:
            mean = float(np.median(drive[there]))
            places.append((mean, float(several.min()), float(several.max())))
    if places:
        values = {"places": tuple(places), "unit": shown_unit("N", data.motion)}
        yield Finding(Question.DESCRIBED, VerdictStatus.TRUSTED, "jump", values)
