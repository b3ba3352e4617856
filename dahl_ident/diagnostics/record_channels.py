"""Effects of errors of the measured channels on fits of records: noise, calibration, delay, window.

A friction force depends on where the motion turned last. An error of the displacement at a turning
point therefore stays in the force over a path of some x_c, where the parameters show most;
elsewhere it does not last. White noise is seen in the displacement itself; a correlated error, such
as that of an encoder between its lines, is hidden by the motion, but not in the residuals after
each reversal.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from scipy import fft, special

from dahl_ident.arrays import FloatArray, IntArray
from dahl_ident.diagnostics.contributions import CHANNELS, excess
from dahl_ident.diagnostics.record_sources import LinearFit, Waves, by_delay, correlated, sandwich
from dahl_ident.elements.recursion import stretches
from dahl_ident.errors import FitError
from dahl_ident.problem.record_noise import LEADS, drive_noise
from dahl_ident.problem.record_problem import RecordProblem

_MATTERS = 0.2  # standard errors that a source may shift without being counted
_DRIVE_DRAWS = 4, 16  # of the drive's noise, fewest and most; the most give it to a third
_DRIVE_SAMPLES = 50_000  # of all these draws: half a second
_BENT = 6.0  # times the displacement's noise: exceeded by a second difference by chance once in 100
_OTHER_WINDOW = 0.5  # of its length: errors of a polynomial of degree 4 fall to a thirtieth
_DRAWS = 8  # of noise: give the mean square change to a half
_MOST_TURNS = 40  # turning points of a record that are evaluated
_DISPLACEMENT_STEP = 1e-5  # of the displacement's range, for slopes
_HIDDEN = 10.0  # times the noise in differences: a correlation of 0.98 leaves a tenth
_FORGOTTEN = 1e-3  # of a pattern's peak, below which the force has forgotten the turn
RELATIVE_STEP = 1e-5
"""Relative step of parameters for the slopes of quantities that follow from them."""
FORCE, DISPLACEMENT_GAIN, DELAY = CHANNELS.values()
DRIVE = "noise in the drive"
DISPLACEMENT = "noise in the displacement"
TURNS = "displacement at turning points"
SAMPLING = "turning points between samples"
WINDOW = "window of differentiation"


def motion_sources(
    fit: LinearFit,
    noisier: Sequence[Waves],
    other_motions: Mapping[str, Waves],
    delay: float | None,
) -> Iterator[tuple[str, FloatArray]]:
    """Yield the contributions of errors of the motion that widen the interval of a parameter.

    Noise in a measured displacement contributes the shift of the estimate by the changes of the
    outputs with `noisier` displacements. If the residuals show larger errors of the displacement at
    turning points, these contribute what exceeds that shift. The changes of the outputs with
    `other_motions` contribute the shifts that they cause. `delay` is the standard uncertainty of
    the delay without the records, or None if its effect cannot be computed.
    """
    problem = fit.problem
    if delay is not None:
        yield from _if_it_matters(fit, DELAY, by_delay(fit, delay))
    if problem.output != "force":
        return
    moved = np.zeros(fit.inverse.shape)
    by_noise = np.asarray(sum((_squared(fit.projected(waves)) for waves in noisier), moved))
    for name, moved in _if_it_matters(fit, DISPLACEMENT, by_noise):
        yield name, moved
    for name, changes in other_motions.items():
        yield from _if_it_matters(fit, name, _squared(fit.projected(changes)))
    if problem.with_memory and not problem.displacement_noise:
        yield from _if_it_matters(fit, TURNS, excess(_at_turns(fit), moved))


def by_other_motions(fit: LinearFit) -> dict[str, Waves]:
    """Return the changes of the outputs with motions that are as likely, by source.

    The sources are turning points between samples, and the window of differentiation.
    """
    problem, changes = fit.problem, dict[str, Waves]()
    if problem.output == "force" and not problem.model.rate_independent:
        other = problem.differentiated_in(_OTHER_WINDOW * problem.window)
        changes[WINDOW] = fit.difference_to(other)
    if problem.output == "force" and problem.with_memory and not problem.displacement_noise:
        other = problem.altered("latest", motions=_beyond_samples(problem))
        changes[SAMPLING] = fit.difference_to(other)
    return changes


def with_noisier_displacement(fit: LinearFit) -> list[Waves]:
    """Return the changes of the outputs with noisier displacements; their squares add up.

    The same amount of noise is added once more, in several draws. With a dead band, there is one
    change: half of that between the ends of the range in which the true displacement may lie.
    """
    problem = fit.problem
    if problem.output != "force":
        return []
    if problem.displacement_noise:
        ends = (problem.without_noise(problem.displacement_noise, lead) for lead in LEADS[::2])
        low, high = (fit.difference_to(end) for end in ends)
        return [[0.5 * (b - a) for a, b in zip(low, high, strict=True)]]

    def drawn(noise: float) -> list[Waves]:
        noisy = (problem.with_more_noise(noise, draw) for draw in range(_DRAWS))
        return [[wave / _DRAWS**0.5 for wave in fit.difference_to(other)] for other in noisy]

    noise = problem.estimated_noise
    draws = drawn(noise)
    unexplained = 0.0
    for waves in draws:
        change = fit.projected(waves)
        left = (y - J @ change for y, J in zip(waves, fit.jacobians, strict=True))
        unexplained += sum(float(e @ e) for e in left)
    squares = sum(float(e @ e) for e in fit.residuals)
    # rough motion looks like noise, but so much noise would leave larger residuals
    return draws if unexplained <= squares else drawn(noise * (squares / unexplained) ** 0.5)


def _if_it_matters(
    fit: LinearFit, name: str, contribution: FloatArray
) -> Iterator[tuple[str, FloatArray]]:
    larger = contribution.diagonal() > _MATTERS**2 * fit.by_noise[0].diagonal()
    if larger[fit.of_model & (fit.unmeasured > 0.0)].any():
        yield name, contribution


def _squared(change: FloatArray) -> FloatArray:
    """Return the covariance by a source that makes one change."""
    return np.outer(change, change)


def by_calibration(fit: LinearFit) -> Iterator[tuple[str, FloatArray]]:
    """Yield the contributions of stated calibrations of the gains.

    A gain changes the unit of force or of displacement, and every parameter with it if all are
    estimated. Known parameters keep their values; the others change as if these were wrong.
    """
    problem = fit.problem
    for place, name in enumerate(("force_gain", "displacement_gain")):
        if u := problem.calibration.get(name):
            yield CHANNELS[name], _squared(u * _by_gain(fit, place))
    stated = [r.drive_factor_uncertainty for r in problem.records]
    factor = max((float(u) for u in stated), default=0.0)
    if factor > 0.0 and (problem.output == "force" or problem.excitation == "force"):
        with_force = np.zeros(fit.values.size)
        for i, p in enumerate(problem.free):
            with_force[i] = factor * fit.values[i] * p.dimension[0]
        yield FORCE, _squared(with_force)


def _by_gain(fit: LinearFit, place: int) -> FloatArray:
    """Return the change of the estimate with ln of the unit of force (0) or displacement (1)."""
    problem = fit.problem
    change = np.array([p.dimension[place] for p in problem.parameters]) * fit.values
    for p in (p for p in problem.model.parameters if not p.free and p.dimension[place]):
        low, high = (
            problem.with_fixed({p.name: (p.value or 0.0) * (1.0 + step)}).outputs(fit.values)
            for step in (-RELATIVE_STEP, RELATIVE_STEP)
        )
        slope = [(b - a) / (2.0 * RELATIVE_STEP) for a, b in zip(low, high, strict=True)]
        change = change + p.dimension[place] * fit.changed(slope)
    return change


def by_drive(fit: LinearFit) -> FloatArray | None:
    """Return the contribution of noise in a measured drive; None if it cannot be estimated.

    It moves the plant most where it resonates or where friction slips, and parameters are
    determined at these places. The covariance by noise assumes that the residuals are equally large
    everywhere, so it includes only a part of such noise. In addition, prediction and derivatives
    have errors in common, which shift the estimate (errors in variables) by as much as the same
    noise once more would shift it. All three follow from draws of the noise.
    """
    problem, known = fit.problem, fit.by_noise[0]
    stds = drive_noise([record.force_samples for record in problem.records])
    if stds is None:
        return None
    draws = int(np.clip(_DRIVE_SAMPLES // problem.n_residuals, *_DRIVE_DRAWS))
    moved, seen, zero = np.zeros_like(known), np.zeros_like(known), np.zeros_like(known)
    shift = np.zeros(len(known))
    for draw in range(draws):
        noisy = problem.with_noisier_drive(stds, draw)
        try:
            predicted = [noisy.predict(fit.values, i) for i in range(len(problem.records))]
        except FitError:
            return zero
        pairs = zip(fit.outputs, predicted, strict=True)
        wander = [problem.filtered(p.output - y) for y, p in pairs]
        change, shifted = fit.projected(wander), np.zeros(len(known))
        for J, p, wave in zip(fit.jacobians, predicted, wander, strict=True):
            shifted -= fit.inverse @ ((problem.filtered(p.by) - J).T @ wave)
        if not draw and not (change**2 + shifted**2 > _MATTERS**2 * known.diagonal()).any():
            return zero
        shift += shifted / draws
        moved += np.outer(change, change) / draws
        seen += sandwich(fit.jacobians, wander, information=fit.information)[0] / draws
    certain = np.isfinite(known.diagonal()) & (known.diagonal() > 0.0)
    more = np.where(certain, np.maximum((moved - seen).diagonal(), 0.0), 0.0)
    size = np.sqrt(more / np.where(certain, known.diagonal(), 1.0))
    wandering = np.where(np.isfinite(known), known, 0.0) * np.outer(size, size)
    return np.asarray(wandering + _squared(shift))


def _beyond_samples(problem: RecordProblem) -> tuple[tuple[FloatArray, ...], ...]:
    """Return the motions with the turning points that lie between samples.

    The samples show a turn at one of them. How much farther the motion went follows from the
    parabola through three samples, unless noise may bend it as much.
    """
    least = _BENT * problem.estimated_noise
    motions = []
    for record, (x, v, a) in zip(problem.records, problem.motions, strict=True):
        slope = np.diff(x) / np.diff(record.time)
        before, after = slope[:-1], slope[1:]
        bend = (after - before) / (record.time[2:] - record.time[:-2])
        gap = np.minimum(np.diff(record.time)[:-1], np.diff(record.time)[1:])
        turns = (before * after < 0.0) & (np.abs(bend) * gap**2 > least)
        middle = before + bend * np.diff(record.time)[:-1]  # the slope at the middle sample
        farther = x.copy()
        farther[1:-1][turns] -= middle[turns] ** 2 / (4.0 * bend[turns])
        motions.append((farther, v, a))
    return tuple(motions)


def _at_turns(fit: LinearFit) -> FloatArray:
    """Return the covariance, (P, P), due to errors of the displacement at turning points.

    Their variance is the excess of the residuals, in the directions of such errors, over what their
    mean spectrum explains; as it cannot be negative, it is the mean of a normal distribution cut
    off at zero. They are at most ten times as large as the noise that differences show.
    """
    excess, strength, scatter = 0.0, 0.0, 0.0
    moved = np.zeros(fit.inverse.shape)
    waves = zip(fit.jacobians, fit.residuals, fit.noise, strict=True)
    for number, (J, e, covariance) in enumerate(waves):
        pattern, first, turns = _patterns(fit, number)
        if not first.size:
            continue
        sums = np.add.reduceat(pattern[:, None] * J[first[0] :], first - first[0])
        change = sums @ fit.inverse  # of the estimate with each turn, (k, P)
        smooth = correlated(J, covariance)
        crossed = np.add.reduceat(pattern[:, None] * smooth[first[0] :], first - first[0])
        mixed = crossed @ change.T
        explained = _between(pattern, first - first[0], covariance)
        explained += change @ (J.T @ smooth) @ change.T - mixed - mixed.T
        seen = np.add.reduceat(pattern * e[first[0] :], first - first[0]) - change @ (J.T @ e)
        product = np.diag(np.add.reduceat(pattern**2, first - first[0])) - sums @ change.T
        excess += float((seen**2).sum() - explained.trace())
        strength += float((product**2).sum())
        scatter += 2.0 * float((explained**2).sum())
        moved += change.T @ change * (turns / first.size)
    if strength == 0.0 or scatter == 0.0:
        return moved * 0.0
    error = scatter**0.5
    a = excess / error
    positive = a + np.exp(-0.5 * a**2 - special.log_ndtr(a)) / np.sqrt(2.0 * np.pi)
    variance = min(positive * error / strength, (_HIDDEN * fit.problem.estimated_noise) ** 2)
    return np.asarray(variance * moved)


def _patterns(fit: LinearFit, number: int) -> tuple[FloatArray, IntArray, int]:
    """Return derivatives of the force with respect to some turns, one after the other.

    The chosen turns are moved at once; they are so few that the force forgets each before the next.
    The derivatives begin at the first of them. Also returned are the samples of these turns, and
    the number of all turns.
    """
    problem = fit.problem
    x, v, a = problem.motions[number]
    samples = stretches(x).samples
    turns = (np.cumsum(samples) - samples)[1:]
    chosen = turns[
        np.unique(np.linspace(0, turns.size - 1, min(_MOST_TURNS, turns.size)).astype(int))
    ]
    step, pattern = _DISPLACEMENT_STEP * float(np.ptp(x)), x[:0]
    while chosen.size:
        ends = []
        for sign in (1.0, -1.0):
            path = x.copy()
            path[chosen] += sign * step
            motions = list(problem.motions)
            motions[number] = path, v, a
            turned = problem.altered("latest", motions=tuple(motions))
            ends.append(turned.predict(fit.values, number, derivatives=False).output[chosen[0] :])
        pattern = (ends[0] - ends[1]) / (2.0 * step)
        size = np.abs(pattern)
        last = np.abs(pattern[np.append(chosen[1:] - chosen[0], pattern.size) - 1])
        peaks = np.maximum.reduceat(size, chosen - chosen[0])
        if chosen.size == 1 or (last <= _FORGOTTEN * peaks)[:-1].all():
            break
        chosen = chosen[::2]
    return pattern, chosen, int(turns.size)


def _between(pattern: FloatArray, first: IntArray, covariance: FloatArray) -> FloatArray:
    """Return the covariances of the patterns' products with noise of these autocovariances."""
    ends = np.append(first[1:], pattern.size)
    size = np.abs(pattern)
    windows = []
    for start, end in zip(first.tolist(), ends.tolist(), strict=True):
        beyond = size[start:end] > _FORGOTTEN * size[start:end].max()
        windows.append(pattern[start : start + int(beyond.nonzero()[0].max(initial=0)) + 1])
    width = max(w.size for w in windows)
    m = fft.next_fast_len(2 * width, real=True)
    waves = np.array([fft.rfft(w, m) for w in windows])
    lags = np.arange(m)
    lags[lags > m // 2] -= m
    covariances = np.zeros((first.size, first.size))
    for apart in range(first.size):
        earlier = np.arange(first.size - apart)
        later = np.arange(apart, first.size)
        distance = np.abs((first[later] - first[earlier])[:, None] + lags)
        near = distance < covariance.size
        if not near.any():
            break
        crossed = fft.irfft(waves[earlier].conj() * waves[later], m)
        weights = np.where(near, covariance[np.minimum(distance, covariance.size - 1)], 0.0)
        covariances[earlier, later] = covariances[later, earlier] = (crossed * weights).sum(axis=1)
    return covariances
