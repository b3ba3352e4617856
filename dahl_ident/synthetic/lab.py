"""Simulation of an experiment, from its description and a seed to data."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray, whole_number
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.steady_state import response
from dahl_ident.synthetic.excitation import SteppedSine
from dahl_ident.synthetic.experiment import Experiment
from dahl_ident.synthetic.mechanism import Mechanism, Progress, Signal
from dahl_ident.synthetic.randomness import Draws
from dahl_ident.synthetic.table_errors import Phasors, Table, receptance_table, stiffness_table
from dahl_ident.synthetic.waveform import Waveform

GENERATOR = "dahl_ident.synthetic 3"
"""Raised whenever the same experiment and seed would give other values."""

IntArray = NDArray[np.int64]
Steps = tuple[FloatArray, FloatArray]
"""Level and frequency, Hz, of every step."""


def simulate(
    experiment: Experiment, *, seed: int, progress: Progress | None = None
) -> Record | FrequencyResponse:
    """Return the data of one experiment, including the effects of its sensors.

    Parameters
    ----------
    experiment : Experiment
        Mechanism, excitation, sensors, and whether a record or a table is wanted.
    seed : int
        Whole number >= 0. The same seed gives the same values to 1e-10 on every platform.
    progress : callable, optional
        Called from time to time with the completed fraction, while a plant is simulated.

    Returns
    -------
    Record or FrequencyResponse
        A table where the experiment asks for one, else waveforms. Its provenance holds the
        experiment, the seed, the true parameters and, for a stepped sine, the measured windows.

    Raises
    ------
    ModelError
        If the motion in time of the plant is not available, it has no steady state, or its motion
        grows without bound.
    ValidationError
        If `experiment` is not an Experiment, `seed` is not a whole number, or the sampling rate is
        too low.

    Notes
    -----
    The friction of a displacement-controlled mechanism is exact (Eqn. 3 from turning point to
    turning point). The equation of motion of a force-controlled plant (Eqn. 53) is integrated to
    about 1e-11 of its motion, reversals located; the describing function is not used. Tables of it
    contain the exact steady motion, :func:`dahl_ident.response`, unless the table asks for the
    describing function.

    Examples
    --------
    >>> from dahl_ident import Dahl
    >>> from dahl_ident.synthetic import Experiment, SteppedSine, Table
    >>> run = Experiment(Dahl(0.1, 30.0), SteppedSine(levels=(1e-3, 1e-2)), table=Table())
    >>> abs(simulate(run, seed=1).response).round(3).tolist()
    [29.256, 11.58]
    """
    if not isinstance(experiment, Experiment):
        raise ValidationError(
            f"experiment is a {type(experiment).__name__}; expected a dahl_ident.synthetic."
            "Experiment, such as Experiment.read('run.toml')"
        )
    draws = Draws(whole_number(seed, "seed", 0))
    provenance: dict[str, Any] = {
        "generator": GENERATOR,
        "seed": int(seed),
        "truth": experiment.truth,
        "experiment": experiment.to_dict(),
    }
    excitation = experiment.excitation
    if experiment.table is not None and isinstance(excitation, SteppedSine):
        level, frequency_hz = np.array(excitation.grid(seed)).T
        data = _table(experiment, (level, frequency_hz), experiment.table, draws)
        outliers = experiment.table.outlier_rows(data.n, draws)
        return replace(
            data, motion=experiment.motion, provenance=provenance | {"outlier_rows": outliers}
        )
    waveform = excitation.waveform(seed)
    windows = [list(window) for window in waveform.windows]
    return _record(experiment, waveform, draws, provenance | {"windows": windows}, progress)


def _record(
    experiment: Experiment,
    waveform: Waveform,
    draws: Draws,
    provenance: dict[str, Any],
    progress: Progress | None,
) -> Record:
    mechanism = Mechanism.of(experiment.plant)
    displacement: Signal = waveform.value
    force: Signal = waveform.value
    if experiment.excitation.controlled == "force":
        displacement = mechanism.displacement_under(waveform, progress)
    else:
        force = mechanism.force_under(waveform, progress)
    acquisition = experiment.acquisition
    times = acquisition.sampling_times(waveform.duration, waveform.highest_frequency_hz)
    time, x, F = acquisition.record(displacement, force, times, draws)
    return Record(time, displacement=x, force=F, motion=experiment.motion, provenance=provenance)


def _table(experiment: Experiment, steps: Steps, table: Table, draws: Draws) -> FrequencyResponse:
    """Return the table of a stepped sine: the true phasors, as measured by the sensors."""
    if experiment.excitation.controlled == "force":
        phasors = _forced_phasors(experiment, *steps, np.array(table.harmonics))
        return receptance_table(phasors, table, draws)
    phasors = _held_phasors(experiment, *steps, np.array(table.harmonics))
    return stiffness_table(phasors, table, draws)


def _held_phasors(
    experiment: Experiment, level: FloatArray, frequency_hz: FloatArray, harmonics: IntArray
) -> Phasors:
    """Return a row for every step and harmonic, with controlled displacement."""
    step, k = (g.ravel() for g in np.meshgrid(np.arange(level.size), harmonics, indexing="ij"))
    A, f = level[step], frequency_hz[step]
    omega = 2.0 * np.pi * f
    force = np.zeros(step.size, dtype=np.complex128)
    for harmonic in harmonics.tolist():
        rows = k == harmonic
        stiffness = experiment.plant.dynamic_stiffness(A[rows], omega[rows], harmonic=harmonic)
        force[rows] = stiffness * A[rows]
    fundamental = np.abs(experiment.plant.dynamic_stiffness(A, omega)) * A
    sensors = experiment.acquisition
    return Phasors(
        f, A, k, step,
        displacement=A * sensors.displacement.response(omega),
        force=force * sensors.force.response(k * omega),
        displacement_size=A * np.abs(sensors.displacement.response(omega)),
        force_size=fundamental * np.abs(sensors.force.response(omega)),
    )  # fmt: skip


def _forced_phasors(
    experiment: Experiment, drive: FloatArray, frequency_hz: FloatArray, harmonics: IntArray
) -> Phasors:
    """Return a row for every step and harmonic, with controlled force."""
    assert experiment.table is not None
    how = experiment.table.steady
    steady = response(experiment.plant, frequency_hz, drive, steady=how)
    if not steady.found.all():
        raise ModelError(steady.message)
    step, k = (g.ravel() for g in np.meshgrid(np.arange(drive.size), harmonics, indexing="ij"))
    f, omega = frequency_hz[step], 2.0 * np.pi * frequency_hz[step]
    sensors = experiment.acquisition
    X = np.asarray(steady.harmonics)[step]
    force = drive[step] * sensors.force.response(omega)
    motion = sensors.displacement.response
    return Phasors(
        f, drive[step], k, step,
        displacement=X[np.arange(step.size), k] * motion(k * omega),
        force=force,
        displacement_size=np.abs(X[:, 1] * motion(omega)),
        force_size=np.abs(force),
    )  # fmt: skip
