"""Events: zeros of the velocity or of a switching function, and the change of branch there.

A step is shortened to end at the event, and the next one begins on the other branch of the laws;
sensitivities jump where the rates do. Arguments are those of :mod:`dahl_ident.engine.radau`.
"""

from __future__ import annotations

import numpy as np

from dahl_ident.engine.radau import (
    NEAR,
    evaluate,
    put_interpolated,
    put_states,
    read_stage,
    shorten,
    signal_at,
    solve_stages,
)
from dahl_ident.engine.stages import POSITIONS, STAGES, VALUE_AT, compiled

LOCATED = 1e-13  # of the span: shorter steps, and smaller differences of time, count as zero
# Distances to a limit over that at the beginning of a step, and over the largest one:
DECADE = 0.1  # a step that ends nearer is checked for a slope that fades
LEFT = 1e-11  # at a smaller distance the limit counts as reached
FADED = 0.6  # share of the slope left after such a step, below which it fades
_BISECTIONS = 60
_VELOCITY_ROUNDING = 1e-14  # of the largest velocity: rounding
_NO_CHANGE = 1e-6  # relative change of a state, or of a step, that counts as none
_SHORTENINGS = 12  # of a step that is shortened to an event; two are typical


@compiled
def choose_branch(f, signal, t, y, w, at):
    """Set the direction and the sides at a state; a zero counts as what it is about to become."""
    put_states(y, w)
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
    """Set the sides of the switches at a state, for motion in the present direction."""
    n, k, o = at.n, at.k, at.outputs
    for _ in range(2 if k else 0):  # the side of one switch may depend on that of another
        put_states(y, w)
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
    put_states(y, w)
    evaluate(f, signal, t, 1.0, w, at)
    return slope_of(e, w, at)


@compiled
def function_at(f, signal, t, h, y, position, e, w, at):
    """Return the velocity (e = 0) or switching function e at a position of the step."""
    put_interpolated(y, position, w, at)
    evaluate(f, signal, t + position * h, 0.0, w, at)
    return w[2] if e == 0 else w[at.outputs + at.n + e]


@compiled
def crosses_over(f, signal, t, h, y, e, w, at):
    """Return whether function e, near zero at the step's end, continues to the other side.

    On the present branch it may stay at zero, as a force does that unloads immediately.
    """
    put_interpolated(y, 1.0, w, at)
    if e == 0 and (at.held or abs(w[2]) < _VELOCITY_ROUNDING * w[at.scale + 1]):
        return False
    w[at.sides + e] *= -1.0
    evaluate(f, signal, t + h, 1.0, w, at)
    w[at.sides + e] *= -1.0
    return slope_of(e, w, at) * w[at.sides + e] < 0.0


@compiled
def first_event(f, signal, t, h, y, w, at):
    """Return which function passes through zero first in the step, or -1, and at which position.

    The polynomials through the stages are examined; at their minima, the functions themselves.
    """
    n, m = at.n, at.n + 1 + at.k
    which, where = -1, 1.0
    for e in range(1 if at.held and signal.sine else 0, at.k + 1):
        side, row = w[at.sides + e], n + e if e else 1
        if side == 0.0:
            continue
        near = NEAR * w[at.scale + row]
        older, old, low, middle = np.inf, w[at.before + e] * side, 0.0, 0.0
        for i in range(VALUE_AT.shape[0]):
            high, value = POSITIONS[i], VALUE_AT[i, 0] * w[at.before + e] * side
            for j in range(STAGES):
                stage = w[at.values + j * m + row] if e else y[1] + w[at.stages + j * n + 1]
                value += VALUE_AT[i, 1 + j] * stage * side
            crossed = value < -near
            if not crossed and i and older > old < value and 2.0 * old < older + value:
                slope1, slope2 = (old - older) / (middle - low), (value - old) / (high - middle)
                minimum = 0.5 * (low + middle - slope1 * (high - low) / (slope2 - slope1))
                crossed = function_at(f, signal, t, h, y, minimum, e, w, at) * side < -near
                high = minimum if crossed else high
            else:
                low = middle
            if not crossed and high == 1.0 and value <= 0.0 < w[at.before + e] * side:
                crossed, low = crosses_over(f, signal, t, h, y, e, w, at), 0.0
            if not crossed:
                older, old, low, middle = old, value, middle, high
                continue
            if low == 0.0 and w[at.before + e] * side <= 0.0:  # does it rise from zero?
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
def reached_zero(y, w, at):
    """Return a switching function that has come to zero at the step's end to stay, or -1.

    Rounding takes it beyond zero, where the present branch would lead further away.
    """
    end = STAGES - 1
    if abs(y[1] + w[at.stages + end * at.n + 1]) <= NEAR * w[at.scale + 1]:
        return -1
    values = at.values + end * (at.n + 1 + at.k) + at.n
    for e in range(1, at.k + 1):
        if w[values + e] * w[at.sides + e] <= 0.0 < w[at.before + e] * w[at.sides + e]:
            return e
    return -1


@compiled
def state_jumps(position, y, w, at):
    """Return whether a state has changed by a position in a step that takes no time."""
    put_interpolated(y, position, w, at)
    for r in range(at.n):
        size = max(abs(y[r]), w[at.scale + r])
        if size > 0.0 and abs(w[1 + r] - y[r]) > _NO_CHANGE * size:
            return True
    return False


@compiled
def slope_fades(solved, y, w, at):
    """Return whether a rate decreases with a switching function by more than a step resolves.

    If a force approaches its limit as a power of the remaining distance, errors do not decay.
    """
    n, late = at.n, (STAGES - 2) * (at.n + 1 + at.k)
    v_first, v_late = y[1] + w[at.stages + 1], y[1] + w[at.stages + (STAGES - 2) * n + 1]
    for e in range(1, at.k + 1):
        row, side = at.values + n + e, w[at.sides + e]
        old, new = w[row] * side, w[row + late] * side
        for r in solved if old > LEFT * w[at.scale + n + e] and new < DECADE * old else solved[:0]:
            if abs(w[at.values + late + r] * v_first) < FADED * abs(w[at.values + r] * v_late):
                return True
    return False


@compiled
def step_to_event(f, solved, followers, signal, t, h, position, e, y, span, w, at, matrix, columns):
    """Solve for a step that ends at a zero of function e; return its length, and whether it does.

    The length is 0 if there is no such step. If the more accurate shorter step shows that the
    function hardly reaches zero, the step ends before that.
    """
    length = position * h
    shorten(position, w, at)
    row = at.n + e if e else 1
    value, change, near = 0.0, np.inf, NEAR * w[at.scale + row]
    for _ in range(_SHORTENINGS):
        if not solve_stages(f, solved, followers, signal, t, length, y, w, at, matrix, columns):
            return 0.0, False
        read_stage(f, solved, followers, 1, STAGES - 1, y, w, at)
        value, slope = w[2] if e == 0 else w[at.outputs + at.n + e], slope_of(e, w, at)
        if value == 0.0:
            return length, True
        change = -value / slope if slope != 0.0 else np.inf
        if abs(change) <= max(min(1e-15 * span, _NO_CHANGE * length), 1e-12 * length):  # rounding
            return length, True
        if not 0.0 < length + change <= h:
            break
        change = max(change, -0.5 * length)
        shorten(1.0 + change / length, w, at)
        length += change
    if abs(value) <= near or abs(change) <= min(LOCATED * span, _NO_CHANGE * length):
        return length, True
    return (length if value * w[at.sides + e] > 0.0 else 0.0), False


@compiled
def passed_another(e, w, at):
    """Return whether another function has passed through zero before the zero of function e."""
    for j in range(at.k + 1):
        row = at.n + j if j else 1
        value = w[at.outputs + at.n + j] if j else w[2]
        near, side = NEAR * w[at.scale + row], w[at.sides + j]
        if j != e and value * side < -near and w[at.before + j] * side > near:
            return True
    return False


@compiled
def pass_event(f, signal, t, e, y, S, first, chosen, w, at):
    """Change the branch at a zero of function e; sensitivities jump where the rates do."""
    n, o, q = at.n, at.outputs, S.shape[1]
    m = n + 1 + at.k
    moves = q > 0 and (e > 0 or not at.held)  # the times of a held motion's turning points do not
    if e == 0 and not at.held:
        y[1] = 0.0
    if moves:
        put_states(y, w)
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
    if e > 0:  # other functions may be zero here too, such as those of y < a and y >= a
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
        if rate == 0.0:  # the function keeps a value that is rounding, and counts as zero
            w[row] = max(w[row], 2.0 * abs(w[o + n + e]) / NEAR)
        # both branches lead to the event, and not because nothing moves
        if rate * w[at.sides + e] <= 0.0 and abs(w[2]) > NEAR * w[at.scale + 1]:
            side, w[at.sides + e] = w[at.sides + e], 0.0
            if slope_at(f, signal, t, y, e, w, at) != 0.0:
                w[at.sides + e] = side
    if moves:
        put_states(y, w)
        evaluate(f, signal, t, 0.0, w, at)
        for r in range(n):
            jump = w[at.jump + r] - w[o + r]
            for z in range(q if jump != 0.0 else 0):
                S[r, z] += jump * w[at.late + z]
