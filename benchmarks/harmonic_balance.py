"""The exact steady motion beside a harmonic-balance program, at equal or better accuracy.

``python -m benchmarks.harmonic_balance PATH`` needs the source of tmdsimpy (a folder that holds
the package ``tmdsimpy``; github.com/tmd-lab/tmdsimpy), which is on no package index. It solves the
response of one Jenkins oscillator (mass, damper, spring, one elastic-perfectly-plastic element) at
150 points, six drives by 25 frequencies, by both, one level after the other from low to high
frequency. Both are timed in one process, processor time. The error of shooting is 1e-8 (the page on
the engine shows it against DOP853), so that the difference between both is the peer's error.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import dahl_ident as di
from dahl_ident.arrays import ComplexArray, FloatArray

DESTINATION = Path("docs/validation/harmonic_balance.md")
MASS, DAMPING, STIFFNESS, CONTACT, LIMIT = 0.3, 0.24, 0.3, 30.0, 0.1
DRIVES = np.geomspace(0.03, 1.0, 6)
FREQUENCIES = np.geomspace(0.3, 6.0, 25)
SETTINGS = ((3, 128), (9, 256), (15, 512), (31, 1024))
"""Highest harmonic and samples of a cycle, of the peer."""


def ours() -> ComplexArray:
    """Return X at every point, (6, 25)."""
    friction = di.MaxwellSlip([LIMIT / CONTACT], [CONTACT])
    plant = friction + di.Mass(MASS) + di.Damper(DAMPING) + di.Spring(STIFFNESS)
    return np.asarray(di.response(plant, FREQUENCIES, DRIVES[:, None]).displacement)


def theirs(harmonics: int, samples: int) -> ComplexArray:
    """Return X at every point by harmonic balance, warm from the point before."""
    system = importlib.import_module("tmdsimpy.vibration_system").VibrationSystem(
        np.array([[MASS]]), np.array([[STIFFNESS]]), ab=[DAMPING / MASS, 0.0]
    )
    law = importlib.import_module("tmdsimpy.nlforces.jenkins_element").JenkinsForce
    one = np.ones((1, 1))
    system.add_nl_force(law(one, one, CONTACT, LIMIT))
    solver = importlib.import_module("tmdsimpy.solvers").NonlinearSolver()
    orders = np.arange(1, harmonics + 1, 2)
    push = np.zeros(2 * orders.size)
    result = np.full((DRIVES.size, FREQUENCIES.size), np.nan, dtype=np.complex128)
    for i, drive in enumerate(DRIVES.tolist()):
        push[0] = drive
        stuck = drive / (CONTACT + STIFFNESS)
        U = np.concatenate([[stuck], np.zeros(push.size - 1)])
        for j, omega in enumerate((2.0 * np.pi * FREQUENCIES).tolist()):

            def residual(
                U: FloatArray, calc_grad: bool = True, omega: float = omega
            ) -> tuple[FloatArray, ...]:
                where = np.append(U, omega)
                found = system.hbm_res(where, push, orders, Nt=samples, calc_grad=calc_grad)
                return tuple(found[:2])

            U, *_ = solver.nsolve(residual, U, verbose=False, xtol=1e-10)
            result[i, j] = U[0] - 1j * U[1]
    return result


def timed(work: Callable[[], ComplexArray]) -> tuple[ComplexArray, float]:
    """Return a result and the processor time that it took."""
    start = time.process_time()
    return work(), time.process_time() - start


def page() -> str:
    """Return the comparison as a page of the manual."""
    ours()  # compiles
    exact, seconds = timed(ours)
    lines = [
        "# Beside harmonic balance\n",
        "Steady response of one Jenkins oscillator at 150 points (six drives, 25 frequencies) by",
        "the engine's shooting and by harmonic balance with tmdsimpy, each point warm from the one",
        "before. Processor time in one process. Shooting has an error of 1e-8 ([page](engine.md)),",
        "so that the difference between both is the error of harmonic balance; where its largest",
        "error is 1, a point was not solved. `python -m benchmarks.harmonic_balance PATH --write`",
        "makes this page.\n",
        "| solved by | median error | largest error | seconds | ratio |",
        "|---|---|---|---|---|",
        f"| shooting | | | {seconds:.2g} | 1 |",
    ]
    for harmonics, samples in SETTINGS:
        X, slow = timed(partial(theirs, harmonics, samples))
        name = f"harmonic balance, {harmonics} harmonics, {samples} samples"
        error = np.abs(X / exact - 1.0)
        ratio = slow / seconds
        lines.append(
            f"| {name} | {np.median(error):.0e} | {error.max():.0e} | {slow:.2g} | {ratio:.0f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the page, or write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", help="folder that holds the package tmdsimpy")
    parser.add_argument("--write", action="store_true", help=f"to {DESTINATION}")
    given = parser.parse_args()
    sys.path.insert(0, given.path)
    try:
        importlib.import_module("tmdsimpy.vibration_system")
    except ImportError as error:
        parser.error(f"no tmdsimpy in that folder: {error}")
    text = page()
    if given.write:
        DESTINATION.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()
