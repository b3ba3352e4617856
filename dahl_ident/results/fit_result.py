"""The result of a least-squares fit, with the names that lmfit's users know."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.intervals import (
    ConfidenceIntervals,
    IntervalComparison,
    Method,
    compare,
    intervals,
)
from dahl_ident.diagnostics.levels import LEVELS
from dahl_ident.diagnostics.verdicts import Identifiability, judged
from dahl_ident.elements import Model, Parameter
from dahl_ident.fitting.optimum import Combination, Optimum
from dahl_ident.fitting.status import Status
from dahl_ident.problem import Problem


@dataclass(frozen=True)
class Estimate:
    """One parameter of a fit.

    Attributes
    ----------
    name, unit, description : str
        As declared beside the element.
    value : float
        The estimate, or the fixed value.
    stderr : float or None
        Standard error, first order (Wald); infinite where undetermined, None where fixed.
    init_value : float or None
        The start that the user gave.
    min, max : float
        Bounds.
    vary : bool
        Whether it was estimated.
    """

    name: str
    unit: str
    description: str
    value: float
    stderr: float | None
    init_value: float | None
    min: float
    max: float
    vary: bool

    def __str__(self) -> str:
        if not self.vary:
            return f"{self.name} = {self.value:g} {self.unit}".rstrip() + " (fixed)"
        return f"{self.name} = {with_unit(self.value, self.stderr, self.unit)}"


class FitResult:
    """What a fit found: estimates, their errors, and whether to trust them.

    Made by :func:`dahl_ident.fit`. Names follow lmfit's ``ModelResult`` where both have the
    same thing; nothing rescales the covariance behind the user's back: `scale` is 1 where the
    noise is known, else estimated and reported.

    Attributes
    ----------
    params : mapping of str to Estimate
        Every parameter of model and sensors, fixed ones included.
    var_names : list of str
        The free ones; they order `covar`.
    covar : ndarray, shape (nvarys, nvarys)
        Covariance of the free values, first order; the noise's scale is in it.
    residual : ndarray, shape (m,)
        Whitened residuals, two a row of data (in units of the noise where its scale is known),
        then those of priors.
    chisqr, redchi : float
        Sum of squared residuals, and the same over `nfree`.
    aic, bic : float
        From the likelihood; an estimated noise scale counts as a parameter.
    ndata, nvarys, nfree, nfev : int
        Real numbers measured (two a row), free parameters, degrees of freedom, evaluations.
    scale, scale_known : float, bool
        The noise's scale, and whether it was known beforehand.
    success, message, status : bool, str, Status
        Whether a finite optimum was found, and how the search ended.
    best_fit : ndarray of complex, shape (n,)
        Predicted response at the estimate.
    model : Model
        The model with the estimates put in.
    """

    def __init__(self, optimum: Optimum) -> None:
        self._optimum = optimum
        self._intervals: dict[tuple[str, tuple[float, ...]], ConfidenceIntervals] = {}

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
    def status(self) -> Status:
        """How the search ended."""
        return self._optimum.status

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
    def params(self) -> Mapping[str, Estimate]:
        """Every parameter of model and sensors, by name."""
        values = dict(zip(self.var_names, self._optimum.values.tolist(), strict=True))
        stderr = self._optimum.stderr
        own = self.problem.model.parameters
        sensed = self.problem.sensors.parameters
        shown = own if self.problem.sensors.are_exact else (*own, *sensed)
        return MappingProxyType({p.name: _estimate(p, values, stderr) for p in shown})

    @property
    def var_names(self) -> list[str]:
        """Names of the free parameters."""
        return list(self.problem.names)

    @cached_property
    def covar(self) -> FloatArray:
        """Covariance of the free values, first order."""
        return self._optimum.values_covariance

    @cached_property
    def correl(self) -> Mapping[str, Mapping[str, float]]:
        """Correlation of each pair of free parameters, by both names."""
        std = np.sqrt(np.diagonal(self._optimum.covariance))
        with np.errstate(invalid="ignore", divide="ignore"):
            matrix = self._optimum.covariance / np.outer(std, std)
        names = self.var_names
        return {
            a: {b: float(matrix[i, j]) for j, b in enumerate(names) if j != i}
            for i, a in enumerate(names)
        }

    @property
    def residual(self) -> FloatArray:
        """Whitened residuals."""
        return self._optimum.residuals

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
        return self._optimum.scale

    @property
    def scale_known(self) -> bool:
        """Whether the noise's scale was known beforehand."""
        return self._optimum.scale_known

    @property
    def ndata(self) -> int:
        """Real numbers measured: two for each row."""
        return self.problem.n_residuals

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

    @cached_property
    def log_likelihood(self) -> float:
        """Log-density of the data at the estimate, at the likeliest scale where unknown."""
        return float(self.problem.log_likelihood(self._optimum.theta))

    @property
    def aic(self) -> float:
        """Akaike's criterion, -2 ln L + 2 k; k counts an estimated noise scale."""
        return -2.0 * self.log_likelihood + 2.0 * self._counted_parameters

    @property
    def bic(self) -> float:
        """Schwarz's criterion, -2 ln L + k ln(ndata); k counts an estimated noise scale."""
        return -2.0 * self.log_likelihood + math.log(self.ndata) * self._counted_parameters

    @property
    def _counted_parameters(self) -> int:
        return self.nvarys + (not self.scale_known)

    @cached_property
    def best_fit(self) -> ComplexArray:
        """Predicted response at the estimate, shape (n,)."""
        return self.problem.predict(self._optimum.theta)

    @cached_property
    def model(self) -> Model:
        """The model with the estimates put in; parameters stay free or fixed as they were."""
        model = self.problem.model
        own = {p.name for p in model.parameters}
        values = self.problem.to_values(self._optimum.theta).tolist()
        found = dict(zip(self.var_names, values, strict=True))
        return model.with_values({name: v for name, v in found.items() if name in own})

    # Judging

    def conf_interval(
        self, method: Method = "profile", levels: Sequence[float] = LEVELS
    ) -> ConfidenceIntervals:
        """Return confidence intervals of every free parameter.

        Parameters
        ----------
        method : {"profile", "wald"}, default "profile"
            See :mod:`dahl_ident.diagnostics.intervals`, which says what to use when.
        levels : sequence of float, default 0.6827, 0.9545, 0.9973
            Confidence levels.

        Returns
        -------
        ConfidenceIntervals
            A mapping from the parameter's name to its intervals; a side on which the data set no
            limit is open. Profiles never raise, however badly a parameter is determined.

        Raises
        ------
        ValidationError
            If `method` is unknown or a level is not between 0 and 1.
        """
        key = (method, tuple(levels))
        if key not in self._intervals:
            self._intervals[key] = intervals(self._optimum, method, levels)
        return self._intervals[key]

    def compare_intervals(
        self, methods: Sequence[Method] = ("wald", "profile"), levels: Sequence[float] = LEVELS
    ) -> IntervalComparison:
        """Return the intervals of several methods side by side, and where they disagree.

        Parameters
        ----------
        methods : sequence of str, default ("wald", "profile")
            The last is the most trusted.
        levels : sequence of float, default 0.6827, 0.9545, 0.9973
            Confidence levels.

        Returns
        -------
        IntervalComparison
            Printed, a table with the disagreements.

        Raises
        ------
        ValidationError
            If there are fewer than two methods, one is unknown, or a level is impossible.
        """
        return compare(self._optimum, [self.conf_interval(method, levels) for method in methods])

    @cached_property
    def identifiability(self) -> Identifiability:
        """Which parameters, or which combinations of them, the data determine."""
        return judged(self._optimum, self.conf_interval())

    def __repr__(self) -> str:
        estimates = ", ".join(str(self.params[name]) for name in self.var_names)
        return f"<FitResult: {estimates}; {self.status.name.lower()}>"


def _estimate(
    parameter: Parameter, values: Mapping[str, float], stderr: Mapping[str, float]
) -> Estimate:
    vary = parameter.name in values
    value = values[parameter.name] if vary else parameter.value
    return Estimate(
        name=parameter.name,
        unit=parameter.unit,
        description=parameter.description,
        value=math.nan if value is None else value,
        stderr=stderr.get(parameter.name),
        init_value=parameter.value if vary else None,
        min=parameter.lower,
        max=parameter.upper,
        vary=vary,
    )
