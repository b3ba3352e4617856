r"""How well a model predicts tests that it was not fitted to: the log density of each, left out.

Deviations count relative to the fundamental of the same test. Their errors are the stated
covariance and beyond it a variance each for fundamentals and for harmonics, estimated from what
this model leaves; so harmonics whose covariance is tiny cannot rule, and a model that misses pays
for its misses. Each run has an unknown gain and phase, with variances estimated
as well. To first order in the parameters, with X their columns and those of the runs, and D the
errors' covariance,

    P = D^-1 - D^-1 X (X' D^-1 X + S^-1)^-1 X' D^-1,

and the test b, predicted from all others, misses by P_bb^-1 (P y)_b, of covariance P_bb^-1
(Dubrule, Mathematical Geology 15 (1983) 687). A test is all rows of one level in one run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.fitting import Optimum

_EXACT = 1e-5  # relative errors that count as none
_ROUNDS = 30  # fixed-point steps of the variances, without a test of convergence
_HEAVY = 4.0  # degrees of freedom of the density with a robust loss


@dataclass(frozen=True)
class PredictiveDensity:
    """Log densities of tests left out.

    Attributes
    ----------
    tests : ndarray, shape (T,)
        Log density of each test.
    run : ndarray of int, shape (T,)
        The run of each.
    misfit, harmonic_misfit : float
        Root mean square that the model leaves of the fundamentals, and of all harmonics over the
        fundamental; NaN where there are none.
    """

    tests: FloatArray
    run: NDArray[np.intp]
    misfit: float
    harmonic_misfit: float

    @property
    def total(self) -> float:
        """The sum over the tests."""
        return float(self.tests.sum())

    def gain_over(self, other: PredictiveDensity) -> tuple[float, float]:
        """Return how much higher the density is than another's, and its standard error.

        The larger of what tests and what runs scatter.
        """
        each = self.tests - other.tests
        sums = np.bincount(self.run, each)
        errors = [
            np.sqrt(part.size) * float(part.std(ddof=1)) if part.size > 1 else 0.0
            for part in (each, sums)
        ]
        return float(each.sum()), max(errors)


def predictive_density(optimum: Optimum) -> PredictiveDensity:
    """Return the log density of every test, predicted by the model fitted to the others.

    Examples
    --------
    >>> import dahl_ident as di
    >>> data = di.load_dataset("noisy")
    >>> one, other = (
    ...     predictive_density(di.fit(data, model, throw=False).optimum)
    ...     for model in (di.Dahl(), di.Spring())
    ... )
    >>> one.total > other.total
    True
    """
    problem, data = optimum.problem, optimum.problem.data
    owner, test, run = _tests(optimum)
    size = np.abs(data.response)[owner]
    size = np.where(size > 0.0, size, size.max())  # a row of nothing counts as the largest
    predicted = problem.predict(optimum.theta)
    missed = (data.response - predicted) / size
    fundamental = owner == np.arange(data.n)
    y = _parts(missed)
    J = problem.prediction_jacobian(optimum.theta) / size[:, None]
    known = np.isfinite(J).all(axis=0) & (np.abs(J) > 0.0).any(axis=0)
    columns = [_parts(column) for column in J[:, known].T]
    P = len(columns)
    runs = int(run.max()) + 1
    if runs > 1:
        relative = predicted / size
        for turn in (relative, 1j * data.harmonic * relative):
            columns += [_parts(turn * (run == r)) for r in range(runs)]
    X = np.array(columns).T if columns else np.zeros((y.size, 0))
    X = X / np.maximum(np.linalg.norm(X, axis=0), 1e-300) if X.size else X
    stated = _stated(optimum, size)
    group = np.repeat(~fundamental, 2).astype(np.intp)
    real = np.repeat(data.harmonic == 0, 2) & (np.arange(y.size) % 2 == 1)
    keep = np.flatnonzero(~real)
    loo = _LeftOut(y[keep], X[keep], P, runs if runs > 1 else 0, stated[keep], group[keep])
    robust = optimum.loss != "linear"
    tests = loo.densities(np.repeat(test, 2)[keep], robust=robust)
    first = np.unique(test, return_index=True)[1]
    square = np.abs(missed) ** 2
    others = ~fundamental
    return PredictiveDensity(
        tests,
        run[first],
        float(np.sqrt(square[fundamental].mean())) if fundamental.any() else float("nan"),
        float(np.sqrt(square[others].sum() / max(fundamental.sum(), 1)))
        if others.any()
        else float("nan"),
    )


def _parts(values: ComplexArray) -> FloatArray:
    return np.ascontiguousarray(values, dtype=np.complex128).view(np.float64)


def _tests(optimum: Optimum) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return each row's fundamental, its test and its run."""
    data = optimum.problem.data
    labels = np.zeros(data.n) if data.run is None else np.unique(data.run, return_inverse=True)[1]
    places = [labels, data.frequency_hz]
    places += [np.asarray(v) for v in (data.amplitude, data.drive) if v is not None]
    _, which = np.unique(np.column_stack(places), axis=0, return_inverse=True)
    which = which.ravel()
    owner = np.arange(data.n)
    first = np.full(which.max() + 1, -1)
    first[which[data.harmonic == 1]] = np.flatnonzero(data.harmonic == 1)
    has = first[which] >= 0
    owner = np.where((data.harmonic != 1) & has, first[which], owner)
    return owner, which, np.asarray(labels, dtype=np.intp)


def _stated(optimum: Optimum, size: FloatArray) -> FloatArray:
    """Return the stated variances of both parts, relative, or zero."""
    problem = optimum.problem
    covariance = problem.data.covariance
    if not problem.scale_known or covariance is None:
        return np.zeros(2 * problem.data.n)
    both = np.diagonal(covariance, axis1=1, axis2=2) / size[:, None] ** 2
    return np.asarray(both.ravel())


class _LeftOut:
    """The linear mixed model of deviations."""

    def __init__(
        self,
        y: FloatArray,
        X: FloatArray,
        P: int,
        runs: int,
        stated: FloatArray,
        group: NDArray[np.intp],
    ) -> None:
        self.y, self.X, self.P, self.runs, self.group = y, X, P, runs, group
        self.stated = stated
        least = _EXACT**2
        start = [float(np.mean(y[group == g] ** 2)) if (group == g).any() else 0.0 for g in (0, 1)]
        beyond = np.maximum(start, least)
        scatter = np.full(2, max(float(np.mean(y**2)), least) * y.size / max(runs, 1))
        for _ in range(_ROUNDS):
            self._solve(beyond, scatter)
            w, left = self.weight, self.left
            for g in (0, 1):
                own = group == g
                if own.any():
                    wanted = float((w * w * left**2)[own].sum())
                    expected = float((w * (1.0 - self.leverage))[own].sum())
                    beyond[g] = max(beyond[g] * wanted / max(expected, 1e-300), least)
            for i in range(2 if runs else 0):
                part = slice(P + i * runs, P + (i + 1) * runs)
                known = max(float(np.trace(self.inverse[part, part])) / scatter[i], 0.0)
                scatter[i] = float(self.b[part] @ self.b[part]) / max(runs - known, 1e-3)
                scatter[i] = max(scatter[i], least * 1e-4)

    def _solve(self, beyond: FloatArray, scatter: FloatArray) -> None:
        self.weight = 1.0 / (self.stated + beyond[self.group])
        weighted = self.X * self.weight[:, None]
        M = self.X.T @ weighted
        if self.runs:
            M[np.arange(self.P, len(M)), np.arange(self.P, len(M))] += np.repeat(
                1.0 / scatter, self.runs
            )
        self.inverse = np.linalg.pinv(M, rcond=1e-13, hermitian=True)
        self.b = self.inverse @ (weighted.T @ self.y)
        self.left = self.y - self.X @ self.b
        self.weighted = weighted
        self.leverage = np.einsum("mi,ij,mj->m", weighted, self.inverse, self.X)

    def densities(self, test: NDArray[np.intp], *, robust: bool) -> FloatArray:
        """Return the log density of each test."""
        found = np.empty(int(test.max()) + 1)
        order = np.argsort(test, kind="stable")
        count = np.bincount(test)
        start = np.cumsum(count) - count
        for size in np.unique(count).tolist():  # tests of one size at once
            tests = np.flatnonzero(count == size)
            rows = order[start[tests][:, None] + np.arange(size)]
            part, weight = self.weighted[rows], self.weight[rows]
            block = weight[:, :, None] * np.eye(size) - part @ self.inverse @ part.swapaxes(1, 2)
            values, vectors = np.linalg.eigh(block)
            values = np.maximum(values, 1e-9 * weight.max(axis=1, keepdims=True))
            z = np.einsum("tij,ti->tj", vectors, weight * self.left[rows])
            loss = np.sum(z * z / values, axis=1)
            if robust:
                loss = (_HEAVY + size) * np.log1p(loss / _HEAVY)
            found[tests] = 0.5 * (np.log(values).sum(axis=1) - size * np.log(2.0 * np.pi) - loss)
        return found
