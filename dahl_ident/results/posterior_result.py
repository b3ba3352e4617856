"""The posterior of a model's parameters, for users."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import FloatArray, array_between, finite_array, positive_array, whole_number
from dahl_ident.bayes.chain import Convergence
from dahl_ident.bayes.density import SCALE, LogDensity
from dahl_ident.bayes.importance import WeightedDraws
from dahl_ident.bayes.priors import PriorLike
from dahl_ident.bayes.sample import ChainSample, PointSample, Sample
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.storage import plain_data
from dahl_ident.diagnostics.bands import DerivedQuantity, problem_at, quantities
from dahl_ident.diagnostics.budget import Budget
from dahl_ident.diagnostics.checks import assumptions, reading
from dahl_ident.diagnostics.judgement import (
    Finding,
    Judgement,
    VerdictStatus,
    assumed,
    described,
    determined,
)
from dahl_ident.diagnostics.verdicts import Verdict
from dahl_ident.errors import FitError, ModelError, ValidationError, choices
from dahl_ident.fitting import Optimum
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.posterior_checks import (
    PredictiveBand,
    PredictiveCheck,
    PriorInfluence,
    contradictions,
    predictive_checks,
    prior_influences,
    to_arviz,
)
from dahl_ident.results.result import Estimate, Parameters, Result, part
from dahl_ident.units import Quantity

if TYPE_CHECKING:
    import pandas as pd

SCHEMA = "dahl_ident.posterior"
_STATED_DRAWS = 4000  # draws for statements
_CHECK_DRAWS = 1000  # draws for a check: a share of 1 % has an error of 0.3 %
_TAIL_END = 1e-6  # probability beyond which there are too few draws for a quantile
_QUANTILES = {"2.3%": 0.02275, "16%": 0.16, "median": 0.5, "84%": 0.84, "97.7%": 0.97725}
_LEVELS = np.array(list(_QUANTILES.values()))


class Posterior(Result):
    """Parameters, priors and weighted draws of one posterior density.

    Made by :func:`dahl_ident.posterior`. The draws are those of a Markov chain, with the names of
    emcee, or importance points (``method="grid"``), which are reproducible and have a known error.
    An unknown scale of the noise is called ``noise_scale``; where other errors count, it is the
    fit's and not sampled.

    Examples
    --------
    >>> import dahl_ident as di
    >>> data = di.load_dataset("noisy")
    >>> chain = di.posterior(data, di.Dahl(), seed=1, steps=60)
    >>> chain.names, chain.steps, chain.converged
    (('f_max', 'sigma', 'alpha'), 60, False)
    >>> grid = di.posterior(data, di.Dahl(alpha=1.0), method="grid")
    >>> print(grid.message)
    Converged: error 0.0008 of the probability, 192 points.
    >>> low, high = grid.quantile("f_max", [0.02275, 0.97725])
    >>> print(f"f_max from {low:.4f} to {high:.4f} N")
    f_max from 0.0992 to 0.1005 N
    """

    _called = "a posterior"

    def __init__(
        self,
        density: LogDensity,
        sample: Sample,
        fit: FitResult | None = None,
        uncertainty: str = "noise",
    ) -> None:
        self._density = density
        self.sample = sample  #: The weighted draws, search coordinates.
        #: The least-squares fit from which the search started; None with too few data.
        self.fit = fit
        #: What is counted: every source of the fit's budget, "combined", or "noise" alone.
        self.uncertainty = uncertainty

    problem: Any = part("_density.problem", "Data, model, noise and sensors.")
    data: FrequencyResponse = part("problem.data", "The table.")
    names: tuple[str, ...] = part(
        "_density.names", "Names of the parameters, the model's first, an unknown noise scale last."
    )
    likelihood: str = part(
        "_density.likelihood", 'How rows count: "gaussian", "student_t" or "none".'
    )
    priors: Mapping[str, str] = part("_density.priors", "Every prior in words.")
    counted: tuple[str, ...] = part("_density.counted", "The sources of error that are counted.")
    normalised: bool = part("_density.normalised", "Whether it has an evidence; records have none.")
    converged: bool = part("sample.converged", "Whether the numbers can be used.")
    message: str = part(
        "sample.message", "Whether the numbers can be used, and what is missing if not."
    )

    @property
    def var_names(self) -> list[str]:
        """Names of the free parameters, an unknown noise scale last."""
        return list(self.names)

    @property
    def optimum(self) -> Optimum | None:
        """The least-squares optimum from which the search started; None with too few data."""
        return None if self.fit is None else self.fit.optimum

    @property
    def units(self) -> tuple[str, ...]:
        """SI units of the parameters."""
        return tuple(self.params[name].unit for name in self.names)

    @property
    def default_priors(self) -> tuple[str, ...]:
        """Names of parameters whose prior follows the data's size."""
        parts = self._density.prior.priors
        return tuple(part.parameter.name for part in parts if part.source == "default")

    @property
    def given_priors(self) -> Mapping[str, PriorLike]:
        """The priors that were given, as they were given; the others follow the data's size."""
        parts = self._density.prior.priors
        return {part.parameter.name: part.prior for part in parts if part.source == "given"}

    # Numbers

    @cached_property
    def params(self) -> Parameters:
        """Every parameter by name, posterior mean and standard deviation; fixed ones included."""
        values = dict(zip(self.names, self.mean().tolist(), strict=True))
        stderr = dict(zip(self.names, self.std().tolist(), strict=True))
        every = Parameters.of(self.problem, values, stderr)
        shown = {name: every[name] for name in self.problem.device_parameters}
        if SCALE in values:
            at = values[SCALE], stderr[SCALE]
            shown[SCALE] = Estimate(SCALE, "", "noise scale", *at, None, 0.0, math.inf, True)
        return Parameters(shown)

    @cached_property
    def values(self) -> FloatArray:
        """Values of all draws that count, shape (N, D), SI units."""
        return self._density.to_values(self.sample.draws.theta)

    weights: FloatArray = part(
        "sample.draws.weights", "Probabilities of the draws, shape (N,), which sum to 1."
    )

    @property
    def points(self) -> tuple[FloatArray, FloatArray]:
        """Weights, shape (N,), and search coordinates, (N, D), of all draws."""
        return self.weights, self.sample.draws.theta

    def mean(self) -> FloatArray:
        """Return the means of the parameters, in the order of `names`."""
        return np.asarray(self.weights @ self.values)

    def std(self) -> FloatArray:
        """Return the standard deviations of the parameters, in the order of `names`."""
        return np.asarray(np.sqrt(self.weights @ (self.values - self.mean()) ** 2))

    def quantile(self, name: str, probabilities: ArrayLike) -> FloatArray:
        """Return quantiles of one parameter.

        Parameters
        ----------
        name : str
            One of `names`.
        probabilities : float or array_like, shape (Q,)
            From 1e-6 to 1 - 1e-6.

        Returns
        -------
        ndarray, shape () or (Q,)
            In SI units.
        """
        axis = self._axis(name)
        q = np.atleast_1d(array_between(probabilities, "probabilities", _TAIL_END, 1.0 - _TAIL_END))
        theta = self.sample.draws.quantiles(axis, q)
        values = np.exp(theta) if self._density.logarithmic[axis] else theta
        return values.reshape(np.shape(probabilities))

    def marginal(self, name: str, values: ArrayLike) -> FloatArray:
        """Return the posterior density of one parameter.

        Parameters
        ----------
        name : str
            One of `names`.
        values : array_like, shape (Q,)
            In SI units; those of a positive parameter above zero.

        Returns
        -------
        ndarray, shape (Q,)
            Probability per SI unit.
        """
        axis = self._axis(name)
        logarithmic = self._density.logarithmic[axis]
        x = (positive_array if logarithmic else finite_array)(values, name)
        theta = np.log(x) if logarithmic else x
        return self.sample.draws.density(axis, theta) / (x if logarithmic else 1.0)

    def _axis(self, name: str) -> int:
        if name not in self.names:
            raise ModelError(f"there is no {name!r}; expected one of {choices(self.names, name)}")
        return self.names.index(name)

    def function(self, of: Callable[..., Any], name: str = "function") -> Mapping[str, float]:
        """Return mean, std and quantiles of a function of the parameters.

        Parameters
        ----------
        of : callable
            Takes arrays of values by parameter name, such as
            ``lambda f_max, sigma, **_: f_max / sigma``.
        name : str, default "function"
            For messages.

        Returns
        -------
        dict of str to float
            ``mean, std, 2.3%, 16%, median, 84%, 97.7%``.
        """
        weights = self.weights
        values = dict(zip(self.names, self.values.T, strict=True))
        if not self.is_chain:  # in which the noise scale is integrated out
            values.pop(SCALE, None)
        x = np.asarray(of(**values))
        if x.shape != weights.shape:
            raise ValidationError(
                f"{name} has shape {x.shape}; expected one number a draw, {weights.shape}"
            )
        mean = float(weights @ x)
        quantiles = WeightedDraws(x[:, None], weights).quantiles(0, _LEVELS).tolist()
        of_levels = dict(zip(_QUANTILES, quantiles, strict=True))
        return {"mean": mean, "std": float(np.sqrt(weights @ (x - mean) ** 2)), **of_levels}

    def summary(self) -> pd.DataFrame:
        """Return one row a parameter: moments, quantiles, and the errors of a chain.

        Returns
        -------
        pandas.DataFrame
            Columns ``mean, std, 2.3%, 16%, median, 84%, 97.7%``; of a chain ``mcse``, the Monte
            Carlo standard error of the mean, ``ess``, the effective number of draws, and
            ``r_hat``; ``unit``. ``ess`` and ``mcse`` are NaN where the chain has not converged.
        """
        import pandas as pd

        columns: dict[str, Any] = {"mean": self.mean(), "std": self.std()}
        quantiles = np.stack([self.quantile(name, _LEVELS) for name in self.names])
        columns |= dict(zip(_QUANTILES, quantiles.T, strict=True))
        columns |= self.sample.columns(columns["std"])
        columns["unit"] = list(self.units)
        return pd.DataFrame(columns, index=pd.Index(self.names, name="parameter"))

    def draws(self, size: int, seed: int = 0) -> FloatArray:
        """Return values drawn from the posterior, shape (size, number of parameters)."""
        return self._density.to_values(self._drawn(size, seed))

    def _drawn(self, size: int, seed: int) -> FloatArray:
        """Return the coordinates of draws."""
        count, seed = whole_number(size, "size", 1), whole_number(seed, "seed", 0, np.inf)
        return self.sample.draws.drawn(count, seed)

    def to_frame(self) -> pd.DataFrame:
        """Return all draws, with a column for each parameter; for a grid also ``weight``."""
        import pandas as pd

        frame = pd.DataFrame(self.values, columns=list(self.names))
        return frame if self.is_chain else frame.assign(weight=self.weights)

    # Importance points

    @property
    def _points(self) -> PointSample:
        if not isinstance(self.sample, PointSample):
            raise ValidationError("a chain has no evidence; use method='grid'")
        return self.sample

    log_evidence: float = part(
        "_points.log_evidence",
        "Logarithm of the data's density under model and prior; differences between models of the "
        "same data are logarithms of Bayes factors, in which the scale's prior 1/s cancels.",
    )
    error: float = part(
        "_points.integral.error",
        "Relative error of the evidence, and error of any probability, with 95 % confidence.",
    )
    evaluations: int = part(
        "_points.integral.evaluations", "Points at which the likelihood was computed."
    )

    # The chain

    @property
    def is_chain(self) -> bool:
        """Whether the draws are those of a Markov chain."""
        return isinstance(self.sample, ChainSample)

    @property
    def chain(self) -> ChainSample:
        """The Markov chain with its convergence and settings."""
        if not isinstance(self.sample, ChainSample):
            raise ValidationError("method='grid' runs no chain; use method='mcmc'")
        return self.sample

    convergence: Convergence = part("chain.convergence", "The verdict on the chain's length.")
    seed: int = part("chain.chain.seed", "With which the same chain comes out again.")
    steps: int = part("chain.chain.steps", "Total number of steps, warm-up included.")
    warm_up: int = part("convergence.discard", "Steps that numbers and pictures leave out.")

    def get_chain(self, discard: int = 0, thin: int = 1, flat: bool = False) -> FloatArray:
        """Return parameter values along the chain, in SI units.

        Parameters
        ----------
        discard : int, default 0
            Steps to leave out at the beginning; `warm_up` is the number that `summary` takes.
        thin : int, default 1
            Keep every thin-th step.
        flat : bool, default False
            Join steps and walkers.

        Returns
        -------
        ndarray, shape (steps, walkers, D) or (steps * walkers, D)
            Walkers are ordered by ensemble.
        """
        points = self.chain.chain.points
        return self._density.to_values(_thinned(points, discard, thin, flat))

    def get_log_prob(self, discard: int = 0, thin: int = 1, flat: bool = False) -> FloatArray:
        """Return the log-posterior, per unit of search coordinate, along the chain."""
        return _thinned(self.chain.chain.log_density, discard, thin, flat)

    def get_autocorr_time(self) -> FloatArray:
        """Return the integrated autocorrelation time of each parameter, in steps."""
        return self.convergence.tau

    def to_arviz(self, seed: int = 0) -> Any:
        """Return the posterior for ArviZ: InferenceData below version 1.0, DataTree from there.

        Groups ``posterior``, ``prior``, ``log_likelihood``, ``observed_data`` and
        ``posterior_predictive``. Its chains are the ensembles, thinned by the autocorrelation
        time, because walkers of one ensemble are not independent.

        Parameters
        ----------
        seed : int, default 0
            Of the draws from the prior and of the replicated noise.

        Returns
        -------
        arviz.InferenceData or xarray.DataTree
            Responses are stored as whitened residuals, real and imaginary part.

        Raises
        ------
        MissingDependencyError
            If ArviZ is not installed.
        ValidationError
            If there is no chain, or it is one of records.
        """
        if not self._density.normalised:
            raise ValidationError("a posterior of records has no form for ArviZ")
        density: Any = self._density
        return to_arviz(density, self.chain, seed)

    # Judging

    @cached_property
    def judgement(self) -> Judgement:
        """Every finding about the posterior, and the status that follows from them.

        Not determined if it has not converged, a default prior sets a parameter, or a parameter is
        known to no better than a factor of seven; not described if the data contradict the model or
        a prior; approximate if the fit is.
        """
        return Judgement([*self._objections(), *self._notes(), *reading(self)])

    def _objections(self) -> Iterator[Finding]:
        """Yield convergence, influences of priors, and contradictions."""
        converged, fit = self.converged, self.counted_fit
        severity = VerdictStatus.TRUSTED if converged else VerdictStatus.NOT_DETERMINED
        code = "sampled" if converged else "not_converged"
        yield determined(code, severity, message=self.message)
        if self.likelihood != "none":
            yield from self._wide()
        lost = VerdictStatus.NOT_DESCRIBED if converged else VerdictStatus.NOT_DETERMINED
        for influence in self.prior_influences:
            by_default = influence.name in self.default_priors
            left_open = VerdictStatus.NOT_DETERMINED if by_default else VerdictStatus.TRUSTED
            yield influence.finding(lost if influence.contradicted else left_open)
        for finding in contradictions(self.fit, self.checks, fit is None and self.normalised):
            yield replace(finding, severity=lost)
        if fit is not None and fit.status is not VerdictStatus.NOT_DESCRIBED:
            yield from (f for f in fit.findings if f.severity is VerdictStatus.APPROXIMATE)

    def _wide(self) -> Iterator[Finding]:
        """Yield the positive parameters with wide intervals, except those that priors set."""
        free = (self.fit or self).problem.names
        by_prior = {influence.name for influence in self.prior_influences}
        verdicts = {
            name: Verdict.of(np.diff(np.log(self.quantile(name, _LEVELS[[0, -1]])))[0] / 4.0)
            for name, positive in zip(self.names, self._density.logarithmic, strict=True)
            if positive and name in free and name not in by_prior
        }
        known, weak, lost = (
            tuple(name for name in verdicts if verdicts[name] is verdict)
            for verdict in (Verdict.IDENTIFIED, Verdict.WEAK, Verdict.NOT_IDENTIFIED)
        )
        if lost:
            yield determined("undetermined", determined=known, weak=weak, lost=lost)
        elif weak:
            is_weak = {"identified": known, "weak": weak, "by_prior": ()}
            yield determined("identified", VerdictStatus.TRUSTED, **is_weak)

    def _notes(self) -> Iterator[Finding]:
        """Yield counted sources of error, assumptions, and the evidence."""
        fit, counted = self.fit, self.counted_fit is not None
        if fit is not None and self.likelihood != "none":
            if counted:
                free = (n for n in self.names if n not in (*fit.problem.names, SCALE))
                ranges = (f"{name} as a parameter, which was not given" for name in free)
                yield assumed("counted", sources=(*self.counted, *ranges))
            elif fit.errors is not None:
                std = zip(self.names, self.std().tolist(), strict=True)
                known = ((n, s) for n, s in std if n in fit.var_names)
                u = [f"{fit.params[n].stderr:.2g} for {n} (here {s:.2g})" for n, s in known]
                yield assumed("noise_alone", compared=tuple(u))
            yield from assumptions(fit.assessment, counted=counted)
        if not self.is_chain and self.normalised:
            yield described("evidence", ln=self.log_evidence)

    @property
    def counted_fit(self) -> FitResult | None:
        """The fit whose sources of error are counted; None if noise alone is counted."""
        return self.fit if self.uncertainty == "combined" else None

    @cached_property
    def prior_influences(self) -> tuple[PriorInfluence, ...]:
        """The parameters that the prior determines, or that contradict it."""
        if self.likelihood == "none":
            return ()
        return prior_influences(self._density.prior, self._drawn(_STATED_DRAWS, 0))

    @cached_property
    def checks(self) -> tuple[PredictiveCheck, ...]:
        """Posterior predictive checks of the residuals, with noise alone.

        Empty if the prior was sampled, or if rows share errors, in which case the fit's tests
        apply.
        """
        density: Any = self._density
        if self.likelihood == "none" or self.counted_fit is not None or not density.normalised:
            return ()
        return predictive_checks(density, self._drawn(_CHECK_DRAWS, 0), np.random.default_rng(0))

    # What follows

    def budget(self) -> Budget:
        """Return the uncertainty budget of the least-squares fit to the same data and model.

        Raises
        ------
        FitError
            If there are too few data for one.
        """
        if self.fit is None:
            raise FitError("there are too few data for a least-squares fit, so there is no budget")
        return self.fit.budget()

    def predict(
        self,
        at: Any,
        /,
        *,
        amplitude: ArrayLike | None = None,
        drive: ArrayLike | None = None,
        quantity: Quantity | None = None,
        initial: Literal["fitted", "rest"] = "fitted",
        size: int | None = None,
        seed: int = 0,
    ) -> Any:
        """Return the prediction of another measurement, at draws from the posterior.

        Parameters
        ----------
        at, amplitude, drive, quantity, initial
            As for :meth:`dahl_ident.FitResult.predict`.
        size : int, optional
            Number of draws. Default: 1000, or 100 for records.
        seed : int, default 0
            Of the draws.

        Returns
        -------
        PredictiveBand or RecordBand
        """
        if not isinstance(at, Record):
            problem = problem_at(self.problem, at, amplitude, drive, quantity)
            values = self.draws(1000 if size is None else size, seed)[:, : len(problem.names)]
            return PredictiveBand(problem.predict(problem.to_search(values)))
        if self.fit is None:
            raise FitError("there are too few data for a least-squares fit of the record's start")
        draws = self.draws(100 if size is None else whole_number(size, "size", 2), seed)
        return self.fit.assessment.record_at_draws(at, initial, draws)

    def derived(
        self, amplitudes: Sequence[float] = (), frequency_hz: float | None = None
    ) -> tuple[DerivedQuantity, ...]:
        """Return x_c, energy per cycle, equivalent stiffness and damping: means and deviations.

        Parameters
        ----------
        amplitudes, frequency_hz
            As for :meth:`dahl_ident.FitResult.derived`.

        Returns
        -------
        tuple of DerivedQuantity
        """
        by_name = dict(zip(self.names, self.draws(_STATED_DRAWS).T, strict=True))
        return tuple(
            DerivedQuantity(name, unit, A, float(draws.mean()), float(draws.std(ddof=1)))
            for name, unit, A, draws in quantities(self.problem, by_name, amplitudes, frequency_hz)
        )

    def plot(self, kind: str | None = None, ax: Any = None) -> Any:
        """Plot the posterior.

        Parameters
        ----------
        kind : {"corner", "trace"}, optional
            "corner" (the default): the density of each parameter and of each pair. "trace": the
            walkers' paths, for a chain.
        ax : axes, optional
            As for the function of this name in :mod:`dahl_ident.plots`.

        Returns
        -------
        ndarray of Axes
        """
        kinds = {"corner": self.plot_corner, "trace": self.plot_trace}
        if not self.is_chain:
            del kinds["trace"]
        if kind is not None and kind not in kinds:
            raise ValidationError(f"kind is {kind!r}; expected one of {choices(kinds, kind)}")
        return kinds[kind or "corner"](ax=ax)

    def plot_corner(self, **options: Any) -> NDArray[Any]:
        """Plot marginals and pairs; options as for :func:`dahl_ident.plots.plot_corner`."""
        from dahl_ident.plots import plot_corner

        draws = self.draws(_STATED_DRAWS)
        return plot_corner(self._labels, draws, log=self._density.logarithmic, **options)

    def plot_trace(self, **options: Any) -> NDArray[Any]:
        """Plot the walkers' paths; options as for :func:`dahl_ident.plots.plot_trace`."""
        from dahl_ident.plots import plot_trace

        paths, log = self.get_chain(), self._density.logarithmic
        return plot_trace(self._labels, paths, discard=self.warm_up, log=log, **options)

    @property
    def _labels(self) -> list[str]:
        pairs = zip(self.names, self.units, strict=True)
        return [f"{name} [{unit}]" if unit else name for name, unit in pairs]

    def to_dict(self) -> dict[str, Any]:
        """Return verdict, numbers and priors as plain data, without the draws."""
        return {
            "schema": SCHEMA,
            "schema_version": 1,
            "dahl_ident_version": version("dahl_ident"),
            "status": str(self.status),
            "trusted": self.trusted,
            "statements": list(self.statements),
            "converged": self.converged,
            "message": self.message,
            "likelihood": self.likelihood,
            "priors": dict(self.priors),
            "set_by_prior": [influence.name for influence in self.prior_influences],
            "findings": [finding.to_dict() for finding in self.findings],
            "summary": self.summary().to_dict(orient="index"),
            **self.sample.facts,
        }

    def to_json(self) -> str:
        """Return :meth:`to_dict` as JSON text."""
        return json.dumps(plain_data(self.to_dict(), not_finite=str), allow_nan=False, indent=1)

    def __str__(self) -> str:
        table = self.summary().to_string(
            float_format=lambda v: f"{v:.5g}", formatters={"mcse": lambda v: f"{v:.2g}"}
        )
        priors = [f"  {name}: {text}" for name, text in self.priors.items()]
        others = [str(f) for f in self.findings if f.code not in ("sampled", "not_converged")]
        return "\n".join([self.message, *others, "", table, "", "Priors:", *priors])

    def __repr__(self) -> str:
        end = "converged" if self.converged else "NOT CONVERGED"
        return f"<{type(self).__name__}: {', '.join(self.names)}; {end}>"


def _thinned(array: FloatArray, discard: int, thin: int, flat: bool) -> FloatArray:
    kept = array[whole_number(discard, "discard", 0) :: whole_number(thin, "thin", 1)]
    return kept.reshape(-1, *kept.shape[2:]) if flat else kept
