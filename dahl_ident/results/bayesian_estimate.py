"""Bayesian estimation: the posterior by Markov chain, or by integration for few parameters."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from inspect import signature
from typing import Any, Literal, NamedTuple, overload

import numpy as np

from dahl_ident.arrays import FloatArray, positive_number, whole_number
from dahl_ident.bayes.chain import Chain, Pool, Settings, run
from dahl_ident.bayes.checkpoint import Stored, identity, open_chain
from dahl_ident.bayes.convergence import Convergence
from dahl_ident.bayes.density import Density, LogDensity
from dahl_ident.bayes.importance import integrate
from dahl_ident.bayes.priors import PriorLike, joint_prior
from dahl_ident.bayes.record_density import RecordDensity, record_prior
from dahl_ident.bayes.walker_start import (
    centre_and_covariance,
    optimum_of,
    scattered,
    starting_points,
)
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.columns import one_of
from dahl_ident.diagnostics.error_model import EXPONENT, error_model, with_assumed
from dahl_ident.diagnostics.shared_errors import row_errors
from dahl_ident.elements import Element
from dahl_ident.errors import ModelError, SamplingError, ValidationError
from dahl_ident.fitting import Optimum
from dahl_ident.problem import Problem
from dahl_ident.results.chain_posterior import ChainPosterior, refuse_unusable
from dahl_ident.results.estimate import fit as fit_any
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.grid_posterior import GridPosterior
from dahl_ident.results.progress import progress_bar
from dahl_ident.results.record_fit import RecordFit
from dahl_ident.results.record_posterior import RecordPosterior
from dahl_ident.sensors import Sensors
from dahl_ident.steady_state import Steady

_LEAST_STEPS = 20  # with fewer no autocorrelation can be estimated
_MOST_AXES = 3  # the number of points is a power of the number of axes
METHODS = ("mcmc", "grid")
UNCERTAINTIES = ("combined", "noise")


@overload
def posterior(
    data: FrequencyResponse | FitResult,
    model: Element | None = None,
    *,
    method: Literal["mcmc"] = "mcmc",
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
) -> ChainPosterior: ...


@overload
def posterior(
    data: Record | Sequence[Record] | RecordFit,
    model: Element | None = None,
    *,
    priors: Mapping[str, PriorLike] | None = None,
    free: Iterable[str] = (),
    fixed: Mapping[str, float] | None = None,
    seed: int | None = None,
    steps: int | None = None,
    max_steps: int = 20000,
    ess: float = 2000.0,
    walkers: int | None = None,
    ensembles: int = 4,
    resume: str | os.PathLike[str] | None = None,
    progress: bool = False,
) -> RecordPosterior: ...


@overload
def posterior(
    data: FrequencyResponse | FitResult,
    model: Element | None = None,
    *,
    method: Literal["grid"],
    priors: Mapping[str, PriorLike] | None = None,
    free: Iterable[str] = (),
    fixed: Mapping[str, float] | None = None,
    noise: str | None = None,
    sensors: Sensors | None = None,
    steady: Steady | None = None,
    likelihood: str = "gaussian",
    uncertainty: str = "combined",
    seed: int | None = None,
    progress: bool = False,
    tolerance: float = 1e-3,
) -> GridPosterior: ...


def posterior(
    data: FrequencyResponse | FitResult | Record | Sequence[Record] | RecordFit,
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
) -> ChainPosterior | GridPosterior | RecordPosterior:
    """Return the posterior of a model's parameters, by Markov chain or by integration.

    Parameters
    ----------
    data : FrequencyResponse, Record, sequence of Record, FitResult or RecordFit
        What was measured; or a fit, whose data, model, noise and sensors are taken over. Records
        are fitted first; where `output`, `excitation` or `start` is needed, give their fit.
    model : Element, optional
        One element or a sum, such as ``Dahl() + Mass(0.3)``; left out with a fit.
    method : {"mcmc", "grid"}, default "mcmc"
        "mcmc" samples with emcee. "grid" integrates over up to three free parameters with
        importance points: no chain, the same answer at every call, and the evidence. An unknown
        noise scale is integrated analytically there and does not count among the three.
    priors : mapping of str to distribution or (low, high), optional
        By parameter: a frozen distribution of scipy.stats over the value, or bounds, between
        which positive parameters are log-uniform and the others uniform. Parameters left out
        get wide bounds from the size of the data, which the report states.
    free, fixed, noise, sensors, steady
        As for :func:`dahl_ident.fit`. Sensors may have any prior here.
    likelihood : {"gaussian", "student_t", "none"}, default "gaussian"
        "student_t" makes outliers count less (4 degrees of freedom; on a grid it needs noise of
        known scale); "none" gives the prior.
    uncertainty : {"combined", "noise"}, default "combined"
        "combined" counts every source of the fit's uncertainty budget that was estimated from the
        data, such as scatter between runs and model error, and samples exponents that were not
        given, log-uniform over their range, which takes several times as long as a given one.
        "noise" counts independent noise alone, as do likelihoods other than "gaussian". The
        verdict says which.
    seed : int, optional
        The same seed gives the same chain. Left out, one is drawn, and reported. A grid needs
        none.
    steps : int, optional
        Total number of steps, warm-up included. Left out, the chain runs until it has
        converged: 50 autocorrelation times after warm-up, R-hat below 1.01, and `ess`.
    max_steps : int, default 20000
        Where to stop a chain that does not converge.
    ess : float, default 2000
        Effective number of draws wanted for every parameter.
    walkers : int, optional
        In all ensembles together. Default: 32 an ensemble, or more for many parameters.
    ensembles : int, default 4
        Groups of walkers that are independent of each other.
    resume : path, optional
        HDF5 file that keeps the chain: begun where there is none, continued to the *total*
        number of steps where there is. It is whole at every moment, also after a crash, and the
        resulting chain is the same however often it was interrupted.
    pool : object with map, optional
        Spreads the likelihood over processes. Left out, one process computes all walkers at
        once, which is faster unless a single likelihood takes milliseconds.
    progress : bool, default False
        Show a bar on the terminal, with the time that is left.
    tolerance : float, default 1e-3
        With "grid": relative error of the evidence and error of probabilities to be reached.

    Returns
    -------
    ChainPosterior, GridPosterior or RecordPosterior
        Each is a ``Posterior``; its first line says where it has not
        converged.

    Raises
    ------
    SamplingError
        If no place of finite density is found, the scale of the noise cannot be estimated, the
        chain never moved (it is in the error's `posterior`), `resume` names a file that is
        damaged, in use, or of another run, or more than three parameters are free on a grid.
    ModelError
        If nothing is free, or a name is unknown.
    DataError
        If the rows lack what their model or noise needs.
    ValidationError
        If an option or a prior is not as described, or belongs to the other method.

    Examples
    --------
    >>> import numpy as np
    >>> import dahl_ident as di
    >>> A = np.geomspace(1e-3, 1e-2, 9)
    >>> N = di.Dahl(f_max=0.1, sigma=30.0).describing_function(A)
    >>> noise = np.random.default_rng(1).normal(scale=0.02, size=(2, 9))
    >>> data = di.FrequencyResponse(np.ones(9), N * np.exp(noise[0] + 1j * noise[1]), A)
    >>> chain = di.posterior(data, di.Dahl(), seed=1)
    >>> chain.converged, chain.names
    (True, ('f_max', 'sigma', 'alpha', 'noise_scale'))
    >>> grid = di.posterior(data, di.Dahl(), method="grid")
    >>> grid.converged, round(float(grid.quantile("f_max", 0.5)), 2)
    (True, 0.1)
    """
    options = {**locals()}
    one_of(method, "method", METHODS)
    of_records = not isinstance(data, FrequencyResponse | FitResult)
    _refuse_options("a posterior of records" if of_records else f"method={method!r}", options)
    if pool is not None and not callable(getattr(pool, "map", None)):
        raise ValidationError(f"pool is {pool!r}; expected an object with map, such as a Pool")
    one_of(uncertainty, "uncertainty", UNCERTAINTIES)
    _refuse_with_a_fit(data, options)
    made: Callable[[Chain, Convergence, Settings], ChainPosterior | RecordPosterior]
    density: LogDensity
    if isinstance(data, FrequencyResponse | FitResult):
        problem, fit = _fit(data, model, noise, sensors, free, fixed, steady)
        case = _case(problem, fit, priors, likelihood, uncertainty)
        if method == "grid":
            return _grid(case, tolerance)
        density, start = case.density, partial(starting_points, case.density, case.optimum)
        made = partial(ChainPosterior, case.density, fit=case.fit, uncertainty=case.uncertainty)
    else:
        recorded = (
            data
            if isinstance(data, RecordFit)
            else fit_any(data, _checked(model), free=free, fixed=fixed, throw=False)
        )
        density = _record_density(recorded, priors)
        start = partial(scattered, density, density.centre, density.root)
        made = partial(RecordPosterior, recorded, density)
    settings = _settings(density, seed, steps, max_steps, ess, walkers, ensembles)
    return refuse_unusable(made(*_chain(density, start, settings, seed, resume, pool, progress)))


_CHAIN_ONLY = ("steps", "max_steps", "ess", "walkers", "ensembles", "resume", "pool")
_TABLES_ONLY = ("method", "noise", "sensors", "steady", "likelihood", "uncertainty")
_REFUSED = {
    "a posterior of records": (*_TABLES_ONLY, "pool", "tolerance"),
    "method='mcmc'": ("tolerance",),
    "method='grid'": _CHAIN_ONLY,
}


def _refuse_options(kind: str, options: Mapping[str, Any]) -> None:
    """Refuse options that a kind of posterior does not have, unless they are left as they are."""
    defaults = signature(posterior).parameters
    given = [name for name in _REFUSED[kind] if options[name] != defaults[name].default]
    if given:
        raise ValidationError(
            f"{', '.join(given)} given with {kind}, which has no such option; leave it out"
        )


def _refuse_with_a_fit(data: object, options: Mapping[str, Any]) -> None:
    """Refuse what a fit has already."""
    if not isinstance(data, FitResult | RecordFit):
        return
    names = ("model", "noise", "sensors", "fixed", "steady")
    given = [name for name in names if options[name] is not None]
    given += ["free"] if tuple(options["free"]) else []
    if given:
        raise ValidationError(
            f"{', '.join(given)} is given together with a {type(data).__name__}, which has its "
            "own; pass the data instead"
        )


def _checked(model: Element | None) -> Element:
    if model is None:
        raise ModelError("there is no model; give one, such as Dahl(), or pass a fit")
    return model


def _record_density(fit: RecordFit, priors: Mapping[str, PriorLike] | None) -> RecordDensity:
    values, count = fit.optimum.values, len(fit.problem.free)
    prior = record_prior(fit.problem, priors, values)
    covariance = fit.covar[:count, :count]
    return RecordDensity(fit.problem, values, covariance, fit.errors.dof, prior)


class _Case(NamedTuple):
    """A posterior density, where to start from, and the fit that its errors are those of."""

    density: Density
    optimum: Optimum | None
    fit: FitResult | None
    uncertainty: str = "noise"


def _case(
    problem: Problem,
    fit: FitResult | None,
    priors: Mapping[str, PriorLike] | None,
    likelihood: str,
    uncertainty: str,
) -> _Case:
    """Return the density with every source of error, or noise alone."""
    from scipy import stats

    given, optimum = dict(priors or {}), None if fit is None else fit.optimum
    if fit is None or optimum is None or uncertainty == "noise" or likelihood != "gaussian":
        values = None if optimum is None else optimum.values
        return _Case(
            Density(problem, joint_prior(problem, given, values), likelihood), optimum, fit
        )
    _, assumed = with_assumed(problem)
    wider = problem.like(free=assumed) if assumed else problem
    errors = fit.errors or error_model(optimum, of_combinations=True)
    known = dict(zip(optimum.names, optimum.theta.tolist(), strict=True))
    theta = np.array([known.get(p.name, np.log(p.value or 1.0)) for p in wider.parameters])
    if errors is not None:
        theta = errors.theta
    ranges = {p.name: p.prior for p in wider.parameters if p.prior is not None}
    own = {
        name: ranges[name] if one.source == EXPONENT else stats.norm(1.0, one.std)
        for name, one in assumed.items()
    }
    shared = None if errors is None else row_errors(errors)
    prior = joint_prior(wider, given, wider.to_values(theta), own)
    density = Density(wider, prior, likelihood, shared)
    return _Case(density, replace(optimum, problem=wider, theta=theta), fit, "combined")


def _grid(case: _Case, tolerance: float) -> GridPosterior:
    """Integrate the posterior of up to three parameters."""
    density, names = case.density, case.density.problem.names
    if len(names) > _MOST_AXES:
        own = names if case.fit is None else case.fit.problem.names
        assumed = [name for name in names if name not in own]
        instead = f"give {', '.join(assumed)} or " if assumed else ""
        raise SamplingError(
            f"{len(names)} parameters are free ({', '.join(names)}); a grid takes up to "
            f"{_MOST_AXES}: {instead}fix some, or use method='mcmc'"
        )
    tolerance = positive_number(tolerance, "tolerance")
    centre, covariance = centre_and_covariance(density, case.optimum, np.random.default_rng(0))
    grid = integrate(
        density.marginal,
        density.prior,
        centre,
        covariance,
        density.decorrelation,
        tolerance=tolerance,
    )
    return GridPosterior(density, grid, tolerance, case.fit, case.uncertainty)


def _chain(
    density: Density | RecordDensity,
    start_with: Callable[[int, np.random.Generator], FloatArray],
    settings: Settings,
    seed: int | None,
    resume: str | os.PathLike[str] | None,
    pool: Pool | None,
    progress: bool,
) -> tuple[Chain, Convergence, Settings]:
    """Run the chain, from its file and into it where there is one."""
    with ExitStack() as stack:
        listeners = [stack.enter_context(progress_bar(settings))] if progress else []
        stored: Stored | None = None
        if resume is not None:
            of = identity(density, settings.walkers, settings.ensembles)
            file = stack.enter_context(open_chain(resume, of))
            stored = file.load()
            settings = _with_seed_of(stored, settings, seed, resume)
            file.begin(settings.seed)
            listeners.append(file)
        if stored is None:
            random = np.random.default_rng(settings.seed)
            chain = Chain.at(start_with(settings.walkers, random), settings.seed)
        else:
            chain = stored.chain

        def tell(chain: Chain, verdict: Convergence | None) -> None:
            for listener in listeners:
                listener(chain, verdict)

        chain, verdict = run(density, chain, settings, pool=pool, listener=tell)
    return chain, verdict, settings


def _with_seed_of(
    stored: Stored | None, settings: Settings, seed: int | None, path: str | os.PathLike[str]
) -> Settings:
    """Return the settings with the seed of the file; a seed that differs from it is refused."""
    if stored is None:
        return settings
    if seed is not None and seed != stored.seed:
        raise SamplingError(
            f"{os.fspath(path)} was begun with seed {stored.seed}, but seed is {seed}; leave it "
            "out to resume, or give another file"
        )
    return replace(settings, seed=stored.seed)


def _fit(
    data: FrequencyResponse | FitResult,
    model: Element | None,
    noise: str | None,
    sensors: Sensors | None,
    free: Iterable[str],
    fixed: Mapping[str, float] | None,
    steady: Steady | None,
) -> tuple[Problem, FitResult | None]:
    """Return the problem, and its least-squares fit; None where there are too few data for one."""
    if isinstance(data, FitResult):
        if data.first_order:
            raise ValidationError(
                "the fit had constraints, which a posterior does not take; pass the data instead"
            )
        return data.problem, data
    model = _checked(model)
    problem = Problem(
        data, model, noise=noise, sensors=sensors, free=free, fixed=fixed, steady=steady or "exact"
    )
    optimum = optimum_of(problem)
    return problem, None if optimum is None else FitResult(optimum)


def _settings(
    density: LogDensity,
    seed: int | None,
    steps: int | None,
    max_steps: int,
    ess: float,
    walkers: int | None,
    ensembles: int,
) -> Settings:
    dims = len(density.names)
    ensembles = whole_number(ensembles, "ensembles", 2)
    if walkers is None:
        walkers = ensembles * max(32, 6 * dims)
    least = ensembles * max(8, 4 * dims)
    whole_number(walkers, "walkers", least)
    if walkers % (2 * ensembles):
        raise ValidationError(
            f"walkers is {walkers}; expected a multiple of {2 * ensembles}, because each of "
            f"{ensembles} ensembles moves in halves"
        )
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
    return Settings(
        walkers,
        ensembles,
        whole_number(seed, "seed", 0),
        None if steps is None else whole_number(steps, "steps", _LEAST_STEPS),
        whole_number(max_steps, "max_steps", _LEAST_STEPS),
        positive_number(ess, "ess"),
    )
