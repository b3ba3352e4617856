"""What is done to every column of a frequency response alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

if TYPE_CHECKING:
    from dahl_ident.data.frequency_response import FrequencyResponse

_COLUMNS = (
    "frequency_hz",
    "response",
    "amplitude",
    "drive",
    "covariance",
    "dof",
    "amplitude_std",
    "amplitude_covariance",
    "level",
    "controlled",
    "harmonic",
)


def combined(
    parts: Sequence[FrequencyResponse], combine: Callable[[list[NDArray[Any]]], NDArray[Any]]
) -> dict[str, Any]:
    """Apply `combine` to each column of all parts; returns constructor arguments."""
    columns: dict[str, Any] = {
        name: combine([getattr(part, name) for part in parts])
        for name in _COLUMNS
        if getattr(parts[0], name) is not None
    }
    columns["quality"] = {
        name: combine([part.quality[name] for part in parts]) for name in parts[0].quality
    }
    return columns


def shape_of(data: FrequencyResponse) -> set[str]:
    """Return what two tables must share to become one."""
    columns = {name for name in _COLUMNS if getattr(data, name) is not None}
    if data.level is not None:
        columns.add("text levels" if data.level.dtype.kind == "U" else "numeric levels")
    return columns | set(data.quality) | {data.quantity, data.motion}
