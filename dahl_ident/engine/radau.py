"""One Radau IIA step on one branch of the laws, with its error and exact sensitivities.

The method is collocation at five Radau points: order 9, stiffly accurate and L-stable, so that
the number of steps grows with neither A/x_c nor the speed of the friction. Sensitivities are the
exact derivatives of the stages, from one more factorization for each step.

States that follow the displacement (:class:`dahl_ident.engine.translate.System`) are not solved
for, because they change in proportion to it during a step. Neither is the displacement of a driven
plant, the integral of the velocity.

E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, 2nd ed., Springer 1996,
sections IV.5 and IV.8.

In the functions below `w` is one array of numbers, and `at` (:class:`Layout`) has the index at
which each quantity begins: numba takes longer to pass twenty arrays than to compute with them. `y`
are the states, `S` their sensitivities. Their columns are derivatives with respect to the initial
states; to the amplitude of a sine, or the time by which another drive comes earlier (column
`first`); and to the parameters `chosen`.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from dahl_ident.engine.stages import (
    CHECKED,
    FACTORS,
    MATRIX,
    NODES,
    SLOPE_BEFORE,
    SLOPE_CHECKED,
    STAGES,
    VALUE_BEFORE,
    compiled,
    eliminate,
    inlined,
    remove_pole,
)

SHRINK, GROW, SAFETY = 0.1, 6.0, 0.8  # limits and safety of the factor to the next step
_STAGE_ITERATIONS = 20  # of the stages; two of Newton's method are typical
# Relative changes of the stages in an iteration:
_NEAR, _FAST = 1e-2, 0.2  # largest first one of fixed-point iterations, and largest ratio of two
_FIXED_POINT = 1e-11  # last one of fixed-point iterations, whose error is a tenth of it
SOLVED = 1e-7  # last one of Newton's method, whose error is rounding: its square
_HARDLY = 1e-6  # of the displacement: a smaller follower is no scale for errors
NEAR = 1e-10  # of a switching function's largest value: counts as zero
SIDED = 0.1  # largest relative change of a switching function whose sign is certain

Signal = namedtuple("Signal", "sine amplitude omega knots coefficients")
"""The drive, or the displacement if that is held.

A sine ``amplitude cos(omega t)``, or polynomials between knots in the position, 0 to 1, with
coefficients of shape (degree + 1, n - 1).
"""

Layout = namedtuple(
    "Layout",
    "n k P held rated degree outputs values rates state_slopes drive_slopes solved_slopes coupling "
    "follow follow_slopes stages last changes scale sides before output weights jump late signal "
    "stiff interval length",
)
"""Numbers of states, switches, parameters; then the index in `w` at which each quantity begins."""
LAYOUT = types.NamedUniTuple(types.int64, len(Layout._fields), Layout)


def layout(sizes: NDArray[np.int64], columns: int, degree: int) -> Layout:
    """Return the layout for the sizes of a system, columns of sensitivities, degree of a signal."""
    n, k, P, held, rated, prepared = sizes.tolist()
    m, s = n + 1 + k, STAGES
    counts = (
        3 + n + k + P + prepared,  # inputs of the function
        m * (2 + n + P),  # its outputs
        s * m,  # values: rates, output and switching functions at stages, (s, m)
        n,  # rates at the beginning
        s * m * n,  # d values / d states, (s, m, n)
        s * m * (1 + P),  # d values / d drive and parameters, (s, m, 1 + P)
        s * n * n,  # d solved rates / d solved states, (s, n, n)
        s * n,  # coupling: d solved rates / d x, followers included, (s, n)
        n,  # d followers / d x
        n * (1 + P),  # their derivatives with respect to drive and parameters
        s * n,  # changes of the states up to the stages, (s, n)
        s * n,  # those of the last step
        s * n * columns,  # changes of the sensitivities up to the stages, (s, n, columns)
        m,  # scale: largest size of each of the values
        1 + k,  # sides: direction of the motion, then sides of the switches
        1 + k,  # velocity and switching functions at the beginning
        1,  # output at the beginning
        s,  # weights of the stages in a polynomial's value
        n,  # jump: rates before an event
        columns,  # derivatives of the time of an event
        3 * s,  # value, rate and second derivative of the signal at the stages, (s, 3)
        1,  # 1 where fixed-point iterations did not converge, until an event
        4 + degree + 1,  # the signal's interval: number, begin, end, 1 if pinned, coefficients
    )
    return Layout(n, k, P, held, rated, degree, *np.cumsum(counts).tolist())


@compiled
def restart(w, at):
    """Reset all that is stored of an earlier motion."""
    w[at.outputs :] = 0.0
    w[at.sides : at.sides + 1 + at.k] = 1.0
    w[at.interval] = -1.0


@compiled
def put_parameters(f, p, w, at):
    """Put parameters into the inputs, with all quantities that depend on them only."""
    for i in range(at.P):
        w[3 + at.n + at.k + i] = p[i]
    w[0] = -1.0
    f(w.ctypes)


@compiled
def find_interval(signal, t, w, at):
    """Store the signal's polynomial at time t."""
    knots, i = signal.knots, max(0, int(w[at.interval]))
    while i + 2 < knots.size and t > knots[i + 1]:
        i += 1
    while i > 0 and t < knots[i]:
        i -= 1
    keep_interval(signal, i, w, at)


@compiled
def keep_interval(signal, i, w, at):
    """Store the signal's polynomial in interval i."""
    w[at.interval] = i
    w[at.interval + 1], w[at.interval + 2] = signal.knots[i], signal.knots[i + 1]
    for j in range(at.degree + 1):
        w[at.interval + 4 + j] = signal.coefficients[j, i]


@inlined
def signal_at(signal, t, w, at):
    """Return value, rate and second derivative of the signal."""
    if signal.sine:
        c, s = np.cos(signal.omega * t), np.sin(signal.omega * t)
        a = signal.amplitude
        return a * c, -a * signal.omega * s, -a * signal.omega * signal.omega * c
    i = at.interval
    if w[i] < 0.0 or (w[i + 3] == 0.0 and not w[i + 1] <= t <= w[i + 2]):
        find_interval(signal, t, w, at)
    width = w[i + 2] - w[i + 1]
    x = (t - w[i + 1]) / width
    value, rate, second = 0.0, 0.0, 0.0
    for j in range(at.degree, -1, -1):
        second = second * x + 2.0 * rate
        rate = rate * x + value
        value = value * x + w[i + 4 + j]
    return value, rate / width, second / (width * width)


@inlined
def evaluate(f, signal, t, level, w, at):
    """Evaluate the function at time t and the states in the inputs; a held motion replaces them."""
    value, rate, second = signal_at(signal, t, w, at)
    call(f, value, rate, second, level, w, at)


@inlined
def call(f, value, rate, second, level, w, at):
    """Evaluate the function at the states in the inputs, with the signal's value and slopes."""
    n = at.n
    if at.held:
        w[1] = value
        w[2] = rate
    else:
        w[1 + n] = value
    w[0] = level
    for i in range(1 + at.k):
        w[2 + n + i] = w[at.sides + i]
    f(w.ctypes)
    if at.held:
        w[at.outputs] = rate
        w[at.outputs + 1] = second


@compiled
def put_states(y, w):
    """Put states into the inputs."""
    for q in range(y.size):
        w[1 + q] = y[q]


@compiled
def at_unit_velocity(f, signal, t, y, w, at):
    """Evaluate the function at the states y and unit velocity, so that rates are d / d x."""
    put_states(y, w)
    evaluate(f, signal, t, 0.0, w, at)
    w[0], w[2] = 2.0, 1.0
    f(w.ctypes)


@compiled
def put_interpolated(y, position, w, at):
    """Put the state at a position of the step, 0 to 1, into the inputs."""
    set_weights(position, w, at)
    for q in range(at.n):
        value = y[q]
        for j in range(STAGES):
            value += w[at.weights + j] * w[at.stages + j * at.n + q]
        w[1 + q] = value


@compiled
def set_weights(position, w, at):
    """Set the weights of the changes at the stages in the change at a position, 0 to 1."""
    for j in range(STAGES):
        value = position * FACTORS[j]
        for k in range(STAGES):
            if k != j:
                value *= position - NODES[k]
        w[at.weights + j] = value


@inlined
def copy(w, target, source, count):
    """Copy `count` numbers within w, from one index to another."""
    to, numbers = w[target : target + count], w[source : source + count]
    for z in range(count):
        to[z] = numbers[z]


@inlined
def add(target, start, factor, source, first, count):
    """Add `factor` times `count` numbers of `source` to those of `target`, each from an index."""
    to, numbers = target[start : start + count], source[first : first + count]
    for z in range(count):
        to[z] += factor * numbers[z]


@compiled
def guess_stages(h, last, w, at):
    """Extrapolate the stages from the last step's polynomial, or without one at constant rates."""
    n = at.n
    for i in range(STAGES):
        if last > 0.0:
            set_weights(1.0 + NODES[i] * h / last, w, at)
            for q in range(n):
                value = -w[at.last + (STAGES - 1) * n + q]
                for j in range(STAGES):
                    value += w[at.weights + j] * w[at.last + j * n + q]
                w[at.stages + i * n + q] = value
        else:
            for q in range(n):
                w[at.stages + i * n + q] = h * NODES[i] * w[at.rates + q]


@compiled
def shorten(fraction, w, at):
    """Set the stages to those of a fraction of the step, on the same polynomial."""
    n = at.n
    for i in range(STAGES * n):
        w[at.last + i] = w[at.stages + i]
    for i in range(STAGES):
        set_weights(fraction * NODES[i], w, at)
        for q in range(n):
            value = 0.0
            for j in range(STAGES):
                value += w[at.weights + j] * w[at.last + j * n + q]
            w[at.stages + i * n + q] = value


@compiled
def keep_signal(signal, t, h, w, at):
    """Store the signal at the stages."""
    for i in range(STAGES):
        s = at.signal + 3 * i
        w[s], w[s + 1], w[s + 2] = signal_at(signal, t + NODES[i] * h, w, at)


@compiled
def complete_stages(followers, h, y, w, at):
    """Set displacement and followers at the stages from the velocity, or from the held motion."""
    n, z = at.n, at.stages
    for i in range(STAGES):
        if at.held:
            w[z + i * n] = w[at.signal + 3 * i] - y[0]
            w[z + i * n + 1] = w[at.signal + 3 * i + 1] - y[1]
        else:
            moved = 0.0
            for k in range(STAGES):
                moved += MATRIX[i, k] * (y[1] + w[z + k * n + 1])
            w[z + i * n] = h * moved
        for b in followers:
            w[z + i * n + b] = w[at.follow + b] * w[z + i * n]


@compiled
def read_stage(f, solved, followers, level, i, y, w, at):
    """Evaluate the function at stage i, and store its outputs."""
    n, P, R, o = at.n, at.P, solved.size, at.outputs
    m = n + 1 + at.k
    for q in range(n):
        w[1 + q] = y[q] + w[at.stages + i * n + q]
    s = at.signal + 3 * i
    call(f, w[s], w[s + 1], w[s + 2], level, w, at)
    copy(w, at.values + i * m, o, m)
    for a in range(R if level else 0):
        row = o + m + solved[a] * n
        for b in range(R):
            w[at.solved_slopes + (i * R + a) * R + b] = w[row + solved[b]]
        value = w[row]
        for b in followers:
            value += w[row + b] * w[at.follow + b]
        w[at.coupling + i * R + a] = value
    if level == 2:
        copy(w, at.state_slopes + i * m * n, o + m, m * n)
        copy(w, at.drive_slopes + i * m * (1 + P), o + m * (1 + n), m * (1 + P))


@compiled
def fill_matrix(R, h, w, at, matrix):
    """Fill the matrix of the stages' linear equations for R solved states."""
    for i in range(STAGES):
        for j in range(STAGES):
            factor = -h * MATRIX[i, j]
            for a in range(R):
                for b in range(R):
                    slope = w[at.solved_slopes + (j * R + a) * R + b]
                    matrix[i * R + a, j * R + b] = factor * slope
        for a in range(R):
            matrix[i * R + a, i * R + a] += 1.0
    if at.held:
        return
    for a in range(R):  # the displacement is the integral of the velocity, the first solved state
        for i in range(STAGES):
            for k in range(STAGES):
                value = 0.0
                for j in range(STAGES):
                    value += MATRIX[i, j] * w[at.coupling + j * R + a] * MATRIX[j, k]
                matrix[i * R + a, k * R] -= h * h * value


@compiled
def solve_stages(f, solved, followers, signal, t, h, y, w, at, matrix, columns):
    """Solve for the stages of a step from a guess; False if the iterations do not converge.

    Fixed-point iterations are used if they converge fast, which the first ones show; otherwise
    Newton's method.
    """
    n, R, z = at.n, solved.size, at.stages
    m = n + 1 + at.k
    keep_signal(signal, t, h, w, at)
    complete_stages(followers, h, y, w, at)
    newton, before = w[at.stiff] > 0.0, _NEAR / _FAST
    for count in range(_STAGE_ITERATIONS):
        for i in range(STAGES):
            read_stage(f, solved, followers, 1 if newton else 0, i, y, w, at)
        if R == 0:
            return True
        for i in range(STAGES):
            for a in range(R):
                value = -w[z + i * n + solved[a]]
                for j in range(STAGES):
                    value += h * MATRIX[i, j] * w[at.values + j * m + solved[a]]
                columns[i * R + a, 0] = value
        if newton:
            fill_matrix(R, h, w, at, matrix)
            if not eliminate(matrix, columns, STAGES * R, 1):
                return False
        largest, total = 0.0, 0.0
        for a in range(R):
            r = solved[a]
            size, change = max(w[at.scale + r], abs(y[r])), 0.0
            for i in range(STAGES):
                change = max(change, abs(columns[i * R + a, 0]))
                total += abs(columns[i * R + a, 0])
                size = max(size, abs(w[z + i * n + r] + columns[i * R + a, 0]))
            if change > 0.0:
                largest = max(largest, change / size)
        if not newton and not (largest <= _FAST * before and total < np.inf):
            newton = True
            w[at.stiff] = 1.0 if count else 0.0
            continue
        if not total < np.inf:  # or NaN, which a maximum does not show
            return False
        before = largest
        for i in range(STAGES):
            for a in range(R):
                w[z + i * n + solved[a]] += columns[i * R + a, 0]
        complete_stages(followers, h, y, w, at)
        done = largest < (SOLVED if newton else _FIXED_POINT)
        for e in range(at.k if done and newton else 0):  # laws are least linear next to a switch
            size = w[at.scale + n + 1 + e]
            for i in range(STAGES):
                value = max(abs(w[at.values + i * m + n + 1 + e]), NEAR * size)
                done = done and largest * size <= SIDED * value
        if done:
            return True
    return False


@compiled
def error_of(f, solved, followers, dense, integrates_output, signal, t, h, y, w, at):
    """Return the error of the step's polynomials, over the largest sizes.

    For each state it is the difference between the slope of the polynomial and the rate: at the
    beginning, where it is of order 6 in the step, and larger than the error at the step's end; and
    before the first and the last stage, which detects changes of such short duration. If the output
    is integrated, the polynomial of its values at the stages is compared with it at the beginning.
    Followers count if the polynomials are read between the stages: if the step is `dense`.
    """
    largest, m = 0.0, at.n + 1 + at.k
    R = solved.size
    for i in range(-1, CHECKED.size):
        if i >= 0:
            put_interpolated(y, CHECKED[i], w, at)
            evaluate(f, signal, t + CHECKED[i] * h, 0.0, w, at)
        for a in range(R + (followers.size if dense else 0)):
            r = solved[a] if a < R else followers[a - R]
            change = -h * (w[at.outputs + r] if i >= 0 else w[at.rates + r])
            size = max(w[at.scale + r], abs(y[r]))
            if a >= R:  # a follower takes over the displacement's rounding
                size = max(size, _HARDLY * abs(w[at.follow + r]) * max(w[at.scale], abs(y[0])))
            for j in range(STAGES):
                moved = w[at.stages + j * at.n + r]
                change += (SLOPE_CHECKED[i, j] if i >= 0 else SLOPE_BEFORE[j]) * moved
                size = max(size, abs(y[r] + moved))
            if size > 0.0:
                largest = max(largest, abs(change) / size)
    if integrates_output:
        change = -w[at.output]
        size = max(w[at.scale + at.n], abs(change))
        for j in range(STAGES):
            value = w[at.values + j * m + at.n]
            change += VALUE_BEFORE[j] * value
            size = max(size, abs(value))
        if size > 0.0:
            largest = max(largest, abs(change) / size)
    return largest


@compiled
def sensitivities(f, solved, followers, signal, t, h, y, S, first, chosen, w, at, matrix, columns):
    """Set the changes of the sensitivities up to the stages of the solved step."""
    n, P, R, q, held = at.n, at.P, solved.size, S.shape[1], at.held
    m, d = n + 1 + at.k, at.changes
    for i in range(STAGES):
        read_stage(f, solved, followers, 2, i, y, w, at)
    for a in range(R):
        for b in range(n):
            remove_pole(w, at.state_slopes + solved[a] * n + b, m * n, w, at.values + b, m)
        for b in range(R):
            rate = at.values + solved[b]
            remove_pole(w, at.solved_slopes + a * R + b, R * R, w, rate, m)
    w[d : d + STAGES * n * q] = 0.0
    for i in range(STAGES):  # first the terms that do not depend on the solved states
        row, phase = d + i * n * q, signal.omega * (t + NODES[i] * h)
        if held:
            add(w, row, -1.0, S[0], 0, q)
            add(w, row + q, -1.0, S[1], 0, q)
            if signal.sine:
                w[row + first] += np.cos(phase)
                w[row + q + first] -= signal.omega * np.sin(phase)
        else:
            add(w, row, h * NODES[i], S[1], 0, q)
        for b in followers:
            add(w, row + b * q, w[at.follow + b], w, row, q)
            for z in range(chosen.size):
                slope = w[at.follow_slopes + b * (1 + P) + 1 + chosen[z]]
                w[row + b * q + first + 1 + z] += slope * w[at.stages + i * n]
        for a in range(R):
            target = row + solved[a] * q
            slopes = at.state_slopes + (i * m + solved[a]) * n
            drives = at.drive_slopes + (i * m + solved[a]) * (1 + P)
            for b in range(n):
                add(w, target, w[slopes + b], S[b], 0, q)
            add(w, target, w[slopes], w, row, q)
            if held:
                add(w, target, w[slopes + 1], w, row + q, q)
            for b in followers:
                add(w, target, w[slopes + b], w, row + b * q, q)
            for z in range(chosen.size):
                w[target + first + 1 + z] += w[drives + 1 + chosen[z]]
            if not held:
                along = np.cos(phase) if signal.sine else w[at.signal + 3 * i + 1]
                w[target + first] += w[drives] * along
    if R:
        columns[:] = 0.0
        for i in range(STAGES):
            for a in range(R):
                for j in range(STAGES):
                    row = d + (j * n + solved[a]) * q
                    add(columns[i * R + a], 0, h * MATRIX[i, j], w, row, q)
        fill_matrix(R, h, w, at, matrix)
        if not eliminate(matrix, columns, STAGES * R, q):
            return False
        for i in range(STAGES):
            for a in range(R):
                row = d + (i * n + solved[a]) * q
                w[row : row + q] = 0.0
                add(w, row, 1.0, columns[i * R + a], 0, q)
    if not held:
        for i in range(STAGES):
            for k in range(STAGES):
                factor, row = h * MATRIX[i, k], d + (k * n + 1) * q
                add(w, d + i * n * q, factor, w, row, q)
                for b in followers:
                    add(w, d + (i * n + b) * q, w[at.follow + b] * factor, w, row, q)
    return True
