"""Simulation of an experiment, from its description and a seed to data."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray, whole_number
from dahl_ident.control_interop import response
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.errors import ModelError, NoSteadyMotionWarning, ValidationError
from dahl_ident.synthetic.acquisition import Draws, Table
from dahl_ident.synthetic.excitation import SteppedSine
from dahl_ident.synthetic.experiment import Experiment
from dahl_ident.synthetic.mechanism import Progress, Signal, displacement_under, force_under

GENERATOR = "dahl_ident.synthetic 3"
"""Version of the generator; it changes whenever an experiment and seed would give other values."""


def simulate(
    experiment: Experiment, *, seed: int, progress: Progress | None = None
) -> Record | FrequencyResponse:
    """Return the data of one experiment, including the effects of its sensors.

    Parameters
    ----------
    experiment : Experiment
        Mechanism, excitation, sensors, and whether a record or a table is requested.
    seed : int
        Whole number >= 0. The same seed gives the same values to 1e-10 on every platform.
    progress : callable, optional
        Called from time to time with the completed fraction of the simulation of a plant.

    Returns
    -------
    Record or FrequencyResponse
        A table if the experiment requests one, otherwise waveforms. Its provenance holds the
        experiment, the seed, the true parameters and, for a stepped sine, the measured windows.

    Raises
    ------
    ModelError
        If the motion of the plant over time cannot be computed, it has no steady state, or its
        motion grows without bound.
    ValidationError
        If `experiment` is not an Experiment, `seed` is not a whole number, or the sampling rate is
        too low.

    Notes
    -----
    The friction of a displacement-controlled mechanism is exact (Eqn. 3 from turning point to
    turning point). The equation of motion of a force-controlled plant (Eqn. 53) is integrated with
    an error of about 1e-11 of its motion, with located reversals; the describing function is not
    used. Tables contain the exact steady motion, :func:`dahl_ident.response`, unless they request
    the describing function.

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
    draws = Draws(whole_number(seed, "seed", 0, np.inf))
    provenance: dict[str, Any] = {
        "generator": GENERATOR,
        "seed": int(seed),
        "truth": experiment.truth,
        "experiment": experiment.to_dict(),
    }
    excitation, acquisition = experiment.excitation, experiment.acquisition
    if experiment.table is not None and isinstance(excitation, SteppedSine):
        grid = np.array(excitation.grid(seed))
        data, outliers = _table(experiment, experiment.table, grid, draws)
        return replace(
            data, motion=experiment.motion, provenance=provenance | {"outlier_rows": outliers}
        )
    waveform = excitation.waveform(seed)
    provenance["windows"] = [list(window) for window in waveform.windows]
    times = acquisition.sampling_times(waveform.duration, waveform.highest_frequency_hz)
    displacement: Signal = waveform.value
    force: Signal = waveform.value
    if excitation.controlled == "force":
        displacement = displacement_under(experiment.plant, waveform, progress)
    else:
        force = force_under(experiment.plant, waveform, progress)
    time, x, F = acquisition.record(displacement, force, times, draws)
    return Record(time, displacement=x, force=F, motion=experiment.motion, provenance=provenance)


def _table(
    experiment: Experiment, table: Table, grid: FloatArray, draws: Draws
) -> tuple[FrequencyResponse, list[int]]:
    """Return the table of a stepped sine, one row per step and harmonic, and its outliers."""
    # The table holds output (1 + e_out) over input (1 + e_in) with relative errors e; the input is
    # the controlled quantity. The covariance is that of the true response: one computed from the
    # erroneous response of each row would bias every fit.
    level, frequency_hz = grid.T
    steps, harmonics = np.arange(level.size), np.array(table.harmonics)
    step, k = (g.ravel() for g in np.meshgrid(steps, harmonics, indexing="ij"))
    omega = 2.0 * np.pi * frequency_hz[step]
    forced = experiment.excitation.controlled == "force"
    sensors = (experiment.acquisition.displacement, experiment.acquisition.force)
    in_sensor, out_sensor = sensors[::-1] if forced else sensors
    errors = {"displacement": table.displacement_std, "force": table.force_std}
    (in_name, in_std), (out_name, out_std) = sorted(errors.items(), reverse=forced)
    if forced:
        with warnings.catch_warnings():  # they are an error here
            warnings.simplefilter("ignore", NoSteadyMotionWarning)
            steady = response(experiment.plant, frequency_hz, level, steady=table.steady)
        if not steady.found.all():
            raise ModelError(steady.message)
        phasors = np.asarray(steady.harmonics)
        output, fundamental = phasors[step, k], phasors[step, 1]
    else:
        plant, A = experiment.plant, level[step]
        fundamental, output = plant.dynamic_stiffness(A, omega) * A, np.zeros(k.size, complex)
        for harmonic in harmonics.tolist():
            rows = k == harmonic
            stiffness = plant.dynamic_stiffness(A[rows], omega[rows], harmonic=harmonic)
            output[rows] = stiffness * A[rows]
    true_input = level[step] * in_sensor.response(omega)
    output = output * out_sensor.response(k * omega)
    size = np.abs(fundamental * out_sensor.response(omega))
    true = _ratio(output, true_input, k)
    in_error = in_std * draws.complex_normal(f"{in_name} phasor", steps.size)[step]
    noisy_input = true_input * (1.0 + in_error)
    direction = np.exp(1j * np.angle(output)) * draws.complex_normal(f"{out_name} phasor", k.size)
    noisy_output = output + out_std * size * direction
    measured = _ratio(noisy_output, noisy_input, k)
    outliers = table.outlier_rows(k.size, draws)
    angle = 2.0 * np.pi * draws.uniform("outlier direction", k.size)[outliers]
    measured[outliers] *= 1.0 + table.outlier_size * np.exp(1j * angle)
    amplitude, drive, change, true_amplitude = np.abs(noisy_input), None, -true, np.abs(true_input)
    if forced:
        drive, true_amplitude = amplitude, size
        amplitude = np.abs(noisy_output)[np.flatnonzero(k == 1)[step]]
        change = np.where(k == 1, true, 0.0)
    stated: dict[str, Any] = {}
    if table.displacement_std > 0.0 or table.force_std > 0.0:
        # the response changes with the size of the input, and with its phase
        by_input = in_std**2 * (_outer(true) + _outer(1j * k * true))
        by_output = (out_std * size / np.abs(true_input))[:, None, None] ** 2 * np.eye(2)
        cross = table.displacement_std**2 * true_amplitude * change
        stated = {
            "covariance": by_input + by_output,
            "dof": np.inf,
            "amplitude_std": table.displacement_std * true_amplitude,
            "amplitude_covariance": np.column_stack([cross.real, cross.imag]),
        }
    data = FrequencyResponse(
        frequency_hz[step],
        measured,
        amplitude,
        drive,
        level=level[step],
        harmonic=k,
        controlled=in_name,
        quantity="receptance" if forced else "dynamic_stiffness",
        **stated,
    )
    return data, outliers


def _ratio(output: ComplexArray, held: ComplexArray, k: NDArray[np.int64]) -> ComplexArray:
    """Return harmonic k over the size of the controlled phasor, relative to k times its phase."""
    return np.asarray(output / np.abs(held) * np.exp(-1j * k * np.angle(held)))


def _outer(v: ComplexArray) -> FloatArray:
    """Return the (n, 2, 2) products of the real and imaginary parts with each other."""
    parts = np.column_stack([v.real, v.imag])
    return np.asarray(parts[:, :, None] * parts[:, None, :])
