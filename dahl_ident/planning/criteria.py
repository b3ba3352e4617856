"""Information in a set of levels: information matrices, criteria and their derivatives.

A level measured for n cycles adds n J' J to the information, J being the derivatives of its
whitened residuals. Errors of gain and phase that all rows of a run share, of standard deviation s,
are further parameters of each run with the information 1/s^2; after their elimination a run gives

    S = M - B (C + I/s^2)^{-1} B'

on the parameters, and R equal runs give R S. S is a concave function of the cycles (a Schur
complement), and every criterion here is the mean over draws of the logarithm of a concave,
homogeneous function of the information, so that the best design is a convex problem:

- D: ln det(M)/P; with departures of the model among the parameters, that of the others
  alone, -ln det((M^{-1})_PP) (D_s-optimality);
- targets: -ln(sum_t (c_t' M^{-1} c_t / u_t^2)^q)/q; with one target c-optimality, with several
  close to the largest ratio of variance to target.

Source: Pukelsheim, *Optimal Design of Experiments*, 2006, chapters 3 and 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray

NOTHING = 1e-8  # information added so that a parameter without any has an uncertainty
_POWER = 4.0  # q: 1 would add the targets' variances, infinity would use only the largest


@dataclass(frozen=True)
class LevelInformation:
    """Information of one cycle at every candidate, for every draw of the parameters."""

    # (..., K, S Q Q): Q = P, or P + 2 with the gain and the phase of the run behind the parameters
    packed: FloatArray
    draws: int  # S and P
    parameters: int
    scatter: float  # s, standard deviation of a run's ln gain and phase; 0 where runs do not differ

    @classmethod
    def of(cls, rows: FloatArray, offsets: FloatArray, scatter: float) -> LevelInformation:
        """Return that of derivatives of whitened residuals, (S, K, m, P); of runs' (.., 2)."""
        S, K, _, P = rows.shape
        if scatter > 0.0:
            rows = np.concatenate([rows, offsets], axis=-1)
        products = rows.swapaxes(-1, -2) @ rows
        packed = products.swapaxes(0, 1).reshape(K, -1)
        return cls(np.ascontiguousarray(packed), S, P, scatter)

    @property
    def size(self) -> int:
        """Q."""
        return self.parameters + (2 if self.scatter > 0.0 else 0)

    def only(self, candidates: NDArray[np.intp]) -> LevelInformation:
        """Return the information of some candidates."""
        return replace(self, packed=self.packed[candidates])

    def of_run(self, total: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return S of packed sums (..., S Q Q), and what takes dS back to them, (..., P, Q)."""
        Q, P = self.size, self.parameters
        M = total.reshape(*total.shape[:-1], self.draws, Q, Q)
        if Q == P:
            return M, np.broadcast_to(np.eye(P), M.shape)
        C = M[..., P:, P:] + np.eye(2) / self.scatter**2
        lever = -M[..., :P, P:] @ np.linalg.inv(C)
        ahead = np.broadcast_to(np.eye(P), (*M.shape[:-2], P, P))
        return (
            M[..., :P, :P] + lever @ M[..., P:, :P],
            np.concatenate([ahead, lever], axis=-1),
        )


@dataclass(frozen=True)
class Term:
    """One criterion on one model: D-optimal, or targets."""

    levels: LevelInformation  # of the candidates
    known: FloatArray  # (S, P, P): information before the plan
    # (S, P, C): directions over their wanted standard uncertainties; None: D-optimality
    targets: FloatArray | None = None
    # (T,): first column of each target, whose variances are added; None: a column each
    starts: NDArray[np.intp] | None = None
    weight: float = 1.0  # In the sum of the terms
    # number of parameters, the last ones, whose uncertainty does not matter by itself
    departures: int = 0

    def value_and_slope(self, M: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the mean over draws and its derivative by M times S; (...), (..., S, P, P)."""
        inverse = np.linalg.inv(M)
        if self.targets is None:
            P = M.shape[-1] - self.departures
            if not self.departures:
                return np.linalg.slogdet(M)[1].mean(axis=-1) / P, inverse / P
            own, ahead = inverse[..., :P, :P], inverse[..., :P, :]
            slope = ahead.swapaxes(-1, -2) @ np.linalg.inv(own) @ ahead
            return -np.linalg.slogdet(own)[1].mean(axis=-1) / P, slope / P
        moved = inverse @ self.targets
        h = np.einsum("...spc,spc->...sc", moved, self.targets)
        starts = np.arange(h.shape[-1]) if self.starts is None else self.starts
        sums = np.add.reduceat(h, starts, axis=-1)
        top = sums.max(axis=-1, keepdims=True)
        powers = (sums / top) ** (_POWER - 1.0)
        total = (powers * sums / top).sum(axis=-1)
        value = -(np.log(top[..., 0]) + np.log(total) / _POWER).mean(axis=-1)
        share = np.repeat(
            powers / (total[..., None] * top), np.diff([*starts, h.shape[-1]]), axis=-1
        )
        return value, (moved * share[..., None, :]) @ moved.swapaxes(-1, -2)


@dataclass(frozen=True)
class DesignPoint:
    """A criterion's value at each design, and its sensitivity for each term's packed rows."""

    value: FloatArray
    sensitivities: tuple[FloatArray, ...]


@dataclass(frozen=True)
class Objective:
    """The weighted sum of terms, as a function of the cycles of every candidate in one run."""

    terms: tuple[Term, ...]  # of the same candidates
    runs: int = 1  # R, runs alike

    @property
    def candidates(self) -> int:
        """K."""
        return len(self.terms[0].levels.packed)

    def only(self, candidates: Sequence[int] | NDArray[np.intp]) -> Objective:
        """Return the objective of some candidates, or of each of several sets, (designs, m)."""
        chosen = np.asarray(candidates, dtype=np.intp)
        terms = tuple(replace(t, levels=t.levels.only(chosen)) for t in self.terms)
        return replace(self, terms=terms)

    def information(self, cycles: FloatArray) -> list[FloatArray]:
        """Return the information of every term, shape (..., S, P, P) each."""
        return [
            t.known + self.runs * t.levels.of_run(_sum(cycles, t.levels.packed))[0]
            for t in self.terms
        ]

    def values(self, totals: Sequence[FloatArray]) -> FloatArray:
        """Return the criterion at packed sums of every term, (designs, S Q Q) each."""
        result = np.zeros(len(totals[0]))
        for term, total in zip(self.terms, totals, strict=True):
            M = term.known + self.runs * term.levels.of_run(total)[0]
            result = result + term.weight * term.value_and_slope(M)[0]
        return result

    def at(self, cycles: FloatArray) -> DesignPoint:
        """Return values and sensitivities at the cycles of every candidate, (..., K)."""
        value, found = np.zeros(cycles.shape[:-1]), []
        for term in self.terms:
            S, back = term.levels.of_run(_sum(cycles, term.levels.packed))
            own, slope = term.value_and_slope(term.known + self.runs * S)
            value = value + term.weight * own
            factor = term.weight * self.runs / term.levels.draws
            by_total = factor * (back.swapaxes(-1, -2) @ slope @ back)
            found.append(by_total.reshape(*value.shape, -1))
        return DesignPoint(value, tuple(found))

    def gradient(self, point: DesignPoint) -> FloatArray:
        """Return the derivative by the cycles of each of this objective's candidates, (..., K)."""
        return np.asarray(
            sum(
                (t.levels.packed @ s[..., None])[..., 0]
                for t, s in zip(self.terms, point.sensitivities, strict=True)
            )
        )


def _sum(cycles: FloatArray, packed: FloatArray) -> FloatArray:
    return np.asarray((cycles[..., None, :] @ packed)[..., 0, :])
