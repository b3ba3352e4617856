"""The posterior of a model's parameters, for users."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from importlib.metadata import version
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import whole_number
from dahl_ident.bayes.density import SCALE
from dahl_ident.data import Record
from dahl_ident.data.storage import plain_data
from dahl_ident.diagnostics.bands import DerivedQuantity, problem_at, quantities
from dahl_ident.diagnostics.budget import Budget
from dahl_ident.diagnostics.checks import assumptions, reading
from dahl_ident.diagnostics.judgement import Finding, Judgement, Question, VerdictStatus
from dahl_ident.errors import FitError, ValidationError, choices
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.posterior_checks import (
    PredictiveBand,
    PredictiveCheck,
    PriorInfluence,
    predictive_checks,
    prior_influences,
    to_arviz,
)
from dahl_ident.results.posterior_draws import PosteriorDraws
from dahl_ident.units import Quantity

SCHEMA = "dahl_ident.posterior"
_STATED_DRAWS = 4000  # draws for statements
_CHECK_DRAWS = 1000  # draws for a check: a share of 1 % has an error of 0.3 %


class Posterior(PosteriorDraws):
    """Parameters, priors and weighted draws of one posterior density.

    Made by :func:`dahl_ident.posterior`. The draws are those of a Markov chain, with the names of
    emcee, or importance points (``method="grid"``), which are reproducible and have a known error.
    An unknown scale of the noise is called ``noise_scale``.

    Examples
    --------
    >>> import dahl_ident as di
    >>> data = di.load_dataset("noisy")
    >>> chain = di.posterior(data, di.Dahl(), seed=1, steps=60)
    >>> chain.names, chain.steps, chain.converged
    (('f_max', 'sigma', 'alpha'), 60, False)
    >>> grid = di.posterior(data, di.Dahl(alpha=1.0), method="grid")
    >>> print(grid.message)
    Converged: error 0.0006 of the probability, 192 points.
    >>> low, high = grid.quantile("f_max", [0.02275, 0.97725])
    >>> print(f"f_max from {low:.4f} to {high:.4f} N")
    f_max from 0.0992 to 0.1004 N
    """

    _called = "a posterior"

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

        Not determined if it has not converged, or a default prior sets a parameter; not described
        if data and model or prior contradict each other; approximate if the fit is.
        """
        return Judgement([*_objections(self), *_notes(self), *reading(self)])

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
        has_shared_errors = self.counted_fit is not None
        if self.likelihood == "none" or has_shared_errors or not density.normalised:
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
        """Return verdict, numbers and priors as plain data; draws are not included."""
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


def _objections(posterior: Posterior) -> Iterator[Finding]:
    """Yield convergence, influences of priors, and contradictions."""
    converged, fit = posterior.converged, posterior.counted_fit
    code = "sampled" if converged else "not_converged"
    severity = VerdictStatus.TRUSTED if converged else VerdictStatus.NOT_DETERMINED
    yield Finding(Question.DETERMINED, severity, code, {"message": posterior.message})
    lost = VerdictStatus.NOT_DESCRIBED if converged else VerdictStatus.NOT_DETERMINED
    for influence in posterior.prior_influences:
        by_default = influence.name in posterior.default_priors
        left_open = VerdictStatus.NOT_DETERMINED if by_default else VerdictStatus.TRUSTED
        yield influence.finding(lost if influence.contradicted else left_open)
    yield from (replace(finding, severity=lost) for finding in _misfits(posterior))
    if fit is not None and fit.status is not VerdictStatus.NOT_DESCRIBED:
        yield from (f for f in fit.findings if f.severity is VerdictStatus.APPROXIMATE)


def _misfits(posterior: Posterior) -> tuple[Finding, ...]:
    """Return findings that the data contradict the model."""
    fit = posterior.fit
    if fit is None or (posterior.counted_fit is None and posterior.normalised):
        lost = Question.DESCRIBED, VerdictStatus.NOT_DESCRIBED
        failed = (check for check in posterior.checks if not check.passed)
        return tuple(Finding(*lost, "predictive_check", {"text": str(c)}) for c in failed)
    if fit.status is VerdictStatus.NOT_DETERMINED and fit.goodness.objections:
        return tuple(fit.goodness.findings())
    if fit.status is not VerdictStatus.NOT_DESCRIBED:
        return ()
    return tuple(f for f in fit.findings if f.severity is not VerdictStatus.TRUSTED)


def _notes(posterior: Posterior) -> Iterator[Finding]:
    """Yield counted sources of error, assumptions, and the evidence."""
    fit, counted = posterior.fit, posterior.counted_fit is not None
    if fit is not None and posterior.likelihood != "none":
        assumed, names = Question.ASSUMED, posterior.names
        if counted:
            free = (n for n in names if n not in (*fit.problem.names, SCALE))
            ranges = (f"{name} as a parameter, which was not given" for name in free)
            sources = {"sources": (*posterior.counted, *ranges)}
            yield Finding(assumed, VerdictStatus.TRUSTED, "counted", sources)
        elif fit.errors is not None:
            std = zip(names, posterior.std().tolist(), strict=True)
            known = ((n, s) for n, s in std if n in fit.var_names)
            u = [f"{fit.params[n].stderr:.2g} for {n} (here {s:.2g})" for n, s in known]
            yield Finding(assumed, VerdictStatus.TRUSTED, "noise_alone", {"compared": tuple(u)})
        yield from assumptions(fit.assessment, counted=counted)
    if not posterior.is_chain and posterior.normalised:
        evidence = {"ln": posterior.log_evidence}
        yield Finding(Question.DESCRIBED, VerdictStatus.TRUSTED, "evidence", evidence)
