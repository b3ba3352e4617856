"""Fits to records: against a loop with solve_ivp, finite differences, and a compiled program."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy import signal
from scipy.optimize import least_squares
from scipy.signal import lfilter

import dahl_ident as di
from benchmarks.harness import Row, print_table, seconds
from benchmarks.hysteresis import by_solver
from dahl_ident.arrays import FloatArray
from dahl_ident.problem.record_problem import RecordProblem
from tests.motions import Driven

TITLE = "Records of any motion"
SAMPLES, PEERS = 100_000, 300
RATE = 750.0
_SIMULATED = 4096  # driven samples
_COMPILED = (4096, 40_960)  # samples; the second as many as the public benchmark's record has
_SUBSTEPS = 4  # of the compiled simulator in a sampling interval: its error is then below the noise
_TRUTH = {
    "sigma": 5e4, "q": -300.0, "p": 1900.0, "mass": 2.0, "damping": 10.0, "stiffness": 5e4,
}  # fmt: skip


def run() -> list[Row]:
    """Return the seconds of whole fits and of those of peers."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        print("no C compiler (cc or gcc) is installed: the compiled simulator is left out")
    compiled = [_compiled_motion(compiler, n) for n in _COMPILED] if compiler else []
    return [_force_from_displacement(), _motion_from_force(), *compiled]


def _force_from_displacement() -> Row:
    x = _displacement(SAMPLES, 0)
    v = np.gradient(x, 1.0 / RATE)
    force = di.Dahl(0.1, 30.0).force(x) + 5.0 * x + 0.1 * v
    force += 1e-3 * np.random.default_rng(1).standard_normal(SAMPLES)
    record = di.Record(np.arange(SAMPLES) / RATE, displacement=x, force=force)
    model = di.Dahl() + di.Spring() + di.Damper()
    fits = []

    def work() -> None:
        fits.append(di.fit(record, model))

    ours = min(seconds(work) for _ in range(3))
    one = seconds(partial(by_solver, x[:PEERS], 1.0)) / PEERS * SAMPLES
    evaluations = fits[-1].nfev
    return Row(
        f"a fit of 4 parameters to {SAMPLES:,} samples ({ours:.2f} s; {evaluations} evaluations)",
        ours,
        one * evaluations,
        "as many loops with solve_ivp",
        30.0,
        faster=True,
    )


def _motion_from_force() -> Row:
    """Compare with the same integrator inside scipy's least squares by finite differences."""
    record = _driven(_SIMULATED)
    model = di.BoucWen() + di.Mass() + di.Damper() + di.Spring()
    start = {name: 1.1 * value for name, value in _TRUTH.items()}
    ours = min(seconds(partial(di.fit, record, model, start=start)) for _ in range(3))
    problem = RecordProblem([record], model)
    size = np.array([*_TRUTH.values(), 1e-4, 1e-2, 1.0, 1e-5])

    def residuals(scaled: FloatArray) -> FloatArray:
        return np.concatenate(problem.split_residuals(scaled * size)) / 1e-6

    begin = np.concatenate([np.full(6, 1.1), np.zeros(4)])
    peer = seconds(partial(least_squares, residuals, begin, x_scale="jac"))
    return Row(
        f"a fit of 6 parameters and a state, {_SIMULATED:,} driven samples ({ours:.2f} s)",
        ours,
        peer,
        "least_squares with finite differences, the same integrator",
        1.0,
        faster=True,
    )


def _compiled_motion(compiler: str, samples: int) -> Row:
    """Compare with a simulator in C with exact derivatives, inside MINPACK's least squares."""
    record = _driven(samples)
    model = di.BoucWen() + di.Mass() + di.Damper() + di.Spring()
    start = {name: 1.1 * value for name, value in _TRUTH.items()}
    fits = []
    ours = min(seconds(lambda: fits.append(di.fit(record, model, start=start))) for _ in range(3))
    wave, measured = record.force_samples, np.asarray(record.displacement)
    fine = signal.resample(wave, 2 * _SUBSTEPS * samples)  # the drive is periodic
    size = np.array([*_TRUTH.values(), 1e-4, 1e-2, 1.0, 1e-5])
    begin = np.concatenate([np.full(6, 1.1), np.zeros(4)])
    with TemporaryDirectory() as folder:
        library = Path(folder) / "motion.so"
        source = Path(__file__).with_name("compiled_motion.c")
        flags = ["-O3", "-march=native", "-shared", "-fPIC"]
        subprocess.run([compiler, *flags, "-o", str(library), str(source), "-lm"], check=True)
        simulate = ctypes.CDLL(str(library)).simulate
        array = np.ctypeslib.ndpointer(dtype=np.float64, flags="C_CONTIGUOUS")
        simulate.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_double, *[array] * 4]
        simulate.restype = None
        motion, by, last = np.empty(samples), np.ones((samples, 10)), np.empty(0)
        slopes = np.empty((samples, 9))

        def run_to(scaled: FloatArray) -> None:
            nonlocal last
            if not np.array_equal(last, scaled):
                last = scaled.copy()
                simulate(samples - 1, _SUBSTEPS, 1.0 / RATE, fine, scaled * size, motion, slopes)
                by[:, :9] = slopes

        def residuals(scaled: FloatArray) -> FloatArray:
            run_to(scaled)
            return np.asarray((measured - motion - scaled[9] * size[9]) / 1e-6)

        def jacobian(scaled: FloatArray) -> FloatArray:
            run_to(scaled)
            return np.asarray(by * (-size / 1e-6))

        found = []
        fitted = partial(least_squares, residuals, begin, jac=jacobian, method="lm")
        peer = min(seconds(lambda: found.append(fitted())) for _ in range(3))
    apart = [
        abs(fits[-1].params[name].value - x * s) / float(fits[-1].params[name].stderr or 1.0)
        for name, x, s in zip(_TRUTH, found[-1].x, size, strict=False)
    ]
    return Row(
        f"the same, {samples:,} samples ({ours:.2f} s; estimates {max(apart):.1g} standard "
        "uncertainties apart)",
        ours,
        peer,
        f"MINPACK, a simulator in C with exact derivatives, {_SUBSTEPS} steps a sample",
        5.0,
    )


def _driven(samples: int) -> di.Record:
    rng = np.random.default_rng(0)
    lines = np.arange(5.0, 150.0, RATE / samples)
    t = np.arange(samples) / RATE
    phases = 2.0 * np.pi * rng.random(lines.size)
    drive = np.sum(np.sin(2.0 * np.pi * lines[:, None] * t + phases[:, None]), axis=0)
    drive *= 50.0 / drive.std()
    model = di.BoucWen(5e4, -300.0, 1900.0) + di.Mass(2.0) + di.Damper(10.0) + di.Spring(5e4)
    x = Driven(model, drive, RATE).motion(np.zeros(3)).output
    x = x + 8e-6 * rng.standard_normal(samples)
    return di.Record(t, displacement=x, force=drive)


def _displacement(samples: int, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    shaped = lfilter([1.0], np.poly([0.97, 0.97, 0.9]), rng.standard_normal(samples))
    return np.asarray(1e-2 * shaped / np.abs(shaped).max())


if __name__ == "__main__":
    print_table(TITLE, run())
