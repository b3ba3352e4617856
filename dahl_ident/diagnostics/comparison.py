"""Comparison of models by Akaike's and Schwarz's criteria.

Both are -2 ln L plus a penalty for each parameter, 2 for AIC and ln(2n) for BIC; lower is better. A
difference above 10 is clear, one below 2 means nothing. The lowest of several often belongs, by
chance, to a model with too many parameters, so another model is called best only if it is clearly
better than the one fitted. Criteria compare models but do not validate one: if none describes the
data, the best of them does not either, and a model with negative damping is not physical.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dahl_ident.diagnostics.formatting import listed, table, with_unit
from dahl_ident.diagnostics.physics import is_spring, negative_parameters
from dahl_ident.diagnostics.verdicts import Fit
from dahl_ident.elements import Element, Model, Spring
from dahl_ident.errors import DahlIdentError, ValidationError
from dahl_ident.fitting import Optimum, solve
from dahl_ident.problem import Problem

_PLAIN = 10.0
_MEANS_NOTHING = 2.0


@dataclass(frozen=True)
class ComparedModel:
    """One model's fit to the data.

    Attributes
    ----------
    name : str
        What distinguishes it.
    optimum : Optimum
        Its estimate.
    """

    name: str
    optimum: Optimum

    @property
    def aic(self) -> float:
        """Akaike's criterion; parameters at infinity do not count."""
        return self.optimum.aic

    @property
    def bic(self) -> float:
        """Schwarz's criterion; parameters at infinity do not count."""
        return self.optimum.bic

    @property
    def estimates(self) -> str:
        """The free parameters in one line; a number without an error is none."""
        o = self.optimum
        units = [p.unit for p in o.problem.parameters]
        rows = zip(o.names, o.values.tolist(), o.stderr.values(), units, strict=True)
        known = [f"{n} = {with_unit(v, e, unit)}" for n, v, e, unit in rows if np.isfinite(e)]
        unknown = [name for name, error in o.stderr.items() if not np.isfinite(error)]
        return ", ".join(known + ([f"{listed(unknown)} not determined"] if unknown else []))


@dataclass(frozen=True)
class ModelComparison:
    """Models side by side; the first is the one that was fitted.

    Attributes
    ----------
    models : tuple of ComparedModel
        Those that could be fitted.
    failed : mapping of str to str
        Why the others could not.

    Examples
    --------
    >>> import dahl_ident as di
    >>> comparison = di.compare_models(di.fit(di.load_dataset("alpha_2"), di.Dahl()))
    >>> comparison.best.name
    'exponent free'
    """

    models: tuple[ComparedModel, ...]
    failed: Mapping[str, str]

    @property
    def best(self) -> ComparedModel:
        """The model with the lowest BIC if that is lower by more than 10, else the one fitted."""
        return self._lowest if self._gain > _PLAIN else self.models[0]

    @property
    def _lowest(self) -> ComparedModel:
        return min(self.models, key=lambda model: model.bic)

    @property
    def _gain(self) -> float:
        """How far the lowest BIC is below that of the model fitted."""
        return self.models[0].bic - self._lowest.bic

    @property
    def headline(self) -> str:
        """The verdict in a sentence or two."""
        lowest = self._lowest
        if self._gain < _MEANS_NOTHING:
            return "No model compared is better than the one fitted."
        word = "clearly better" if self._gain > _PLAIN else "perhaps better"
        aic = self.models[0].aic - lowest.aic
        text = f"{lowest.name} would be {word} (AIC lower by {aic:.0f}, BIC by {self._gain:.0f})."
        absurd = [f"There {warning}." for warning in negative_parameters(lowest.optimum)]
        return " ".join([text, *absurd])

    def __str__(self) -> str:
        head = ("model", "AIC", "BIC", "estimates")
        aic, bic = (min(getattr(m, name) for m in self.models) for name in ("aic", "bic"))
        rows = [
            (
                m.name,
                f"{m.aic - aic:+.1f}",
                f"{m.bic - bic:+.1f}",
                m.estimates if m.optimum.success else f"{m.estimates} ({m.optimum.status.name})",
            )
            for m in self.models
        ]
        lines = [self.headline, table([head, *rows], left=(0, 3))]
        lines += [f"{name} could not be fitted: {why}" for name, why in self.failed.items()]
        return "\n".join(lines)

    def to_frame(self) -> Any:
        """Return a pandas table: one row a model."""
        import pandas as pd

        return pd.DataFrame(
            [
                {
                    "model": m.name,
                    "aic": m.aic,
                    "bic": m.bic,
                    "status": m.optimum.status.name,
                    **dict(zip(m.optimum.names, m.optimum.values.tolist(), strict=True)),
                }
                for m in self.models
            ]
        )


def compare_models(fit: Fit, models: Mapping[str, Element] | None = None) -> ModelComparison:
    """Fit other models to the same data and compare them by AIC and BIC.

    Parameters
    ----------
    fit : FitResult
        From :func:`dahl_ident.fit`; its data, noise model, sensors and loss are used for all.
    models : mapping of str to Element, optional
        Models to compare with, by a name for each. Left out: the exponent free (or 1, where it
        was free), two Dahl elements in place of one, and a spring added.

    Returns
    -------
    ModelComparison
        Printed, a table; `best` is the model of the lowest BIC.

    Examples
    --------
    >>> import numpy as np
    >>> import dahl_ident as di
    >>> rng = np.random.default_rng(1)
    >>> A = np.geomspace(1e-4, 1e-2, 20)
    >>> N = di.Dahl(f_max=0.1, sigma=30.0, alpha=2.0).describing_function(A)
    >>> noise = np.exp(0.01 * rng.standard_normal((2, 20)).T @ [1.0, 1.0j])
    >>> result = di.fit(di.FrequencyResponse(np.ones(20), N * noise, A), di.Dahl())
    >>> compare_models(result).best.name
    'exponent free'
    """
    if not isinstance(models, Mapping | None):
        raise ValidationError(
            f"models is a {type(models).__name__}; expected a mapping of names to models, such as "
            "{'stiff': Dahl() + Spring()}"
        )
    problem = fit.optimum.problem
    fitted = [ComparedModel("as fitted", fit.optimum)]
    failed = {}
    for name, model in (_variants(problem.model) if models is None else models).items():
        try:
            other = Problem(problem.data, model, noise=problem.noise, sensors=problem.sensors)
            fitted.append(ComparedModel(name, solve(other, loss=fit.optimum.loss)))
        except DahlIdentError as exc:
            failed[name] = str(exc)
    return ModelComparison(tuple(fitted), failed)


def _variants(model: Model) -> dict[str, Element]:
    """Return the usual alternatives to a model."""
    found: dict[str, Element] = {}
    offers = [(e, e.alternatives()) for e in model.elements]
    for name in dict.fromkeys(name for _, offered in offers for name in offered):
        taken = [offered[name] for _, offered in offers if name in offered]
        if len(taken) > 1 and any(len(instead) > 1 for instead in taken):
            continue  # more elements of one law in place of several would share their names
        found[name] = Model(*(new for e, offered in offers for new in offered.get(name, (e,))))
    if not any(is_spring(e) for e in model.elements):
        found["spring added"] = model + Spring()
    return found
