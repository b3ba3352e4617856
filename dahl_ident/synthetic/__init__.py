"""The synthetic laboratory: data whose truth is known, as close to a real laboratory as can be.

An :class:`Experiment` says which mechanism is driven how, through which sensors; ``simulate``
turns it and a seed into a :class:`~dahl_ident.data.Record` of waveforms or a
:class:`~dahl_ident.data.FrequencyResponse`. Friction follows Eqn. 2 in time, so that whatever is
estimated by describing functions is tested against something else. Ready-made data sets ship
with the package: see :func:`load_dataset`.
"""

from dahl_ident.synthetic.acquisition import Acquisition, Channel
from dahl_ident.synthetic.excitation import AmplitudeRamp, FrequencySweep, SteppedSine
from dahl_ident.synthetic.experiment import Experiment
from dahl_ident.synthetic.lab import simulate
from dahl_ident.synthetic.shipped import load_dataset
from dahl_ident.synthetic.table_errors import Table

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
