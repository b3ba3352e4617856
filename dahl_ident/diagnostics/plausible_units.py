"""Numbers that look like another unit: friction of impossible size, peak-to-peak amplitudes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dahl_ident.diagnostics.parameters import parameter_values
from dahl_ident.fitting import Optimum
from dahl_ident.units import engineering, shown_unit

# Ranges in SI units within which mechanisms lie, from micromachines to bridge bearings.
_TYPICAL = {"x_c": (1e-9, 0.1), "force limit": (1e-9, 1e8), "contact stiffness": (1e-2, 1e12)}
_TYPICAL_ROTATION = {
    "x_c": (1e-7, 1.0), "force limit": (1e-10, 1e8), "contact stiffness": (1e-4, 1e12)
}  # fmt: skip
_DIMENSIONS = {(1, 0, 0): "force limit", (1, -1, 0): "contact stiffness"}
_RATIOS = {2.0: "peak-to-peak", 2.0**-0.5: "root-mean-square"}
_ALIKE = 0.05  # relative difference from such a ratio, and spread


def implausible_units(optimum: Optimum) -> Iterator[str]:
    """Yield a sentence for every number that another unit would explain."""
    yield from _sizes(optimum)
    yield from _levels(optimum)


def _sizes(optimum: Optimum) -> Iterator[str]:
    if not optimum.success:
        return
    motion, values = optimum.problem.data.motion, parameter_values(optimum)
    typical = _TYPICAL if motion == "translation" else _TYPICAL_ROTATION
    for element in optimum.problem.model.elements:
        if not element.has_memory:
            continue
        own = [float(values[p.name]) for p in element.parameters]
        sizes = [
            (p.name, p.unit, _DIMENSIONS[p.dimension], value)
            for p, value in zip(element.parameters, own, strict=True)
            if p.free and p.dimension in _DIMENSIONS
        ]
        low, high = element.knee([np.asarray(v) for v in own])
        if sizes and low == high:
            sizes.append(("x_c", "m", "x_c", float(low)))
        for name, unit, kind, value in sizes:
            least, most = typical[kind]
            if np.isfinite(value) and not least <= value <= most:
                shown = shown_unit(unit, motion)
                yield (
                    f"{name} is {engineering(value, shown)}, where mechanisms have "
                    f"{engineering(least, shown)} to {engineering(most, shown)}: check the units "
                    "of displacement and force"
                )


def _levels(optimum: Optimum) -> Iterator[str]:
    """Yield that amplitudes are not zero-to-peak, where nominal levels say what they should be."""
    data = optimum.problem.data
    driven = bool((data.controlled == "force").all())
    size = data.drive if driven else data.amplitude
    if size is None or data.level is None or data.level.dtype.kind not in "if":
        return
    level = np.asarray(data.level, dtype=np.float64)
    if not (level > 0.0).all() or np.ptp(level) == 0.0:
        return
    ratio = size / level
    for wrong, name in _RATIOS.items():
        if np.all(np.abs(ratio / wrong - 1.0) < _ALIKE):
            yield (
                f"every {'drive' if driven else 'amplitude'} is {np.median(ratio):.3g} times its "
                f"nominal level: {name} values, where zero-to-peak is meant?"
            )
