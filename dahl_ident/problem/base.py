"""The interface of problems, of tables and of records, that searches, samplers and tests use."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray, IntArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.elements import Model, Parameter
from dahl_ident.elements.parameter import Dimension
from dahl_ident.errors import ValidationError
from dahl_ident.noise import Rho, squares_of, weighted
from dahl_ident.problem.space import Space
from dahl_ident.sensors import EXACT, Prior, Sensors
from dahl_ident.units import Motion

EXPLICIT = 1e-13
"""Relative error of predictions in closed form or by roots."""


class Quadratic(NamedTuple):
    """Half the sum of squares (or of losses), its gradient, and its Gauss-Newton Hessian."""

    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray


class Problem(ABC):
    """Residuals as functions of search coordinates, and what is known of their noise."""

    arguments: ClassVar[tuple[str, ...]]
    """Names of the constructor's arguments; each is also an attribute."""
    kind: ClassVar[str]
    """The kind of data: "table" or "records"."""
    kind_in_words: ClassVar[str]
    """The kind of data, in words for a sentence."""
    refused_options: ClassVar[Mapping[str, str]]
    """Options of estimates that do not apply to such data, and why."""
    around_optimum: ClassVar[bool] = False
    """Whether a posterior is centred on the least-squares optimum, which then has to exist."""
    scaled_priors: ClassVar[bool] = False
    """Whether priors are in units of the residuals, and scaled with them."""
    model: Model
    space: Space
    motion: Motion
    n_residuals: int
    """Number of residuals of the data, without those of priors."""
    n_nonzero: int
    """Number of residuals that can differ from zero."""
    runs: tuple[Any, ...]
    """The run of each row or record."""
    sensors: Sensors = EXACT
    residuals_per_row: int = 2
    """Number of residuals that a robust loss takes together."""
    priors: Mapping[str, Prior] = {}
    """Priors of free sensor parameters."""
    ranges: Mapping[str, tuple[float, float]] = {}
    """Mean and standard deviation of the logarithms of assumed parameters."""
    scale_known: bool = False
    """Whether the data state the noise, so that the residuals have unit variance."""
    has_misfit: bool = False
    """Whether covariances include a misfit in addition to the stated noise."""
    tail: Rho | None = None
    """The loss of rows whose covariance has few degrees of freedom; None if they are Gaussian."""
    n_simulations: int = 4999
    """Number of simulated experiments: seven are beyond either limit of a 99.73 % interval."""

    @property
    def gaussian(self) -> bool:
        """Whether residuals are Gaussian: no covariance has few degrees of freedom."""
        return self.tail is None

    @property
    def response(self) -> FrequencyResponse | None:
        """The table, if the data are one."""
        return None

    @abstractmethod
    def for_table(self, table: FrequencyResponse) -> Any:
        """Return the problem of the same model and sensors for a table, without its covariance."""

    def why_not_finite(self, residuals: FloatArray) -> str:
        """Return why residuals are not finite; empty if they are."""
        return ""

    @property
    @abstractmethod
    def extent(self) -> str:
        """The amount of data, in words."""

    @property
    def n_reported(self) -> int:
        """Number of free parameters of model and sensors; unknowns of records follow them."""
        return len(self.names)

    @property
    def device_parameters(self) -> tuple[str, ...]:
        """Names of the parameters of model and sensors, fixed ones included."""
        of_records = self.names[self.n_reported :]
        return tuple(p.name for p in self.all_parameters if p.name not in of_records)

    @property
    @abstractmethod
    def provenances(self) -> tuple[Mapping[str, Any] | None, ...]:
        """Where the data come from: one for a table, or one for each record."""

    @property
    def n_priors(self) -> int:
        """The number of priors, those of assumed parameters included."""
        return len(self.priors) + len(self.ranges)

    @property
    def calibrations(self) -> Mapping[str, float]:
        """Standard uncertainties of gains and delay of the channels, by name."""
        return {name: float(prior.std()) for name, prior in self.priors.items()}

    @abstractmethod
    def unit_sizes(self, dimension: Dimension) -> FloatArray:
        """Return the sizes in the data of a quantity with these powers of N, m and s."""

    @property
    @abstractmethod
    def output_in_words(self) -> str:
        """The quantity of which a misfit is a share, in words."""

    # Tables

    @property
    def n_tables(self) -> int:
        """The number of tables: one."""
        return 1

    def take(self, tables: IntArray | slice) -> Self:
        """Return this problem: all the tables of a search are this one."""
        return self

    def table(self, index: int) -> Any:
        """Return this problem."""
        return self

    # Coordinates

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The free parameters, the model's first."""
        return self.space.parameters

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the free parameters."""
        return self.space.names

    @property
    def all_parameters(self) -> tuple[Parameter, ...]:
        """The parameters of model and sensors, fixed ones included."""
        sensors = () if self.sensors.are_exact else self.sensors.parameters
        return (*self.model.parameters, *sensors)

    def to_search(self, values: ArrayLike) -> FloatArray:
        """Return the search coordinates of values in SI units, in the order of `names`."""
        return self.space.to_search(values)

    def to_values(self, theta: ArrayLike) -> FloatArray:
        """Return the parameter values at search coordinates, shape (P,) or (S, P)."""
        return self.space.to_values(self.space.checked(theta))

    def value_slopes(self, theta: ArrayLike) -> FloatArray:
        """Return d value / d theta: the value itself for positive parameters, 1 for most others."""
        return self.space.slopes(self.to_values(theta))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the parameters' lower and upper bounds in search coordinates."""
        return self.space.bounds

    @property
    def is_bounded(self) -> bool:
        """Whether any parameter has a finite bound in search coordinates."""
        return self.space.is_bounded

    def near(self, theta: FloatArray) -> Problem:
        """Return a faster problem with nearly the same predictions near theta, if there is one."""
        return self

    def in_order(self, theta: ArrayLike) -> FloatArray:
        """Return theta with interchangeable elements, if any, in order."""
        return self.space.checked(theta)

    def like(self, **changes: Any) -> Self:
        """Return this problem with some of its arguments changed."""
        return type(self)(**{name: getattr(self, name) for name in self.arguments} | changes)

    def altered(self, *stale: str, **changes: Any) -> Self:
        """Return this problem with other attributes, and without the cached `stale` ones."""
        changed = copy(self)
        for name in stale:
            changed.__dict__.pop(name, None)
        changed.__dict__.update(changes)
        return changed

    @abstractmethod
    def fitted(self, theta: FloatArray) -> Any:
        """Return the predicted measurement: a response, or a wave for each record."""

    # Residuals

    def with_priors(self, rows: FloatArray, theta: FloatArray) -> FloatArray:
        """Return residuals and their derivatives, (..., 1 or 1 + P, m), with those of priors."""
        if not self.n_priors:
            return rows
        prior_rows = np.zeros((*rows.shape[:-1], self.n_priors))
        values = self.space.to_values(theta)
        slopes = self.space.slopes(values)
        moments = [(name, _normal_moments(name, prior)) for name, prior in self.priors.items()]
        moments += self.ranges.items()
        for column, (name, (mean, std)) in enumerate(moments):
            index = self.names.index(name)
            value, slope = values[..., index], slopes[..., index]
            if name in self.ranges:
                value, slope = np.log(np.abs(value)), slope / value
            prior_rows[..., 0, column] = (value - mean) / std
            if rows.shape[-2] > 1:
                prior_rows[..., 1 + index, column] = slope / std
        return np.concatenate([rows, prior_rows], axis=-1)

    @property
    @abstractmethod
    def rounding(self) -> FloatArray:
        """Size of residuals that may be pure rounding errors; no estimated scale is smaller."""

    @property
    def accuracy(self) -> float:
        """Relative error of predictions."""
        return EXPLICIT

    @abstractmethod
    def data_rows(
        self, theta: FloatArray, *, derivatives: bool = True, tails: bool = True
    ) -> FloatArray:
        """Return the data's residuals and, below them, their derivatives, (..., 1 or 1 + P, m).

        Theta is not checked; residuals without a prediction are not finite. Without `tails`, a
        covariance with few degrees of freedom counts as known.
        """

    def rows(
        self,
        theta: FloatArray,
        scale: ArrayLike = 1.0,
        *,
        derivatives: bool = True,
        tails: bool = True,
    ) -> FloatArray:
        """Return ``data_rows`` over the noise's scale, () or (S,), followed by those of priors."""
        rows = self.data_rows(theta, derivatives=derivatives, tails=tails)
        size = np.asarray(scale)[..., None, None]
        if self.scaled_priors:
            return np.asarray(self.with_priors(rows, theta) / size)
        if size.ndim > 2 or size != 1.0:
            rows = rows / size
        return self.with_priors(rows, theta)

    def quadratic(
        self,
        theta: FloatArray,
        scale: ArrayLike = 1.0,
        rho: Rho | None = None,
        chart: FloatArray | None = None,
    ) -> Quadratic:
        """Return half the sum of squares with its gradient and Hessian, unchecked.

        Derivatives are with respect to theta, or with `chart` = dtheta/dphi, (P, Q) or (S, P, Q),
        with respect to phi.

        The cost has shape () or (S,), and is infinite where there is no prediction. With a loss
        rho(z) of each row, the gradient is exact, and the Hessian is the one for a linear model,
        rho' d' d + 2 rho'' (y' d)(y' d)', without its negative part.
        """
        rho = rho or self.tail
        m = self.n_residuals
        rows = self.rows(theta, scale, tails=False)
        if chart is not None:
            r, J = rows[..., :1, :], rows[..., 1:, :]
            rows = np.concatenate([r, chart.swapaxes(-1, -2) @ J], axis=-2)
        with np.errstate(over="ignore", invalid="ignore"):  # a law may overflow at extreme theta
            if rho is None:
                products = rows @ rows.swapaxes(-1, -2)
                cost = 0.5 * products[..., 0, 0]
            else:
                z = squares_of(rows[..., 0, :m], self.residuals_per_row)
                loss, slope, curvature = rho(z)
                cost = 0.5 * (loss.sum(axis=-1) + (rows[..., 0, m:] ** 2).sum(axis=-1))
                along = np.maximum(2.0 * curvature, -slope / np.maximum(z, 1e-300))
                weighted_rows = weighted(rows, m, slope, along, self.residuals_per_row)
                products = weighted_rows @ rows.swapaxes(-1, -2)
        cost = np.where(cost < np.inf, cost, np.inf)
        return Quadratic(cost, products[..., 0, 1:], products[..., 1:, 1:])

    def residuals(self, theta: ArrayLike, scale: ArrayLike = 1.0) -> FloatArray:
        """Return the whitened residuals, measured minus predicted, over `scale`, (m,) or (S, m).

        They are followed by (value - mean)/std of each prior.
        """
        return self.rows(self.space.checked(theta), scale, derivatives=False)[..., 0, :]

    def residuals_and_jacobian(
        self, theta: ArrayLike, scale: ArrayLike = 1.0, *, tails: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        """Return residuals, (m,) or (S, m), and Jacobian, (m, P) or (S, m, P)."""
        rows = self.rows(self.space.checked(theta), scale, tails=tails)
        return rows[..., 0, :], rows[..., 1:, :].swapaxes(-1, -2)

    def whitened(self, theta: FloatArray, *, tails: bool = True) -> FloatArray:
        """Return the data's residuals, (..., m), without priors, unchecked."""
        return self.data_rows(theta, derivatives=False, tails=tails)[..., 0, :]

    def squares(self, theta: FloatArray, *, tails: bool = True) -> FloatArray:
        """Return the sum of squared residuals of every row, (..., n), without priors, unchecked."""
        with np.errstate(over="ignore"):
            return squares_of(self.whitened(theta, tails=tails), self.residuals_per_row)

    @property
    @abstractmethod
    def log_area(self) -> Any:
        """Return ln of the volume of a unit cube of residuals, in the units of the data."""

    def log_likelihood(self, theta: ArrayLike, scale: ArrayLike | None = None) -> FloatArray:
        """Return ln of the density of the data: of Re R and Im R of every row, or of samples.

        `scale` is that of the noise, if unknown: the standard deviation of ln gain and of phase
        (rad) for "relative", of Re R and Im R for "absolute", of samples over `output_std` for
        records. By default it maximizes the likelihood at each theta:
        (sum of squares / n_residuals)^(1/2).

        Priors are not included; the result is -inf where the model has no prediction. All noise
        models give densities of the same numbers, so their likelihoods can be compared. If a
        covariance has few degrees of freedom, the loss of :mod:`dahl_ident.noise` replaces the sum
        of squares, and the result is a log-likelihood except for a constant. The filtered residuals
        of records are taken as independent.
        """
        theta = self.space.checked(theta)
        if self.scale_known and scale is not None:
            raise ValidationError("scale is given, but the noise has a known scale; leave it out")
        total, m = self.squares(theta).sum(axis=-1), self.n_residuals
        if scale is None:
            s2 = np.asarray(1.0) if self.scale_known else total / m
        else:
            s2 = np.asarray(scale) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            result = self.log_area - 0.5 * (m * np.log(2.0 * np.pi * s2) + total / s2)
        return np.where(np.isnan(result), -np.inf, result)[()]

    def information(
        self, theta: ArrayLike, scale: ArrayLike = 1.0, chart: FloatArray | None = None
    ) -> FloatArray:
        """Return the Fisher information of theta, shape (P, P) or (S, P, P), priors included."""
        return self.quadratic(self.space.checked(theta), scale, chart=chart).hessian


def _normal_moments(name: str, prior: Prior) -> tuple[float, float]:
    """Return mean and standard deviation of a normal prior, the only kind least squares takes."""
    kind = getattr(getattr(prior, "dist", None), "name", type(prior).__name__)
    if kind != "norm":
        raise ValidationError(
            f"the prior of {name} is {kind}; least squares takes normal priors "
            "(scipy.stats.norm); any other needs sampling"
        )
    return float(prior.mean()), float(prior.std())
