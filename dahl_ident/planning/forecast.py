"""Uncertainties after measurements at candidates, in addition to earlier data.

The model error of an earlier fit (:mod:`dahl_ident.diagnostics.bands`) enters as W more
parameters, shared by earlier and later levels: a level close to a measured one then has little
information, however long it is measured. Parameters that may be needed although the model fixes or
omits them are forecast in a larger model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.bands import Departures, departures
from dahl_ident.diagnostics.confidence_levels import coverage_factor
from dahl_ident.errors import ValidationError
from dahl_ident.planning.candidates import OF_DRAWS, Candidates
from dahl_ident.planning.design import Design, Term, packed_information
from dahl_ident.planning.knowledge import Knowledge, spread, units_of
from dahl_ident.planning.question import RESPONSE, PlanRequest, is_expanded, least_factor, powers_of
from dahl_ident.units import DEFINITIONS

NOTHING = 1e-8  # information added, so that every parameter has a finite uncertainty
_ROUNDING = 1e-14  # fraction of a parameter's information that is rounding
_NONE = 1e12  # information with which departures are zero
SEARCHED = 24  # draws that the search for levels averages over
_SEARCHED_WITH_DEPARTURES = 2  # the same with departures: more parameters, close to the estimate
_PLACES = 24  # candidates over which the uncertainty of the response is averaged
_UNKNOWN = 1e-2  # information for the search: a suspected parameter is known within a decade or so


@dataclass(frozen=True)
class Expected:
    """Predicted relative standard uncertainty of a quantity; of ``"U(...)"`` the expanded one."""

    value: float  # of the fit or posterior, or the middle of ranges; NaN for the response
    # relative standard uncertainty from the earlier data, and with the plan's data: the geometric
    # mean over the draws; inf without any information
    before: float
    after: float
    low: float  # tenth and ninetieth percentile of `after` over the draws
    high: float
    scatter_share: float  # fraction of the variance that is due to scatter between runs


@dataclass(frozen=True)
class Forecast:
    """Candidates, and the uncertainties after measuring some of them, given earlier data."""

    knowledge: Knowledge  # before the plan
    # with derivatives with respect to scaled parameters and W departures, Q in all
    candidates: Candidates
    before: FloatArray  # (S, Q, Q) information of the earlier data as in their fit
    # (S, Q, Q) the same for the choice of levels: with ranges, and an assumed model error
    searched: FloatArray
    # (S, Q, c) relative changes of each quantity; the squares of several columns are added
    directions: Mapping[str, FloatArray]
    scatter: float  # standard deviation of ln gain and phase between runs
    model_error: str  # {"none", "assumed", "estimated"} of the earlier fit
    departures: int  # number of departures, W
    between: FloatArray | None = None  # (Q, Q) covariance of parameters between runs

    @classmethod
    def of(cls, question: PlanRequest, candidates: Candidates) -> Forecast:
        """Return the forecast of a question's quantities for candidates."""
        knowledge, units = question.knowledge, question.knowledge.units
        rows, square = candidates.rows * units, np.outer(units, units)
        known = knowledge.information * square
        searched = known + np.diag(knowledge.prior) * square
        error, model_error = _departures(knowledge, candidates), "none"
        if error is not None:
            model_error = "assumed" if error.assumed else "estimated"
            rows = np.concatenate([rows, error.columns * candidates.weight], axis=-1)
            known, searched = _joint(known, searched, error, units)
        candidates, between = replace(candidates, rows=rows), None
        if knowledge.between is not None:
            scaled = knowledge.between / units**2
            between = np.diag(np.pad(scaled, (0, known.shape[-1] - units.size)))
        directions, positive = {}, [p.positive for p in knowledge.parameters]
        for name in (*knowledge.names, *(n for n in question.target if n != RESPONSE)):
            change = np.zeros((len(known), known.shape[-1]))
            powers = powers_of(name, knowledge.names)
            change[:, : units.size] = powers * units / np.where(positive, 1.0, knowledge.values)
            directions[name] = change[..., None]
        if RESPONSE in question.target:
            directions[RESPONSE] = _response(candidates)
        return cls(
            knowledge,
            candidates,
            known,
            searched,
            directions,
            question.scatter,
            model_error,
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

    def term(self, target: Mapping[str, float], known: FloatArray | None = None) -> Term:
        """Return the criterion: uncertainties over their targets, or D-optimality."""
        c = self.candidates
        packed = packed_information(c.rows, c.offsets, self.scatter)
        known = self.searched if known is None else known
        term = Term(packed, known, self.scatter, between=self.between, departures=self.departures)
        if not target:
            return term
        columns = [self.directions[n] * least_factor(n) / u for n, u in target.items()]
        starts = np.cumsum([0, *(c.shape[-1] for c in columns[:-1])])
        return replace(term, targets=np.concatenate(columns, axis=-1), starts=starts)

    def covariance(self, design: Design) -> FloatArray:
        """Return the covariance of parameters and departures after a design, (S, Q, Q)."""
        c = self.candidates.only(design.levels)
        packed = packed_information(c.rows, c.offsets, self.scatter)
        term = Term(packed, self.before, self.scatter, between=self.between)
        return covariance_of(self.before + design.runs * term.of_run(design.cycles)[0])

    def uncertainty(self, covariance: FloatArray) -> dict[str, FloatArray]:
        """Return the relative standard uncertainty of every quantity at every draw."""
        return {
            name: np.sqrt(np.einsum("sic,sij,sjc->s", c, covariance, c))
            for name, c in self.directions.items()
        }

    def after(self, design: Design) -> tuple[dict[str, FloatArray], dict[str, float]]:
        """Return every quantity's uncertainty at every draw, and the share of scatter in it.

        Expanded uncertainties have the coverage factor of the runs' degrees of freedom.
        """
        after = self.uncertainty(self.covariance(design))
        shares = dict.fromkeys(after, 0.0)
        if self.scatter > 0.0 or self.between is not None:
            alike = replace(self, scatter=0.0, between=None)
            by_noise = self.uncertainty(alike.covariance(design))
            for name, u in by_noise.items():
                if np.isfinite(typical(after[name])):
                    shares[name] = max(0.0, 1.0 - (typical(u) / typical(after[name])) ** 2)
        for name, share in shares.items():
            if is_expanded(name):
                dof = max(design.runs - 1, 1) / share**2 if share > 0.0 else np.inf
                after[name] = coverage_factor(dof) * after[name]
        return after, shares

    def expected(self, design: Design) -> dict[str, Expected]:
        """Return the expected uncertainty of each quantity after a design."""
        after, shares = self.after(design)
        before = self.uncertainty(covariance_of(self.before))
        values, names = self.knowledge.stated, self.knowledge.names
        return {
            name: Expected(
                value=np.nan
                if name == RESPONSE
                else float(np.prod(values ** powers_of(name, names))),
                before=least_factor(name) * typical(before[name]),
                after=typical(u),
                low=_shown(float(np.quantile(u, 0.1))),
                high=_shown(float(np.quantile(u, 0.9))),
                scatter_share=shares[name],
            )
            for name, u in after.items()
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


def _joint(
    known: FloatArray, searched: FloatArray, error: Departures, units: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the information on parameters and departures: as in the fit, and for the search.

    The first does not include a model error that is only assumed.
    """
    P, W = len(units), error.columns.shape[-1]
    scale = np.concatenate([units, np.ones(W)])
    joint = np.broadcast_to(error.information * np.outer(scale, scale), (len(known), P + W, P + W))
    ranges = np.zeros((P + W, P + W))
    ranges[:P, :P] = (searched - known)[0]
    if not error.assumed:
        return joint, joint + ranges
    plain = np.zeros(joint.shape)
    plain[:, :P, :P] = known
    plain[:, P:, P:] = _NONE * np.eye(W)
    return plain, joint + ranges


def _response(candidates: Candidates) -> FloatArray:
    """Return changes of ln gain and phase, whose summed squares are their mean over levels."""
    order = np.argsort(np.median(candidates.force, axis=0), kind="stable")
    part = candidates.only(order[spread(candidates.count, _PLACES)])
    S, levels, _, Q = part.rows.shape
    changes = (part.rows / part.weight).reshape(S, -1, Q) / np.sqrt(2.0 * levels)
    return np.asarray(np.linalg.qr(changes, mode="r")).swapaxes(-1, -2)


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
    return _shown(float(np.exp(np.mean(np.log(np.maximum(u, 1e-300))))))


def _shown(u: float) -> float:
    return u if u < 100.0 else float("inf")


def forecast_of_suspects(
    question: PlanRequest, knowledge: Knowledge, candidates: Candidates
) -> Forecast:
    """Return the forecast of suspected parameters in the larger model, at the draws of `knowledge`.

    If displacement is controlled, the second harmonic is included, because only it shows asymmetry;
    the noise of a harmonic's force is that of the fundamental's.
    """
    larger, suspects = question.larger, question.suspects
    assert larger is not None
    levels = candidates.level, candidates.frequency_hz, candidates.controlled
    problem = knowledge.problem_at(*levels, model=larger)
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
    even = candidates.controlled == "displacement" and any(
        e.has_harmonic(2) for e in larger.elements
    )
    rows = []
    for k in (1, 2) if even else (1,):
        harmonic_problem = knowledge.problem_at(*levels, model=larger, harmonic=k, noise="absolute")
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = harmonic_problem.prediction_jacobian(theta) / fundamental
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
    scaled = np.broadcast_to(np.diag(units), (S, *2 * units.shape))
    directions = {name: scaled[..., [names.index(name)]] for name in suspects}
    candidates = replace(candidates, rows=np.concatenate(rows, axis=2))
    return Forecast(
        knowledge, candidates, known, searched, directions, question.scatter, "none", departures=0
    )
