"""Settled loops of laws with one state, under a sine of displacement.

The settled force at the turning point is the fixed point of a cycle. It is solved by Newton's
method with the derivative of the cycle, from a guess by the loops at smaller amplitudes. The steps
of a half cycle (:mod:`dahl_ident.engine.loop_step`) are as long as their error allows, and end at
every kink of the law. A law that is the same in both directions needs half a cycle. The last pass
gives the harmonics and all derivatives.

A gap in the link to the law is crossed at zero force, where the angle jumps. The gap is then the
last of the parameters; the law's function does not have it.
"""

from __future__ import annotations

import numpy as np
from numba import boolean, complex128, float64, njit, types

from dahl_ident.engine.loop_step import (
    Work,
    choose_sides,
    cross_gap,
    error_of,
    evaluate,
    event_at,
    first_event,
    guess_stages,
    last_step,
    pass_switch,
    passed_before,
    reached_zero,
    slope_fades,
    solve_stages,
)
from dahl_ident.engine.radau import GROW, SAFETY, SHRINK
from dahl_ident.engine.stages import (
    FUNCTION,
    MATRIX,
    NUMBERS,
    SHORTEST,
    STAGES,
    TABLE,
    VECTOR,
    compiled,
)

_LOCATED = 1e-14  # rad: shorter steps count as zero
_MOST = 500  # steps of a half cycle, in addition to those for the highest harmonic
_SHOTS = 60  # of shooting with coarse steps; one is typical, three without a guess
# Changes of the initial force over the largest force:
_CONVERGED = 1e-5  # with coarse steps; the error is its square
_LAST_PASS = 1e-7  # in the last pass: derivatives have errors of this size
_PREDICTED = 1e-6  # second-order part of a guess whose error is below _LAST_PASS
_AGREED = 1e-3  # a larger change by the last pass means that nothing settles
_COARSE = 10.0  # errors of steps while shooting, over those of the last pass
_BEYOND_BOUNDS = 1e200  # N: far beyond any force
_FIRST_STEP = 0.05  # rad, guess of the first step after a turning point
_EXPANDS = 3.0  # largest ln of a step's growth; steps controlled by the error grow less
_PASSES = 4  # with fine steps, if coarse ones ended elsewhere; one is typical
_REPEATS, _BISECTIONS = 8, 60  # of a step that ends at an event; two are typical
_APPROACH = 0.6  # of the way to the turning point: largest step if a law depends on the speed
_NEAREST = 1e-3  # rad before the turning point: the last such step


@compiled
def _half_cycle(f, F, gap, last_pass, first, at):
    """Return the force at the end of a half cycle and its first step, 0 if the end is not reached.

    The sensitivities in `at` are integrated too: one column, or all in the last pass.
    """
    columns = 2 + at.chosen.size if last_pass else 1
    tolerance = at.tolerance if last_pass else _COARSE * at.tolerance
    longest = at.longest if last_pass else np.pi
    w, o, omega, heading = at.w, at.o, at.numbers[1], at.numbers[2]
    w[5] = heading
    turned = -heading
    psi, last, step, stuck, after_turn = 0.0, 0.0, first, 0, 0.0
    w[6 : 6 + at.k] = heading
    choose_sides(f, 1.0, 0.0, F, at)
    crossing, new_branch, output, rate = gap > 0.0, True, 0.0, 0.0
    event, tries, low, high, h = -1, 0, 0.0, 0.0, 0.0
    if crossing and heading * F >= 0.0:
        psi = cross_gap(f, gap, psi, columns, at)
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
            evaluate(f, 0.0, np.cos(psi), np.sin(psi), F, at)
            rate, output = w[o + 2] / omega, w[o + 3]
            for i in range(at.k):
                at.before[i] = w[o + 4 + i]
            new_branch, last = False, 0.0
        guess_stages(h, last if tries == 0 else 0.0, rate, at)
        if not solve_stages(f, psi, h, F, at):
            if last > 0.0:
                last = 0.0
            else:
                step = 0.25 * h
                if step < _LOCATED:
                    return F, 0.0
            tries, event = 0, -1
            continue
        error = error_of(f, psi, h, F, output, at) / tolerance
        factor = min(GROW, max(SHRINK, SAFETY * (error + 1e-30) ** (-1.0 / (STAGES + 1))))
        if error > 1.0 and h > _LOCATED:
            step, last, tries, event = h * factor, 0.0, 0, -1
            continue
        if tries == 0:
            event, position = first_event(f, psi, h, F, crossing, at)
            if slope_fades(at):
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
            value, slope, side, near = event_at(f, psi + h, F + at.stages[STAGES - 1], event, at)
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
            other = passed_before(event, at)
            if other >= 0 and h > _LOCATED:
                event, low, high, tries = other, 0.0, h, 1
                h *= 0.5
                continue
        tries = 0
        if h > 0.0:
            stuck = 0
            if last_pass:
                if not last_step(f, h, F, columns, turned, at):
                    return F, 0.0
                for z in range(columns):
                    at.S[z] += at.columns[STAGES - 1, z]
            else:
                growth = 0.0
                for j in range(STAGES):
                    growth += h * MATRIX[STAGES - 1, j] * at.slopes[j]
                at.S[0] *= np.exp(growth) if growth < _EXPANDS else 0.0
            event = event if event >= 0 else reached_zero(at)
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
            psi = cross_gap(f, gap, psi, columns, at)
            crossing, F, new_branch = False, 0.0, True
        elif event >= 0:
            pass_switch(f, event, np.cos(psi), np.sin(psi), F, columns, at)
            new_branch = True
    return F, 0.0


@compiled
def _settle(f, y, sure, gap, halves, sign, at):
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
            at.sums[:] = 0.0
            for half in range(halves):
                at.numbers[2] = -1.0 if half == 0 else 1.0
                F, first = _half_cycle(f, F, gap, last_pass, at.steps[half], at)
                if first == 0.0:
                    return False, y, np.inf, 1.0
                at.steps[half] = first
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
    sums = np.zeros((harmonics.size, 1 + columns), dtype=np.complex128)
    highest = 1.0
    for h in harmonics:
        highest = max(highest, float(h))
    longest = 2.0 * np.pi / (SHORTEST * highest)
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
        chosen,
        harmonics,
        sums,
        tolerance,
        longest,
        np.full(2, _FIRST_STEP),
    )
    converged = np.zeros(rows, dtype=np.int64)
    result = np.zeros((rows, harmonics.size, columns), dtype=np.complex128)
    tops, decays = np.zeros(rows), np.zeros(rows)
    sign, halves = (-1.0, 1) if odd else (1.0, 2)
    last, rise, older, older_rise = -1, 0.0, 0.0, 0.0
    for row in range(rows):
        amplitude, gap = amplitudes[row], parameters[row, P] if gaps else 0.0
        if 2.0 * amplitude <= gap:
            converged[row] = 1
            continue
        at.w[6 + k : 6 + k + P] = parameters[row, :P]
        at.w[0] = -1.0
        f(at.w.ctypes)
        at.numbers[0], at.numbers[1] = amplitude, omegas[row]
        y, sure, guessed = 0.0, False, last >= 0 and _continues(row, last, omegas, parameters)
        if guessed:
            increase, bend = amplitude - amplitudes[last], 0.0
            if older > 0.0:  # from the slopes at the two amplitudes before this one
                bend = 0.5 * (rise - older_rise) / (amplitudes[last] - older)
            y = tops[last] + increase * (rise + increase * bend)
            sure = older > 0.0 and abs(increase * increase * bend) <= _PREDICTED * abs(tops[last])
        else:
            last = -1
            at.steps[:] = _FIRST_STEP
        settles, y, change, one_minus_map = _settle(f, y, sure, gap, halves, sign, at)
        if guessed and not settles:
            at.steps[:] = _FIRST_STEP
            settles, y, change, one_minus_map = _settle(f, 0.0, False, gap, halves, sign, at)
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
