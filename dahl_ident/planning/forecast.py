"""Uncertainties after measurements at candidates, in addition to earlier data.

The model error of an earlier fit (:mod:`dahl_ident.diagnostics.bands`) enters as W more
parameters, shared by earlier and later levels: a level close to a measured one then has little
information, however long it is measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.bands import Departures, departures
from dahl_ident.planning.candidates import OF_DRAWS, Candidates
from dahl_ident.planning.design import Criterion, Design, packed_information
from dahl_ident.planning.knowledge import Knowledge, spread
from dahl_ident.planning.question import PlanRequest, powers_of
from dahl_ident.units import DEFINITIONS

NOTHING = 1e-8  # information added, so that every parameter has a finite uncertainty
_ROUNDING = 1e-14  # fraction of a parameter's information that is rounding
SEARCHED = 24  # draws that the search for levels averages over
_SEARCHED_WITH_DEPARTURES = 2  # the same with departures: more parameters, close to the estimate


@dataclass(frozen=True)
class Expected:
    """Predicted relative standard uncertainty of a quantity."""

    value: float  # of the fit or posterior, or the middle of ranges
    # relative standard uncertainty from the earlier data, and with the plan's data: the geometric
    # mean over the draws; inf without any information
    before: float
    after: float


@dataclass(frozen=True)
class Forecast:
    """Candidates, and the uncertainties after measuring some of them, given earlier data."""

    knowledge: Knowledge  # before the plan
    # with derivatives with respect to scaled parameters and W departures, Q in all
    candidates: Candidates
    before: FloatArray  # (S, Q, Q) information of the earlier data as in their fit
    searched: FloatArray  # (S, Q, Q) the same for the choice of levels, with ranges
    # (S, Q) relative changes of each quantity
    directions: Mapping[str, FloatArray]
    scatter: float  # standard deviation of ln gain and phase between runs
    departures: int  # number of departures, W
    between: FloatArray | None = None  # (Q, Q) covariance of parameters between runs

    @classmethod
    def of(cls, question: PlanRequest, candidates: Candidates) -> Forecast:
        """Return the forecast of a question's quantities for candidates."""
        knowledge, units = question.knowledge, question.knowledge.units
        rows, scale = candidates.rows * units, units
        information, prior = knowledge.information, knowledge.prior
        error = _departures(knowledge, candidates)
        if error is not None:
            rows = np.concatenate([rows, error.columns * candidates.weight], axis=-1)
            W = error.columns.shape[-1]
            scale, prior = np.append(units, np.ones(W)), np.append(prior, np.zeros(W))
            information = np.broadcast_to(error.information, (len(information), *2 * scale.shape))
        known = information * np.outer(scale, scale)
        searched = known + np.diag(prior * scale**2)
        candidates, between = replace(candidates, rows=rows), None
        if knowledge.between is not None:
            scaled = knowledge.between / units**2
            between = np.diag(np.pad(scaled, (0, known.shape[-1] - units.size)))
        directions, positive = {}, [p.positive for p in knowledge.parameters]
        for name in (*knowledge.names, *question.target):
            change = np.zeros((len(known), known.shape[-1]))
            powers = powers_of(name, knowledge.names)
            change[:, : units.size] = powers * units / np.where(positive, 1.0, knowledge.values)
            directions[name] = change
        return cls(
            knowledge,
            candidates,
            known,
            searched,
            directions,
            question.scatter,
            departures=known.shape[-1] - units.size,
            between=between,
        )

    def thinned(self) -> Forecast:
        """Return the forecast at the few draws that a search averages over."""
        most = SEARCHED if self.departures == 0 else _SEARCHED_WITH_DEPARTURES
        some, candidates = spread(len(self.before), most), self.candidates
        return replace(
            self,
            knowledge=self.knowledge.only(some),
            candidates=replace(candidates, **{n: getattr(candidates, n)[some] for n in OF_DRAWS}),
            before=self.before[some],
            searched=self.searched[some],
            directions={name: d[some] for name, d in self.directions.items()},
        )

    def criterion(self, target: Mapping[str, float]) -> Criterion:
        """Return the criterion: uncertainties over their targets, or D-optimality."""
        c = self.candidates
        packed = packed_information(c.rows, c.offsets, self.scatter)
        criterion = Criterion(
            packed,
            self.searched,
            self.scatter,
            between=self.between,
            departures=self.departures,
        )
        if not target:
            return criterion
        columns = [self.directions[name] / u for name, u in target.items()]
        return replace(criterion, targets=np.stack(columns, axis=-1))

    def covariance(self, design: Design) -> FloatArray:
        """Return the covariance of parameters and departures after a design, (S, Q, Q)."""
        c = self.candidates.only(design.levels)
        packed = packed_information(c.rows, c.offsets, self.scatter)
        criterion = Criterion(packed, self.before, self.scatter, between=self.between)
        return covariance_of(self.before + design.runs * criterion.of_run(design.cycles)[0])

    def uncertainty(self, covariance: FloatArray) -> dict[str, float]:
        """Return the relative standard uncertainty of every quantity, typical of the draws."""
        return {
            name: typical(np.sqrt(np.einsum("si,sij,sj->s", c, covariance, c)))
            for name, c in self.directions.items()
        }

    def after(self, design: Design) -> dict[str, float]:
        """Return the uncertainty of every quantity after a design."""
        return self.uncertainty(self.covariance(design))

    def expected(self, design: Design) -> dict[str, Expected]:
        """Return the expected uncertainty of each quantity after a design."""
        before = self.uncertainty(covariance_of(self.before))
        values, names = self.knowledge.stated, self.knowledge.names
        return {
            name: Expected(float(np.prod(values ** powers_of(name, names))), before[name], u)
            for name, u in self.after(design).items()
        }


def _departures(knowledge: Knowledge, candidates: Candidates) -> Departures | None:
    """Return the model error of the earlier fit at candidates."""
    errors = knowledge.errors
    if errors is None:
        return None
    indices = [errors.names.index(name) for name in knowledge.names]
    problem = knowledge.problem_at(candidates.level, candidates.frequency_hz, candidates.controlled)
    predicted, changes = problem.prediction_and_jacobian(errors.theta[indices])
    amplitude = candidates.level
    if candidates.controlled == "force":
        amplitude = amplitude / np.abs(predicted)
    # a receptance rises as the stiffness falls
    sign = DEFINITIONS[errors.problem.data.quantity].exponent
    slopes = np.zeros((candidates.count, len(errors.names)), dtype=np.complex128)
    slopes[:, indices] = sign * changes / predicted[:, None]
    error = departures(errors, slopes, amplitude, 2.0 * np.pi * candidates.frequency_hz, predicted)
    if error is None:
        return None
    kept = [*indices, *range(len(errors.names), len(error.information))]
    return error._replace(
        columns=sign * error.columns, information=error.information[np.ix_(kept, kept)]
    )


def covariance_of(M: FloatArray) -> FloatArray:
    """Return the inverse of the information; undetermined directions have a very large variance.

    It is computed in units in which the diagonal is 1, against rounding.
    """
    size = np.sqrt(np.diagonal(M, axis1=-2, axis2=-1) + NOTHING)
    units = size[..., :, None] * size[..., None, :]
    eye = np.eye(M.shape[-1])
    return np.asarray(np.linalg.inv((M + NOTHING * eye) / units + _ROUNDING * eye) / units)


def typical(u: FloatArray) -> float:
    """Return the geometric mean over draws, inf without any information."""
    mean = float(np.exp(np.mean(np.log(np.maximum(u, 1e-300)))))
    return mean if mean < 100.0 else float("inf")
