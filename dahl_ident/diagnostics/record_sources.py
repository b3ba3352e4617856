"""Errors of a fit to records: noise, model error, scatter between runs, fixed exponents and delay.

A misfit changes along a record, and a device changes between runs. Estimates from blocks of the
records, or from single records, then scatter more than noise explains; the excess is a separate
source of error.

Least squares is unbiased with residuals that are correlated from sample to sample, but (J'J)^-1
times their variance is not its covariance, often ten times too small. Their spectrum is estimated
by an autoregressive model, its order by Akaike's criterion, and their covariance matrix R used in

    covariance = (J'J)^-1 J'R J (J'J)^-1
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy import fft, special
from scipy.linalg import solve_toeplitz, toeplitz

from dahl_ident.arrays import TINY, BoolArray, FloatArray, IntArray, unit_diagonal
from dahl_ident.diagnostics.contributions import excess, positive_part
from dahl_ident.errors import FitError
from dahl_ident.fitting.record_search import STEPS, RecordSearch, noise_power
from dahl_ident.problem.record_noise import HIGHEST_ORDER, SAMPLES_PER_ORDER
from dahl_ident.problem.record_problem import RecordProblem

BLOCKS = 20
"""Number of blocks into which all records together are divided to estimate the model error."""
_BLOCKS_CONFIDENCE = 0.9995  # at which scatter between blocks exceeds the noise
_RECORDS_CONFIDENCE = 0.95  # the same between records; lower, so that scatter is seldom missed
_LINEAR = 0.05  # step of an exponent's logarithm up to which the model is linear
_CONTRADICTED = 3.3  # standard deviations: once in 1000 by chance
_SINGULAR = 1e-13  # eigenvalue of J'J, with unit diagonal, that is rounding
_INVOLVED = 1e-6  # squared component of a parameter in undetermined directions that matters
_SLIGHT_CHANGE = 1e-3  # change of autocovariances over the variance that does not matter
_TRANSFORM = 2**15  # samples: enough unless the noise is very slow
_VANISHED = 1e-9  # autocovariance over the variance that is rounding
_CORRECTIONS = 4  # most iterations of the correction, which converges fast

Waves: TypeAlias = Sequence[FloatArray]
"""A filtered change of the output of each record."""
Sources: TypeAlias = Callable[["LinearFit"], Iterable[tuple[str, FloatArray]]]
"""Returns covariances of a fit's values, (P, P), by source."""


class ContradictedExponent(NamedTuple):
    """An assumed or stated exponent, and the different one that the data indicate."""

    name: str
    fixed: float
    indicated: float
    stderr: float
    range: tuple[float, float] | None  # None where the user stated the value


@dataclass(frozen=True)
class LinearFit:
    """A fit of records to first order; residuals and derivatives are filtered as in the fit."""

    problem: RecordProblem  # its names order every array here
    values: FloatArray  # (Q,): the estimate
    jacobians: Sequence[FloatArray]  # (n, Q): derivatives of each record's prediction
    residuals: Sequence[FloatArray]  # (n,): measured minus predicted
    noise: Sequence[FloatArray]  # autocovariances of the residuals' noise
    of_model: BoolArray  # (Q,): parameters that are not states or offsets of records
    # (Q,): standard uncertainties without the records: those of assumed values, or 0 where they are
    # taken as exact; infinite for all others
    unmeasured: FloatArray
    information: FloatArray  # (Q,): what is known without the records, in units of J'J

    @classmethod
    def of(
        cls,
        problem: RecordProblem,
        values: FloatArray,
        residuals: Sequence[FloatArray],
        free: Iterable[str] = (),
    ) -> LinearFit:
        """Return the fit with these residuals, filtered here, and some exponents free.

        Raises
        ------
        FitError
            If the motion next to the estimate cannot be computed.
        """
        wider = problem.freed(free)
        values = problem.values_in(wider, values)
        numbers = range(len(wider.records))
        J = [wider.filtered(wider.predict(values, number).by) for number in numbers]
        e = [wider.filtered(wave) for wave in residuals]
        of_model = np.arange(values.size) < len(wider.free)
        unmeasured, information = np.full(values.size, np.inf), np.zeros(values.size)
        return cls(wider, values, J, e, noise_in(J, e), of_model, unmeasured, information)

    def assuming(self, stds: Mapping[int, float], variances: FloatArray) -> LinearFit:
        """Return the fit with some values that have standard uncertainties without the records.

        `variances`, (Q,), are those of the estimate from the records alone, with which what is
        assumed is weighted.
        """
        unmeasured, information = self.unmeasured.copy(), self.information.copy()
        white = sum(float(e @ e) for e in self.residuals) / sum(e.size for e in self.residuals)
        for i, std in stds.items():
            unit = self.inverse[i, i]
            noise = variances[i] / unit if np.isfinite(variances[i]) else white
            unmeasured[i], information[i] = std, noise / std**2 if std else np.inf
        return replace(self, unmeasured=unmeasured, information=information)

    @cached_property
    def by_noise(self) -> tuple[FloatArray, float]:
        """Covariance of the estimate from noise, and the effective number of samples."""
        return sandwich(self.jacobians, self.residuals, self.noise, self.information)

    @cached_property
    def between_blocks(self) -> FloatArray | None:
        """Covariance from scatter between blocks in excess of noise; None if noise explains it."""
        if sum(e.size for e in self.residuals) < BLOCKS * BLOCKS:
            return None
        blocks = [[block] for block in blocks_of(self.residuals)]
        return _between(self, blocks, self.by_noise[0], _BLOCKS_CONFIDENCE)

    @cached_property
    def inverse(self) -> FloatArray:
        """Inverse of the normal matrix, (Q, Q)."""
        return inverse_normal(self.jacobians, self.information)[0]

    @cached_property
    def outputs(self) -> Sequence[FloatArray]:
        """Predicted outputs."""
        return self.problem.outputs(self.values)

    def projected(self, waves: Waves) -> FloatArray:
        """Return the change of the estimate due to filtered changes of the measured outputs."""
        parts = zip(self.jacobians, waves, strict=True)
        return np.asarray(self.inverse @ sum(J.T @ y for J, y in parts))

    def changed(self, outputs: Sequence[FloatArray]) -> FloatArray:
        """Return the change of the estimate due to changes of the measured outputs."""
        return self.projected([self.problem.filtered(y) for y in outputs])

    def difference_to(self, other: RecordProblem) -> Waves:
        """Return the filtered outputs of another problem minus those of this one."""
        ends = zip(self.outputs, other.outputs(self.values), strict=True)
        return [self.problem.filtered(b - a) for a, b in ends]

    @cached_property
    def delay_slopes(self) -> Waves:
        """Derivatives of the filtered outputs with respect to the delay, per second."""
        return [self.problem.filtered(slope) for slope in self.problem.delay_slopes(self.values)]

    def covariance(self, sources: Sources | None = None) -> FloatArray:
        """Return the covariance from noise, scatter between blocks and other `sources`, (Q, Q).

        What the estimate owes to assumed values is as uncertain as they are.
        """
        at = np.flatnonzero((self.unmeasured > 0.0) & (self.unmeasured < np.inf))
        moved = self.inverse[:, at] * self.information[at] * self.unmeasured[at]
        parts = [self.by_noise[0], self.between_blocks, moved @ moved.T]
        parts += [part for _, part in sources(self)] if sources else []
        return np.asarray(sum(part for part in parts if part is not None))

    def shifted(self, place: int, limits: tuple[float, float] = (-np.inf, np.inf)) -> FloatArray:
        """Return the covariance, (Q, Q), due to a value that is not at the optimum.

        That is the square of the change of this value to the optimum, within `limits`, in excess of
        its variance.
        """
        variance = self.covariance()[place, place]
        change = np.clip(self.projected(self.residuals)[place], *limits)
        line = self.inverse[:, place] / (self.inverse[place, place] or 1.0)
        return np.asarray(max(change**2 - variance, 0.0) * np.outer(line, line))


def by_exponents(fit: LinearFit, exact: FloatArray, sources: Sources) -> FloatArray:
    """Return the covariance due to assumed exponents, (Q, Q), in excess of that of `exact` ones."""
    covariance = excess(fit.covariance(sources), exact)
    for i in np.flatnonzero(np.isfinite(fit.unmeasured)).tolist():
        low, high = fit.problem.parameters[i].prior or (0.0, np.inf)
        covariance += fit.shifted(i, (low - fit.values[i], high - fit.values[i]))
    return covariance


def widened(std: float, variance: float) -> float:
    """Return the standard uncertainty of an assumption, with less weight than the records.

    It is larger where the records alone determine the value better, with this `variance`.
    """
    return max(std, std**2 / max(variance, TINY) ** 0.5) if np.isfinite(variance) else std


def delay_std(fit: LinearFit) -> float:
    """Return the standard uncertainty of the remaining delay without the records.

    It has the unit of the problem's `delay_std`. The estimated delay has been removed, unless it is
    too long for that. If the user stated none, it is at least what the records show in excess of
    chance.
    """
    free = _with_delay(fit)
    variance = float(free.covariance()[-1, -1])
    if "delay" in fit.problem.calibration or not np.isfinite(variance):
        return 1.0
    square = float(free.projected(free.residuals)[-1]) ** 2 - _CONTRADICTED**2 * variance
    return max(widened(1.0, variance), float(max(square, 0.0) ** 0.5))


def by_delay(fit: LinearFit, std: float) -> FloatArray:
    """Return the covariance of the estimate due to the remaining delay, (Q, Q)."""
    free = _with_delay(fit)
    delayed = free.assuming({-1: std}, free.covariance().diagonal())
    total = delayed.covariance()[:-1, :-1]
    return excess(total, fit.covariance()) + delayed.shifted(-1)[:-1, :-1]


def _with_delay(fit: LinearFit) -> LinearFit:
    """Return the fit with the delay as one more value, the last."""
    unit = fit.problem.delay_std
    slopes = zip(fit.jacobians, fit.delay_slopes, strict=True)
    return replace(
        fit,
        jacobians=[np.column_stack([J, unit * slope]) for J, slope in slopes],
        of_model=np.append(fit.of_model, True),
        unmeasured=np.append(fit.unmeasured, np.inf),
        information=np.append(fit.information, 0.0),
    )


def contradicted_exponents(
    problem: RecordProblem, values: FloatArray, residuals: Sequence[FloatArray], sources: Sources
) -> Iterator[ContradictedExponent]:
    """Yield the fixed exponents, stated or assumed, that the records contradict.

    Its uncertainty is due to noise, scatter between blocks, and `sources`. A stated exponent is
    estimated by a search in which it is free. An assumed one, which is close to its optimum, is
    estimated by a Gauss-Newton step, and by a search if that step is long.
    """
    for p in problem.exponents:
        with suppress(FitError):  # the motion cannot be computed at values that are tried
            freed = LinearFit.of(problem, values, residuals, [p.name])
            i, value = freed.problem.names.index(p.name), float(p.value or 1.0)
            ratio = float(freed.projected(freed.residuals)[i]) / value
            u = float(freed.covariance(sources)[i, i]) ** 0.5 / value
            if not p.assumed or abs(ratio) > max(_LINEAR, _CONTRADICTED * u):
                ratio, u = _searched_ratio(freed, p.name, sources) or (ratio, u)
            if abs(ratio) > _CONTRADICTED * u:
                indicated = value * float(np.exp(ratio))
                limits = p.prior if p.assumed else None
                yield ContradictedExponent(p.name, value, indicated, indicated * u, limits)


def _searched_ratio(fit: LinearFit, name: str, sources: Sources) -> tuple[float, float] | None:
    """Return ln of an exponent's estimate over its value, and its standard deviation, by a search.

    `fit` is the fit in which it is free. None if the fixed exponent describes the records better.
    The noise of the displacement is estimated again, because its estimate with the exponent fixed
    may contain misfit. Far from the value the model is not linear: the distance has at most as many
    standard deviations as the fall of the cost shows.
    """
    search, free = RecordSearch("lm", "linear"), fit.problem
    i, start = free.names.index(name), free.to_search(fit.values)
    cost, free = float(free.quadratic(start).cost), free.smoothed(on=False).without_noise(0.0)
    end = search.descend(free, start, STEPS)
    if free.output == "force":
        free, end = search.without_noise(free, end)
    if not end.converged[0] or not end.cost[0] < cost:
        return None
    values = free.to_values(end.theta[0])
    e = free.split_residuals(values)
    u = float(LinearFit.of(free, values, e).covariance(sources)[i, i]) ** 0.5 / float(values[i])
    ratio, fall = float(np.log(values[i] / fit.values[i])), cost - float(end.cost[0])
    deviance = 2.0 * fall / noise_power(float(end.cost[0]), free.n_residuals, e)
    return ratio, max(u, abs(ratio) / deviance**0.5)


def blocks_of(waves: Sequence[FloatArray], blocks: int = BLOCKS) -> list[tuple[int, IntArray]]:
    """Return the blocks, each as the number of its record and the samples in that record."""
    samples = sum(len(wave) for wave in waves)
    return [
        (number, rows)
        for number, wave in enumerate(waves)
        for rows in np.array_split(
            np.arange(len(wave)), max(1, round(blocks * len(wave) / samples))
        )
    ]


def between_records(fit: LinearFit) -> FloatArray | None:
    """Return the covariance between records that noise and blocks do not explain, or None.

    A record counts once, however many samples or parts it has: the problem's `runs` state to which
    record each part belongs.
    """
    runs = np.asarray(fit.problem.runs)
    whole = [np.arange(e.size) for e in fit.residuals]
    members = [np.flatnonzero(runs == run).tolist() for run in np.unique(runs)]
    records = [[(i, whole[i]) for i in each] for each in members]
    known = fit.covariance()
    return _between(fit, records, known, _RECORDS_CONFIDENCE) if len(records) > 1 else None


def _between(
    fit: LinearFit,
    groups: Sequence[Sequence[tuple[int, IntArray]]],
    noise: FloatArray,
    level: float,
) -> FloatArray | None:
    """Return the covariance between groups of samples in excess of `noise`.

    None if chance explains it at the confidence `level`. A group is a list of records' numbers with
    samples of each. The covariance between groups is that of Liang and Zeger, Biometrika 73 (1986)
    13-22.
    """
    seen = np.flatnonzero(np.isfinite(noise.diagonal()) & (noise.diagonal() > 0.0))
    inside = np.ix_(seen, seen)
    if not seen.size:
        return None
    size = np.sqrt(noise.diagonal()[seen])
    units, scores, parts = np.outer(size, size), [], []
    for group in groups:
        J = np.concatenate([fit.jacobians[i][rows] for i, rows in group])[:, seen]
        scores.append(size * (J.T @ np.concatenate([fit.residuals[i][rows] for i, rows in group])))
        parts.append(units * (J.T @ J))
    known = np.diag(fit.information[seen] * size**2)
    inverse = np.linalg.inv(sum(parts) + known)
    change = inverse @ sum(scores)  # to the optimum, off which an assumed range may hold it
    steps = (np.array(scores) - np.array(parts) @ change) @ inverse
    between = len(steps) / (len(steps) - 1.0) * steps.T @ steps
    by_chance = noise[inside] / units
    # information of each block on each parameter
    weights = np.array([(inverse @ part @ inverse).diagonal() for part in parts])
    dof = np.maximum(weights.sum(axis=0) ** 2 / (weights**2).sum(axis=0) - 1.0, 1.0)
    ratio = between.diagonal() / by_chance.diagonal()
    if not (ratio > special.chdtri(dof, 1.0 - level) / dof)[fit.of_model[seen]].any():
        return None
    covariance = np.zeros(noise.shape)
    covariance[inside] = positive_part(between - by_chance) * units
    return covariance


def sandwich(
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    noise: Sequence[FloatArray] | None = None,
    information: FloatArray | float = 0.0,
) -> tuple[FloatArray, float]:
    """Return the covariance of a least-squares estimate, and the effective number of samples.

    Parameters
    ----------
    jacobians : sequence of ndarray, shape (n_i, P)
        Derivatives of each record's prediction with respect to the P parameters.
    residuals : sequence of ndarray, shape (n_i,)
        Measured minus predicted.
    noise : sequence of ndarray, optional
        Autocovariances of each record's noise, estimated if left out.
    information : float or ndarray, shape (P,), default 0.0
        What is known without the records, in units of J'J; infinite for exact parameters.

    Returns
    -------
    covariance : ndarray, shape (P, P)
        Zero variances of exact parameters; infinite ones of parameters without an effect, or
        without one of their own.
    effective : float
        The number of samples, divided by the mean ratio of a parameter's variance to its variance
        with uncorrelated residuals; at most the number of samples.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> J = np.column_stack([np.ones(1000), np.arange(1000.0)])
    >>> covariance, effective = sandwich([J], [rng.standard_normal(1000)])
    >>> bool(500 < effective <= 1000)
    True
    """
    P = jacobians[0].shape[1]
    samples = sum(e.size for e in residuals)
    total = sum(float(e @ e) for e in residuals)
    variance = total / max(samples - P, 1)
    inverse, lost = inverse_normal(jacobians, information)
    middle = np.zeros((P, P))
    if noise is None:
        noise = noise_in(jacobians, residuals)
    for J, known in zip(jacobians, noise, strict=True):
        # the states and offsets of other records have zero columns
        columns = np.flatnonzero((J != 0.0).any(axis=0))
        nonzero = J if columns.size == P else J[:, columns]
        middle[np.ix_(columns, columns)] += nonzero.T @ correlated(nonzero, known)
    covariance = inverse @ middle @ inverse
    white, seen = variance * inverse.diagonal(), inverse.diagonal() > 0.0
    ratio = float(np.mean(covariance.diagonal()[seen] / white[seen])) if variance > 0.0 else 1.0
    covariance[lost], covariance[:, lost] = 0.0, 0.0
    covariance[lost, lost] = np.inf
    return covariance, samples / max(ratio, 1.0)


def inverse_normal(
    jacobians: Sequence[FloatArray], information: FloatArray | float
) -> tuple[FloatArray, BoolArray]:
    """Return the inverse of the normal matrix of all records, and what is not determined, (P,).

    It is zero for exact parameters, whose `information` is infinite, and in the directions that the
    records do not determine.
    """
    normal = np.asarray(sum(J.T @ J for J in jacobians))
    exact = np.isinf(np.broadcast_to(information, len(normal)))
    normal = normal + np.diag(np.where(exact, 0.0, information))
    normal[exact], normal[:, exact] = 0.0, 0.0
    normal, size = unit_diagonal(normal)
    seen = np.flatnonzero(normal.diagonal() > 0.0)
    part = np.ix_(seen, seen)
    values, vectors = np.linalg.eigh(normal[part])
    shown = values > _SINGULAR
    inverse, lost = np.zeros(normal.shape), ~exact
    inverse[part] = (vectors[:, shown] / values[shown]) @ vectors[:, shown].T
    lost[seen] = (vectors[:, ~shown] ** 2).sum(axis=1) > _INVOLVED
    return inverse / np.outer(size, size), lost


def autoregression(
    residual: FloatArray, jacobian: FloatArray | None = None
) -> tuple[FloatArray, float]:
    """Return the coefficients of an autoregressive model and its innovations' variance.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Its mean is nearly zero.
    jacobian : ndarray, shape (n, P), optional
        Of the fit with these residuals. A fit explains a part of the noise, and most of it if it
        is slow; the autocovariances are corrected for that part.

    Returns
    -------
    coefficients : ndarray, shape (order,)
        a_k in e_t = sum a_k e_(t-k) + innovation; the order has the lowest Akaike criterion.
    variance : float
    """
    n = residual.size
    highest = int(min(HIGHEST_ORDER, n // SAMPLES_PER_ORDER))
    spectrum = np.abs(fft.rfft(residual, 2 * n)) ** 2
    observed = fft.irfft(spectrum)[: highest + 1] / n
    model = _chosen(observed, n)
    if jacobian is None or observed[0] <= 0.0:
        return model
    peak = float(np.max(spectrum_of(model, fft.next_fast_len(2 * n, real=True))))
    if 3.0 * jacobian.shape[1] * peak < _SLIGHT_CHANGE * n * observed[0]:  # bound of the part
        return model
    basis = np.linalg.qr(jacobian)[0]
    explained: FloatArray = np.zeros(highest + 1)
    for _ in range(_CORRECTIONS):
        before, explained = explained, _explained_by_fit(basis, model, highest)
        if np.max(np.abs(explained - before)) < _SLIGHT_CHANGE * observed[0]:
            break
        corrected = observed + explained
        if np.linalg.eigvalsh(toeplitz(corrected))[0] <= 0.0:
            break
        model = _chosen(corrected, n)
    return model


def _chosen(covariance: FloatArray, n: int) -> tuple[FloatArray, float]:
    """Return the autoregressive model of the order that Akaike's criterion prefers."""
    best, chosen = np.inf, (np.zeros(0), float(covariance[0]))
    if covariance[0] <= 0.0:
        return chosen
    for order in range(covariance.size):
        following = covariance[1 : order + 1]
        a = solve_toeplitz(covariance[:order], following) if order else np.zeros(0)
        variance = max(float(covariance[0] - a @ following), 1e-300)
        criterion = n * np.log(variance) + 2.0 * order
        if criterion < best:
            best, chosen = criterion, (a, variance)
    return chosen


def _explained_by_fit(
    basis: FloatArray, model: tuple[FloatArray, float], highest: int
) -> FloatArray:
    """Return how far a fit reduces the mean autocovariances of noise with this model.

    With Q an orthonormal basis of what was fitted, R the noise's covariance matrix and S_k the
    symmetric part of a shift by k, it is (2 tr(Q' R S_k Q) - tr(Q' S_k Q Q' R Q))/n. Fourier
    transforms give it for all shifts at once.
    """
    n = basis.shape[0]
    m = fft.next_fast_len(2 * n, real=True)
    waves = fft.rfft(basis, m, axis=0)
    filtered = fft.irfft(waves * spectrum_of(model, m)[:, None], m, axis=0)[:n]
    inner = basis.T @ filtered
    crossed = 2.0 * fft.rfft(filtered, m, axis=0) - waves @ inner
    total = fft.irfft(np.sum((crossed * waves.conj()).real, axis=1), m)
    return np.asarray(total[: highest + 1] / n)


def spectrum_of(model: tuple[FloatArray, float], m: int) -> FloatArray:
    """Return the spectrum of an autoregressive model at the frequencies of m samples."""
    a, variance = model
    return np.asarray(variance / np.abs(fft.rfft(np.concatenate([[1.0], -a]), m)) ** 2)


def autocovariances(residual: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return the significant autocovariances of the noise in residuals of a fit.

    From the autoregressive model; see :func:`autoregression`.
    """
    model = autoregression(residual, jacobian)
    whole = fft.next_fast_len(2 * residual.size, real=True)
    for m in (min(_TRANSFORM, whole), whole):
        covariance = np.asarray(fft.irfft(spectrum_of(model, m), m)[: m // 2])
        matters = np.abs(covariance) > _VANISHED * covariance[0]
        if not matters[m // 4 :].any():
            break
    return covariance[: int(np.flatnonzero(matters).max(initial=0)) + 1][: residual.size]


def noise_in(jacobians: Sequence[FloatArray], residuals: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the autocovariances of the noise in the residuals of each record."""
    pairs = zip(jacobians, residuals, strict=True)
    return [autocovariances(e, J[:, (J != 0.0).any(axis=0)]) for J, e in pairs]


def correlated(waves: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return R times waves, (n, k), with the matrix R of these autocovariances."""
    if covariance.size == 1:
        return waves * covariance
    from scipy.signal import oaconvolve  # slow to import, and only for records

    kernel = np.concatenate([covariance[:0:-1], covariance])[:, None]
    full = oaconvolve(waves, kernel, axes=0)
    return np.asarray(full[covariance.size - 1 : covariance.size - 1 + len(waves)])
