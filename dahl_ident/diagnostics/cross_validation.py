"""Cross-validation of the bands: each test is predicted from the others.

The width of each band follows from the other tests alone; the variances are those of all, and
nothing is fitted again (:mod:`dahl_ident.diagnostics.held_out`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.diagnostics.error_model import ErrorModel
from dahl_ident.diagnostics.held_out import band_factor, held_out
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus

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

    def finding(self, severity: VerdictStatus) -> Finding:
        """Return the check as a finding."""
        values = {
            "tests": self.tests,
            "available": self.available,
            "inside": self.inside,
            "count": self.count,
            "width": self.width,
        }
        return Finding(Question.DESCRIBED, severity, "held_out", values)

    def __str__(self) -> str:
        return str(self.finding(VerdictStatus.TRUSTED))


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
    found = held_out(errors)
    if found is None:
        return None
    width = np.empty(found.std.shape)
    for test in np.unique(found.test).tolist():
        rows = found.test == test
        k = band_factor(found.without(test), found.dof[rows], _CONFIDENCE)
        width[rows] = k * found.std[rows]
    known = np.isfinite(width)
    if not known.any():
        return None
    first = known & (errors.problem.data.harmonic[found.rows] == 1)[:, None]
    sized = first if first.any() else known
    return CrossValidation(
        len(np.unique(found.test)),
        int((np.abs(found.deviation) <= width)[known].sum()),
        int(known.sum()),
        float(np.sqrt(np.mean(width[sized] ** 2))),
        float(np.sqrt(np.mean(found.deviation[sized] ** 2))),
        found.available,
    )
