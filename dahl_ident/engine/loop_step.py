"""One step of a law with one state along a half cycle: Radau IIA, errors, events, sensitivities.

A half cycle begins at a turning point; its variable is the angle psi, from 0 to pi:
``x = -s A cos(psi)`` with the direction s. The force obeys dF/dpsi = rate(F, psi)/omega, one
equation, which is solved by Radau IIA steps of order 9. In the functions below `at` (:class:`Work`)
has all arrays, of which `w` is that of the law's function.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from dahl_ident.engine.events import DECADE, FADED, LEFT
from dahl_ident.engine.radau import NEAR, SIDED, SOLVED
from dahl_ident.engine.stages import (
    CHANGE_CHECKED,
    CHECKED,
    MATRIX,
    NODES,
    POSITIONS,
    SLOPE_CHECKED,
    STAGES,
    VALUE_AT,
    VALUE_BEFORE,
    compiled,
    eliminate,
    remove_pole,
)

_NEWTON = 15  # iterations of the stages
_FLOOR = 1e-6  # of the largest force: smaller local forces are no scale for errors

Work = namedtuple(
    "Work",
    "w k P o m rated stages last rates slopes output functions turns before scale cosines sines "
    "matrix columns changes explicit S numbers chosen harmonics sums tolerance longest steps",
)
"""Scratch arrays of a row, and what is asked; `numbers` are amplitude, omega, direction, largest F.

`sums` are integrals of the output and its derivatives, `steps` the first ones of both half cycles.
"""


@compiled
def evaluate(f, level, cosine, sine, F, at):
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
    evaluate(f, 0.0, 0.0, 1.0, F, at)
    return at.w[at.o + 2] / at.w[2]


@compiled
def _function_rate(i, cosine, sine, at):
    """Return the change of switching function i over psi, from outputs of the first level."""
    w, row = at.w, at.o + at.m + 3 * (4 + i)
    amplitude, omega, heading = at.numbers[0], at.numbers[1], at.numbers[2]
    rate = w[row] * heading * amplitude * sine + w[row + 2] * w[at.o + 2] / omega
    return rate + w[row + 1] * heading * amplitude * omega * cosine


@compiled
def choose_sides(f, cosine, sine, F, at):
    """Set the sides of the switches; a zero counts as what it is about to become."""
    w, o = at.w, at.o
    for _ in range(2 if at.k else 0):  # the side of one switch may depend on that of another
        for i in range(at.k):
            evaluate(f, 1.0, cosine, sine, F, at)
            value = w[o + 4 + i]
            at.scale[i] = max(at.scale[i], abs(value))
            if abs(value) > NEAR * at.scale[i]:
                w[6 + i] = np.sign(value)
                continue
            rate = _function_rate(i, cosine, sine, at)
            if rate == 0.0:
                evaluate(f, 1.0, 0.0, 1.0, F, at)
                rate = _function_rate(i, 0.0, 1.0, at)
            if rate != 0.0:
                w[6 + i] = np.sign(rate)


@compiled
def solve_stages(f, psi, h, F, at):
    """Solve for the changes of the force at the stages from a guess; False if that fails."""
    w, o, omega, converged = at.w, at.o, at.numbers[1], False
    for i in range(STAGES):
        at.cosines[i], at.sines[i] = np.cos(psi + NODES[i] * h), np.sin(psi + NODES[i] * h)
    for _ in range(_NEWTON):
        for i in range(STAGES):
            evaluate(f, 1.0, at.cosines[i], at.sines[i], F + at.stages[i], at)
            at.rates[i] = w[o + 2] / omega
            at.slopes[i] = w[o + at.m + 8] / omega
            at.output[i] = w[o + 3]
            for e in range(at.k):
                at.functions[i, e] = w[o + 4 + e]
                at.turns[i, e] = w[o + at.m + 3 * (4 + e) + 2]
        remove_pole(at.slopes, 0, 1, at.rates, 0, 1)
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
        converged = largest <= SOLVED * max(size, _FLOOR * at.numbers[3])
        if converged and sided:
            break
    return converged


@compiled
def error_of(f, psi, h, F, output, at):
    """Return the differences of the polynomials from rates and output, over the local values."""
    largest, size = 0.0, max(abs(F), _FLOOR * at.numbers[3])
    for j in range(STAGES):
        size = max(size, abs(F + at.stages[j]))
    for i in range(CHECKED.size):
        angle, force, change = psi + CHECKED[i] * h, F, 0.0
        for j in range(STAGES):
            force += CHANGE_CHECKED[i, j] * at.stages[j]
            change += SLOPE_CHECKED[i, j] * at.stages[j]
        evaluate(f, 0.0, np.cos(angle), np.sin(angle), force, at)
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
def guess_stages(h, last, rate, at):
    """Extrapolate the stages from the last step's polynomial, or without one at a constant rate."""
    for i in range(STAGES):
        if last > 0.0:
            at.stages[i] = _change(1.0 + NODES[i] * h / last, at.last) - at.last[STAGES - 1]
        else:
            at.stages[i] = h * NODES[i] * rate


@compiled
def first_event(f, psi, h, F, gap, at):
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
        for i in range(VALUE_AT.shape[0]):
            high, value = POSITIONS[i], VALUE_AT[i, 0] * before * side
            for j in range(STAGES):
                stage = at.numbers[2] * (F + at.stages[j]) if e == at.k else at.functions[j, e]
                value += VALUE_AT[i, 1 + j] * stage * side
            if low >= where:
                break
            if i and e < at.k and older > old < value:
                slope1, slope2 = (old - older) / (low - lower), (value - old) / (high - low)
                minimum = 0.5 * (lower + low - slope1 * (high - lower) / (slope2 - slope1))
                angle, force = psi + minimum * h, F + _change(minimum, at.stages)
                evaluate(f, 0.0, np.cos(angle), np.sin(angle), force, at)
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
def reached_zero(at):
    """Return a switching function that has come to zero at the step's end to stay, or -1.

    Otherwise rounding would choose the branch of the later steps, and their slopes.
    """
    for e in range(at.k if at.sines[STAGES - 1] > NEAR else 0):
        if at.functions[STAGES - 1, e] * at.w[6 + e] <= 0.0 < at.before[e] * at.w[6 + e]:
            return e
    return -1


@compiled
def slope_fades(at):
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
def event_at(f, psi, F, e, at):
    """Return value and rate of function e, its side, and the size that counts as zero."""
    c, s = np.cos(psi), np.sin(psi)
    evaluate(f, 1.0, c, s, F, at)
    if e == at.k:
        return F, at.w[at.o + 2] / at.numbers[1], -at.numbers[2], 0.0
    return at.w[at.o + 4 + e], _function_rate(e, c, s, at), at.w[6 + e], NEAR * at.scale[e]


@compiled
def passed_before(event, at):
    """Return which other function has passed through zero before the event, or -1."""
    for e in range(at.k):
        value, near, side = at.w[at.o + 4 + e], NEAR * at.scale[e], at.w[6 + e]
        if e != event and value * side < -near and at.before[e] * side > near:
            return e
    return -1


@compiled
def pass_switch(f, e, cosine, sine, F, columns, at):
    """Change the branch at a zero of switching function e; sensitivities jump with the rates."""
    w, o, omega = at.w, at.o, at.numbers[1]
    evaluate(f, 2.0, cosine, sine, F, at)
    before, rate = w[o + 2] / omega, _function_rate(e, cosine, sine, at)
    late = at.changes[0]
    for z in range(columns):
        value = w[o + at.m + 3 * (4 + e) + 2] * at.S[z]
        if z == 1:
            row = o + at.m + 3 * (4 + e)
            value += (w[row] * w[1] + w[row + 1] * w[2]) / at.numbers[0]
        elif z > 1 and at.chosen[z - 2] < at.P:
            value += w[o + 4 * at.m + (4 + e) * (1 + at.P) + 1 + at.chosen[z - 2]]
        late[z] = -value / rate if rate != 0.0 else 0.0
    for i in range(at.k):  # other functions may be zero here too, such as those of y < a and y >= a
        zero = i != e and abs(w[o + 4 + i]) <= NEAR * at.scale[i]
        if zero and _function_rate(i, cosine, sine, at) * w[6 + i] < 0.0:
            w[6 + i] *= -1.0
    w[6 + e] *= -1.0
    evaluate(f, 1.0, cosine, sine, F, at)
    # do both branches lead to the event?
    if _function_rate(e, cosine, sine, at) * w[6 + e] <= 0.0 < sine:
        side, w[6 + e] = w[6 + e], 0.0
        evaluate(f, 1.0, cosine, sine, F, at)
        if w[o + 2] != 0.0:
            w[6 + e] = side
    evaluate(f, 0.0, cosine, sine, F, at)
    jump = before - w[o + 2] / omega
    for z in range(columns if jump != 0.0 else 0):
        at.S[z] += jump * late[z]


@compiled
def cross_gap(f, gap, psi, columns, at):
    """Return the angle behind the gap, or pi if the motion turns in it; change sensitivities."""
    amplitude, heading = at.numbers[0], at.numbers[2]
    before = _slope(f, 0.0, at)
    haversine = np.sin(0.5 * psi) ** 2 + 0.5 * gap / amplitude
    if haversine >= 1.0:
        at.S[:columns] = 0.0
        return np.pi
    beyond = 2.0 * np.arcsin(np.sqrt(haversine))
    choose_sides(f, np.cos(beyond), np.sin(beyond), 0.0, at)
    after = _slope(f, 0.0, at)
    for z in range(columns):
        moved = -at.S[z] / before
        if z == 1:
            moved += heading * (np.cos(beyond) - np.cos(psi))
        elif z > 1 and at.chosen[z - 2] == at.P:
            moved += heading
        at.S[z] = -after * moved
    return beyond


@compiled
def last_step(f, h, F, columns, turned, at):
    """Set the changes of the sensitivities up to the stages of the step; False if singular.

    The step's part of the integrals of output exp(-j k theta), and of their derivatives, is added.
    """
    w, o, omega = at.w, at.o, at.numbers[1]
    for j in range(STAGES):
        evaluate(f, 2.0, at.cosines[j], at.sines[j], F + at.stages[j], at)
        # derivatives with respect to x, v and force, and below with respect to the parameters
        rates, outputs = o + at.m + 6, o + at.m + 9
        by_rate = o + 4 * at.m + 2 * (1 + at.P) + 1
        by_output = by_rate + 1 + at.P
        at.slopes[j], at.last[j], at.output[j] = w[rates + 2] / omega, w[outputs + 2], w[o + 3]
        for z in range(columns):
            value, explicit = 0.0, 0.0
            if z == 1:
                value = (w[rates] * w[1] + w[rates + 1] * w[2]) / (at.numbers[0] * omega)
                explicit = (w[outputs] * w[1] + w[outputs + 1] * w[2]) / at.numbers[0]
            elif z > 1 and at.chosen[z - 2] < at.P:
                value = w[by_rate + at.chosen[z - 2]] / omega
                explicit = w[by_output + at.chosen[z - 2]]
            at.changes[j, z], at.explicit[j, z] = value, explicit
    remove_pole(at.slopes, 0, 1, at.rates, 0, 1)
    for j in range(STAGES):
        for z in range(columns):
            at.changes[j, z] += at.slopes[j] * at.S[z]
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
        for a in range(at.harmonics.size):
            while power < at.harmonics[a]:
                turn *= phasor
                power += 1
            at.sums[a, 0] += at.output[j] * turn
            for z in range(columns):
                value = at.last[j] * (at.S[z] + at.columns[j, z]) + at.explicit[j, z]
                at.sums[a, 1 + z] += value * turn
    return True
