r"""Cross-validation of the bands: each test is predicted from the others.

For the linear mixed model of :mod:`dahl_ident.diagnostics.error_model` the prediction of rows b
from all others, parameters estimated without them, misses by

    e_b = (P_bb)^-1 (P y)_b,    with the covariance (P_bb)^-1,

P as in :mod:`dahl_ident.diagnostics.variance_components`; nothing is fitted again. Source:
Dubrule, *Cross validation of kriging in a unique neighborhood*, Mathematical Geology 15 (1983) 687.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.budget import coverage_factor
from dahl_ident.diagnostics.error_model import ErrorModel
from dahl_ident.diagnostics.error_sources import repeated_levels

_FEWEST_TESTS = 3  # two leave one from which to predict, which shows no scatter
_MOST_TESTS = 500  # left out one at a time: the share inside is then known to 1 %
_CONFIDENCE = 0.95  # of the bands: one value in twenty is outside by chance


@dataclass(frozen=True)
class CrossValidation:
    """Held-out gains and phases against their 95 % bands.

    Attributes
    ----------
    tests : int
        Runs, levels or rows that were left out, one at a time.
    inside, count : int
        Held-out gains and phases inside their bands, and all of them.
    width : float
        Root mean square of the bands' half widths, in ln gain and phase (rad); of the
        fundamentals where there are any, as other harmonics may be next to nothing.
    misfit : float
        Root mean square of the held-out deviations, in the same.
    available : int
        Tests there are; of very many, some were left out, chosen evenly.
    """

    tests: int
    inside: int
    count: int
    width: float
    misfit: float
    available: int

    def __str__(self) -> str:
        of = "" if self.tests == self.available else f" of {self.available}"
        return (
            f"leaving out each of {self.tests}{of} tests in turn, {self.inside} of {self.count} "
            f"held-out gains and phases are inside their 95 % bands (half width "
            f"{100.0 * self.width:.2g} %)"
        )


def cross_validation(errors: ErrorModel) -> CrossValidation | None:
    """Return how well bands hold for tests that were left out; None with fewer than three tests.

    Examples
    --------
    >>> import dahl_ident as di
    >>> from dahl_ident.diagnostics import error_model
    >>> found = cross_validation(error_model(di.fit(di.load_dataset("noisy"), di.Dahl()).optimum))
    >>> found.inside > 0.8 * found.count
    True
    """
    problem = errors.problem
    tests = tests_of(problem.data)
    if len(tests) < _FEWEST_TESTS:
        return None
    chosen = np.linspace(0, len(tests) - 1, min(len(tests), _MOST_TESTS)).round().astype(int)
    block_of, Py = errors.projected()
    k = _factor(errors)
    deviations, widths, orders = [], [], []
    turn = errors.relative_units()
    for rows in (tests[i] for i in chosen):
        index = (2 * rows[:, None] + np.arange(2)).ravel()
        try:
            covariance = np.linalg.inv(block_of(index))
        except np.linalg.LinAlgError:
            continue
        missed = (covariance @ Py[index]).reshape(-1, 2)
        for place, row in enumerate(rows):
            part = covariance[2 * place : 2 * place + 2, 2 * place : 2 * place + 2]
            to_relative = turn[row]
            own = to_relative @ part @ to_relative.T
            deviations.append(to_relative @ missed[place])
            orders.append(problem.data.harmonic[row])
            widths.append(k * np.sqrt(np.maximum(np.diagonal(own), 0.0)))
    found, width = np.array(deviations), np.array(widths)
    known = np.isfinite(width) & (width < 1e6) & (width > 0.0)
    if not known.any():
        return None
    first = known & (np.array(orders) == 1)[:, None]
    sized = first if first.any() else known
    return CrossValidation(
        len(chosen),
        int((np.abs(found) <= width)[known].sum()),
        int(known.sum()),
        float(np.sqrt(np.mean(width[sized] ** 2))),
        float(np.sqrt(np.mean(found[sized] ** 2))),
        len(tests),
    )


def tests_of(data: FrequencyResponse) -> list[NDArray[np.intp]]:
    """Return the rows of each test: runs, else labelled levels, else repeats of one level."""
    for labels in (data.run, data.level):
        if labels is not None:
            names, which = np.unique(labels, return_inverse=True)
            if _FEWEST_TESTS <= len(names) < data.n:
                return _rows_of(which)
    return _rows_of(repeated_levels(data))


def _rows_of(which: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    return np.split(np.argsort(which, kind="stable"), np.cumsum(np.bincount(which))[:-1])


def _factor(errors: ErrorModel) -> float:
    """Return the factor of a prediction's band, by the degrees of freedom of the variances."""
    total = float(errors.variances.sum())
    C = errors.components.covariance
    spread = float(C.sum())
    if not spread > 0.0 or errors.problem.scale_known:
        return coverage_factor(np.inf, _CONFIDENCE)
    return coverage_factor(max(2.0, 2.0 * total**2 / spread), _CONFIDENCE)
