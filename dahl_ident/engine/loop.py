"""Settled loops of laws with one state, under a sine of displacement.

A half cycle begins at a turning point; its variable is the angle psi, from 0 to pi:
``x = -s A cos(psi)`` with the direction s. The force obeys dF/dpsi = rate(F, psi)/omega, one
equation, which is solved by Radau IIA steps of order 9. Their length is controlled by the error,
and they end at every kink of the law. The settled force at the turning point is the fixed point of
a cycle. It is solved by Newton's method with the derivative of the cycle, from a guess by the loops
at smaller amplitudes. A law that is the same in both directions needs half a cycle. The last pass
gives the harmonics and all derivatives.

A gap in the link to the law is crossed at zero force, where the angle jumps. The gap is then the
last of the parameters; the law's function does not have it.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import boolean, complex128, float64, njit, types

from dahl_ident.engine.events import DECADE, FADED, LEFT, POSITIONS, WEIGHTS
from dahl_ident.engine.radau import (
    CHECKED,
    FUNCTION,
    GROW,
    MATRIX,
    NEAR,
    NODES,
    NUMBERS,
    SAFETY,
    SHRINK,
    SIDED,
    SLOPE_CHECKED,
    STAGES,
    TABLE,
    VALUE_BEFORE,
    VECTOR,
    compiled,
    eliminate,
)

_NEWTON = 15  # iterations of the stages
_SOLVED = 1e-7  # last relative change of the stages, whose error is rounding: its square
_LOCATED = 1e-14  # rad: shorter steps count as zero
_MOST = 500  # steps of a half cycle, in addition to those for the highest harmonic
_SHOTS = 60  # of shooting with coarse steps; one is typical, three without a guess
# Changes of the initial force over the largest force:
_CONVERGED = 1e-5  # with coarse steps; the error is its square
_LAST_PASS = 1e-7  # in the last pass: derivatives have errors of this size
_PREDICTED = 1e-6  # second-order part of a guess whose error is below _LAST_PASS
_AGREED = 1e-3  # a larger change by the last pass means that nothing settles
_COARSE = 10.0  # errors of steps while shooting, over those of the last pass
_SHORTEST = 12.0  # least number of steps in a cycle of the highest harmonic
_FLOOR = 1e-6  # of the largest force: smaller local forces are no scale for errors
_BEYOND_BOUNDS = 1e200  # N: far beyond any force
_FIRST_STEP = 0.05  # rad, guess of the first step after a turning point
_EXPANDS = 3.0  # largest ln of a step's growth; steps controlled by the error grow less
_PASSES = 4  # with fine steps, if coarse ones ended elsewhere; one is typical
_REPEATS, _BISECTIONS = 8, 60  # of a step that ends at an event; two are typical
_APPROACH = 0.6  # of the way to the turning point: largest step if a law depends on the speed
_NEAREST = 1e-3  # rad before the turning point: the last such step

_WEIGHTS_CHECKED = CHECKED[:, None] ** np.arange(1, STAGES + 1) @ np.linalg.inv(
    NODES[:, None] ** np.arange(1, STAGES + 1)
)
"""Weights of the changes at the stages in those at `CHECKED`."""

Work = namedtuple(
    "Work",
    "w k P o m rated stages last rates slopes output functions turns before scale cosines sines "
    "matrix columns changes explicit S numbers",
)
"""Scratch arrays of a row; `numbers` are amplitude, omega, direction, largest force."""


@compiled
def _evaluate(f, level, cosine, sine, F, at):
    """Evaluate the law at a position of the half cycle."""
    w, amplitude, omega, heading = at.w, at.numbers[0], at.numbers[1], at.numbers[2]
    w[0] = level
    w[1] = -heading * amplitude * cosine
    w[2] = heading * amplitude * omega * sine
    w[3] = F
    f(w.ctypes)


@compiled
def _slope(f, F, at):
    """Return dF/dx on the present branch, at the largest speed."""
    _evaluate(f, 0.0, 0.0, 1.0, F, at)
    return at.w[at.o + 2] / at.w[2]


@compiled
def _function_rate(i, cosine, sine, at):
    """Return the change of switching function i over psi, from outputs of the first level."""
    w, row = at.w, at.o + at.m + 3 * (4 + i)
    amplitude, omega, heading = at.numbers[0], at.numbers[1], at.numbers[2]
    rate = w[row] * heading * amplitude * sine + w[row + 2] * w[at.o + 2] / omega
    return rate + w[row + 1] * heading * amplitude * omega * cosine


@compiled
def _choose_sides(f, cosine, sine, F, at):
    """Set the sides of the switches; a zero counts as what it is about to become."""
    w, o = at.w, at.o
    for _ in range(2 if at.k else 0):  # the side of one switch may depend on that of another
        for i in range(at.k):
            _evaluate(f, 1.0, cosine, sine, F, at)
            value = w[o + 4 + i]
            at.scale[i] = max(at.scale[i], abs(value))
            if abs(value) > NEAR * at.scale[i]:
                w[6 + i] = np.sign(value)
                continue
            rate = _function_rate(i, cosine, sine, at)
            if rate == 0.0:
                _evaluate(f, 1.0, 0.0, 1.0, F, at)
                rate = _function_rate(i, 0.0, 1.0, at)
            if rate != 0.0:
                w[6 + i] = np.sign(rate)


@compiled
def _solve(f, psi, h, F, at):
    """Solve for the changes of the force at the stages from a guess; False if that fails."""
    w, o, omega, converged = at.w, at.o, at.numbers[1], False
    for i in range(STAGES):
        at.cosines[i], at.sines[i] = np.cos(psi + NODES[i] * h), np.sin(psi + NODES[i] * h)
    for _ in range(_NEWTON):
        for i in range(STAGES):
            _evaluate(f, 1.0, at.cosines[i], at.sines[i], F + at.stages[i], at)
            at.rates[i] = w[o + 2] / omega
            at.slopes[i] = w[o + at.m + 8] / omega
            at.output[i] = w[o + 3]
            for e in range(at.k):
                at.functions[i, e] = w[o + 4 + e]
                at.turns[i, e] = w[o + at.m + 3 * (4 + e) + 2]
        for i in range(STAGES):
            value = -at.stages[i]
            for j in range(STAGES):
                value += h * MATRIX[i, j] * at.rates[j]
                at.matrix[i, j] = -h * MATRIX[i, j] * at.slopes[j]
            at.matrix[i, i] += 1.0
            at.columns[i, 0] = value
        if not eliminate(at.matrix, at.columns, STAGES, 1):
            return False
        largest, size, total, sided = 0.0, abs(F), 0.0, True
        for i in range(STAGES):
            at.stages[i] += at.columns[i, 0]
            total += abs(at.columns[i, 0])
            for e in range(at.k):
                change = at.turns[i, e] * at.columns[i, 0]
                at.functions[i, e] += change
                value = max(abs(at.functions[i, e]), NEAR * at.scale[e])
                sided = sided and abs(change) <= SIDED * value
            largest = max(largest, abs(at.columns[i, 0]))
            size = max(size, abs(F + at.stages[i]))
        if not total < np.inf:  # or NaN
            return False
        converged = largest <= _SOLVED * max(size, _FLOOR * at.numbers[3])
        if converged and sided:
            break
    return converged


@compiled
def _error(f, psi, h, F, output, at):
    """Return the differences of the polynomials from rates and output, over the local values."""
    largest, size = 0.0, max(abs(F), _FLOOR * at.numbers[3])
    for j in range(STAGES):
        size = max(size, abs(F + at.stages[j]))
    for i in range(CHECKED.size):
        angle, force, change = psi + CHECKED[i] * h, F, 0.0
        for j in range(STAGES):
            force += _WEIGHTS_CHECKED[i, j] * at.stages[j]
            change += SLOPE_CHECKED[i, j] * at.stages[j]
        _evaluate(f, 0.0, np.cos(angle), np.sin(angle), force, at)
        change -= h * at.w[at.o + 2] / at.numbers[1]
        if not abs(change) < np.inf:
            return np.inf
        largest = max(largest, abs(change))
    change, total = -output, max(size, abs(output))
    for j in range(STAGES):
        change += VALUE_BEFORE[j] * at.output[j]
        total = max(total, abs(at.output[j]))
    if not abs(change) < np.inf:
        return np.inf
    return max(largest / size, abs(change) / total) if size > 0.0 else 0.0


@compiled
def _change(x, changes):
    """Return the change of the force at position x of a step, 0 to 1, from those at the stages."""
    value = 0.0
    for j in range(STAGES):
        weight = x / NODES[j]
        for k in range(STAGES):
            if k != j:
                weight *= (x - NODES[k]) / (NODES[j] - NODES[k])
        value += weight * changes[j]
    return value


@compiled
def _guess(h, last, rate, at):
    """Extrapolate the stages from the last step's polynomial, or without one at a constant rate."""
    for i in range(STAGES):
        if last > 0.0:
            at.stages[i] = _change(1.0 + NODES[i] * h / last, at.last) - at.last[STAGES - 1]
        else:
            at.stages[i] = h * NODES[i] * rate


@compiled
def _first_event(f, psi, h, F, gap, at):
    """Return which function passes through zero first in the step, or -1, and at which position.

    The polynomials through the stages are examined; at their minima, the functions themselves.
    Function k, after the switches, is the force, if a gap is to be crossed.
    """
    which, where = -1, 2.0
    for e in range(at.k + 1):
        if e == at.k:
            if not gap:
                continue
            side, near, before = -1.0, 0.0, at.numbers[2] * F
        else:
            side, near, before = at.w[6 + e], NEAR * at.scale[e], at.before[e]
        if side == 0.0:
            continue
        lower, older, low, old = 0.0, np.inf, 0.0, before * side
        for i in range(WEIGHTS.shape[0]):
            high, value = POSITIONS[i], WEIGHTS[i, 0] * before * side
            for j in range(STAGES):
                stage = at.numbers[2] * (F + at.stages[j]) if e == at.k else at.functions[j, e]
                value += WEIGHTS[i, 1 + j] * stage * side
            if low >= where:
                break
            if i and e < at.k and older > old < value:
                slope1, slope2 = (old - older) / (low - lower), (value - old) / (high - low)
                minimum = 0.5 * (lower + low - slope1 * (high - lower) / (slope2 - slope1))
                angle, force = psi + minimum * h, F + _change(minimum, at.stages)
                _evaluate(f, 0.0, np.cos(angle), np.sin(angle), force, at)
                if at.w[at.o + 4 + e] * side < -near:
                    low, old, high, value = lower, older, minimum, at.w[at.o + 4 + e] * side
            if value < -near or (e == at.k and value <= 0.0):
                if old > 0.0:  # by the chord: the step to the event is solved later
                    high = low + (high - low) * old / (old - value)
                elif low == 0.0:
                    high = 0.0 if i == 0 and value < old else high
                if high < where:
                    which, where = e, high
                break
            lower, older, low, old = low, old, high, value
    return which, where


@compiled
def _slope_fades(at):
    """Return whether the slope decreases with a switching function by more than a step resolves.

    If the force approaches its limit as a power of the remaining distance, errors do not decay.
    """
    for e in range(at.k):
        old, new = at.functions[0, e] * at.w[6 + e], at.functions[STAGES - 2, e] * at.w[6 + e]
        if old > LEFT * at.scale[e] and new < DECADE * old:
            before = at.rates[0] * at.sines[STAGES - 2]
            if abs(at.rates[STAGES - 2] * at.sines[0]) < FADED * abs(before):
                return True
    return False


@compiled
def _event_at(f, psi, F, e, at):
    """Return value and rate of function e, its side, and the size that counts as zero."""
    c, s = np.cos(psi), np.sin(psi)
    _evaluate(f, 1.0, c, s, F, at)
    if e == at.k:
        return F, at.w[at.o + 2] / at.numbers[1], -at.numbers[2], 0.0
    return at.w[at.o + 4 + e], _function_rate(e, c, s, at), at.w[6 + e], NEAR * at.scale[e]


@compiled
def _passed_before(event, at):
    """Return which other function has passed through zero before the event, or -1."""
    for e in range(at.k):
        value, near, side = at.w[at.o + 4 + e], NEAR * at.scale[e], at.w[6 + e]
        if e != event and value * side < -near and at.before[e] * side > near:
            return e
    return -1


@compiled
def _pass_switch(f, e, cosine, sine, F, chosen, columns, at):
    """Change the branch at a zero of switching function e; sensitivities jump with the rates."""
    w, o, omega = at.w, at.o, at.numbers[1]
    _evaluate(f, 2.0, cosine, sine, F, at)
    before, rate = w[o + 2] / omega, _function_rate(e, cosine, sine, at)
    late = at.changes[0]
    for z in range(columns):
        value = w[o + at.m + 3 * (4 + e) + 2] * at.S[z]
        if z == 1:
            row = o + at.m + 3 * (4 + e)
            value += (w[row] * w[1] + w[row + 1] * w[2]) / at.numbers[0]
        elif z > 1 and chosen[z - 2] < at.P:
            value += w[o + 4 * at.m + (4 + e) * (1 + at.P) + 1 + chosen[z - 2]]
        late[z] = -value / rate if rate != 0.0 else 0.0
    for i in range(at.k):  # other functions may be zero here too, such as those of y < a and y >= a
        zero = i != e and abs(w[o + 4 + i]) <= NEAR * at.scale[i]
        if zero and _function_rate(i, cosine, sine, at) * w[6 + i] < 0.0:
            w[6 + i] *= -1.0
    w[6 + e] *= -1.0
    _evaluate(f, 1.0, cosine, sine, F, at)
    # do both branches lead to the event?
    if _function_rate(e, cosine, sine, at) * w[6 + e] <= 0.0 < sine:
        side, w[6 + e] = w[6 + e], 0.0
        _evaluate(f, 1.0, cosine, sine, F, at)
        if w[o + 2] != 0.0:
            w[6 + e] = side
    _evaluate(f, 0.0, cosine, sine, F, at)
    jump = before - w[o + 2] / omega
    for z in range(columns if jump != 0.0 else 0):
        at.S[z] += jump * late[z]


@compiled
def _cross_gap(f, gap, psi, chosen, columns, at):
    """Return the angle behind the gap, or pi if the motion turns in it; change sensitivities."""
    amplitude, heading = at.numbers[0], at.numbers[2]
    before = _slope(f, 0.0, at)
    haversine = np.sin(0.5 * psi) ** 2 + 0.5 * gap / amplitude
    if haversine >= 1.0:
        at.S[:columns] = 0.0
        return np.pi
    beyond = 2.0 * np.arcsin(np.sqrt(haversine))
    _choose_sides(f, np.cos(beyond), np.sin(beyond), 0.0, at)
    after = _slope(f, 0.0, at)
    for z in range(columns):
        moved = -at.S[z] / before
        if z == 1:
            moved += heading * (np.cos(beyond) - np.cos(psi))
        elif z > 1 and chosen[z - 2] == at.P:
            moved += heading
        at.S[z] = -after * moved
    return beyond


@compiled
def _last_step(f, h, F, chosen, columns, harmonics, turned, sums, at):
    """Set the changes of the sensitivities up to the stages of the step; False if singular.

    The step's part of the integrals of output exp(-j k theta), and of their derivatives, is added.
    """
    w, o, omega = at.w, at.o, at.numbers[1]
    for j in range(STAGES):
        _evaluate(f, 2.0, at.cosines[j], at.sines[j], F + at.stages[j], at)
        # derivatives with respect to x, v and force, and below with respect to the parameters
        rates, outputs = o + at.m + 6, o + at.m + 9
        by_rate = o + 4 * at.m + 2 * (1 + at.P) + 1
        by_output = by_rate + 1 + at.P
        at.slopes[j], at.last[j], at.output[j] = w[rates + 2] / omega, w[outputs + 2], w[o + 3]
        for z in range(columns):
            value, explicit = at.slopes[j] * at.S[z], 0.0
            if z == 1:
                value += (w[rates] * w[1] + w[rates + 1] * w[2]) / (at.numbers[0] * omega)
                explicit = (w[outputs] * w[1] + w[outputs + 1] * w[2]) / at.numbers[0]
            elif z > 1 and chosen[z - 2] < at.P:
                value += w[by_rate + chosen[z - 2]] / omega
                explicit = w[by_output + chosen[z - 2]]
            at.changes[j, z], at.explicit[j, z] = value, explicit
    for i in range(STAGES):
        for z in range(columns):
            value = 0.0
            for j in range(STAGES):
                value += MATRIX[i, j] * at.changes[j, z]
            at.columns[i, z] = h * value
        for j in range(STAGES):
            at.matrix[i, j] = -h * MATRIX[i, j] * at.slopes[j]
        at.matrix[i, i] += 1.0
    if not eliminate(at.matrix, at.columns, STAGES, columns):
        return False
    for j in range(STAGES):
        phasor = complex(at.cosines[j], -at.sines[j]) * turned
        turn, power = complex(h * MATRIX[STAGES - 1, j], 0.0), 0
        for a in range(harmonics.size):
            while power < harmonics[a]:
                turn *= phasor
                power += 1
            sums[a, 0] += at.output[j] * turn
            for z in range(columns):
                value = at.last[j] * (at.S[z] + at.columns[j, z]) + at.explicit[j, z]
                sums[a, 1 + z] += value * turn
    return True


@compiled
def _half_cycle(f, F, gap, chosen, last_pass, harmonics, sums, tolerance, longest, first, at):
    """Return the force at the end of a half cycle and its first step, 0 if the end is not reached.

    The sensitivities in `at` are integrated too: one column, or all in the last pass.
    """
    columns = 2 + chosen.size if last_pass else 1
    w, o, omega, heading = at.w, at.o, at.numbers[1], at.numbers[2]
    w[5] = heading
    turned = -heading
    psi, last, step, stuck, after_turn = 0.0, 0.0, first, 0, 0.0
    w[6 : 6 + at.k] = heading
    _choose_sides(f, 1.0, 0.0, F, at)
    crossing, new_branch, output, rate = gap > 0.0, True, 0.0, 0.0
    event, tries, low, high, h = -1, 0, 0.0, 0.0, 0.0
    if crossing and heading * F >= 0.0:
        psi = _cross_gap(f, gap, psi, chosen, columns, at)
        crossing, F = False, 0.0
    for _ in range(_MOST + int(2.0 * np.pi / longest)):
        if np.pi - psi <= _LOCATED:
            return F, after_turn
        if tries == 0:  # otherwise the step's end is being moved to an event
            h = min(step, longest)
            h = np.pi - psi if psi + 1.1 * h >= np.pi else h
            if at.rated:  # changes are as fast as the turning point is near
                h = min(h, max(_APPROACH * (np.pi - psi), _NEAREST))
        if new_branch:
            _evaluate(f, 0.0, np.cos(psi), np.sin(psi), F, at)
            rate, output = w[o + 2] / omega, w[o + 3]
            for i in range(at.k):
                at.before[i] = w[o + 4 + i]
            new_branch, last = False, 0.0
        _guess(h, last if tries == 0 else 0.0, rate, at)
        if not _solve(f, psi, h, F, at):
            if last > 0.0:
                last = 0.0
            else:
                step = 0.25 * h
                if step < _LOCATED:
                    return F, 0.0
            tries, event = 0, -1
            continue
        error = _error(f, psi, h, F, output, at) / tolerance
        factor = min(GROW, max(SHRINK, SAFETY * (error + 1e-30) ** (-1.0 / (STAGES + 1))))
        if error > 1.0 and h > _LOCATED:
            step, last, tries, event = h * factor, 0.0, 0, -1
            continue
        if tries == 0:
            event, position = _first_event(f, psi, h, F, crossing, at)
            if _slope_fades(at):
                step, last = 0.5 * h, 0.0
                continue
            if event >= 0:
                low, high = 0.0, h
                h *= position
                if h > _LOCATED:
                    tries = 1
                    continue
                h = 0.0
                stuck += 1
                if stuck > 2 * (at.k + 2):
                    return F, 0.0
        else:
            value, slope, side, near = _event_at(f, psi + h, F + at.stages[STAGES - 1], event, at)
            change = -value / slope if slope != 0.0 else np.inf
            located = value == 0.0 or abs(change) <= max(1e-15, 1e-12 * h)
            if not (located or (abs(value) <= near and tries > _REPEATS)):
                if value * side > 0.0:
                    low = h
                else:
                    high = h
                h = h + change if low < h + change < high else 0.5 * (low + high)
                tries += 1
                if tries < _BISECTIONS and high - low > _LOCATED:
                    continue
                step, last, tries, event = max(0.5 * h, _LOCATED), 0.0, 0, -1
                continue
            other = _passed_before(event, at)
            if other >= 0 and h > _LOCATED:
                event, low, high, tries = other, 0.0, h, 1
                h *= 0.5
                continue
        tries = 0
        if h > 0.0:
            stuck = 0
            if last_pass:
                if not _last_step(f, h, F, chosen, columns, harmonics, turned, sums, at):
                    return F, 0.0
                for z in range(columns):
                    at.S[z] += at.columns[STAGES - 1, z]
            else:
                growth = 0.0
                for j in range(STAGES):
                    growth += h * MATRIX[STAGES - 1, j] * at.slopes[j]
                at.S[0] *= np.exp(growth) if growth < _EXPANDS else 0.0
            for j in range(STAGES):
                at.last[j] = at.stages[j]
            F += at.stages[STAGES - 1]
            at.numbers[3] = max(at.numbers[3], abs(F))
            if not at.numbers[3] < _BEYOND_BOUNDS:
                return F, 0.0
            rate, output = at.rates[STAGES - 1], at.output[STAGES - 1]
            for i in range(at.k):
                at.before[i] = at.functions[STAGES - 1, i]
                at.scale[i] = max(at.scale[i], abs(at.before[i]))
            psi, last = (np.pi if np.pi - psi - h <= _LOCATED else psi + h), h
            after_turn = after_turn if after_turn > 0.0 else h * factor
            step = max(step, h * factor) if h < step else h * factor
        if event == at.k:
            psi = _cross_gap(f, gap, psi, chosen, columns, at)
            crossing, F, new_branch = False, 0.0, True
        elif event >= 0:
            _pass_switch(f, event, np.cos(psi), np.sin(psi), F, chosen, columns, at)
            new_branch = True
    return F, 0.0


@compiled
def _settle(f, y, sure, halves, sign, gap, chosen, harmonics, sums, tolerance, longest, steps, at):
    """Return whether the loop settles, its initial force, the remaining correction, and 1 - map.

    Coarse passes, which are left out if the guess y is `sure`, are followed by fine ones with all
    derivatives.
    """
    change, one_minus_map, start = np.inf, 1.0, y
    at.scale[:], at.numbers[3] = 0.0, 0.0
    for last_pass in (False, True):
        if sure and not last_pass:
            continue
        for _ in range(_PASSES if last_pass else _SHOTS):
            F = y
            at.S[:] = 0.0
            at.S[0] = 1.0
            sums[:] = 0.0
            for half in range(halves):
                at.numbers[2] = -1.0 if half == 0 else 1.0
                F, first = _half_cycle(
                    f,
                    F,
                    gap,
                    chosen,
                    last_pass,
                    harmonics,
                    sums,
                    tolerance if last_pass else _COARSE * tolerance,
                    longest if last_pass else np.pi,
                    steps[half],
                    at,
                )
                if first == 0.0:
                    return False, y, np.inf, 1.0
                steps[half] = first
            excess, one_minus_map = sign * F - y, 1.0 - sign * at.S[0]
            change = excess / one_minus_map if one_minus_map != 0.0 else np.inf
            near = abs(change) <= (_LAST_PASS if last_pass else _CONVERGED) * at.numbers[3]
            if near and last_pass:
                return True, y, change, one_minus_map
            start, y = y, y + (change if abs(change) < np.inf else excess)
            if near:
                break
    return abs(change) <= _AGREED * at.numbers[3], start, change, one_minus_map


@compiled
def _continues(row, other, omegas, parameters):
    """Return whether two rows differ in the amplitude only."""
    same = omegas[row] == omegas[other]
    for i in range(parameters.shape[1]):
        same = same and parameters[row, i] == parameters[other, i]
    return same


@njit(
    types.Tuple((NUMBERS, complex128[:, :, ::1], VECTOR, VECTOR))(
        FUNCTION, NUMBERS, boolean, boolean, VECTOR, VECTOR, TABLE, NUMBERS, NUMBERS, float64
    ),
    cache=True,
    error_model="numpy",
)
def loops(f, sizes, odd, gaps, amplitudes, omegas, parameters, chosen, harmonics, tolerance):
    """Return settled loops, row by row, each from a guess by the rows before it.

    Whether each converged; harmonics c_k of ``output = sum of Re c_k exp(j k theta)``, for rising
    k, with their derivatives with respect to the amplitude and the parameters `chosen`; the force
    at the upper turning point; and the factor by which a deviation shrinks in a cycle.
    """
    k, P, rows = sizes[1], sizes[2], amplitudes.size
    o, m, columns = 6 + k + P + sizes[5], 4 + k, 2 + chosen.size
    at = Work(
        np.zeros(o + m * (5 + P)),
        k,
        P,
        o,
        m,
        sizes[4] == 1,
        np.zeros(STAGES),
        np.zeros(STAGES),
        np.zeros(STAGES),
        np.zeros(STAGES),
        np.zeros(STAGES),
        np.zeros((STAGES, k)),
        np.zeros((STAGES, k)),
        np.zeros(k),
        np.zeros(k),
        np.zeros(STAGES),
        np.zeros(STAGES),
        np.zeros((STAGES, STAGES)),
        np.zeros((STAGES, columns)),
        np.zeros((STAGES, columns)),
        np.zeros((STAGES, columns)),
        np.zeros(columns),
        np.zeros(4),
    )
    converged = np.zeros(rows, dtype=np.int64)
    result = np.zeros((rows, harmonics.size, columns), dtype=np.complex128)
    tops, decays = np.zeros(rows), np.zeros(rows)
    sums = np.zeros((harmonics.size, 1 + columns), dtype=np.complex128)
    highest = 1.0
    for h in harmonics:
        highest = max(highest, float(h))
    longest = 2.0 * np.pi / (_SHORTEST * highest)
    sign, halves = (-1.0, 1) if odd else (1.0, 2)
    steps, last, rise, older, older_rise = np.full(2, _FIRST_STEP), -1, 0.0, 0.0, 0.0
    for row in range(rows):
        amplitude, gap = amplitudes[row], parameters[row, P] if gaps else 0.0
        if 2.0 * amplitude <= gap:
            converged[row] = 1
            continue
        at.w[6 + k : 6 + k + P] = parameters[row, :P]
        at.w[0] = -1.0
        f(at.w.ctypes)
        at.numbers[0], at.numbers[1] = amplitude, omegas[row]
        y, settles, sure, change, one_minus_map = 0.0, False, False, 0.0, 1.0
        if last >= 0 and _continues(row, last, omegas, parameters):
            increase, bend = amplitude - amplitudes[last], 0.0
            if older > 0.0:  # from the slopes at the two amplitudes before this one
                bend = 0.5 * (rise - older_rise) / (amplitudes[last] - older)
            guess = tops[last] + increase * (rise + increase * bend)
            sure = older > 0.0 and abs(increase * increase * bend) <= _PREDICTED * abs(tops[last])
            settles, y, change, one_minus_map = _settle(
                f,
                guess,
                sure,
                halves,
                sign,
                gap,
                chosen,
                harmonics,
                sums,
                tolerance,
                longest,
                steps,
                at,
            )
        else:
            last = -1
        if not settles:
            steps[:] = _FIRST_STEP
            settles, y, change, one_minus_map = _settle(
                f,
                0.0,
                False,
                halves,
                sign,
                gap,
                chosen,
                harmonics,
                sums,
                tolerance,
                longest,
                steps,
                at,
            )
        if not settles:
            last = -1
            continue
        converged[row], tops[row], decays[row] = 1, y + change, at.S[0] ** (2 // halves)
        older, older_rise = (amplitudes[last], rise) if last >= 0 else (0.0, 0.0)
        last, rise = row, sign * at.S[1] / one_minus_map if one_minus_map != 0.0 else 0.0
        for a in range(harmonics.size):
            factor = (1.0 if harmonics[a] else 0.5) / np.pi
            if odd:
                factor *= 2.0 * (harmonics[a] % 2)
            result[row, a, 0] = factor * (sums[a, 0] + sums[a, 1] * change)
            for z in range(1, columns):
                by_start = sign * at.S[z] / one_minus_map if one_minus_map != 0.0 else 0.0
                result[row, a, z] = factor * (sums[a, 1 + z] + sums[a, 1] * by_start)
    return converged, result, tops, decays
