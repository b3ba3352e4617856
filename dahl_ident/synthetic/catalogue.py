"""The data sets that ship: which experiment each is, what it teaches, what it can determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.elements import Backlash, Dahl, Damper, Mass, Spring
from dahl_ident.synthetic.acquisition import Acquisition, Channel
from dahl_ident.synthetic.excitation import FrequencySweep, SteppedSine
from dahl_ident.synthetic.experiment import Experiment
from dahl_ident.synthetic.table_errors import Table

_F_MAX, _SIGMA = 0.1, 30.0  # N and N/m, as in the plant of Fig. 7
_X_C = _F_MAX / _SIGMA


@dataclass(frozen=True)
class DataSet:
    """One shipped data set.

    Attributes
    ----------
    name : str
        Name for ``load_dataset``, and of its files.
    experiment : Experiment
        How it was made.
    seed : int
        Of its random numbers.
    teaches : str
        What it demonstrates, in one line.
    identifiable : tuple of str
        Parameters that the data determine (standard deviation of the logarithm below 0.25).
    not_identifiable : tuple of str
        Parameters that they do not; a fit has to say so.
    caution : str
        The flaw of the data that an analysis has to report, or an empty string.
    """

    name: str
    experiment: Experiment
    seed: int
    teaches: str
    identifiable: tuple[str, ...]
    not_identifiable: tuple[str, ...] = ()
    caution: str = ""

    @property
    def kind(self) -> str:
        """What the set holds: "frequency_response" or "record"."""
        return "record" if self.experiment.table is None else "frequency_response"

    @property
    def file(self) -> str:
        """Name of the data file."""
        return f"{self.name}.csv.gz" if self.kind == "record" else f"{self.name}.csv"


def _spread(low: float, high: float, n: int, unit: float = 1.0) -> tuple[float, ...]:
    """Return `n` levels of three digits, evenly spread over their logarithm."""
    return tuple(float(f"{v:.3g}") for v in unit * np.geomspace(low, high, n))


def _friction(
    beta: tuple[float, float], table: Table, *, alpha: float = 1.0, levels: int = 30
) -> Experiment:
    """Return friction alone, the displacement held at levels from one beta to another."""
    steps = SteppedSine(_spread(*beta, levels, unit=_X_C))
    return Experiment(Dahl(_F_MAX, _SIGMA, alpha), steps, table=table)


_PLANT = Dahl(_F_MAX, _SIGMA, 1.0) + Mass(0.3) + Damper(0.24) + Spring(0.3)  # Fig. 7
_FIG_7 = SteppedSine(
    levels=(0.001, 0.01, 0.05, 0.1, 0.15, 0.2, 0.5, 2.0),
    frequencies_hz=_spread(0.05, 5.0, 25),
    controlled="force",
)
_ONE_PERCENT = Table(force_std=0.01)  # noise
_BOTH = ("f_max", "sigma")
_ALL_OF_PLANT = ("f_max", "sigma", "mass", "damping", "stiffness")

DATA_SETS: dict[str, DataSet] = {
    one.name: one
    for one in (
        DataSet(
            "clean",
            _friction((0.1, 10.0), Table()),
            seed=1,
            teaches="friction alone around its knee, without noise: the estimate is exact",
            identifiable=_BOTH,
        ),
        DataSet(
            "noisy",
            _friction((0.1, 10.0), _ONE_PERCENT),
            seed=2,
            teaches="the same with 1 % noise: what a good measurement looks like",
            identifiable=_BOTH,
        ),
        DataSet(
            "microslip",
            _friction((0.0002, 0.002), _ONE_PERCENT),
            seed=3,
            teaches="small amplitudes alone determine sigma well, f_max only through the loss",
            identifiable=("sigma",),
            not_identifiable=("f_max",),
        ),
        DataSet(
            "gross_slip",
            Experiment(
                Dahl(_F_MAX, 3e5, 1.0),
                SteppedSine(_spread(3e-3, 3e-2, 30)),
                table=Table(force_std=0.03),
            ),
            seed=4,
            teaches="strokes beyond 10,000 x_c determine f_max; sigma's effect is below 3 % noise",
            identifiable=("f_max",),
            not_identifiable=("sigma",),
        ),
        DataSet(
            "alpha_2",
            _friction((0.1, 30.0), _ONE_PERCENT, alpha=2.0, levels=40),
            seed=5,
            teaches="friction that no linear Dahl model fits: free alpha and compare the models",
            identifiable=("f_max", "sigma", "alpha"),
        ),
        DataSet(
            "fig_7_plant",
            Experiment(
                _PLANT,
                _FIG_7,
                table=Table(displacement_std=0.01),
            ),
            seed=12,
            teaches="a plant driven by force, from stick to slip: friction with linear elements",
            identifiable=_ALL_OF_PLANT,
        ),
        DataSet(
            "fig_7_describing_function",
            Experiment(
                _PLANT, _FIG_7, table=Table(displacement_std=0.01, steady="describing function")
            ),
            seed=12,
            teaches="Fig. 7 as the paper computes it, by the describing function: no plant does so",
            identifiable=_ALL_OF_PLANT,
            caution="not the motion of a mechanism: fit with steady='describing function'",
        ),
        DataSet(
            "frf_levels",
            Experiment(
                _PLANT,
                SteppedSine(
                    levels=(0.03, 0.06, 0.1, 0.2, 0.4, 1.0),
                    frequencies_hz=_spread(0.3, 6.0, 25),
                    controlled="force",
                ),
                Acquisition(force=Channel(gain=1.01), displacement=Channel(gain=0.995)),
                Table(displacement_std=0.003),
            ),
            seed=14,
            teaches="a sweep at six drive levels, as an analyser gives it; calibration to 1 %",
            identifiable=_ALL_OF_PLANT,
        ),
        DataSet(
            "unsettled",
            Experiment(
                Dahl(_F_MAX, _SIGMA, 1.0),
                SteppedSine(
                    tuple(float(f"{beta * _X_C:.3g}") for beta in (10.0, 2.0, 0.2, 0.02)),
                    (1.0, 2.0),
                    order="descending",
                    settling_periods=1,
                    num_periods=5,
                    ramp_periods=0.0,
                ),
                Acquisition(
                    sample_rate_hz=64.0,
                    displacement=Channel(noise_std=1e-7),
                    force=Channel(noise_std=1e-5),
                ),
            ),
            seed=7,
            teaches="descending levels without time to settle: the loss at small ones is biased",
            identifiable=_BOTH,
            caution="the small levels have not settled",
        ),
        DataSet(
            "quantised",
            Experiment(
                Dahl(_F_MAX, _SIGMA, 1.0),
                SteppedSine(_spread(0.05, 5.0, 8, unit=_X_C), order="ascending", num_periods=4),
                Acquisition(
                    sample_rate_hz=100.0,
                    displacement=Channel(noise_std=1e-6, resolution=1e-4),
                    force=Channel(noise_std=1e-4),
                ),
            ),
            seed=8,
            teaches="a displacement sensor whose steps are as large as the smallest levels",
            identifiable=_BOTH,
            caution="the displacement is quantised coarsely at small levels",
        ),
        DataSet(
            "outliers",
            _friction((0.1, 10.0), Table(force_std=0.01, outlier_fraction=0.1)),
            seed=9,
            teaches="3 rows of 30 with errors of 50 %: robust losses, and residuals that show them",
            identifiable=_BOTH,
            caution="three rows are outliers",
        ),
        DataSet(
            "delayed",
            Experiment(
                Dahl(_F_MAX, _SIGMA, 1.0),
                SteppedSine(_spread(0.1, 10.0, 10, unit=_X_C), (1.0, 5.0, 20.0)),
                Acquisition(displacement=Channel(delay=2e-3), force=Channel(gain=1.2)),
                _ONE_PERCENT,
            ),
            seed=10,
            teaches="displacement 2 ms late, force 20 % high: the delay is found, the gain is not",
            identifiable=("delay",),
            not_identifiable=("f_max", "sigma", "force_gain"),
            caution="the phase depends on frequency, as no friction alone can do",
        ),
        DataSet(
            "play_and_two_limits",
            Experiment(
                Backlash(Dahl(_F_MAX, _SIGMA, 1.0, asymmetry=0.15), 4e-4),
                SteppedSine(
                    _spread(0.15, 10.0, 8, unit=_X_C),
                    order="ascending",
                    settling_periods=4,
                    num_periods=3,
                ),
                Acquisition(
                    sample_rate_hz=64.0,
                    displacement=Channel(noise_std=2e-7),
                    force=Channel(noise_std=2e-4),
                ),
            ),
            seed=13,
            teaches="friction with unequal limits behind a gap, estimated from hysteresis loops",
            identifiable=("f_max", "sigma", "asymmetry", "gap"),
        ),
        DataSet(
            "plant_recording",
            Experiment(
                Dahl(_F_MAX, _SIGMA, 1.0) + Mass(0.3) + Damper(2.0) + Spring(0.3),
                SteppedSine(
                    # high enough for the mass to filter the harmonics of friction
                    levels=(0.05, 0.15, 0.5, 1.0, 2.0),
                    frequencies_hz=(2.5, 3.5, 5.0),
                    controlled="force",
                    order="descending",
                    settling_periods=20,
                    num_periods=10,
                    ramp_periods=10.0,  # slow, or friction keeps the mean position displaced
                ),
                Acquisition(
                    sample_rate_hz=200.0,
                    displacement=Channel(noise_std=3e-5, offset=1e-3, antialias_hz=1000.0),
                    force=Channel(
                        noise_std=1e-2, flicker_std=1e-3, hum_amplitude=5e-3, antialias_hz=1000.0
                    ),
                ),
            ),
            seed=11,
            teaches="what a laboratory stores: fifteen steps of a plant with noise, hum, offset",
            identifiable=_ALL_OF_PLANT,
        ),
        DataSet(
            "sweep_plant",
            Experiment(
                _PLANT,
                FrequencySweep((0.05, 0.2, 1.0), 0.4, 5.0, 90.0),
                Acquisition(
                    sample_rate_hz=32.0,
                    displacement=Channel(noise_std=1e-4),
                    force=Channel(noise_std=5e-5),
                ),
            ),
            seed=15,
            teaches="continuous sweeps at three drive levels, fitted as waveforms",
            identifiable=_ALL_OF_PLANT,
            caution="swept too fast for a table: fit the waveforms",
        ),
    )
}
"""Every shipped data set by its name."""
