"""Excitations: stepped sines, frequency sweeps, amplitude ramps.

Each excitation controls either displacement or force, and its levels are zero-to-peak amplitudes of
the controlled one. Before the first step the mechanism is at rest without force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from dahl_ident.arrays import non_negative_number, positive_array, positive_number, whole_number
from dahl_ident.data.columns import Controlled, one_of, set_checked
from dahl_ident.errors import ValidationError
from dahl_ident.synthetic.acquisition import Draws
from dahl_ident.synthetic.waveform import Waveform, WaveformBuilder

Order = Literal["given", "ascending", "descending", "random"]
Spacing = Literal["linear", "log"]


@dataclass(frozen=True)
class SteppedSine:
    """A sine at every frequency and level of a grid: ramp, settle, measure, and optionally rest.

    Parameters
    ----------
    levels : sequence of float
        Zero-to-peak amplitudes, m (rad) or N (N m).
    frequencies_hz : sequence of float, default (1.0,)
        Hz. All levels are measured at one frequency before the next.
    controlled : {"displacement", "force"}
        What the levels are amplitudes of.
    order : {"given", "ascending", "descending", "random"}
        Order of the levels; "random" shuffles the whole grid by the seed.
    settling_periods : int, default 10
        Periods at the full level before measuring starts.
    num_periods : int, default 5
        Measured periods of each step.
    ramp_periods : float, default 2
        Periods of the smooth transition to the next level and frequency; 0 is a jump.
    rest : float, default 0
        Seconds at rest between the steps, with ramps down and up; 0 for no rest.

    Raises
    ------
    ValidationError
        If a value is not as said here.

    Examples
    --------
    >>> steps = SteppedSine(levels=(1e-3, 2e-3), order="descending")
    >>> [level for level, _ in steps.grid(seed=0)]
    [0.002, 0.001]
    """

    levels: Sequence[float]
    frequencies_hz: Sequence[float] = (1.0,)
    controlled: Controlled = "displacement"
    order: Order = "given"
    settling_periods: int = 10
    num_periods: int = 5
    ramp_periods: float = 2.0
    rest: float = 0.0

    def __post_init__(self) -> None:
        set_checked(self, _numbers, "levels", "frequencies_hz")
        one_of(self.controlled, "controlled", get_args(Controlled))
        one_of(self.order, "order", get_args(Order))
        whole_number(self.settling_periods, "settling_periods", 0)
        whole_number(self.num_periods, "num_periods", 1)
        set_checked(self, non_negative_number, "ramp_periods", "rest")

    def grid(self, seed: int) -> list[tuple[float, float]]:
        """Return level and frequency of every step in the order of the run."""
        levels = list(self.levels)
        if self.order in ("ascending", "descending"):
            levels.sort(reverse=self.order == "descending")
        steps = [(level, f) for f in self.frequencies_hz for level in levels]
        if self.order == "random":
            steps = [steps[i] for i in Draws(seed).permutation("order of steps", len(steps))]
        return steps

    def waveform(self, seed: int) -> Waveform:
        """Return the run as one smooth waveform with its measured windows."""
        steps = self.grid(seed)
        run = WaveformBuilder(steps[0][1])
        for level, f in steps:
            run.go_to(level, f, self.ramp_periods / f)
            run.stay(self.settling_periods / f)
            run.measure(self.num_periods / f)
            if self.rest > 0.0:
                run.go_to(0.0, f, self.ramp_periods / f)
                run.stay(self.rest)
        return run.finish()


@dataclass(frozen=True)
class FrequencySweep:
    """A frequency that changes steadily from start to stop, at one level or several in turn.

    Parameters
    ----------
    level : float or sequence of float
        Zero-to-peak amplitude, m (rad) or N (N m); several are swept one after the other.
    start_hz, stop_hz : float
        Hz, in either direction.
    duration : float
        Seconds from start to stop, after the ramp.
    spacing : {"log", "linear"}
        Equal times for equal ratios, or for equal differences.
    controlled : {"displacement", "force"}
        What the level is an amplitude of.
    ramp_periods : float, default 2
        Duration of the initial ramp in periods of the first frequency.

    Raises
    ------
    ValidationError
        If a value is not as said here.

    Examples
    --------
    >>> FrequencySweep(level=0.1, start_hz=1.0, stop_hz=10.0, duration=60.0).waveform(0).duration
    62.0
    """

    level: float | Sequence[float]
    start_hz: float
    stop_hz: float
    duration: float
    spacing: Spacing = "log"
    controlled: Controlled = "force"
    ramp_periods: float = 2.0

    def __post_init__(self) -> None:
        several = isinstance(self.level, Sequence)
        if several:
            set_checked(self, _numbers, "level")
        _check_sweep(self, *["level"][several:], "start_hz", "stop_hz", "duration")

    def waveform(self, seed: int) -> Waveform:
        """Return a ramp and the sweep for each level."""
        run = WaveformBuilder(self.start_hz)
        for level in self.level if isinstance(self.level, Sequence) else (self.level,):
            run.go_to(level, self.start_hz, self.ramp_periods / self.start_hz)
            run.go_to(level, self.stop_hz, self.duration, self.spacing)
        return run.finish()


@dataclass(frozen=True)
class AmplitudeRamp:
    """A sine of constant frequency with a level that changes steadily from start to stop.

    Parameters
    ----------
    start_level, stop_level : float
        Zero-to-peak amplitudes, m (rad) or N (N m), in either direction.
    frequency_hz : float
        Hz.
    duration : float
        Seconds from start to stop, after the ramp.
    spacing : {"log", "linear"}
        Equal times for equal ratios, or for equal differences.
    controlled : {"displacement", "force"}
        What the levels are amplitudes of.
    ramp_periods : float, default 2
        Duration of the initial ramp in periods.

    Raises
    ------
    ValidationError
        If a value is not as said here.

    Examples
    --------
    >>> ramp = AmplitudeRamp(start_level=1e-5, stop_level=1e-2, frequency_hz=2.0, duration=100.0)
    >>> ramp.waveform(0).duration
    101.0
    """

    start_level: float
    stop_level: float
    frequency_hz: float
    duration: float
    spacing: Spacing = "log"
    controlled: Controlled = "displacement"
    ramp_periods: float = 2.0

    def __post_init__(self) -> None:
        _check_sweep(self, "start_level", "stop_level", "frequency_hz", "duration")

    def waveform(self, seed: int) -> Waveform:
        """Return the smooth start and the ramp."""
        run = WaveformBuilder(self.frequency_hz)
        run.go_to(self.start_level, self.frequency_hz, self.ramp_periods / self.frequency_hz)
        run.go_to(self.stop_level, self.frequency_hz, self.duration, self.spacing)
        return run.finish()


def _numbers(numbers: Sequence[float], name: str) -> tuple[float, ...]:
    """Return one or more positive numbers as a tuple."""
    values = positive_array(numbers, name)
    if values.ndim != 1 or values.size == 0:
        raise ValidationError(f"{name}: expected some numbers, got shape {values.shape}")
    return tuple(values.tolist())


def _check_sweep(sweep: FrequencySweep | AmplitudeRamp, *positive: str) -> None:
    """Check a sweep or ramp, and convert its numbers to floats."""
    set_checked(sweep, positive_number, *positive)
    one_of(sweep.spacing, "spacing", get_args(Spacing))
    one_of(sweep.controlled, "controlled", get_args(Controlled))
    set_checked(sweep, non_negative_number, "ramp_periods")


Excitation = SteppedSine | FrequencySweep | AmplitudeRamp
