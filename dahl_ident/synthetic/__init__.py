"""The synthetic laboratory: realistic data with known true parameters.

An :class:`Experiment` describes the mechanism, the excitation and the sensors; ``simulate`` turns
it and a seed into a :class:`~dahl_ident.data.Record` of waveforms or a
:class:`~dahl_ident.data.FrequencyResponse`. Friction is simulated in time by Eqn. 2, so that
estimates by describing functions are tested independently. Ready-made data sets are shipped with
the package: see :func:`load_dataset`.
"""

from dahl_ident.synthetic.acquisition import Acquisition, Channel, Table
from dahl_ident.synthetic.excitation import AmplitudeRamp, FrequencySweep, SteppedSine
from dahl_ident.synthetic.experiment import Experiment
from dahl_ident.synthetic.lab import simulate
from dahl_ident.synthetic.shipped import load_dataset

__all__ = [
    "Acquisition",
    "AmplitudeRamp",
    "Channel",
    "Experiment",
    "FrequencySweep",
    "SteppedSine",
    "Table",
    "load_dataset",
    "simulate",
]
