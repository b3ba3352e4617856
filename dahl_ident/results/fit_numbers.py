"""The numbers of a least-squares fit, with the names of lmfit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.error_model import ErrorModel, error_model
from dahl_ident.diagnostics.error_sources import NOISE
from dahl_ident.elements import Model, Parameter
from dahl_ident.fitting.optimum import Combination, Optimum, propagated
from dahl_ident.problem import Problem
from dahl_ident.results.result import Estimate, Parameters, Result
from dahl_ident.units import Motion, shown_unit


class FitNumbers(Result):
    """An optimum under lmfit's names; see :class:`dahl_ident.FitResult`."""

    _first_order = False  # constraints: errors of first order alone

    def __init__(self, optimum: Optimum) -> None:
        self._optimum = optimum

    @property
    def optimum(self) -> Optimum:
        """The solver's plain result."""
        return self._optimum

    @property
    def problem(self) -> Problem:
        """Data, model, noise and sensors as they were fitted."""
        return self._optimum.problem

    @property
    def data(self) -> FrequencyResponse:
        """The data that were fitted."""
        return self.problem.data

    @property
    def method(self) -> str:
        """The solver."""
        return self._optimum.method

    @property
    def noise(self) -> str:
        """The noise model."""
        return self.problem.noise

    @property
    def first_order(self) -> bool:
        """Whether errors are of first order alone: with constraints."""
        return self._first_order

    @property
    def success(self) -> bool:
        """Whether a finite optimum was found."""
        return self._optimum.success

    @property
    def message(self) -> str:
        """How the search ended, in words."""
        return self._optimum.message

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """Combinations that the data determine where single parameters run away."""
        return self._optimum.combinations

    @cached_property
    def errors(self) -> ErrorModel | None:
        """The sources of error; None where there is nothing to estimate them from."""
        return None if self._first_order else error_model(self._optimum)

    @cached_property
    def errors_of_combinations(self) -> ErrorModel | None:
        """The same; also where only combinations of parameters are determined, for these alone."""
        if self._first_order:
            return None
        return self.errors or error_model(self._optimum, of_combinations=True)

    @cached_property
    def params(self) -> Parameters:
        """Every parameter of model and sensors, by name, with combined uncertainties.

        Assumed exponents have their estimates, so that all of them together are a model.
        """
        values = dict(zip(self.var_names, self._optimum.values.tolist(), strict=True))
        stderr = dict(self._optimum.stderr)
        errors = self.errors_of_combinations
        if errors is not None:
            known = [name for name in (*values, *errors.assumed) if errors.holds(name)]
            values |= {name: errors.values[name] for name in known}
            stderr |= {name: errors.stderr[name] for name in known}
        return Parameters(estimates(self.problem, values, stderr))

    @cached_property
    def stderr_noise(self) -> Mapping[str, float]:
        """Standard errors of the estimate from noise alone, by name."""
        found = dict(self._optimum.stderr)
        errors = self.errors_of_combinations
        if errors is not None:
            size = np.abs(errors.problem.value_slopes(errors.theta))
            noise = size * np.sqrt(np.maximum(np.diagonal(errors.contributions[NOISE]), 0.0))
            own = dict(zip(errors.names, noise.tolist(), strict=True))
            found |= {name: own[name] for name in found if errors.holds(name)}
        return found

    @property
    def var_names(self) -> list[str]:
        """Names of the free parameters."""
        return list(self.problem.names)

    @cached_property
    def covar(self) -> FloatArray:
        """Combined covariance of the free values, by every source of error, first order."""
        errors = self.errors
        if errors is None:
            return self._optimum.values_covariance
        own = [errors.names.index(name) for name in self.var_names]
        slopes = errors.problem.value_slopes(errors.theta)
        whole = propagated(errors.covariance, slopes)
        return np.asarray(whole[np.ix_(own, own)])

    @cached_property
    def correl(self) -> Mapping[str, Mapping[str, float]]:
        """Correlation of each pair of free parameters, by both names."""
        std = np.sqrt(np.diagonal(self.covar))
        with np.errstate(invalid="ignore", divide="ignore"):
            matrix = self.covar / np.outer(std, std)
        names = self.var_names
        return {
            a: {b: float(matrix[i, j]) for j, b in enumerate(names) if j != i}
            for i, a in enumerate(names)
        }

    @cached_property
    def _estimate(self) -> Optimum:
        """The estimate, as an optimum; the search's where nothing else is estimated."""
        errors = self.errors_of_combinations
        return self._optimum if errors is None else errors.at_estimate

    @property
    def residual(self) -> FloatArray:
        """Whitened residuals at the estimate."""
        return self._estimate.residuals

    @property
    def chisqr(self) -> float:
        """Sum of squared residuals."""
        return float(self.residual @ self.residual)

    @property
    def redchi(self) -> float:
        """`chisqr` over `nfree`; the squared scale where that was estimated."""
        return self.chisqr / self.nfree if self.nfree > 0 else math.nan

    @property
    def scale(self) -> float:
        """Standard deviation of the residuals: 1 where known beforehand."""
        return self._estimate.scale

    @property
    def scale_known(self) -> bool:
        """Whether the noise's scale was known beforehand."""
        return self._optimum.scale_known

    @property
    def ndata(self) -> int:
        """Real numbers measured: two for each row, one for that of a mean force."""
        return self.problem.n_numbers

    @property
    def nvarys(self) -> int:
        """Number of free parameters."""
        return len(self.problem.names)

    @property
    def nfree(self) -> int:
        """Degrees of freedom."""
        return self._optimum.dof

    @property
    def nfev(self) -> int:
        """Evaluations of the residuals."""
        return self._optimum.nfev

    @property
    def log_likelihood(self) -> float:
        """Log-density of the data at the estimate, at the likeliest scale where unknown.

        With a robust loss rho, that of the density proportional to exp(-rho/2).
        """
        return self._optimum.log_likelihood

    @property
    def aic(self) -> float:
        """Akaike's criterion, -2 ln L + 2 k.

        k counts an estimated noise scale, and no parameter whose optimum lies at infinity.
        """
        return self._optimum.aic

    @property
    def bic(self) -> float:
        """Schwarz's criterion, -2 ln L + k ln(ndata); k as for `aic`."""
        return self._optimum.bic

    @cached_property
    def best_fit(self) -> ComplexArray:
        """Predicted response at the estimate, shape (n,)."""
        return self._estimate.problem.predict(self._estimate.theta)

    @cached_property
    def model(self) -> Model:
        """The model with the estimates put in; parameters stay free or fixed as they were."""
        model = self.problem.model
        own = {p.name for p in model.parameters}
        values = self.problem.to_values(self._optimum.theta).tolist()
        found = dict(zip(self.var_names, values, strict=True))
        if self.errors is not None:
            found = dict(self.errors.values)
        return model.with_values({name: v for name, v in found.items() if name in own})


def estimates(
    problem: Problem, values: Mapping[str, float], stderr: Mapping[str, float]
) -> dict[str, Estimate]:
    """Return every parameter of model and sensors, with those values that were estimated."""
    exact = problem.sensors.are_exact
    shown = (*problem.model.parameters, *(() if exact else problem.sensors.parameters))
    return {p.name: _estimate(p, values, stderr, problem.data.motion) for p in shown}


def _estimate(
    parameter: Parameter,
    values: Mapping[str, float],
    stderr: Mapping[str, float],
    motion: Motion,
) -> Estimate:
    vary = bool(parameter.free)
    value = values.get(parameter.name, parameter.value)
    return Estimate(
        name=parameter.name,
        unit=shown_unit(parameter.unit, motion),
        description=parameter.description,
        value=math.nan if value is None else value,
        stderr=stderr.get(parameter.name),
        init_value=parameter.value if parameter.name in values else None,
        min=parameter.lower,
        max=parameter.upper,
        vary=vary,
    )
