"""The kernels called with arrays: settled motions under sines, and motions along samples."""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray
from dahl_ident.engine.translate import System
from dahl_ident.errors import FitError

# Tolerances of the error of a step's polynomial:
_SETTLED = 1e-6  # of settled motions; the error of harmonics is then below 1e-10
_SAMPLED = 5e-6  # of steps that end at samples; a hundredth of it if samples lie between
_LOOP = 1e-6  # of loops of laws with one state, over the local force
# Factors by which they are smaller:
_HELD = 10.0  # if the displacement is held: forces to 1e-9, and motions to 1e-8
_RATED = 10.0  # if the law depends on the speed: it changes most near rest
_CYCLES = 4  # from rest before Newton's method: a plant is then near its settled motion
_FINER_STEPS = 10.0  # factor: coarse steps may pass over two turning points that are close together
_LONG = 30  # cycles in which a motion leaves an unstable branch for a stable one
# runs of cycles without Newton's method, and cycles of each, more than the kernel computes
_LONG_RUNS, _ALL_CYCLES = 3, 1000
_KERNELS = ("stages", "radau", "events", "integrate", "samples", "cycle", "loop_step", "loop")


class Settled(NamedTuple):
    """Settled motions, or loops of laws, under ``amplitude cos(omega t)``; one row each.

    Attributes
    ----------
    found : ndarray of bool, shape (rows,)
    harmonics : ndarray of complex, shape (rows, K)
        c_k of the output, sum of Re c_k exp(j k omega t); c_0 is its mean. NaN where not found.
    by_amplitude : ndarray of complex, shape (rows, K)
    by_parameter : ndarray of complex, shape (rows, K, chosen)
    starts : ndarray, shape (rows, order)
        States at t = 0; of a loop the force alone.
    multiplier : ndarray, shape (rows,)
        Largest factor by which a small deviation grows in a cycle: the largest modulus of Floquet's
        multipliers. Above 1 a motion is unstable.
    maps : ndarray, shape (rows, order, order)
        Derivatives of the states after a cycle, or after half a cycle with the sign of an odd
        system, with respect to those at its beginning; empty for loops.
    """

    found: BoolArray
    harmonics: ComplexArray
    by_amplitude: ComplexArray
    by_parameter: ComplexArray
    starts: FloatArray
    multiplier: FloatArray
    maps: FloatArray = np.empty(0)


class Marched(NamedTuple):
    """A motion along samples.

    Attributes
    ----------
    output : ndarray, shape (n,)
    by_first : ndarray, shape (n, order)
        Derivatives of the output with respect to the first state.
    by_delay : ndarray, shape (n,)
        With respect to the time by which the drive comes later; zero if the motion is held.
    by_parameter : ndarray, shape (n, chosen)
    states : ndarray, shape (n, order)
    map : ndarray, shape (order, order)
        Derivatives of the last state with respect to the first.
    """

    output: FloatArray
    by_first: FloatArray
    by_delay: FloatArray
    by_parameter: FloatArray
    states: FloatArray
    map: FloatArray


def settled(
    system: System,
    amplitude: FloatArray,
    omega: FloatArray,
    parameters: FloatArray,
    *,
    chosen: Sequence[int] = (),
    harmonics: Sequence[int] = (1,),
    starts: FloatArray | None = None,
    cycles: int | None = None,
    finer: float = 1.0,
) -> Settled:
    """Return the settled motions of a system under sines, one for each row, by shooting.

    Derivatives are with respect to the parameters `chosen`. Shooting begins from the states
    `starts`, such as those of nearby parameters, or from rest. Newton's method begins after
    `cycles` cycles. The tolerance of a step's error is divided by `finer`.
    """
    from dahl_ident.engine.radau import layout  # numba is slow to import

    if cycles is None:
        cycles = 0 if starts is not None else 1 if system.held else _CYCLES
    first = np.zeros((amplitude.size, system.order)) if starts is None else starts
    columns = system.order - 2 * system.held + 1 + len(chosen)
    found, result, first, maps = _run(
        kernels("cycle").cycles,
        system.function,
        layout(system.sizes, columns, 0),
        system.solved,
        system.followers,
        system.odd,
        _numbers(amplitude),
        _numbers(omega),
        _numbers(parameters),
        _numbers(first),
        np.asarray(chosen, dtype=np.int64),
        np.asarray(harmonics, dtype=np.float64),
        cycles,
        _SETTLED / finer,
    )
    with np.errstate(invalid="ignore"):
        finite = found.astype(bool) & np.isfinite(maps).all(axis=(1, 2))
    moduli = np.abs(np.linalg.eigvals(maps[finite])).max(axis=1, initial=0.0)
    multiplier = np.full(found.size, np.nan)
    multiplier[finite] = moduli**2 if system.odd else moduli  # the map of half a cycle
    return _settled(found, result, first, multiplier, maps)


def steady_motions(
    system: System,
    parameters: FloatArray,
    omega: FloatArray,
    drive: FloatArray,
    *,
    chosen: Sequence[int] = (),
    harmonics: Sequence[int] = (1,),
    starts: FloatArray | None = None,
    cycles: int | None = None,
    again: bool = True,
    largest: float = np.inf,
    one_sided: bool = False,
) -> Settled:
    """Return the steady motions of a system at rows of parameters, frequency and drive.

    Each row begins from its states `starts` at t = 0, NaN for rest, and runs through `cycles`
    cycles before Newton's method; if that fails, it is started `again`, from rest. A motion with a
    multiplier above `largest` is rejected. If `one_sided`, the motion may differ in both directions
    even if the law does not: such motions come in pairs with the same fundamental if the symmetric
    motion is unstable.
    """
    rows, K = omega.size, len(harmonics)
    result = Settled(
        np.zeros(rows, dtype=np.bool_),
        np.full((rows, K), np.nan + 0j),
        np.full((rows, K), np.nan + 0j),
        np.full((rows, K, len(chosen)), np.nan + 0j),
        np.full((rows, system.order), np.nan),
        np.full(rows, np.nan),
    )

    def solve(
        which: BoolArray,
        starts: FloatArray | None = None,
        *runs: int | None,
        finer: float = 1.0,
        one_sided: bool = one_sided,
    ) -> None:
        """Put the motions of some rows into the result; each run begins where the last one ended.

        `runs` are the numbers of cycles before Newton's method.
        """
        solved = np.flatnonzero(which)
        if not solved.size:
            return
        symmetric = replace(system, odd=system.odd and not one_sided)
        states = None if starts is None else starts[solved]
        for count in runs or (None,):
            with np.errstate(all="ignore"):
                motions = settled(
                    symmetric,
                    drive[solved],
                    omega[solved],
                    parameters[solved],
                    chosen=chosen,
                    harmonics=harmonics,
                    starts=states,
                    cycles=count,
                    finer=finer,
                )
            states = motions.starts
        multiplier = result.multiplier[solved] = motions.multiplier
        with np.errstate(invalid="ignore"):
            good = multiplier <= largest
        # the first five fields of both tuples correspond
        for array, part in zip(result[:5], (good, *motions[1:5]), strict=True):
            array[solved[good]] = part[good]

    must_be_stable = largest < np.inf
    possible = np.isfinite(parameters).all(axis=1) & np.isfinite(omega) & np.isfinite(drive)
    if starts is not None:
        started = possible & np.isfinite(starts).all(axis=1)
        solve(started, starts, cycles)
        possible &= again | ~started
    solve(possible & ~result.found)
    unstable = np.isfinite(result.multiplier)
    failed = possible & ~result.found & ~unstable
    # in a search many rows may have no settled motion, and it would take long to try all again
    if must_be_stable or np.all(parameters == parameters[0]) or _FINER_STEPS * failed.sum() <= rows:
        solve(failed, finer=_FINER_STEPS)
    solve(possible & ~result.found & unstable, None, _LONG)
    if must_be_stable and system.odd:
        unstable = np.isfinite(result.multiplier)
        long_runs = (_ALL_CYCLES,) * (_LONG_RUNS if one_sided else 0)
        solve(possible & ~result.found & unstable, None, *long_runs, _LONG, one_sided=True)
    return result


def loops(
    system: System,
    amplitude: FloatArray,
    omega: FloatArray,
    parameters: FloatArray,
    *,
    chosen: Sequence[int] = (),
    harmonics: Sequence[int] = (1,),
    gap: bool = False,
    finer: float = 1.0,
) -> Settled:
    """Return the settled loops of a law with one state under sines of displacement.

    Arguments are those of :func:`settled`; harmonics must rise. If the link to the law has a `gap`,
    that is the last parameter.
    """
    found, result, tops, decays = kernels("loop").loops(
        system.function,
        system.sizes,
        system.odd,
        gap,
        _numbers(amplitude),
        _numbers(omega),
        _numbers(parameters),
        np.asarray(chosen, dtype=np.int64),
        np.asarray(harmonics, dtype=np.int64),
        _LOOP / finer / (_RATED if system.sizes[4] else 1.0),
    )
    return _settled(found, result, tops[:, None], decays)


def _settled(found: FloatArray, result: ComplexArray, *others: FloatArray) -> Settled:
    """Return the results of a kernel; NaN in rows in which nothing settles."""
    result[found == 0] = np.nan
    return Settled(found.astype(bool), result[..., 0], result[..., 1], result[..., 2:], *others)


def march(
    system: System,
    knots: FloatArray,
    coefficients: FloatArray,
    samples: FloatArray,
    first: FloatArray,
    parameters: FloatArray,
    *,
    chosen: Sequence[int] = (),
    derivatives: bool = False,
    finer: float = 1.0,
) -> Marched:
    """Return the motion of a system whose drive, or held displacement, is polynomials in time.

    `coefficients`, (degree + 1, m), are those of powers of the position, 0 to 1, between two of the
    `knots`, (m + 1,). The motion starts from the states `first` at the first of the `samples`.
    FitError is raised if it grows beyond all bounds, or lacks the `derivatives` requested.
    """
    from dahl_ident.engine.radau import layout  # numba is slow to import

    columns = system.order + 1 + len(chosen) if derivatives else 0
    found, output, by, states, last = _run(
        kernels("samples").march,
        system.function,
        layout(system.sizes, columns, len(coefficients) - 1),
        system.solved,
        system.followers,
        _numbers(knots),
        _numbers(coefficients),
        _numbers(samples),
        _numbers(first),
        _numbers(parameters),
        np.asarray(chosen, dtype=np.int64),
        int(derivatives),
        _SAMPLED / finer / (_HELD if system.held else 1.0),
    )
    if not found or not np.isfinite(output).all():
        smooth = ", or has no derivatives," if derivatives else ""
        raise FitError(
            f"the motion grows beyond all bounds{smooth} at the parameters {parameters.tolist()}"
        )
    n = system.order
    return Marched(
        output, by[:, :n], -by[:, n : n + 1].ravel(), by[:, n + 1 :], states, last[:, :n]
    )


def _run(kernel: Callable[..., Any], *arguments: Any) -> Any:
    """Return what a kernel returns; an interrupt of compiled code raises KeyboardInterrupt."""
    try:
        return kernel(*arguments)
    except SystemError as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__cause__
        if cause is not None:
            raise KeyboardInterrupt from None
        raise


def _numbers(array: FloatArray) -> FloatArray:
    return np.ascontiguousarray(array, dtype=np.float64)


@cache
def _say_that_it_compiles() -> None:
    print("compiling the engine, once (one to two minutes) ...", file=sys.stderr)  # noqa: T201 - users wait


@cache
def kernels(name: str) -> ModuleType:
    """Return the module of a compiled kernel, from a cache on disk if that can be written.

    The cache belongs to this version of the kernels, so that no kernel compiled from another source
    is used.
    """
    from importlib import import_module

    from numba import __version__, config

    engine = Path(__file__).absolute().parent  # the path that numba uses
    source = b"".join((engine / f"{n}.py").read_bytes() for n in _KERNELS)
    key = hashlib.sha256(source + __version__.encode()).hexdigest()[:16]
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "dahl_ident" / f"engine-{key}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        folder = Path(tempfile.mkdtemp(prefix="dahl_ident-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    # numba makes one subfolder for each installation
    subfolder = folder / f"{engine.name}_{hashlib.sha1(str(engine).encode()).hexdigest()}"
    if not any(subfolder.glob(f"{name}.*.nbi")):
        _say_that_it_compiles()
    before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
    try:
        return import_module(f"dahl_ident.engine.{name}")
    finally:
        config.CACHE_DIR = before
