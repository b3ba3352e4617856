"""Parameters that may be needed although the model fixes or omits them, in a larger model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import ValidationError
from dahl_ident.planning.candidates import Candidates
from dahl_ident.planning.design import Objective, Term, packed_information
from dahl_ident.planning.forecast import NOTHING, typical
from dahl_ident.planning.knowledge import Knowledge, units_of
from dahl_ident.planning.question import Question

_UNKNOWN = 1e-2  # information for the search: a suspected parameter is known within a decade or so


@dataclass(frozen=True)
class Suspects:
    """The criterion on suspected parameters, and the information before it, nothing assumed."""

    term: Term
    before: FloatArray

    @classmethod
    def of(cls, question: Question, knowledge: Knowledge, candidates: Candidates) -> Suspects:
        """Return the suspects of a question, at the draws of `knowledge` and the candidates.

        Where displacement is controlled, the second harmonic counts in addition to the fundamental,
        because only it shows asymmetry; the noise of a harmonic's force is that of the
        fundamental's.
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
                    f"the larger model has the free parameter {p.name}, about which nothing is "
                    "known; give it a value there"
                )
            columns.append(drawn.get(p.name, np.full(S, p.value)))
        theta = problem.to_search(np.stack(columns, axis=-1))
        units = units_of(problem.parameters, theta)
        fundamental = problem.predict(theta)[..., None]
        orders, rows, offsets = [1], [], []
        if candidates.controlled == "displacement" and any(e.answers(2) for e in larger.elements):
            orders.append(2)
        for k in orders:
            one = knowledge.problem_at(*places, model=larger, harmonic=k, noise="absolute")
            with np.errstate(divide="ignore", invalid="ignore"):
                relative = one.prediction_jacobian(theta) / fundamental
            # within a gap there is no response, and no information
            relative[~np.isfinite(relative)] = 0.0
            parts = np.stack([relative.real, relative.imag], axis=2)
            rows.append(parts * units * candidates.weight)
            offsets.append(candidates.offsets * (k == 1))
        known = np.zeros((S, *2 * units.shape))
        if knowledge.problem is not None:
            before = knowledge.problem.like(model=larger, sensors=knowledge.sensors)
            scale = 1.0 if before.scale_known else float(knowledge.row_noise or 1.0)
            known = before.information(theta, scale) * np.outer(units, units)
        searched = known + _UNKNOWN * np.eye(units.size)
        for prior, name in zip(knowledge.prior, knowledge.names, strict=True):
            i = names.index(name)
            searched[:, i, i] += prior * units[i] ** 2
        targets = np.zeros((S, units.size, len(suspects)))
        for t, (name, u) in enumerate(suspects.items()):
            i = names.index(name)
            targets[:, i, t] = units[i] / u
        packed = packed_information(
            np.concatenate(rows, axis=2), np.concatenate(offsets, axis=2), question.scatter
        )
        term = Term(packed, searched, question.scatter, targets)
        return cls(term, known + NOTHING * np.eye(units.size))

    def ratio(self, levels: NDArray[np.intp], cycles: FloatArray, runs: int) -> float:
        """Return the largest ratio of a suspected parameter's uncertainty to its target."""
        (term,) = Objective((replace(self.term, known=self.before),)).only(levels).terms
        inverse = np.linalg.inv(self.before + runs * term.of_run(cycles)[0])
        targets = self.term.targets
        assert targets is not None
        h = np.sqrt(np.einsum("sit,sij,sjt->st", targets, inverse, targets))
        return max(typical(column) for column in h.T)
