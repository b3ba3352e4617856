"""What posteriors by chain and by quadrature have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from dahl_ident.arrays import FloatArray, whole_number
from dahl_ident.bayes.density import Density
from dahl_ident.bayes.priors import PriorLike
from dahl_ident.problem import Problem
from dahl_ident.results.predictive import PredictiveCheck, predictive_checks
from dahl_ident.results.prior_rule import PriorRule, prior_rules

if TYPE_CHECKING:
    import pandas as pd

_RULE_DRAWS = 4000
_CHECK_DRAWS = 1000
QUANTILES = {"2.5%": 0.025, "16%": 0.16, "median": 0.5, "84%": 0.84, "97.5%": 0.975}


class BayesianResult(ABC):
    """Parameters, priors and draws of one posterior density."""

    _density: Density

    @property
    def problem(self) -> Problem:
        """Data, model, noise and sensors."""
        return self._density.problem

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, the model's first, an unknown noise scale last."""
        return self._density.names

    @property
    def units(self) -> tuple[str, ...]:
        """SI units of the parameters."""
        own = [p.unit for p in self.problem.parameters]
        return (*own, *([""] * (len(self.names) - len(own))))

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
        parts = self._density.prior.parts
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
    def prior_rules(self) -> tuple[PriorRule, ...]:
        """The parameters that the prior determines rather than the data, or against them."""
        if self.likelihood == "none":
            return ()
        return prior_rules(self._density.prior, self._draws(_RULE_DRAWS, 0))

    @cached_property
    def checks(self) -> tuple[PredictiveCheck, ...]:
        """Posterior predictive checks of the residuals; none where the prior was sampled."""
        if self.likelihood == "none":
            return ()
        draws = self._draws(_CHECK_DRAWS, 0)
        return predictive_checks(self._density, draws, np.random.default_rng(0))

    @property
    def objections(self) -> tuple[str, ...]:
        """Why the numbers are not to be trusted; none where they are."""
        unfinished = () if self.converged else (self.message,)
        against = (str(rule) for rule in self.prior_rules if rule.contradicted)
        return (*unfinished, *against, *self._misfits)

    @property
    def trusted(self) -> bool:
        """Whether the posterior has converged, fits the data, and no prior stands against them."""
        return not self.objections

    @property
    def findings(self) -> tuple[str, ...]:
        """What to know besides the numbers: what the prior decides, and what does not fit."""
        return (*map(str, self.prior_rules), *self._misfits)

    @property
    def _misfits(self) -> tuple[str, ...]:
        return tuple(str(check) for check in self.checks if not check.passed)

    def draws(self, size: int, seed: int = 0) -> FloatArray:
        """Return values drawn from the posterior, shape (size, number of parameters)."""
        return self._density.to_values(self._draws(whole_number(size, "size", 1), seed))

    @abstractmethod
    def _draws(self, size: int, seed: int) -> FloatArray:
        """Return the coordinates of draws."""

    @abstractmethod
    def summary(self) -> pd.DataFrame:
        """Return one row a parameter: moments and quantiles."""

    def report(self) -> str:
        """Return the posterior as text: verdict, objections, numbers, findings and priors."""
        table = self.summary().to_string(float_format=lambda v: f"{v:.5g}")
        priors = [f"  {name}: {text}" for name, text in self.priors.items()]
        grave = [text for text in self.objections if text != self.message]
        others = [text for text in self.findings if text not in grave]
        return "\n".join([self.message, *grave, "", table, *others, "", "Priors:", *priors])

    def __str__(self) -> str:
        return self.report()
