"""What measurements at candidates would determine, in addition to what earlier data did.

The model error of an earlier fit (:mod:`dahl_ident.diagnostics.prediction_error`) enters as W more
parameters, shared by earlier and later levels: a level close to a measured one then teaches
little, however long it is measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.data.quantities import DEFINITIONS
from dahl_ident.diagnostics.budget import coverage_factor
from dahl_ident.diagnostics.prediction_error import Departures, departures
from dahl_ident.planning.candidates import Candidates
from dahl_ident.planning.criteria import NOTHING, Term
from dahl_ident.planning.knowledge import Knowledge
from dahl_ident.planning.measurement_plan import Expected
from dahl_ident.planning.quantities import (
    RESPONSE,
    direction,
    is_expanded,
    least_factor,
    product,
    sizes,
)

_ROUNDING = 1e-14  # of a parameter's information: less is rounding, and could cancel to nothing
_NONE = 1e12  # information on departures that are left out
SEARCHED = 24  # draws that the search for levels averages over
_SEARCHED_WITH_DEPARTURES = 2  # the same of many parameters more, close to the fit's estimate
_PLACES = 24  # of the candidates, over which the response is averaged


@dataclass(frozen=True)
class Forecast:
    """Candidates, the information before them, and the uncertainties after some of them."""

    knowledge: Knowledge  # before the plan
    # with derivatives with respect to scaled parameters and W departures, Q together
    candidates: Candidates
    before: FloatArray  # (S, Q, Q): information of the earlier data as their fit judges it
    # (S, Q, Q): the same for the choice of levels: with ranges, and an assumed model error
    searched: FloatArray
    # (S, Q, c): relative changes of each quantity; the squares of several columns are added
    directions: Mapping[str, FloatArray]
    scatter: float  # standard deviation of ln gain and phase between runs
    model_error: str  # of the earlier fit
    draws: NDArray[np.intp]  # (S,): which of the draws of the plan

    @classmethod
    def of(
        cls,
        knowledge: Knowledge,
        candidates: Candidates,
        wanted: Mapping[str, float],
        scatter: float,
    ) -> Forecast:
        """Return the forecast of candidates and wanted quantities."""
        size = sizes(knowledge.parameters, knowledge.theta)
        rows = candidates.rows * size
        known = knowledge.information * np.outer(size, size)
        searched = known + knowledge.prior * np.outer(size, size)
        error, model_error = _departures(knowledge, candidates), "none"
        if error is not None:
            model_error = "assumed" if error.assumed else "estimated"
            own = error.columns / np.sqrt(candidates.variance)[..., None, None]
            rows = np.concatenate([rows, own], axis=-1)
            known, searched = _joint(known, searched, error, size)
        candidates = replace(candidates, rows=rows)
        directions = {}
        for name in (*knowledge.names, *(n for n in wanted if n != RESPONSE)):
            change = direction(name, knowledge.parameters, knowledge.values) * size
            padded = np.zeros((len(change), known.shape[-1]))
            padded[:, : len(size)] = change
            directions[name] = padded[..., None]
        if RESPONSE in wanted:
            directions[RESPONSE] = _response(candidates)
        draws = np.arange(len(known))
        return cls(knowledge, candidates, known, searched, directions, scatter, model_error, draws)

    @property
    def departures(self) -> int:
        """W."""
        return int(self.before.shape[-1]) - len(self.knowledge.names)

    def thinned(self) -> Forecast:
        """Return the forecast at the few draws that a search averages over."""
        S = len(self.before)
        most = SEARCHED if self.departures == 0 else _SEARCHED_WITH_DEPARTURES
        some = np.unique(np.linspace(0, S - 1, min(S, most)).astype(int))
        return replace(
            self,
            knowledge=self.knowledge.only(some),
            candidates=self.candidates.at_draws(some),
            before=self.before[some],
            searched=self.searched[some],
            directions={name: d[some] for name, d in self.directions.items()},
            draws=some,
        )

    def term(self, wanted: Mapping[str, float]) -> Term:
        """Return the criterion: uncertainties over the wanted ones, or D-optimality."""
        levels = self.candidates.information(self.scatter)
        if not wanted:
            return Term(levels, self.searched, departures=self.departures)
        columns = [self.directions[n] * least_factor(n) / u for n, u in wanted.items()]
        starts = np.cumsum([0, *(c.shape[-1] for c in columns[:-1])])
        return Term(levels, self.searched, np.concatenate(columns, axis=-1), starts)

    def covariance(
        self, levels: Any, cycles: FloatArray, runs: int, scatter: float | None = None
    ) -> FloatArray:
        """Return the covariance of parameters and departures after a design, (S, Q, Q)."""
        if not len(levels):
            return covariance_of(self.before)
        one = self.candidates.only(levels).information(self.scatter if scatter is None else scatter)
        return covariance_of(self.before + runs * one.of_run(cycles @ one.packed)[0])

    def uncertainty(self, covariance: FloatArray) -> dict[str, FloatArray]:
        """Return the relative standard uncertainty of every quantity at every draw."""
        return {
            name: np.sqrt(np.einsum("sic,sij,sjc->s", c, covariance, c))
            for name, c in self.directions.items()
        }

    def after(
        self, levels: Any, cycles: FloatArray, runs: int
    ) -> tuple[dict[str, FloatArray], dict[str, float]]:
        """Return every quantity's uncertainty at every draw, and the share of scatter in it.

        Expanded uncertainties have the coverage factor of the runs' degrees of freedom; noise has
        many.
        """
        found = self.uncertainty(self.covariance(levels, cycles, runs))
        shares = dict.fromkeys(found, 0.0)
        if self.scatter > 0.0:
            quiet = self.uncertainty(self.covariance(levels, cycles, runs, 0.0))
            for name, least in quiet.items():
                if np.isfinite(typical(found[name])):
                    shares[name] = max(0.0, 1.0 - (typical(least) / typical(found[name])) ** 2)
        for name, share in shares.items():
            if is_expanded(name):
                dof = max(runs - 1, 1) / share**2 if share > 0.0 else np.inf
                found[name] = coverage_factor(dof) * found[name]
        return found, shares

    def expected(self, levels: Any, cycles: FloatArray, runs: int) -> dict[str, Expected]:
        """Return the expected uncertainty of each quantity after a design."""
        after, shares = self.after(levels, cycles, runs)
        before = self.uncertainty(covariance_of(self.before))
        values = dict(zip(self.knowledge.names, self.knowledge.values.T, strict=True))
        return {
            name: Expected(
                value=np.nan if name == RESPONSE else float(np.median(product(name, values))),
                before=least_factor(name) * typical(before[name]),
                after=typical(u),
                low=_shown(float(np.quantile(u, 0.1))),
                high=_shown(float(np.quantile(u, 0.9))),
                scatter_share=shares[name],
            )
            for name, u in after.items()
        }  # fmt: skip


def _departures(knowledge: Knowledge, candidates: Candidates) -> Departures | None:
    """Return the model error of the earlier fit at candidates."""
    errors = knowledge.errors
    if errors is None:
        return None
    own = [errors.names.index(name) for name in knowledge.names]
    problem = knowledge.problem_at(candidates.level, candidates.frequency_hz, candidates.controlled)
    theta = errors.theta[own]
    predicted = problem.predict(theta)
    amplitude = candidates.level
    if candidates.controlled == "force":
        amplitude = amplitude / np.abs(predicted)
    # earlier responses that are receptances rise where the stiffness falls
    sign = DEFINITIONS[errors.problem.data.quantity].exponent
    slopes = np.zeros((candidates.count, len(errors.names)), dtype=np.complex128)
    slopes[:, own] = sign * problem.prediction_jacobian(theta) / predicted[:, None]
    found = departures(errors, slopes, amplitude, 2.0 * np.pi * candidates.frequency_hz, predicted)
    if found is None:
        return None
    W = found.columns.shape[-1]
    kept = [*own, *range(len(errors.names), len(errors.names) + W)]
    return found._replace(
        columns=sign * found.columns, information=found.information[np.ix_(kept, kept)]
    )


def _joint(
    known: FloatArray, searched: FloatArray, error: Departures, size: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the information of parameters and departures: as the fit has it, and for the search.

    A model error that is only assumed is left out of the first.
    """
    P, W = len(size), error.columns.shape[-1]
    scale = np.concatenate([size, np.ones(W)])
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
    """Return changes of ln gain and phase, whose squares add up to their mean over places."""
    order = np.argsort(np.median(candidates.force, axis=0), kind="stable")
    some = order[np.unique(np.linspace(0, candidates.count - 1, _PLACES).astype(int))]
    part = candidates.only(some)
    changes = part.rows * np.sqrt(part.variance)[..., None, None]
    S, _, _, Q = changes.shape
    changes = changes.reshape(S, -1, Q) / np.sqrt(2.0 * len(some))
    return np.asarray(np.linalg.qr(changes, mode="r")).swapaxes(-1, -2)


def covariance_of(M: FloatArray) -> FloatArray:
    """Return the inverse of the information; unknown directions get a very large variance.

    In units in which the diagonal is 1, so that much information on one parameter does not hide
    that there is none on another.
    """
    size = np.sqrt(np.diagonal(M, axis1=-2, axis2=-1) + NOTHING)
    units = size[..., :, None] * size[..., None, :]
    eye = np.eye(M.shape[-1])
    return np.asarray(np.linalg.inv((M + NOTHING * eye) / units + _ROUNDING * eye) / units)


def typical(u: FloatArray) -> float:
    """Return the geometric mean over draws, inf where nothing is known."""
    return _shown(float(np.exp(np.mean(np.log(np.maximum(u, 1e-300))))))


def _shown(u: float) -> float:
    return u if u < 100.0 else float("inf")
