"""The common base of posteriors by chain and by importance points."""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray, whole_number
from dahl_ident.bayes.density import LogDensity
from dahl_ident.bayes.priors import PriorLike
from dahl_ident.data.storage import plain_data
from dahl_ident.diagnostics.checks import doubted
from dahl_ident.diagnostics.judgement import Finding, Judgement, Question, VerdictStatus
from dahl_ident.errors import ValidationError, choices
from dahl_ident.results.prior_influence import PriorInfluence, prior_influences
from dahl_ident.results.result import Result
from dahl_ident.version import __version__

if TYPE_CHECKING:
    import pandas as pd

    from dahl_ident.results.fit_result import FitResult
    from dahl_ident.results.record_fit import RecordFit


SCHEMA = "dahl_ident.posterior"

RULE_DRAWS = 4000
"""Draws that statements rest on."""
_HOW = ("seed", "steps", "warm_up", "log_evidence", "error", "evaluations")
QUANTILES = {"2.5%": 0.025, "16%": 0.16, "median": 0.5, "84%": 0.84, "97.5%": 0.975}


class Posterior(Result):
    """Parameters, priors and draws of one posterior density."""

    _called = "a posterior"
    _density: LogDensity

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, the model's first, an unknown noise scale last."""
        return self._density.names

    @property
    @abstractmethod
    def units(self) -> tuple[str, ...]:
        """SI units of the parameters."""

    @property
    def likelihood(self) -> str:
        """How rows count: "gaussian", "student_t" or "none"."""
        return self._density.likelihood

    @property
    def priors(self) -> Mapping[str, str]:
        """Every prior in words."""
        return self._density.priors

    @property
    def given_priors(self) -> Mapping[str, PriorLike]:
        """The priors that were given, as they were given; the others follow the data's size."""
        parts = self._density.prior.priors
        return {part.parameter.name: part.given for part in parts if part.source == "given"}

    @property
    @abstractmethod
    def converged(self) -> bool:
        """Whether the numbers can be used."""

    @property
    @abstractmethod
    def message(self) -> str:
        """Whether the numbers can be used, and what is missing if not."""

    @cached_property
    def prior_influences(self) -> tuple[PriorInfluence, ...]:
        """The parameters that the prior determines rather than the data, or against them."""
        if self.likelihood == "none":
            return ()
        return prior_influences(self._density.prior, self._draws(RULE_DRAWS, 0))

    @cached_property
    def judgement(self) -> Judgement:
        """Every finding about the posterior, and the status that follows from them.

        Not determined where it has not converged, or a prior that nobody gave sets a parameter;
        not described where data or prior object; approximate where the fit's numbers are.
        """
        return Judgement((*self._objections, *self._notes, *doubted(*self._provenances)))

    @property
    def _objections(self) -> Iterator[Finding]:
        """Yield what speaks against the numbers."""
        code = "sampled" if self.converged else "not_converged"
        severity = VerdictStatus.TRUSTED if self.converged else VerdictStatus.NOT_DETERMINED
        yield Finding(Question.DETERMINED, severity, code, {"message": self.message})
        lost = VerdictStatus.NOT_DESCRIBED if self.converged else VerdictStatus.NOT_DETERMINED
        default = {p.parameter.name for p in self._density.prior.priors if p.source == "default"}
        for rule in self.prior_influences:
            left_open = VerdictStatus.NOT_DETERMINED if rule.name in default else None
            severity = lost if rule.contradicted else left_open or VerdictStatus.TRUSTED
            yield rule.finding(severity)
        yield from (replace(finding, severity=lost) for finding in self._misfits)
        fit = self._counted_fit
        if fit is not None and fit.status is not VerdictStatus.NOT_DESCRIBED:
            yield from (f for f in fit.findings if f.severity is VerdictStatus.APPROXIMATE)

    @property
    @abstractmethod
    def _provenances(self) -> tuple[Mapping[str, Any] | None, ...]:
        """Where the data come from."""

    @property
    @abstractmethod
    def _counted_fit(self) -> FitResult | RecordFit | None:
        """The fit whose sources of error are counted; None where noise alone is."""

    @property
    def _notes(self) -> tuple[Finding, ...]:
        """What the numbers count and assume."""
        return ()

    @property
    def _misfits(self) -> tuple[Finding, ...]:
        """Where the data contradict the model; by default what the fit's status rests on."""
        fit = self._counted_fit
        if fit is None or fit.status is not VerdictStatus.NOT_DESCRIBED:
            return ()
        return tuple(f for f in fit.findings if f.severity is not VerdictStatus.TRUSTED)

    def draws(self, size: int, seed: int = 0) -> FloatArray:
        """Return values drawn from the posterior, shape (size, number of parameters)."""
        return self._density.to_values(self._draws(whole_number(size, "size", 1), seed))

    @abstractmethod
    def _draws(self, size: int, seed: int) -> FloatArray:
        """Return the coordinates of draws."""

    @property
    def var_names(self) -> list[str]:
        """Names of the free parameters, an unknown noise scale last."""
        return list(self.names)

    @abstractmethod
    def mean(self) -> FloatArray:
        """Return the means of the parameters, in the order of `names`."""

    @abstractmethod
    def std(self) -> FloatArray:
        """Return the standard deviations of the parameters, in the order of `names`."""

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
            ``mean, std, 2.5%, 16%, median, 84%, 97.5%``.
        """
        values, weights = self._weighted()
        found = np.asarray(of(**dict(zip(self.names, values.T, strict=False))))
        if found.shape != weights.shape:
            raise ValidationError(
                f"{name} has shape {found.shape}; expected one number a draw, {weights.shape}"
            )
        mean = float(weights @ found)
        moments = {"mean": mean, "std": float(np.sqrt(weights @ (found - mean) ** 2))}
        order = np.argsort(found)
        below = np.cumsum(weights[order]) - 0.5 * weights[order]
        quantiles = np.interp(list(QUANTILES.values()), below, found[order]).tolist()
        return moments | dict(zip(QUANTILES, quantiles, strict=True))

    @abstractmethod
    def _weighted(self) -> tuple[FloatArray, FloatArray]:
        """Return values, (N, at most D), and weights, (N,), which sum to 1."""

    _PLOTS: ClassVar[tuple[str, ...]] = ("corner",)

    def plot(self, kind: str | None = None, ax: Any = None) -> Any:
        """Draw the posterior.

        Parameters
        ----------
        kind : {"corner", "trace"}, optional
            "corner" (the default): the density of each parameter and of each pair. "trace": the
            walkers' paths, for a chain.
        ax : axes, optional
            As the function of this name in :mod:`dahl_ident.plots` takes them.

        Returns
        -------
        ndarray of Axes
        """
        kind = self._PLOTS[0] if kind is None else kind
        if kind not in self._PLOTS:
            raise ValidationError(f"kind is {kind!r}; expected one of {choices(self._PLOTS, kind)}")
        return getattr(self, f"plot_{kind}")(ax=ax)

    def plot_corner(self, **options: Any) -> NDArray[Any]:
        """Draw marginals and pairs; options as :func:`dahl_ident.plots.plot_corner`."""
        from dahl_ident.plots import plot_corner

        draws = self.draws(RULE_DRAWS)
        return plot_corner(self._labels, draws, log=self._density.logarithmic, **options)

    @property
    def _labels(self) -> list[str]:
        pairs = zip(self.names, self.units, strict=True)
        return [f"{name} ({unit})" if unit else name for name, unit in pairs]

    def to_dict(self) -> dict[str, Any]:
        """Return verdict, numbers and priors as plain data; draws are not included."""
        found = {
            "schema": SCHEMA,
            "schema_version": 1,
            "dahl_ident_version": __version__,
            "status": str(self.status),
            "trusted": self.trusted,
            "statements": list(self.statements),
            "converged": self.converged,
            "message": self.message,
            "likelihood": self.likelihood,
            "priors": dict(self.priors),
            "set_by_prior": [rule.name for rule in self.prior_influences],
            "findings": [finding.to_dict() for finding in self.findings],
            "summary": self.summary().to_dict(orient="index"),
        }
        return found | {name: getattr(self, name) for name in _HOW if hasattr(self, name)}

    def to_json(self) -> str:
        """Return :meth:`to_dict` as JSON text."""
        return json.dumps(plain_data(self.to_dict(), not_finite=str), allow_nan=False, indent=1)

    @abstractmethod
    def summary(self) -> pd.DataFrame:
        """Return one row a parameter: moments and quantiles."""

    def __str__(self) -> str:
        table = self.summary().to_string(float_format=lambda v: f"{v:.5g}")
        priors = [f"  {name}: {text}" for name, text in self.priors.items()]
        said = [str(f) for f in self.findings if f.code not in ("sampled", "not_converged")]
        return "\n".join([self.message, *said, "", table, "", "Priors:", *priors])
