"""Where the velocity or a switching function passes through zero, and what changes there.

A step is shortened to end at the event, and the next one begins on the other branch of the laws;
sensitivities jump where the rates do. Arguments are those of :mod:`dahl_ident.engine.radau`.
"""

from __future__ import annotations

import numpy as np

from dahl_ident.engine.radau import (
    NEAR,
    NODES,
    STAGES,
    compiled,
    evaluate,
    put,
    put_place,
    read_stage,
    shorten,
    signal_at,
    solve_stages,
)

LOCATED = 1e-13  # of the span: shorter steps, and times that differ by less, are none
DECADE, LEFT = 0.1, 1e-11  # of the distance to a limit: left after a step; at the end
FADED = 0.6  # of a slope after a step that comes so near
_BISECTIONS = 60
_AT_REST = 1e-14  # of the largest velocity: rounding
_SMALL = 1e-6  # of a state, or of a step: nothing has changed
_REPEATS = 12  # of a step that is shortened to an event; two are the rule
PLACES = np.concatenate(
    [a + (b - a) * np.arange(1, 5) / 4 for a, b in zip([0.0, *NODES[:-1]], NODES, strict=True)]
)
_POWERS = np.arange(STAGES + 1)
WITHIN = PLACES[:, None] ** _POWERS @ np.linalg.inv(np.append(0.0, NODES)[:, None] ** _POWERS)
"""Weights of values at the beginning and the stages in those at the places between them."""


@compiled
def choose_branch(f, signal, t, y, w, at):
    """Set direction and sides at a state; where a function is zero, what it is about to become."""
    put(y, w)
    evaluate(f, signal, t, 1.0, w, at)
    size = w[at.scale + 1]
    if at.held and signal.sine:
        size = abs(signal.omega * signal.amplitude)
    if abs(w[2]) > NEAR * size:
        w[at.sides] = np.sign(w[2])
    elif w[at.outputs + 1] != 0.0:
        w[at.sides] = np.sign(w[at.outputs + 1])
    choose_sides(f, signal, t, y, w, at)


@compiled
def choose_sides(f, signal, t, y, w, at):
    """Set the sides of the switches at a state, on the way in the present direction."""
    n, k, o = at.n, at.k, at.outputs
    for _ in range(2 if k else 0):  # the side of one may depend on that of another
        put(y, w)
        evaluate(f, signal, t, 1.0, w, at)
        for i in range(k):
            value, scale = w[o + n + 1 + i], at.scale + n + 1 + i
            w[scale] = max(w[scale], abs(value))
            if abs(value) > NEAR * w[scale]:
                w[at.sides + 1 + i] = np.sign(value)
                continue
            rate = slope_of(1 + i, w, at)
            if rate != 0.0:
                w[at.sides + 1 + i] = np.sign(rate)


@compiled
def slope_of(e, w, at):
    """Return the rate of change of the velocity (e = 0) or switching function e, from outputs."""
    o, n = at.outputs, at.n
    if e == 0:
        return w[o + 1]
    rate, row = 0.0, o + at.n + 1 + at.k + (n + e) * n
    for q in range(n):
        rate += w[row + q] * w[o + q]
    return rate


@compiled
def slope_at(f, signal, t, y, e, w, at):
    """Return the rate of change of switching function e at a state."""
    put(y, w)
    evaluate(f, signal, t, 1.0, w, at)
    return slope_of(e, w, at)


@compiled
def function_at(f, signal, t, h, y, place, e, w, at):
    """Return the velocity (e = 0) or switching function e at a place of the step."""
    put_place(y, place, w, at)
    evaluate(f, signal, t + place * h, 0.0, w, at)
    return w[2] if e == 0 else w[at.outputs + at.n + e]


@compiled
def goes_on(f, signal, t, h, y, e, w, at):
    """Return whether function e, near zero at the step's end, goes on to the other side.

    On its own branch it may rest there, as a force does that unloads at once.
    """
    put_place(y, 1.0, w, at)
    if e == 0 and (at.held or abs(w[2]) < _AT_REST * w[at.scale + 1]):
        return False
    w[at.sides + e] *= -1.0
    evaluate(f, signal, t + h, 1.0, w, at)
    w[at.sides + e] *= -1.0
    return slope_of(e, w, at) * w[at.sides + e] < 0.0


@compiled
def first_event(f, signal, t, h, y, w, at):
    """Return which function passes through zero first in the step, or -1, and at which place.

    A function is looked at by its polynomial between the stages; where it is smallest, itself.
    """
    n, m = at.n, at.n + 1 + at.k
    which, where = -1, 1.0
    for e in range(1 if at.held and signal.sine else 0, at.k + 1):
        side, row = w[at.sides + e], n + e if e else 1
        if side == 0.0:
            continue
        near = NEAR * w[at.scale + row]
        older, old, low, middle = np.inf, w[at.before + e] * side, 0.0, 0.0
        for i in range(WITHIN.shape[0]):
            high, value = PLACES[i], WITHIN[i, 0] * w[at.before + e] * side
            for j in range(STAGES):
                there = w[at.values + j * m + row] if e else y[1] + w[at.stages + j * n + 1]
                value += WITHIN[i, 1 + j] * there * side
            crossed = value < -near
            if not crossed and i and older > old < value and 2.0 * old < older + value:
                one, two = (old - older) / (middle - low), (value - old) / (high - middle)
                least = 0.5 * (low + middle - one * (high - low) / (two - one))
                crossed = function_at(f, signal, t, h, y, least, e, w, at) * side < -near
                high = least if crossed else high
            else:
                low = middle
            if not crossed and high == 1.0 and value <= 0.0 < w[at.before + e] * side:
                crossed, low = goes_on(f, signal, t, h, y, e, w, at), 0.0
            if not crossed:
                older, old, low, middle = old, value, middle, high
                continue
            if low == 0.0 and w[at.before + e] * side <= 0.0:  # zero first: does it rise?
                low = 1e-3 * high
                if function_at(f, signal, t, h, y, low, e, w, at) * side <= 0.0:
                    return e, 0.0
            for _ in range(_BISECTIONS):
                if low >= where or high - low < 1e-9:
                    break
                half = 0.5 * (low + high)
                if function_at(f, signal, t, h, y, half, e, w, at) * side >= 0.0:
                    low = half
                else:
                    high = half
            if high < where:
                which, where = e, high
            break
    return which, where


@compiled
def falls(place, y, w, at):
    """Return whether a state has changed at a place of a step that takes no time."""
    put_place(y, place, w, at)
    for r in range(at.n):
        size = max(abs(y[r]), w[at.scale + r])
        if size > 0.0 and abs(w[1 + r] - y[r]) > _SMALL * size:
            return True
    return False


@compiled
def fades(solved, y, w, at):
    """Return whether a rate dies away with a switching function by more than a step resolves.

    Where a force comes to its limit as a power of the distance left, errors stay.
    """
    n, late = at.n, (STAGES - 2) * (at.n + 1 + at.k)
    one, other = y[1] + w[at.stages + 1], y[1] + w[at.stages + (STAGES - 2) * n + 1]
    for e in range(1, at.k + 1):
        row, side = at.values + n + e, w[at.sides + e]
        old, new = w[row] * side, w[row + late] * side
        for r in solved if old > LEFT * w[at.scale + n + e] and new < DECADE * old else solved[:0]:
            if abs(w[at.values + late + r] * one) < FADED * abs(w[at.values + r] * other):
                return True
    return False


@compiled
def step_to_event(
    f, solved, followers, signal, t, h, share, e, y, span, w, at, matrix, columns
):  # fmt: skip
    """Solve for the step that ends where function e is zero; return its length, and whether it is.

    The length is 0 where there is no such step. Where the function is no longer zero in the step,
    because it hardly was and the shorter step is more accurate, the step ends before it.
    """
    length = share * h
    shorten(share, w, at)
    row = at.n + e if e else 1
    value, change, near = 0.0, np.inf, NEAR * w[at.scale + row]
    for _ in range(_REPEATS):
        if not solve_stages(f, solved, followers, signal, t, length, y, w, at, matrix, columns):
            return 0.0, False
        read_stage(f, solved, followers, 1, STAGES - 1, y, w, at)
        value, slope = w[2] if e == 0 else w[at.outputs + at.n + e], slope_of(e, w, at)
        if value == 0.0:
            return length, True
        change = -value / slope if slope != 0.0 else np.inf
        if abs(change) <= max(min(1e-15 * span, _SMALL * length), 1e-12 * length):  # rounding
            return length, True
        if not 0.0 < length + change <= h:
            break
        change = max(change, -0.5 * length)
        shorten(1.0 + change / length, w, at)
        length += change
    if abs(value) <= near or abs(change) <= min(LOCATED * span, _SMALL * length):
        return length, True
    return (length if value * w[at.sides + e] > 0.0 else 0.0), False


@compiled
def passed_another(e, w, at):
    """Return whether, where function e was found to be zero, another one has passed through it."""
    for j in range(at.k + 1):
        row = at.n + j if j else 1
        value = w[at.outputs + at.n + j] if j else w[2]
        near, side = NEAR * w[at.scale + row], w[at.sides + j]
        if j != e and value * side < -near and w[at.before + j] * side > near:
            return True
    return False


@compiled
def pass_event(f, signal, t, e, y, S, first, chosen, w, at):
    """Change the branch where function e is zero; sensitivities jump where the rates do."""
    n, o, q = at.n, at.outputs, S.shape[1]
    m = n + 1 + at.k
    moves = q > 0 and (e > 0 or not at.held)  # turning points of a held motion do not move
    if e == 0 and not at.held:
        y[1] = 0.0
    if moves:
        put(y, w)
        evaluate(f, signal, t, 2.0, w, at)
        for r in range(n):
            w[at.jump + r] = w[o + r]
        w[at.late : at.late + q] = 0.0
        slope, row = slope_of(e, w, at), o + m * (1 + n) + (n + e) * (1 + at.P)
        along = np.cos(signal.omega * t) if signal.sine else signal_at(signal, t, w, at)[1]
        for z in range(q if slope != 0.0 else 0):
            value = 0.0
            if e == 0:
                value = S[1, z]
            else:
                for b in range(n):
                    value += w[o + m + (n + e) * n + b] * S[b, z]
                if z > first:
                    value += w[row + 1 + chosen[z - first - 1]]
                elif z == first and not at.held:
                    value += w[row] * along
            w[at.late + z] = -value / slope
    if e > 0:  # others may be zero here too, such as y < a and y >= a
        slope_at(f, signal, t, y, e, w, at)
        for j in range(1, 1 + at.k):
            zero = abs(w[o + n + j]) <= NEAR * w[at.scale + n + j]
            if j != e and zero and slope_of(j, w, at) * w[at.sides + j] < 0.0:
                w[at.sides + j] *= -1.0
    w[at.sides + e] *= -1.0
    if e == 0:
        choose_sides(f, signal, t, y, w, at)
    else:
        rate, row = slope_at(f, signal, t, y, e, w, at), at.scale + n + e
        if rate == 0.0:  # it stays as rounding left it, and counts as zero
            w[row] = max(w[row], 2.0 * abs(w[o + n + e]) / NEAR)
        # both branches lead here, and not because nothing moves
        if rate * w[at.sides + e] <= 0.0 and abs(w[2]) > NEAR * w[at.scale + 1]:
            side, w[at.sides + e] = w[at.sides + e], 0.0
            if slope_at(f, signal, t, y, e, w, at) != 0.0:
                w[at.sides + e] = side
    if moves:
        put(y, w)
        evaluate(f, signal, t, 0.0, w, at)
        for r in range(n):
            jump = w[at.jump + r] - w[o + r]
            for z in range(q if jump != 0.0 else 0):
                S[r, z] += jump * w[at.late + z]
