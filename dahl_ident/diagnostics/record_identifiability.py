"""Parameters that records do not determine, the reasons, and which motion would do so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.diagnostics.error_sources import RUNS
from dahl_ident.diagnostics.estimate import EXPONENT
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus
from dahl_ident.diagnostics.record_errors import MODEL
from dahl_ident.elements import Model
from dahl_ident.elements.recursion import stretches
from dahl_ident.units import si_unit

_UNCERTAIN = 0.3  # relative standard uncertainty of a parameter that is not determined
_LONG_ENOUGH = 0.02  # share of samples near a reversal
_ALIKE = 0.95  # correlation at which two parameters cannot be distinguished
_BECAUSE = {  # by the source of most of the uncertainty
    EXPONENT: "of the exponent, which was not given: give it if it is known, or estimate it too",
    RUNS: "the records ask for different values: fit each alone, and look at what differs",
    MODEL: "parts of the records ask for different values: choose a model that describes them",
}


def undetermined(
    model: Model,
    records: Sequence[Record],
    stderr: Mapping[str, float],
    covariance: FloatArray,
    names: Sequence[str],
    mostly: Mapping[str, str] = MappingProxyType({}),
) -> tuple[Finding, ...]:
    """Return one finding for each parameter that the records do not determine.

    Parameters
    ----------
    model : Model
        With the estimates put in.
    records : sequence of Record
        Those that were fitted.
    stderr : mapping of str to float
        Standard uncertainties of the model's free parameters.
    covariance : ndarray, shape (P, P)
        Of the parameters `names`.
    names : sequence of str
    mostly : mapping of str to str
        The source of most of the uncertainty, of parameters for which there is one.

    Returns
    -------
    tuple of Finding
    """
    found = []
    paths = [stretches(r.displacement) for r in records if r.displacement is not None]
    unit = si_unit("displacement", records[0].motion if records else "translation")
    farthest = max((float(p.path.max()) for p in paths), default=np.nan)
    for element in model.elements:
        values = [np.asarray(p.value if p.value is not None else 0.0) for p in element.parameters]
        low, high = (
            (float(k) for k in element.knee(values)) if element.has_memory else (np.nan,) * 2
        )
        near = np.mean(np.concatenate([p.path < 2.0 * low for p in paths])) if paths else np.nan
        for parameter in element.parameters:
            error = stderr.get(parameter.name)
            # a parameter that may be zero, such as an asymmetry, is known whatever its bounds
            limit = min(parameter.upper, -parameter.lower) if parameter.lower < 0.0 else 0.0
            size = limit if np.isfinite(limit) else 0.0
            if error is None or error <= _UNCERTAIN * max(size, abs(float(parameter.value or 0.0))):
                continue
            if farthest == 0.0:
                why = ": the displacement is constant; move"
            elif element.has_memory and farthest < 2.0 * low:
                # an estimate within its own uncertainty of zero says nothing of where slip begins
                known = error < abs(float(parameter.value or 0.0))
                needs = f"{2.0 * high:.2g} {unit}" if known else "more"
                why = (
                    f": the motion moves no farther than {farthest:.2g} {unit} after a reversal, "
                    f"and slip needs {needs}; move farther"
                )
            elif element.has_memory and near < _LONG_ENOUGH:
                why = (
                    f": the motion never stays below x_c = {low:.2g} {unit} long enough; add "
                    "reversals and small motions of that size, sampled closely"
                )
            elif mostly.get(parameter.name) in _BECAUSE:
                why = f" because {_BECAUSE[mostly[parameter.name]]}"
            else:
                why = _alike(parameter.name, covariance, names)
            values_of = {
                "name": parameter.name, "stderr": error, "unit": parameter.unit, "why": why
            }  # fmt: skip
            found.append(
                Finding(
                    Question.DETERMINED, VerdictStatus.NOT_DETERMINED, "record_parameter", values_of
                )
            )
    return tuple(found)


def _alike(name: str, covariance: FloatArray, names: Sequence[str]) -> str:
    place = list(names).index(name)
    with np.errstate(all="ignore"):
        size = np.sqrt(covariance.diagonal())
        correlation = covariance[place] / size / size[place]
    others = [n for n, c in zip(names, correlation, strict=True) if n != name and abs(c) > _ALIKE]
    if others:
        return f": it cannot be distinguished from {', '.join(others)}; fix one of them"
    return ": its effect is small compared with the residuals; fix it, or leave the element out"
