"""The public functions ``fit`` and ``fit_many``: from data and a model to estimates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, cast, overload

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.data import FrequencyResponse, Record, read_frequency_response
from dahl_ident.data.rows import row_names
from dahl_ident.elements import Element
from dahl_ident.elements.element import as_model
from dahl_ident.errors import FitError, ValidationError
from dahl_ident.fitting import Optimum, solve, solve_many
from dahl_ident.problem import Problem, ProblemBatch
from dahl_ident.results.fit_batch import FitBatch
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.record_fit import RecordFit, fit_records
from dahl_ident.sensors import Sensors
from dahl_ident.steady_state import Steady

if TYPE_CHECKING:
    import pandas as pd

    from dahl_ident.elements.equations import Excitation
    from dahl_ident.fitting.constraints import Constraints
    from dahl_ident.problem.record_problem import Output


@overload
def fit(
    data: FrequencyResponse | pd.DataFrame,
    model: Element,
    *,
    method: str = ...,
    free: Iterable[str] = ...,
    fixed: Mapping[str, float] | None = ...,
    noise: str | None = ...,
    sensors: Sensors | None = ...,
    loss: str = ...,
    start: Mapping[str, float] | None = ...,
    constraints: Constraints | None = ...,
    drive_std: ArrayLike | None = ...,
    drive_covariance: ArrayLike | None = ...,
    steady: Steady = ...,
    throw: bool = ...,
) -> FitResult: ...
@overload
def fit(
    data: Record | Sequence[Record],
    model: Element,
    *,
    free: Iterable[str] = ...,
    fixed: Mapping[str, float] | None = ...,
    sensors: Sensors | None = ...,
    start: Mapping[str, float] | None = ...,
    output: Output | None = ...,
    excitation: Excitation = ...,
    throw: bool = ...,
    progress: bool = ...,
) -> RecordFit: ...
def fit(
    data: FrequencyResponse | pd.DataFrame | Record | Sequence[Record],
    model: Element,
    *,
    method: str = "lm",
    free: Iterable[str] = (),
    fixed: Mapping[str, float] | None = None,
    noise: str | None = None,
    sensors: Sensors | None = None,
    loss: str = "linear",
    start: Mapping[str, float] | None = None,
    constraints: Constraints | None = None,
    drive_std: ArrayLike | None = None,
    drive_covariance: ArrayLike | None = None,
    steady: Steady = "exact",
    output: Output | None = None,
    excitation: Excitation = "force",
    throw: bool = True,
    progress: bool = False,
) -> FitResult | RecordFit:
    """Estimate a model's free parameters by least squares; no initial values are needed.

    Parameters
    ----------
    data : FrequencyResponse, DataFrame, Record or sequence of Record
        What was measured; a pandas table is read by `read_frequency_response`.
        Displacement-controlled rows need an amplitude, force-controlled rows
        a drive. Records of any motion are fitted sample by sample, several as runs of one device.
    model : Element
        One element or a sum, such as ``Dahl() + Mass(0.3)``. Numbers are fixed, the rest free.
    method : {"lm", "scipy", "ipopt"}, default "lm"
        "lm" is Levenberg and Marquardt's method from a global start. "scipy" is
        `scipy.optimize.least_squares` on the same residuals and Jacobian from the same starts.
        "ipopt" goes on from the optimum by IPOPT, and alone takes `constraints` and noise in the
        drive. All three find the same optimum; "lm" is the fastest.
    free : iterable of str, optional
        Names of parameters that have values but are to be estimated, starting from these values.
    fixed : mapping of str to float, optional
        Parameters to hold at a value.
    noise : {"measured", "relative", "absolute"}, optional
        Default: "measured" where the data have a covariance, else "relative".
    sensors : Sensors, optional
        Gains and delay of the channels; left out, they are taken as exact. Of records: priors
        about 1 and 0 alone, whose standard deviations count in the uncertainty.
    loss : {"linear", "huber", "soft_l1", "student_t"}, default "linear"
        A robust loss down-weights outliers; the noise's scale is then estimated robustly.
    start : mapping of str to float, optional
        Additional start of the search: values of some or all free parameters.
    constraints : callable, optional
        With "ipopt": takes a mapping of every parameter's name to its casadi symbol and returns
        comparisons, such as ``lambda p: [p["sigma"] >= 100 * p["f_max"]]``.
    drive_std, drive_covariance : array_like, shapes (n,) and (n, 2), optional
        With "ipopt", for force-controlled rows: standard deviation of the measured drive, and its
        covariance with real and imaginary part of the response.
    steady : {"exact", "describing function"}, default "exact"
        How rows whose force was controlled are predicted: by the exact steady motion of a model
        with a mass, or as if the displacement were a sine. The second is faster and the paper's.
    output : {"force", "motion"}, optional
        For records: predict the force from the measured displacement, or the motion from the
        measured force. Default: the motion if the model has a mass.
    excitation : {"force", "base"}, default "force"
        Of records whose motion is predicted: "base" where their force channel is the acceleration
        of the base, m/s^2, and the motion relative to it.
    throw : bool, default True
        Raise where the data give no finite optimum; otherwise return what was found, with its
        `status`.
    progress : bool, default False
        Of records: show on the terminal how the search goes, once it has taken two seconds.

    Returns
    -------
    FitResult
        Estimates, errors and diagnostics, each computed when first asked for.

    Raises
    ------
    FitInterrupted
        If a fit of records was stopped from the keyboard; its `result` holds the best so far.
    FitError
        If there is no finite optimum and `throw`; the error's `result` holds what was found.
        Also if there are fewer numbers than parameters, or no values tried predict every row.
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
    if hasattr(data, "iloc"):  # a table in memory, without the import of pandas
        data = read_frequency_response(cast("pd.DataFrame", data))
    if not isinstance(data, FrequencyResponse):
        taken = {
            "noise": noise, "constraints": constraints,
            "drive_std": drive_std, "drive_covariance": drive_covariance,
            "loss": None if loss == "linear" else loss,
            "method": None if method == "lm" else method,
            "steady": None if steady == "exact" else steady,
        }  # fmt: skip
        refused = [name for name, value in taken.items() if value is not None]
        if refused:
            raise ValidationError(f"{' and '.join(refused)} given; a fit of records takes none")
        records = [data] if isinstance(data, Record) else list(data)
        bound = as_model(model).with_free(free).with_fixed(fixed or {})
        return fit_records(
            records, bound, start=start, output=output, excitation=excitation,
            calibration=(sensors or Sensors()).stated_uncertainties(),
            throw=throw, progress=progress,
        )  # fmt: skip
    problem = Problem(
        data, model, noise=noise, sensors=sensors, free=free, fixed=fixed, steady=steady
    )
    own = {
        "constraints": constraints, "drive_std": drive_std, "drive_covariance": drive_covariance
    }  # fmt: skip
    beyond = [name for name, value in own.items() if value is not None]
    if method == "ipopt":
        from dahl_ident.fitting.ipopt import solve_ipopt

        optimum = solve_ipopt(
            problem,
            constraints=constraints,
            start=start,
            loss=loss,
            drive_std=drive_std,
            drive_covariance=drive_covariance,
        )
    elif method not in ("lm", "scipy"):
        raise ValidationError(f"method is {method!r}; expected lm, scipy or ipopt")
    elif beyond:
        raise ValidationError(f"{' and '.join(beyond)} given; only method='ipopt' takes that")
    else:
        optimum = solve(problem, method=method, loss=loss, start=start)
    if not np.isfinite(optimum.residuals).all():
        raise FitError(_no_prediction(optimum))
    result = FitResult(optimum, first_order=constraints is not None)
    if throw and not result.success:
        cause = result.goodness.cause
        raise FitError(f"{cause} {result.message}" if cause else result.message, result)
    return result


def _no_prediction(optimum: Optimum) -> str:
    """Return what to do where no values tried predict a finite response in every row."""
    data = optimum.problem.data
    (name,) = row_names(data, [int(np.flatnonzero(~np.isfinite(optimum.residuals))[0]) // 2])
    cause = "the model has no finite response there; give a start, or another model"
    if (data.controlled == "force").any():
        cause = (
            "the drive moves the model without bound; add the mass, damper or spring that friction "
            "is in parallel, or give a start"
        )
    return f"No parameters that were tried predict {name}: {cause}"


def fit_many(
    tables: Sequence[FrequencyResponse],
    model: Element,
    *,
    free: Iterable[str] = (),
    fixed: Mapping[str, float] | None = None,
    noise: str | None = None,
    sensors: Sensors | None = None,
    steady: Steady = "exact",
) -> FitBatch:
    """Estimate one model's parameters from each of many tables at once.

    Parameters
    ----------
    tables : sequence of FrequencyResponse
        With the same number of rows, quantity, harmonics and controlled variable.
    model, free, fixed, noise, sensors, steady
        As for :func:`fit`.

    Returns
    -------
    FitBatch
        Estimates of all tables, with standard errors from noise alone and, on request, combined
        uncertainties; ``batch[i]`` is the :class:`FitResult` of one of them, with everything that
        a single fit offers.

    Raises
    ------
    DataError
        If the tables do not agree in shape, or there is none.
    ModelError
        If nothing is free, or a name is unknown.
    FitError
        If there are fewer numbers than parameters.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl, FrequencyResponse
    >>> A = np.geomspace(1e-4, 1e-2, 9)
    >>> tables = [
    ...     FrequencyResponse(np.ones(9), Dahl(f_max, 30.0).describing_function(A), A)
    ...     for f_max in (0.1, 0.2)
    ... ]
    >>> fit_many(tables, Dahl()).values.round(6).tolist()
    [[0.1, 30.0], [0.2, 30.0]]
    """
    batch = ProblemBatch(
        tables, model, noise=noise, sensors=sensors, free=free, fixed=fixed, steady=steady
    )
    return FitBatch(tuple(tables), solve_many(batch))
