"""How near estimates are to what made the data."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from dahl_ident.elements import Element

Truth = Element | Mapping[str, float] | Iterable[tuple[str, float]]


def assert_near(fit: Any, truth: Truth, most: float, share: float = np.inf) -> None:
    """Check that estimates are within so many standard uncertainties, which are below a share.

    Of an element, those of the parameters that were free.
    """
    if isinstance(truth, Element):
        values = {p.name: float(p.value or 0.0) for p in truth.parameters}
        truth = {name: value for name, value in values.items() if fit.params[name].vary}
    for name, value in dict(truth).items():
        found = fit.params[name]
        assert abs(found.value - value) < most * found.stderr, f"{found}; the truth is {value}"
        assert found.stderr < share * abs(value), f"{found}; the truth is {value}"
