"""The main door: from data and a model to estimates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from dahl_ident.data import FrequencyResponse
from dahl_ident.elements import Element
from dahl_ident.errors import FitError
from dahl_ident.fitting import solve
from dahl_ident.problem import Problem
from dahl_ident.results.fit_result import FitResult
from dahl_ident.sensors import Sensors


def fit(
    data: FrequencyResponse,
    model: Element,
    *,
    free: Iterable[str] = (),
    fixed: Mapping[str, float] | None = None,
    noise: str | None = None,
    sensors: Sensors | None = None,
    loss: str = "linear",
    start: Mapping[str, float] | None = None,
    throw: bool = True,
) -> FitResult:
    """Estimate a model's free parameters by least squares; no guess is needed.

    Parameters
    ----------
    data : FrequencyResponse
        What was measured. Displacement-controlled rows need an amplitude, force-controlled rows
        a drive.
    model : Element
        One element or a sum, such as ``Dahl() + Mass(0.3)``. Numbers are fixed, the rest free.
    free : iterable of str, optional
        Names of given parameters to estimate all the same, from their values.
    fixed : mapping of str to float, optional
        Parameters to hold at a value.
    noise : {"measured", "relative", "absolute"}, optional
        Default: "measured" where the data have a covariance, else "relative".
    sensors : Sensors, optional
        Gains and delay of the channels; left out, they are taken as exact.
    loss : {"linear", "huber", "soft_l1", "student_t"}, default "linear"
        A robust loss makes outliers count less; the noise's scale is estimated robustly then.
    start : mapping of str to float, optional
        One more start for the search: values of some or all free parameters.
    throw : bool, default True
        Raise where the data give no finite optimum; otherwise return what was found, with its
        `status`.

    Returns
    -------
    FitResult
        Estimates, errors and diagnostics, each computed when first asked for.

    Raises
    ------
    FitError
        If there is no finite optimum and `throw`; the error's `result` holds what was found.
        Also if there are fewer numbers than parameters.
    ModelError
        If nothing is free, or a name is unknown.
    DataError
        If the rows lack what their model or noise needs.
    ValidationError
        If an option is unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl, FrequencyResponse
    >>> A = np.geomspace(1e-4, 1e-2, 9)
    >>> N = Dahl(f_max=0.1, sigma=30.0).describing_function(A)
    >>> result = fit(FrequencyResponse(np.ones(9), N, A), Dahl())
    >>> result.params["f_max"].value.__round__(9), result.success
    (0.1, True)
    """
    problem = Problem(data, model, noise=noise, sensors=sensors, free=free, fixed=fixed)
    result = FitResult(solve(problem, loss=loss, start=start))
    if throw and not result.success:
        raise FitError(result.message, result)
    return result
