"""The public functions from data and a model to results: ``fit``, ``fit_many``, ``posterior``."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.bayes.chain import LENGTH, Chain, ChainSettings, Convergence, Listener, Pool
from dahl_ident.bayes.density import Density, LogDensity, RecordDensity
from dahl_ident.bayes.priors import PriorLike, joint_prior
from dahl_ident.bayes.sample import (
    centre_and_covariance,
    optimum_of,
    sample_chain,
    sample_points,
    starting_points,
)
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.columns import one_of
from dahl_ident.diagnostics.contributions import EXPONENT, NOISE
from dahl_ident.diagnostics.error_model import row_errors
from dahl_ident.diagnostics.estimate import with_assumed
from dahl_ident.elements import Element
from dahl_ident.elements.driven_motion import Steady
from dahl_ident.elements.element import as_model
from dahl_ident.errors import FitError, FitInterrupted, ModelError, ValidationError, argument
from dahl_ident.fitting import Optimum, solve, solve_many
from dahl_ident.problem import (
    ProblemBatch,
    changed_options,
    problem_class,
    problem_of,
    refuse_options,
)
from dahl_ident.progress import spinner
from dahl_ident.results.fit_result import FitBatch, FitResult
from dahl_ident.results.posterior_result import Posterior
from dahl_ident.sensors import Sensors
from dahl_ident.units import counted, percent

if TYPE_CHECKING:
    import pandas as pd

    from dahl_ident.elements.equations import Excitation
    from dahl_ident.fitting.ipopt import Constraints
    from dahl_ident.problem.record_waves import Output

METHODS = ("mcmc", "grid")
UNCERTAINTIES = ("combined", "noise")


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
) -> FitResult:
    """Estimate a model's free parameters by least squares; no initial values are needed.

    Parameters
    ----------
    data : FrequencyResponse, DataFrame, Record or sequence of Record
        Measured data; a pandas table is read by `read_frequency_response`.
        Displacement-controlled rows need an amplitude, force-controlled rows a drive. Records of
        any motion are fitted sample by sample, several as runs of one device.
    model : Element
        One element or a sum, such as ``Dahl() + Mass(0.3)``. Numbers are fixed, the rest free.
    method : {"lm", "scipy", "ipopt"}, default "lm"
        "lm" is Levenberg and Marquardt's method from a global start. "scipy" is
        `scipy.optimize.least_squares` on the same residuals and Jacobian from the same starts.
        "ipopt" continues from the optimum with IPOPT, and alone takes `constraints` and noise in
        the drive. All three find the same optimum; "lm" is the fastest.
    free : iterable of str, optional
        Names of parameters with values that are to be estimated; the values are starts.
    fixed : mapping of str to float, optional
        Parameters to hold at a value.
    noise : {"measured", "relative", "absolute"}, optional
        For tables. Default: "measured" if the data have a covariance, otherwise "relative".
    sensors : Sensors, optional
        Gains and delay of the channels; left out, they are taken as exact. For records, only
        priors about 1 and 0, whose standard deviations are included in the uncertainty.
    loss : {"linear", "huber", "soft_l1", "student_t"}, default "linear"
        A robust loss down-weights outliers; the noise's scale is then estimated robustly. The
        sources of error are the same as without one.
    start : mapping of str to float, optional
        Additional start of the search: values of some or all free parameters.
    constraints : callable, optional
        With "ipopt": function of a mapping of every parameter's name to its casadi symbol, which
        returns comparisons, such as ``lambda p: [p["sigma"] >= 100 * p["f_max"]]``. An exponent
        that was not given is then a free parameter.
    drive_std, drive_covariance : array_like, shapes (n,) and (n, 2), optional
        With "ipopt", for force-controlled rows: standard deviation of the measured drive, and its
        covariance with real and imaginary part of the response.
    steady : {"exact", "describing function"}, default "exact"
        How force-controlled rows are predicted: by the exact steady motion of a model with a mass,
        or as if the displacement were a sine, which is faster and the method of the paper.
    output : {"force", "motion"}, optional
        For records: predict the force from the measured displacement, or the motion from the
        measured force. Default: the motion if the model has a mass.
    excitation : {"force", "base"}, default "force"
        For records whose motion is predicted: "base" if their force channel is the acceleration of
        the base, m/s^2, and the motion is relative to it.
    throw : bool, default True
        Raise an error if there is no finite optimum; otherwise return the best point, with its
        `status`.
    progress : bool, default False
        For records: show the progress of the search on the terminal after two seconds.

    Returns
    -------
    FitResult
        Estimates, errors and diagnostics, each computed when first needed.

    Raises
    ------
    FitInterrupted
        If a fit of records was stopped from the keyboard; its `result` holds the best so far.
    FitError
        If there is no finite optimum and `throw`; the error's `result` is the best point. Also if
        there are fewer numbers than parameters, or no values that were tried predict every row.
    ModelError
        If no parameter is free, or a name is unknown.
    DataError
        If the rows lack data for their model or noise.
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
    options = {**locals()}
    refuse_options(problem_class(data), options, fit)
    if method not in ("lm", "scipy", "ipopt"):
        raise ValidationError(f"method is {method!r}; expected lm, scipy or ipopt")
    of_ipopt = {name: options[name] for name in ("constraints", "drive_std", "drive_covariance")}
    given = [name for name, value in of_ipopt.items() if value is not None]
    if given and method != "ipopt":
        raise ValidationError(
            f"{' and '.join(given)} given; only {argument('method', 'ipopt')} takes that"
        )

    if constraints is not None:  # what nobody gave is estimated with them, as it is without
        model = as_model(model)
        unstated = (p for p in model.parameters if p.assumed and p.name not in (fixed or {}))
        model = model.with_parameters({p.name: p.freed() for p in unstated})
    problem = problem_of(
        data,
        model,
        free=free,
        fixed=fixed,
        sensors=sensors,
        noise=noise,
        steady=steady,
        output=output,
        excitation=excitation,
    )
    try:
        with _fit_progress() if progress else nullcontext() as tell:
            if method != "ipopt":
                optimum = solve(problem, method=method, loss=loss, start=start, tell=tell)
            else:
                from dahl_ident.fitting.ipopt import solve_ipopt

                optimum = solve_ipopt(problem, start=start, loss=loss, tell=tell, **of_ipopt)
            result = FitResult(optimum, first_order=constraints is not None)
    except FitInterrupted as stop:
        raise FitInterrupted(
            f"{stop}; this exception's `result` holds the best values so far",
            FitResult(stop.result),
        ) from stop
    if cause := problem.why_not_finite(optimum.residuals):
        raise FitError(cause)
    if throw and not result.success:
        raise FitError(f"{result.goodness.cause} {result.message}".strip(), result)
    return result


def fit_many(
    data: Sequence[FrequencyResponse] | Sequence[Record],
    model: Element,
    *,
    free: Iterable[str] = (),
    fixed: Mapping[str, float] | None = None,
    noise: str | None = None,
    sensors: Sensors | None = None,
    steady: Steady = "exact",
) -> FitBatch:
    """Estimate one model's parameters from each of many tables, or of many records.

    Parameters
    ----------
    data : sequence of FrequencyResponse or Record
        Tables with the same number of rows, quantity, harmonics and controlled variable, which are
        fitted at once; or records, each fitted on its own.
    model, free, fixed, noise, sensors, steady
        As for :func:`fit`.

    Returns
    -------
    FitBatch
        All estimates, with combined uncertainties; ``batch[i]`` is the
        :class:`FitResult` of one of them, with everything that a single fit offers.

    Raises
    ------
    DataError
        If the tables do not agree in shape, or there is none.
    ModelError
        If no parameter is free, or a name is unknown.
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
    options: dict[str, Any] = {
        "free": list(free),
        "fixed": fixed,
        "noise": noise,
        "sensors": sensors,
        "steady": steady,
    }
    if isinstance(data, list | tuple) and data and all(isinstance(one, Record) for one in data):
        return FitBatch(tuple(fit(one, model, throw=False, **options).optimum for one in data))
    return FitBatch(solve_many(ProblemBatch(data, model, **options)))


def posterior(
    data: FrequencyResponse | FitResult | Record | Sequence[Record],
    model: Element | None = None,
    *,
    method: str = "mcmc",
    priors: Mapping[str, PriorLike] | None = None,
    free: Iterable[str] = (),
    fixed: Mapping[str, float] | None = None,
    noise: str | None = None,
    sensors: Sensors | None = None,
    steady: Steady | None = None,
    likelihood: str = "gaussian",
    uncertainty: str = "combined",
    seed: int | None = None,
    steps: int | None = None,
    max_steps: int = 20000,
    ess: float = 2000.0,
    walkers: int | None = None,
    ensembles: int = 4,
    resume: str | os.PathLike[str] | None = None,
    pool: Pool | None = None,
    progress: bool = False,
    tolerance: float = 1e-3,
) -> Posterior:
    """Return the posterior of a model's parameters, by Markov chain or by integration.

    Parameters
    ----------
    data : FrequencyResponse, Record, sequence of Record or FitResult
        Measured data; or a fit, whose data, model, noise and sensors are used. Records are fitted
        first; if `output`, `excitation` or `start` is needed, give their fit.
    model : Element, optional
        One element or a sum, such as ``Dahl() + Mass(0.3)``; left out with a fit.
    method : {"mcmc", "grid"}, default "mcmc"
        "mcmc" samples with emcee. "grid" integrates over up to three free parameters with
        importance points: no chain, a reproducible result, and the evidence. An unknown noise scale
        is integrated analytically and is not one of the three.
    priors : mapping of str to distribution or (low, high), optional
        By parameter: a frozen distribution of scipy.stats over the value, or bounds, between
        which positive parameters are log-uniform and the others uniform. Other parameters have
        wide bounds from the size of the data, which the report states.
    free, fixed, noise, sensors, steady
        As for :func:`dahl_ident.fit`. Sensors may have any prior here.
    likelihood : {"gaussian", "student_t", "none"}, default "gaussian"
        "student_t" reduces the weight of outliers (4 degrees of freedom; on a grid it needs noise
        of known scale); "none" gives the prior.
    uncertainty : {"combined", "noise"}, default "combined"
        "combined" includes every source of the fit's uncertainty budget that was estimated from
        the data, such as scatter between runs and model error, and samples exponents that were not
        given, log-uniform over their range, which takes several times as long as with given ones.
        "noise" includes independent noise alone, as do likelihoods other than "gaussian". The
        verdict states which.
    seed : int, optional
        The same seed gives the same chain. Default: a random one, which is reported. A grid does
        not need a seed.
    steps : int, optional
        Total number of steps, warm-up included. Default: until the chain has converged, with 50
        autocorrelation times after warm-up, R-hat below 1.01, and `ess`.
    max_steps : int, default 20000
        Limit of steps without convergence.
    ess : float, default 2000
        Required effective number of draws of every parameter.
    walkers : int, optional
        Number in all ensembles together. Default: 32 per ensemble, more for many parameters.
    ensembles : int, default 4
        Number of independent groups of walkers.
    resume : path, optional
        HDF5 file for the chain: created if it does not exist, otherwise continued to the *total*
        number of steps. It is valid at any time, also after a crash, and interruptions do not
        change the chain.
    pool : object with map, optional
        Distributes the likelihood over processes. Default: one process computes all walkers at
        once, which is faster unless a single likelihood takes milliseconds.
    progress : bool, default False
        Show the progress on the terminal; for a chain, with the remaining time.
    tolerance : float, default 1e-3
        With "grid": largest relative error of the evidence and error of probabilities.

    Returns
    -------
    Posterior
        Its first line states if it has not converged.

    Raises
    ------
    SamplingError
        If no point of finite density is found, the scale of the noise cannot be estimated, the
        chain never moved (it is in the error's `posterior`), `resume` is a file that is damaged, in
        use, or of another run, or more than three parameters are free on a grid.
    ModelError
        If no parameter is free, or a name is unknown.
    DataError
        If the rows lack data for their model or noise.
    ValidationError
        If an option or a prior is invalid, or belongs to the other method.

    Examples
    --------
    >>> import numpy as np
    >>> import dahl_ident as di
    >>> A = np.geomspace(1e-3, 1e-2, 9)
    >>> N = di.Dahl(f_max=0.1, sigma=30.0).describing_function(A)
    >>> noise = np.random.default_rng(1).normal(scale=0.02, size=(2, 9))
    >>> data = di.FrequencyResponse(np.ones(9), N * np.exp(noise[0] + 1j * noise[1]), A)
    >>> chain = di.posterior(data, di.Dahl(alpha=1.0), seed=1)
    >>> chain.converged, chain.names
    (True, ('f_max', 'sigma'))
    >>> grid = di.posterior(data, di.Dahl(alpha=1.0), method="grid")
    >>> grid.converged, round(float(grid.quantile("f_max", 0.5)), 2)
    (True, 0.1)
    """
    options = {**locals()}
    one_of(method, "method", METHODS)
    source = data if isinstance(data, FitResult) else None
    refuse_options(
        problem_class(data) if source is None else type(source.problem), options, posterior
    )
    if refused := changed_options(_NOT_OF_METHODS[method], options, posterior):
        names = ", ".join(argument(name).rstrip("=") for name in refused)
        raise ValidationError(
            f"{names} given with {argument('method', method)}, which has no such option; leave it "
            "out"
        )
    if pool is not None and not callable(getattr(pool, "map", None)):
        raise ValidationError(f"pool is {pool!r}; expected an object with map, such as a Pool")
    one_of(uncertainty, "uncertainty", UNCERTAINTIES)
    if source is not None:
        _refuse_with_a_fit(source, options)

    fitted: FitResult | None = source
    if source is not None:
        problem = source.problem
    elif model is None:
        raise ModelError("there is no model; give one, such as Dahl(), or pass a fit")
    else:
        problem = problem_of(
            data,
            model,
            free=free,
            fixed=fixed,
            sensors=sensors,
            noise=noise,
            steady=steady or "exact",
        )
        with _fit_progress() if progress else nullcontext() as tell:
            optimum = optimum_of(problem, tell)
        fitted = None if optimum is None else FitResult(optimum)
    if fitted is None or likelihood != "gaussian":
        uncertainty = "noise"
    density, optimum = _density(problem, fitted, priors, likelihood, uncertainty)
    begin = partial(centre_and_covariance, density, optimum, np.random.default_rng(0))
    if method == "grid":
        with _grid_progress() if progress else nullcontext() as show:
            points = sample_points(density, begin, problem.names, tolerance, show)
        return Posterior(density, points, fitted, uncertainty)
    settings = ChainSettings(
        len(density.names),
        seed=seed,
        steps=steps,
        max_steps=max_steps,
        ess=ess,
        walkers=walkers,
        ensembles=ensembles,
    )
    start = partial(starting_points, density, optimum)
    with _chain_progress(settings) if progress else nullcontext() as bar:
        sample = sample_chain(
            density,
            start,
            settings,
            seed=seed,
            resume=resume,
            pool=pool,
            listeners=[] if bar is None else [bar],
        )
    result = Posterior(density, sample, fitted, uncertainty)
    sample.check(result.names, result)
    return result


@contextmanager
def _chain_progress(settings: ChainSettings) -> Iterator[Listener]:
    """Yield a listener that shows the number of steps, and the expected total once it is known."""
    with spinner("sampling", patience=0.0) as show:

        def update(chain: Chain, verdict: Convergence | None) -> None:
            total = settings.steps
            if total is None and verdict is not None and verdict.usable:
                kept = verdict.steps - verdict.discard
                needed = max(LENGTH * verdict.tau.max(), kept * settings.ess / verdict.ess.min())
                total = max(min(verdict.discard + int(needed) + 1, settings.max_steps), chain.steps)
            show(f" {chain.steps}/{total or '?'}", chain.steps, total)

        yield update


@contextmanager
def _fit_progress() -> Iterator[Callable[[int, float], None]]:
    """Yield a function that shows evaluations and unexplained share of variance after 2 s."""
    with spinner("fitting") as show:
        yield lambda evaluations, share: show(
            f": {counted(evaluations, 'evaluation')}, {percent(share**0.5, 3)} rms left"
        )


@contextmanager
def _grid_progress() -> Iterator[Callable[[int], None]]:
    """Yield a function that shows the number of points after 2 s."""
    with spinner("integrating") as show:
        yield lambda points: show(f": {counted(points, 'point')}")


_NOT_OF_METHODS = {
    "mcmc": ("tolerance",),
    "grid": ("steps", "max_steps", "ess", "walkers", "ensembles", "resume", "pool"),
}


def _refuse_with_a_fit(fit: FitResult, options: Mapping[str, Any]) -> None:
    """Refuse options that a fit already has, and fits that a posterior cannot use."""
    names = ("model", "noise", "sensors", "fixed", "steady")
    given = [name for name in names if options[name] is not None]
    given += ["free"] if tuple(options["free"]) else []
    if given:
        raise ValidationError(
            f"{', '.join(given)} is given together with a FitResult, which has its own; pass the "
            "data instead"
        )
    if fit.first_order or fit.optimum.loss != "linear":
        had = "constraints" if fit.first_order else "a robust loss"
        raise ValidationError(
            f"the fit had {had}, which a posterior does not take; use the fit's confidence "
            f"intervals, or pass the data for a posterior without {had}"
        )


def _record_density(
    fit: FitResult, priors: Mapping[str, PriorLike] | None, uncertainty: str
) -> LogDensity:
    """Return the density around a fit of records."""
    problem, values, errors = fit.problem, fit.optimum.values, fit.errors
    sources = tuple(name for name, part in errors.contributions.items() if part.any())
    covariance, dof = fit.covar, errors.least_dof
    if uncertainty == "noise":
        sources, covariance, dof = (NOISE,), fit.assessment.covar_noise, errors.dof_of(NOISE)
    prior, count = joint_prior(problem, priors, values), problem.n_reported
    return RecordDensity(problem, values, covariance[:count, :count], dof, sources, prior)


def _density(
    problem: Any,
    fit: FitResult | None,
    priors: Mapping[str, PriorLike] | None,
    likelihood: str,
    uncertainty: str,
) -> tuple[LogDensity, Optimum | None]:
    """Return the density, with every source of error or noise alone, and its starting optimum."""
    from scipy import stats

    stated, optimum = dict(priors or {}), None if fit is None else fit.optimum
    if fit is not None and problem.around_optimum:
        return _record_density(fit, priors, uncertainty), optimum
    if fit is None or optimum is None or uncertainty == "noise":
        values = None if optimum is None else optimum.values
        return Density(problem, joint_prior(problem, stated, values), likelihood), optimum
    _, assumed = with_assumed(problem)
    wider = problem.like(free=assumed) if assumed else problem
    errors = fit.errors_of_combinations
    theta = optimum.theta_in(wider) if errors is None else errors.theta
    ranges = {p.name: p.prior for p in wider.parameters if p.prior is not None}
    assumed_priors = {
        name: ranges[name] if assumption.source == EXPONENT else stats.norm(1.0, assumption.std)
        for name, assumption in assumed.items()
    }
    shared = None if errors is None else row_errors(errors)
    prior = joint_prior(wider, stated, wider.to_values(theta), assumed_priors)
    density = Density(wider, prior, likelihood, shared)
    return density, replace(optimum, source=wider, theta=theta)
