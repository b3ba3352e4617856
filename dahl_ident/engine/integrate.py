"""One integration for all motions: Radau IIA steps between events.

Each step lies on one branch of the laws. Arguments are those of :mod:`dahl_ident.engine.radau`.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from dahl_ident.engine.events import (
    LOCATED,
    choose_branch,
    first_event,
    pass_event,
    passed_another,
    reached_zero,
    slope_fades,
    state_jumps,
    step_to_event,
)
from dahl_ident.engine.radau import (
    GROW,
    SAFETY,
    SHRINK,
    at_unit_velocity,
    error_of,
    evaluate,
    guess_stages,
    keep_interval,
    put_interpolated,
    put_states,
    read_stage,
    sensitivities,
    signal_at,
    solve_stages,
)
from dahl_ident.engine.stages import MATRIX, NODES, SLOPE_AFTER, STAGES, compiled

_TURNING = 10.0  # factor on errors next to a turning point, where laws are least smooth
_FAILED = 0.25  # factor on a step whose stages did not converge
_SMALLEST_STEP = 1e-14  # of the span: a shorter step cannot advance the time
_DENSE = 1e-2  # factor on the tolerance of a polynomial that is read between its ends
_DENSE_STEP = _DENSE ** (1.0 / (STAGES + 1))  # factor on the step for that
_SAME_TIME = 1e-8  # of the span: events that are as near to each other may exchange their order
_NEAREST = 0.005  # rad of a sine, or of an interval: the last step before a turning point
_MOST, _PER_SAMPLE = 20_000, 200  # steps at most
_BEYOND_BOUNDS = 1e100  # m/s: far beyond any motion, and its square is still finite


@compiled
def begin_branch(f, followers, signal, t, y, w, at):
    """Set the initial values of the first step on a branch."""
    n, k, o = at.n, at.k, at.outputs
    m = n + 1 + k
    if followers.size:
        at_unit_velocity(f, signal, t, y, w, at)
        for b in followers:
            w[at.follow + b] = w[o + b]
            for z in range(1 + at.P):
                slope = w[o + m * (1 + n) + b * (1 + at.P) + z]
                w[at.follow_slopes + b * (1 + at.P) + z] = slope
    w[at.stiff] = 0.0
    put_states(y, w)
    evaluate(f, signal, t, 0.0, w, at)
    for q in range(n):
        w[at.rates + q] = w[o + q]
    w[at.before], w[at.output] = w[2], w[o + n]
    for i in range(k):
        w[at.before + 1 + i] = w[o + n + 1 + i]


@compiled
def next_stop(signal, t, end, span, w, at):
    """Return the latest end of the step for which the signal is smooth within it."""
    if not at.held:
        return end
    if signal.sine:
        half = np.pi / signal.omega
        return min(end, half * (np.floor(t / half + 1e-9) + 1.0))
    knots, i = signal.knots, max(0, int(w[at.interval]))
    while i + 2 < knots.size and t >= knots[i + 1] - LOCATED * span:
        i += 1
    if i != w[at.interval]:
        keep_interval(signal, i, w, at)
        w[at.interval + 3] = 1.0
    return min(end, knots[i + 1])


@compiled
def add_harmonics(signal, t, h, S, first, chosen, harmonics, sums, w, at):
    """Add the step's part of the integrals of output exp(-j k omega t), and its derivatives."""
    n, P, q = at.n, at.P, S.shape[1]
    m = n + 1 + at.k
    for i in range(STAGES):
        weight = h * MATRIX[STAGES - 1, i]
        phase = signal.omega * (t + NODES[i] * h)
        slopes = at.state_slopes + (i * m + n) * n
        drives = at.drive_slopes + (i * m + n) * (1 + P)
        for a in range(harmonics.size):
            turn = weight * np.exp(-1j * harmonics[a] * phase)
            sums[a, 0] += w[at.values + i * m + n] * turn
            for z in range(q):
                value = 0.0
                for b in range(n):
                    if w[slopes + b] != 0.0:
                        change = S[b, z] + w[at.changes + (i * n + b) * q + z]
                        value += w[slopes + b] * change
                if z > first:
                    value += w[drives + 1 + chosen[z - first - 1]]
                elif z == first and not at.held:
                    value += w[drives] * np.cos(phase)
                sums[a, 1 + z] += value * turn


@compiled
def write_samples(f, signal, t, h, y, S, first, chosen, samples, i, output, by, path, w, at):
    """Write outputs and states at the samples in the step; return the first sample beyond it."""
    n, P, q, o = at.n, at.P, S.shape[1], at.outputs
    m = n + 1 + at.k
    while i < samples.size and samples[i] <= t + h * (1.0 + 1e-12):
        position = min(1.0, max(0.0, (samples[i] - t) / h))
        put_interpolated(y, position, w, at)
        evaluate(f, signal, t + position * h, 2.0 if q else 0.0, w, at)
        output[i] = w[o + n]
        for b in range(n if path.size else 0):
            path[i, b] = w[1 + b]
        slopes, drives = o + m + n * n, o + m * (1 + n) + n * (1 + P)
        for z in range(q):
            value = 0.0
            for b in range(n):
                if w[slopes + b] != 0.0:
                    change = S[b, z]
                    for j in range(STAGES):
                        change += w[at.weights + j] * w[at.changes + (j * n + b) * q + z]
                    value += w[slopes + b] * change
            if z > first:
                value += w[drives + 1 + chosen[z - first - 1]]
            elif z == first and not at.held:
                value += w[drives] * signal_at(signal, samples[i], w, at)[1]
            by[i, z] = value
        i += 1
    return i


@compiled
def finish_step(h, y, S, w, at):
    """Advance the states to the end of the step, and set the initial values of the next one."""
    n, k, q = at.n, at.k, S.shape[1]
    m = n + 1 + k
    for r in range(n):
        rate, scale = 0.0, w[at.scale + r]
        for j in range(STAGES):
            moved = w[at.stages + j * n + r]
            w[at.last + j * n + r] = moved
            rate += SLOPE_AFTER[j] * moved
            scale = max(scale, abs(y[r] + moved))
        w[at.rates + r], w[at.scale + r] = rate / h, scale
        y[r] += w[at.stages + (STAGES - 1) * n + r]
        for z in range(q):
            S[r, z] += w[at.changes + ((STAGES - 1) * n + r) * q + z]
    for r in range(n, m):
        for i in range(STAGES):
            w[at.scale + r] = max(w[at.scale + r], abs(w[at.values + i * m + r]))
    w[at.before], w[at.output] = y[1], w[at.values + (STAGES - 1) * m + n]
    for i in range(k):
        w[at.before + 1 + i] = w[at.values + (STAGES - 1) * m + n + 1 + i]


Asked = namedtuple("Asked", "harmonics sums samples output by path")
"""What is to be known of a motion: harmonics of the output are added to `sums`; the output at
`samples`, its derivatives and the states are written to `output`, `by` and `path`."""

Scratch = namedtuple("Scratch", "solved followers w at matrix columns")
"""Which states are solved for, and which follow the displacement; arrays for the stages."""


@compiled
def advance(f, signal, times, y, S, chosen, tolerance, longest, step, asked, scratch):
    """Integrate from times[0] to times[1], in place; return a length of step, 0 if it fails.

    `longest` is the longest step. `step` is a guess of the first step, and of the first after a
    turning point; a better one is returned.
    """
    harmonics, sums, samples, output, by, path = asked
    solved, followers, w, at, matrix, columns = scratch
    q = S.shape[1]
    first = q - chosen.size - 1
    t, end = times[0], times[1]
    span = end - t
    sample, stuck, last = 0, 0, 0.0
    integrates_output = harmonics.size > 0
    new_branch, turned, after_turn = True, True, step
    dense = at.held and samples.size > 0
    next_stop(signal, t, end, span, w, at)
    choose_branch(f, signal, t, y, w, at)
    for _ in range(_MOST + _PER_SAMPLE * samples.size):
        if t >= end - LOCATED * span:
            return after_turn
        stop = next_stop(signal, t, end, span, w, at)
        if new_branch:
            begin_branch(f, followers, signal, t, y, w, at)
            new_branch, last = False, 0.0
        step = min(step, longest)
        wanted, allowed = step, tolerance
        if sample < samples.size:  # read samples within the step, or end at the next one
            gap = samples[sample] - t
            if _DENSE_STEP * step > gap:
                wanted, allowed = _DENSE_STEP * step, _DENSE * tolerance
            else:
                wanted = min(step, gap)
        h = stop - t if t + 1.1 * wanted >= stop else wanted
        if at.rated and signal.sine:  # changes are as fast as the turning point is near
            h = min(h, max(0.5 * (stop - t), _NEAREST / signal.omega))
        if sample < samples.size and allowed == tolerance:
            h = min(h, samples[sample] - t)
        guess_stages(h, last, w, at)
        converged = solve_stages(f, solved, followers, signal, t, h, y, w, at, matrix, columns)
        if not converged and last > 0.0:
            guess_stages(h, 0.0, w, at)
            converged = solve_stages(f, solved, followers, signal, t, h, y, w, at, matrix, columns)
        if not converged:
            step, last = h * _FAILED, 0.0
            if step < _SMALLEST_STEP * span:
                return 0.0
            continue
        error = (
            error_of(f, solved, followers, dense, integrates_output, signal, t, h, y, w, at)
            / tolerance
        )
        if turned:
            error *= _TURNING
        factor = GROW
        if error > 0.0:
            factor = min(GROW, max(SHRINK, SAFETY * error ** (-1.0 / (STAGES + 1))))
        if error * tolerance > allowed and h > LOCATED * span:
            step, last = h * factor, 0.0
            continue
        which, where = first_event(f, signal, t, h, y, w, at)
        if at.held and h > LOCATED * span and slope_fades(solved, y, w, at):
            step, last = 0.5 * h, 0.0
            continue
        if which >= 0 and where * h <= LOCATED * span and not state_jumps(where, y, w, at):
            stuck += 1
            if stuck > 2 * (at.k + 2):
                return 0.0  # the motion is stuck between two branches
            pass_event(f, signal, t, which, y, S, first, chosen, w, at)
            new_branch = True
            continue
        stuck = 0
        if which >= 0:
            full = h
            h, at_event = step_to_event(
                f, solved, followers, signal, t, h, where, which, y, span, w, at, matrix, columns
            )
            if h <= 0.0 or (h > _SAME_TIME * span and passed_another(which, w, at)):
                step, last = 0.5 * where * full, 0.0
                continue
            error = (
                error_of(f, solved, followers, dense, integrates_output, signal, t, h, y, w, at)
                / tolerance
            )
            if which == 0:
                error *= _TURNING
            if error * tolerance > allowed and h > LOCATED * span:
                step, last = h * max(SHRINK, SAFETY * error ** (-1.0 / (STAGES + 1))), 0.0
                continue
            nearest = _NEAREST * (w[at.interval + 2] - w[at.interval + 1])
            # changes are fast near rest; steps may be longer by a tenth, to end at a knot
            if which == 0 and at.rated and h > 1.2 * nearest:
                step, last = max(0.5 * h, nearest), 0.0
                continue
            if not at_event:
                which = -1
        if q:
            if not sensitivities(
                f, solved, followers, signal, t, h, y, S, first, chosen, w, at, matrix, columns
            ):
                return 0.0
        elif harmonics.size:
            for i in range(STAGES):
                read_stage(f, solved, followers, 0, i, y, w, at)
        if harmonics.size:
            add_harmonics(signal, t, h, S, first, chosen, harmonics, sums, w, at)
        if samples.size:
            sample = write_samples(
                f, signal, t, h, y, S, first, chosen, samples, sample, output, by, path, w, at
            )
        event = which if which >= 0 else reached_zero(y, w, at)
        finish_step(h, y, S, w, at)
        if not w[at.scale + 1] < _BEYOND_BOUNDS:
            return 0.0
        last = h
        at_stop = t + h >= stop - LOCATED * span
        t = stop if at_stop else t + h
        if turned:
            after_turn, turned = h * factor, False
        step = max(step, h * factor) if h < step else h * factor
        if event >= 0:
            pass_event(f, signal, t, event, y, S, first, chosen, w, at)
            new_branch = True
        if which == 0:
            step, turned = after_turn, True
        elif (
            which < 0 and at.held and at_stop and t < end
        ):  # the held motion turns, or has another polynomial
            next_stop(signal, t, end, span, w, at)
            choose_branch(f, signal, t, y, w, at)
            new_branch = True
    return 0.0
