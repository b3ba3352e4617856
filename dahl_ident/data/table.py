"""Frequency responses and records as tables with units in their headers.

A table holds everything but what concerns all rows alike; that goes into ``attrs`` under
``dahl_ident``, and from there into a comment line, a schema or an attribute of a saved file:
which columns are verdicts, which hold text, and the provenance.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.data.columns import ROLES
from dahl_ident.data.quantities import polar_std
from dahl_ident.errors import ValidationError
from dahl_ident.units import MOTION_KINDS, si_unit

if TYPE_CHECKING:
    import pandas as pd

    from dahl_ident.data.frequency_response import FrequencyResponse
    from dahl_ident.data.record import Record


def response_frame(data: FrequencyResponse, *, polar: bool = False) -> pd.DataFrame:
    """Return one row for each point; see :meth:`FrequencyResponse.to_frame`."""
    import pandas as pd

    clashing = sorted({name for name in data.quality if name in ROLES or name == "frequency_hz"})
    if clashing:
        raise ValidationError(
            f"quality {clashing[0]!r} is also the name of a column of the table; rename it"
        )
    m, r = si_unit("displacement", data.motion), data.unit
    columns: dict[str, Any] = {
        "frequency_hz": data.frequency_hz,
        "level": data.level,
        f"amplitude [{m}]": data.amplitude,
        f"drive [{si_unit('force', data.motion)}]": data.drive,
        **(_polar(data) if polar else _rectangular(data)),
        "dof": data.dof,
        f"amplitude_std [{m}]": data.amplitude_std,
    }
    if data.amplitude_covariance is not None and not polar:
        for i, part in enumerate(("real", "imag")):
            columns[f"covariance_amplitude_{part} [({m})*({r})]"] = data.amplitude_covariance[:, i]
    columns |= {"controlled": data.controlled, "harmonic": data.harmonic, **data.quality}
    frame = pd.DataFrame({name: c for name, c in columns.items() if c is not None})
    frame.attrs["dahl_ident"] = {
        "quality": {name: verdict.dtype.kind for name, verdict in data.quality.items()},
        "text": [str(name) for name, c in columns.items() if c is not None and c.dtype.kind == "U"],
        "provenance": plain(data.provenance),
    }
    return frame


def _rectangular(data: FrequencyResponse) -> dict[str, Any]:
    r = data.unit
    columns: dict[str, Any] = {f"real [{r}]": data.response.real, f"imag [{r}]": data.response.imag}
    if data.covariance is not None:
        for name, i, j in (("real_real", 0, 0), ("real_imag", 0, 1), ("imag_imag", 1, 1)):
            columns[f"covariance_{name} [({r})^2]"] = data.covariance[:, i, j]
    return columns


def _polar(data: FrequencyResponse) -> dict[str, Any]:
    """Return gain and phase; their standard deviations to first order."""
    columns: dict[str, Any] = {
        f"gain [{data.unit}]": data.gain,
        "phase_deg": np.degrees(data.phase),
    }
    if data.covariance is not None:
        gain_std, phase_std = polar_std(data.response, data.covariance)
        columns[f"gain_std [{data.unit}]"] = gain_std
        columns["phase_std_deg"] = np.degrees(phase_std)
    return columns


def record_frame(record: Record) -> pd.DataFrame:
    """Return one row for each sample; see :meth:`Record.to_frame`."""
    import pandas as pd

    units = {kind: si_unit(kind, record.motion) for kind in (*MOTION_KINDS, "force")}
    units |= {"time": "s", "drive": record.drive_unit}
    columns = {
        f"{name} [{units[name]}]": getattr(record, name)
        for name in ("time", *MOTION_KINDS, "force", "drive")
        if getattr(record, name) is not None
    }
    frame = pd.DataFrame(columns)
    frame.attrs["dahl_ident"] = {
        "drive_factor": record.drive_factor,
        "drive_factor_uncertainty": record.drive_factor_uncertainty,
        "provenance": plain(record.provenance),
    }
    return frame


def control_systems(data: FrequencyResponse) -> dict[Any, Any]:
    """Return one transfer function for each level; see :meth:`FrequencyResponse.to_control`."""
    import control

    if (data.harmonic > 1).any():
        raise ValidationError("a transfer function has no harmonics; use select(harmonic=1) first")
    systems = {}
    for label in data.levels or [None]:
        part = data if label is None else data.select(level=label)
        order = np.argsort(part.omega, kind="stable")
        twice = np.flatnonzero(np.diff(part.omega[order]) == 0.0)
        if twice.size:
            raise ValidationError(
                f"level {label!r} has {part.frequency_hz[order][twice[0]]:g} Hz more than once; a "
                "transfer function has one value a frequency. Give the rows levels"
            )
        systems[label] = control.FrequencyResponseData(part.response[order], part.omega[order])
    return systems


def plain(value: Any) -> Any:
    """Return mappings as dicts and sequences as lists, down to what JSON holds."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)
