r"""Statistics of many devices: mean, scatter, covariates, outlying devices, drift.

For the logarithm of a positive parameter (or the value of any other) of fit i, device d(i):

    y_i = x_i' b + t_d(i) + r_i + e_i,   t ~ N(0, tau^2),  r ~ N(0, omega^2),  e_i ~ N(0, u_i^2)

u_i is the fit's combined standard uncertainty, tau the scatter between devices, omega that
between runs of one device (only where some device has several fits). tau and omega have flat
priors, and all results are averaged over their posterior on a grid, so that few devices give wide
intervals; b is integrated in closed form. The REML estimate is the posterior's mode.

Outlying devices are identified first, and excluded from mean, scatter and coefficients. A control
chart compares a fit with the other fits of its device if there are several, because scatter between
devices is not a change in time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from dahl_ident.arrays import BoolArray, FloatArray, IntArray
from dahl_ident.data.readers import is_frame
from dahl_ident.diagnostics.formatting import interval, with_unit
from dahl_ident.errors import DataError, ValidationError
from dahl_ident.units import counted

if TYPE_CHECKING:
    import pandas as pd

USABLE = ("trusted", "approximate")
"""Statuses whose numbers and uncertainties can be used."""
_NODES = 31  # grid points in tau and in omega; twice as many change no interval by 1 %
_GRID_DROP = 14.0  # drop of the log-likelihood, a factor of a million, at which the grid ends
_FALSE_ALARMS = 0.01  # probability that any device is called outlying if none is
# Lucas and Saccucci (1990): one false alarm in 370 points, as with three standard deviations
EWMA_WEIGHT, EWMA_WIDTH = 0.2, 2.86
# Degrees of freedom of the scatter. Its likelihood falls as tau^-freedom, so that with flat priors
# its posterior exists from 2 on, and the variance of the coefficients, of order tau^2, from 4 on.
_FEWEST, _ENOUGH = 2, 4
# Mean difference of two normal numbers, in standard deviations (1.128)
_MOVING_RANGE = 2.0 / np.sqrt(np.pi)


@dataclass(frozen=True)
class _Fits:
    """The fits of one parameter, with devices numbered."""

    y: FloatArray
    u2: FloatArray
    X: FloatArray
    device: IntArray
    devices: int

    @classmethod
    def of(cls, y: FloatArray, u2: FloatArray, X: FloatArray, device: NDArray[Any]) -> _Fits:
        labels, numbers = np.unique(device, return_inverse=True)
        return cls(y, u2, X, numbers, labels.size)

    def select(self, mask: BoolArray) -> _Fits:
        return _Fits.of(self.y[mask], self.u2[mask], self.X[mask], self.device[mask])

    def sums(self, values: FloatArray) -> FloatArray:
        """Return the sums of values, (n,) or (n, c), over the fits of each device."""
        sums = [np.bincount(self.device, v, self.devices) for v in np.atleast_2d(values.T)]
        return np.asarray(sums[0] if values.ndim == 1 else np.stack(sums, axis=-1))

    def solve(self, tau: float, omega: float) -> _Solution:
        """Return the generalised least squares solution for given tau and omega."""
        w = 1.0 / (omega**2 + self.u2)
        total = self.sums(w)
        shrink = tau**2 / (1.0 + tau**2 * total)
        columns = np.column_stack([self.X, self.y])
        sums = self.sums(w[:, None] * columns)
        G = columns.T @ (w[:, None] * columns) - sums.T @ (shrink[:, None] * sums)
        C = np.asarray(np.linalg.inv(G[:-1, :-1]), dtype=np.float64)
        b = C @ G[:-1, -1]
        log_det = -np.log(w).sum() + np.log1p(tau**2 * total).sum()
        squares = G[-1, -1] - G[:-1, -1] @ b
        log_likelihood = -0.5 * (log_det - np.linalg.slogdet(C)[1] + squares)
        residual = self.sums(w * (self.y - self.X @ b)) / total
        return _Solution(tau, b, C, float(log_likelihood), residual, 1.0 / total)


class _Solution(NamedTuple):
    """Coefficients b with covariance C; for each device its mean residual and its variance."""

    tau: float
    b: FloatArray
    C: FloatArray
    log_likelihood: float
    residual: FloatArray
    variance: FloatArray

    def shrunken(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return shrunk estimates of the devices, with mean covariates x, and their variances."""
        weight = self.tau**2 / (self.tau**2 + self.variance)
        remaining = (1.0 - weight)[:, None] * x
        variance = weight * self.variance + np.einsum("ij,jk,ik->i", remaining, self.C, remaining)
        return x @ self.b + weight * self.residual, variance


@dataclass(frozen=True)
class PopulationParameter:
    """Population statistics of one parameter.

    Attributes
    ----------
    name, unit : str
        Name and unit of the parameter.
    logarithmic : bool
        Whether the model describes its logarithm; scatter is then relative.
    coefficients : mapping of str to (float, float)
        Value and standard uncertainty of the mean (at the mean of the covariates) and of the
        change per unit of each covariate.
    between_devices, between_runs : (float, float, float)
        Posterior median and limits (95.45 %) of tau and omega; omega is zero if every device has
        one fit.
    devices : DataFrame
        One row per device: the mean of its own fits (`own`), the estimate shrunk towards the
        population (`shrunken`) with its standard uncertainty, and `p`, the probability that a
        device of the population lies this far from the others.
    ordered : bool
        Whether an order in time was stated.
    fits : DataFrame
        Control charts, one row per fit: individuals (`value`, `centre`, `limit`) and, if an order
        in time is stated, EWMA (`ewma`, `ewma_limit`). If devices have several fits, a value is the
        deviation from the others of its device, and NaN for a device with one.

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> from dahl_ident.campaigns.population import population
    >>> f_max = 0.1 * np.exp(0.05 * np.array([-1.2, -0.3, 0.1, 0.4, 1.0]))
    >>> table = pd.DataFrame({"device": list("abcde"), "status": "trusted",
    ...     "f_max": f_max, "u_f_max": 0.001})
    >>> statistics = population(table)["f_max"]
    >>> statistics.outlying, statistics.out_of_control
    ((), ())
    """

    name: str
    unit: str
    logarithmic: bool
    coefficients: Mapping[str, tuple[float, float]]
    between_devices: tuple[float, float, float]
    between_runs: tuple[float, float, float]
    devices: pd.DataFrame
    ordered: bool
    fits: pd.DataFrame

    @cached_property
    def mean(self) -> tuple[float, float]:
        """Population mean (the median of a logarithmic one) and its standard uncertainty."""
        value, u = self.coefficients["mean"]
        return (float(np.exp(value)), float(np.exp(value) * u)) if self.logarithmic else (value, u)

    def __str__(self) -> str:
        value, u = self.mean
        lines = [f"{self.name}: mean {with_unit(value, u, self.unit)}"]
        quantity = f"ln {self.name}" if self.logarithmic else self.name
        lines += [
            f"change of {quantity} per unit of {name}: {with_unit(b, error, '')}"
            for name, (b, error) in self.coefficients.items()
            if name != "mean"
        ]
        unit = "" if self.logarithmic else self.unit
        for groups, (median, low, high) in (
            ("devices", self.between_devices),
            ("runs", self.between_runs),
        ):
            if high > 0.0:
                limits = interval(low, high, unit)
                lines.append(f"scatter of {quantity} between {groups}: {median:.2g} ({limits})")
        if self.out_of_control:
            lines.append(f"fits outside the control limits: {len(self.out_of_control)}")
        lines += [self.few_devices] if self.few_devices else []
        names = ", ".join(self.outlying)
        outlying = f"{names}, not in these numbers" if names else "no device"
        lines.append(f"outside the population: {outlying}")
        return "\n".join(lines)

    @property
    def few_devices(self) -> str:
        """Sentence on too few devices for finite variances; empty if there are enough."""
        n, slopes = len(self.devices) - len(self.outlying), len(self.coefficients) - 1
        if n - slopes - 1 >= _ENOUGH:
            return ""
        also = f", {counted(slopes, 'slope')}" if slopes else ""
        return (
            f"{n} devices are few for a mean{also} and a scatter, whose uncertainties have heavy "
            f"tails: measure at least {slopes + 1 + _ENOUGH}"
        )

    @property
    def outlying(self) -> tuple[str, ...]:
        """Devices outside the population; the false-alarm rate is 1 % for all devices together."""
        return tuple(self.devices.index[self.devices["outlying"]])

    @property
    def out_of_control(self) -> tuple[int, ...]:
        """Rows of `fits` outside the limits of either control chart."""
        charts = {"value": "limit", "ewma": "ewma_limit"} if self.ordered else {"value": "limit"}
        beyond = [
            (self.fits[value] - self.fits["centre"]).abs() > self.fits[limit]
            for value, limit in charts.items()
        ]
        return tuple(int(i) for i in np.flatnonzero(np.any(beyond, axis=0)))


@dataclass(frozen=True)
class Population:
    """The parameters of a population; made by :func:`dahl_ident.population`.

    Attributes
    ----------
    parameters : mapping of str to PopulationParameter
        Parameters by name; the population itself can be indexed by name as well.
    used : int
        Number of fits used.
    left_out : mapping of str to int
        Number of fits not used, by status.

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> from dahl_ident.campaigns.population import population
    >>> f_max = 0.1 * np.exp(0.05 * np.array([-1.2, -0.3, 0.1, 0.4, 1.0]))
    >>> table = pd.DataFrame({"device": list("abcde"), "status": "trusted",
    ...     "f_max": f_max, "u_f_max": 0.001})
    >>> population(table).summary().index.tolist()
    ['f_max']
    """

    parameters: Mapping[str, PopulationParameter]
    used: int
    left_out: Mapping[str, int]

    def __getitem__(self, name: str) -> PopulationParameter:
        """Return one parameter."""
        return self.parameters[name]

    def summary(self) -> pd.DataFrame:
        """Return one row per parameter: mean, u, scatter between devices and runs, covariates."""
        import pandas as pd

        rows = {}
        for name, p in self.parameters.items():
            row: dict[str, Any] = {"mean": p.mean[0], "u": p.mean[1], "unit": p.unit}
            row |= {"between_devices": p.between_devices[0], "between_runs": p.between_runs[0]}
            for covariate, (value, u) in p.coefficients.items():
                if covariate != "mean":
                    row |= {f"per_{covariate}": value, f"u_per_{covariate}": u}
            row["outlying"] = ", ".join(p.outlying)
            rows[name] = row
        return pd.DataFrame.from_dict(rows, orient="index")

    def __str__(self) -> str:
        unused = ", ".join(f"{count} {status}" for status, count in self.left_out.items())
        head = f"{self.used} fits used" + (f"; left out: {unused}" if unused else "")
        few = dict.fromkeys(p.few_devices for p in self.parameters.values() if p.few_devices)
        return "\n".join([head, str(self.summary()), *few])


def population(
    table: pd.DataFrame,
    parameters: Sequence[str] | None = None,
    *,
    covariates: Sequence[str] = (),
    order: str | None = None,
) -> Population:
    """Estimate the statistics of a population of devices by partial pooling of their results.

    Parameters
    ----------
    table : DataFrame
        Table of a campaign: one row per fit, with `device`, `status`, and for each parameter ``p``
        its value ``p`` and its combined standard uncertainty ``u_p``.
    parameters : sequence of str, optional
        Parameters to evaluate; by default every column that has an uncertainty, except exponents
        that the user did not give (column `assumed`): their estimates share a prior.
    covariates : sequence of str, optional
        Columns on which the parameters may depend linearly.
    order : str, optional
        Column that orders the fits in time. Without it the control charts show no drift: there is
        a chart of individuals in the order of the table, and no EWMA chart.

    Returns
    -------
    Population
        For each parameter the population's mean, scatter between devices and runs, coefficients
        of covariates, estimates of each device shrunk towards the mean, outlying devices, and
        control charts.

    Raises
    ------
    DataError
        If a column is missing or not numeric, or fewer devices are usable than three and one for
        each covariate.
    ValidationError
        If a covariate is the same in every fit, or a linear combination of others.

    Notes
    -----
    Fits whose status is neither trusted nor approximate, or that have no finite uncertainty, are
    left out and counted. Devices outside the population are named, and excluded from its mean,
    scatter and coefficients, and from the limits of control charts.

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> rng = np.random.default_rng(1)
    >>> f_max = np.exp(rng.normal(np.log(0.1), 0.05, 40))
    >>> table = pd.DataFrame({"device": [f"d{i}" for i in range(40)], "status": "trusted",
    ...     "f_max": f_max * np.exp(rng.normal(0, 0.01, 40)), "u_f_max": 0.01 * f_max})
    >>> statistics = population(table)["f_max"]
    >>> round(statistics.mean[0], 2), round(statistics.between_devices[0], 2)
    (0.1, 0.05)
    """
    if not is_frame(table):
        raise ValidationError(
            f"table is a {type(table).__name__}; expected a pandas.DataFrame with one row per fit, "
            "such as that of a campaign"
        )
    names = _parameters(table, parameters)
    _require(table, ["device", "status", *covariates, *([order] if order else [])])
    table = with_final_status(table, names)
    usable = table["status"].isin(USABLE).to_numpy()
    left_out = table.loc[~usable, "status"].value_counts().to_dict()
    chosen = table.loc[usable]
    if order is not None:
        chosen = chosen.sort_values(order, kind="stable")
    if (n := chosen["device"].nunique()) < (least := fewest_devices(covariates)):
        also = f" with {counted(len(covariates), 'covariate')}" if covariates else ""
        raise DataError(
            f"{n} devices have usable results; a population{also} needs at least {least}"
        )
    evaluated = {
        name: _parameter_statistics(chosen, name, list(covariates), order is not None)
        for name in names
    }
    return Population(evaluated, len(chosen), {str(k): int(v) for k, v in left_out.items()})


def fewest_devices(covariates: Sequence[str]) -> int:
    """Return the least number of devices for a population with these covariates."""
    return 1 + len(covariates) + _FEWEST


def with_final_status(table: pd.DataFrame, parameters: Sequence[str] | None = None) -> pd.DataFrame:
    """Return the table, in which usable fits without a finite uncertainty have another status."""
    names = _estimated(table) if parameters is None else parameters
    u = table[[f"u_{name}" for name in names]].replace(np.inf, np.nan)
    without = table["status"].isin(USABLE) & (u.isna().any(axis=1) | u.empty)
    status = table["status"].astype(str)
    return table.assign(status=status.mask(without, status + " without a finite uncertainty"))


def _parameters(table: pd.DataFrame, names: Sequence[str] | None) -> list[str]:
    if names is not None:
        _require(table, [column for name in names for column in (name, f"u_{name}")])
        return list(names)
    if not (estimated := _estimated(table)):
        raise DataError("the table has no parameter with an uncertainty (columns p and u_p)")
    return estimated


def _estimated(table: pd.DataFrame) -> list[str]:
    """Return the parameters with an uncertainty; assumed ones are left out: they share a prior."""
    columns = [str(c) for c in table if f"u_{c}" in table]
    assumed = assumed_in(table)
    return [c for c in columns if not c.startswith("posterior_") and c not in assumed]


def assumed_in(table: pd.DataFrame) -> set[str]:
    """Return the parameters that the user did not give, so that a fit of the table assumed them."""
    texts = table["assumed"].dropna().unique() if "assumed" in table else ()
    return {name for text in texts for name in text.split(" | ")}


def unit_in(table: pd.DataFrame, name: str) -> str:
    """Return the unit of a parameter; "" if it has none, or if the table does not state it."""
    units = table[f"unit_{name}"].dropna() if f"unit_{name}" in table else ()
    return next(map(str, units), "")


def _require(table: pd.DataFrame, columns: Sequence[str]) -> None:
    missing = [c for c in columns if c not in table]
    if missing:
        raise DataError(
            f"the table has no column {', '.join(missing)}; it has {', '.join(map(str, table))}"
        )


def _parameter_statistics(
    table: pd.DataFrame, name: str, covariates: list[str], ordered: bool
) -> PopulationParameter:
    import pandas as pd

    value, u = _numbers(table, name), _numbers(table, f"u_{name}")
    if not (u > 0.0).all():
        raise DataError(f"u_{name} of row {int(np.argmin(u))} is not above zero")
    logarithmic = bool((value > 0.0).all())
    y, u = (np.log(value), u / value) if logarithmic else (value, u)
    labels, device = np.unique(table["device"].to_numpy(dtype=str), return_inverse=True)
    X = np.stack([np.ones(len(y)), *(_numbers(table, c) for c in covariates)], axis=-1)
    X[:, 1:] -= X[:, 1:].mean(axis=0)
    if np.linalg.matrix_rank(X / np.maximum(np.abs(X).max(axis=0), 1e-300)) < X.shape[1]:
        raise ValidationError(
            f"the covariates {', '.join(covariates)} are constant or follow from each other in "
            "these fits; leave one out"
        )
    fits = _Fits(y, u**2, X, device, len(labels))
    p, outlying = _outlying(fits)
    inside = ~outlying[device]
    X[:, 1:] -= X[inside, 1:].mean(axis=0)
    posterior = _Averages.of(fits.select(inside))
    tau, omega = posterior.scatters
    own = fits.sums(y / u**2) / fits.sums(u**-2)
    w = 1.0 / (omega[0] ** 2 + u**2)
    weight = fits.sums(w)
    shrunken, variance = fits.sums(w * y) / weight, 1.0 / weight  # outlying: not shrunk
    shrunken[~outlying], variance[~outlying] = posterior.devices, posterior.variance
    devices = pd.DataFrame({"own": own, "shrunken": shrunken, "u": np.sqrt(variance)}, index=labels)
    devices["p"], devices["outlying"] = p, outlying
    if logarithmic:
        devices["u"] *= np.exp(devices["shrunken"])
        devices[["own", "shrunken"]] = np.exp(devices[["own", "shrunken"]])
    b, u_b = posterior.b, np.sqrt(np.diag(posterior.C))
    charts = _charts(y - X[:, 1:] @ b[1:], device, inside, ordered)
    return PopulationParameter(
        name=name,
        unit=unit_in(table, name),
        logarithmic=logarithmic,
        coefficients=dict(
            zip(["mean", *covariates], zip(b.tolist(), u_b.tolist(), strict=True), strict=True)
        ),
        between_devices=tau,
        between_runs=omega,
        devices=devices,
        ordered=ordered,
        fits=pd.DataFrame({"device": table["device"].to_numpy(), **charts}),
    )


def _numbers(table: pd.DataFrame, column: str) -> FloatArray:
    try:
        values = table[column].to_numpy(dtype=float)
    except (TypeError, ValueError):
        raise DataError(f"the column {column} holds text; expected numbers") from None
    if not np.isfinite(values).all():
        row = int(np.argmin(np.isfinite(values)))
        raise DataError(
            f"{column} is {values[row]} for device {table['device'].iloc[row]}; expected a number"
        )
    return np.asarray(values, dtype=np.float64)


class _Averages(NamedTuple):
    """Averages over the posterior of tau and omega under flat priors."""

    b: FloatArray
    C: FloatArray
    devices: FloatArray
    variance: FloatArray
    scatters: list[tuple[float, float, float]]

    @classmethod
    def of(cls, data: _Fits) -> _Averages:
        """Return means and covariances, and median and 95.45 % limits of tau and omega."""
        mode = _reml(data)
        repeated = len(data.y) > data.devices
        nodes = [_nodes(data, mode, 0), _nodes(data, mode, 1) if repeated else np.zeros(1)]
        solutions = [data.solve(tau, omega) for tau in nodes[0] for omega in nodes[1]]
        values = np.array([s.log_likelihood for s in solutions])
        widths = [np.gradient(n) if n.size > 1 else np.ones(1) for n in nodes]
        weights = np.exp(values - values.max()) * np.outer(*widths).ravel()
        weights /= weights.sum()
        b, C = np.array([s.b for s in solutions]), np.array([s.C for s in solutions])
        mean = weights @ b
        covariance = np.tensordot(weights, C, 1) + (weights[:, None] * (b - mean)).T @ (b - mean)
        x = data.sums(data.X) / data.sums(np.ones(len(data.y)))[:, None]
        estimates = [s.shrunken(x) for s in solutions]
        devices, variances = (np.array(part) for part in zip(*estimates, strict=True))
        shrunken = weights @ devices
        variance = weights @ (variances + (devices - shrunken) ** 2)
        grid, scatters = weights.reshape(len(nodes[0]), -1), []
        for axis, marginal in zip(nodes, (grid.sum(1), grid.sum(0)), strict=True):
            cumulative = np.cumsum(marginal) - 0.5 * marginal
            low, middle, high = np.interp([0.02275, 0.5, 0.97725], cumulative, axis)
            scatters.append((float(middle), float(low), float(high)))
        return cls(mean, covariance, shrunken, variance, scatters)


def _reml(data: _Fits) -> tuple[float, float]:
    """Return the restricted maximum-likelihood estimates of tau and omega, each 0 or more."""
    spread = float(np.sqrt(np.var(data.y) + data.u2.min()))
    unknown = 2 if len(data.y) > data.devices else 1

    def scatters(x: FloatArray) -> FloatArray:
        return np.pad(np.abs(x) * spread, (0, 2 - unknown))  # even: zero is no edge

    def objective(x: FloatArray) -> float:
        return -data.solve(*scatters(x).tolist()).log_likelihood

    best = optimize.minimize(objective, np.full(unknown, 0.5), method="Nelder-Mead")
    tau, omega = scatters(best.x).tolist()
    return tau, omega


def _nodes(data: _Fits, mode: tuple[float, float], axis: int) -> FloatArray:
    """Return nodes from zero to where the likelihood is negligible, finer near zero."""
    point = list(mode)
    top = data.solve(*point).log_likelihood
    step = 0.1 * float(np.sqrt(np.median(data.u2)))
    while top - data.solve(*point).log_likelihood < _GRID_DROP:
        point[axis] = 1.3 * point[axis] + step
    return np.asarray(point[axis] * np.linspace(0.0, 1.0, _NODES) ** 1.5)


def _outlying(data: _Fits) -> tuple[FloatArray, BoolArray]:
    """Return each device's p value against all others, and which are outlying.

    Outlying devices are removed one by one, the most distant first, so that they do not mask one
    another; at most half of the devices are removed, and enough remain for a scatter.
    """
    p, outlying = np.ones(data.devices), np.zeros(data.devices, dtype=bool)
    kept, numbers = data, np.arange(data.devices)
    for _ in range(data.devices // 2):
        solution = kept.solve(*_reml(kept))
        worst = int(np.argmax(solution.residual**2 / (solution.tau**2 + solution.variance)))
        fits = kept.device == worst
        others = kept.select(~fits)
        freedom = others.devices - others.X.shape[1]
        if freedom < _FEWEST or np.linalg.matrix_rank(others.X) < others.X.shape[1]:
            break
        tau, omega = _reml(others)
        solution = others.solve(tau, omega)
        w = 1.0 / (omega**2 + kept.u2[fits])
        x = (w[:, None] * kept.X[fits]).sum(axis=0) / w.sum()
        deviation = float((w * kept.y[fits]).sum() / w.sum() - x @ solution.b)
        distance = deviation / np.sqrt(tau**2 + 1.0 / w.sum() + x @ solution.C @ x)
        # Sidak's correction: the most distant of several devices is tested
        single = 2.0 * stats.t.sf(abs(distance), freedom)
        p[numbers[worst]] = -np.expm1(kept.devices * np.log1p(-min(single, 1.0 - 1e-16)))
        if p[numbers[worst]] >= _FALSE_ALARMS:
            break
        outlying[numbers[worst]] = True
        kept, numbers = others, np.delete(numbers, worst)
    return p, outlying


def _charts(y: FloatArray, device: IntArray, inside: BoolArray, ordered: bool) -> dict[str, Any]:
    """Return control charts of fits; those `inside` the population determine centre and limits.

    If devices have several fits, a value is the deviation from the mean of its device, enlarged to
    the variance of a single fit; the scatter is that of successive fits of one device.
    """
    import pandas as pd

    fits = np.bincount(device)[device]
    repeated = bool(fits.max() > 1)
    group = device if repeated else np.zeros_like(device)
    rows = np.flatnonzero(inside)
    rows = rows[np.argsort(group[rows], kind="stable")]
    ranges = np.abs(np.diff(y[rows]))[np.diff(group[rows]) == 0]
    sigma = float(ranges.mean()) / _MOVING_RANGE if ranges.size else np.nan
    centre = float(y[inside].mean())
    if repeated:
        deviation = y - np.bincount(device, y)[device] / fits
        y = centre + np.where(fits > 1, deviation * np.sqrt(fits / np.maximum(fits - 1, 1)), np.nan)
    charts: dict[str, Any] = {"value": y, "centre": centre, "limit": 3.0 * sigma}
    if not ordered:
        return charts
    charted = np.flatnonzero(np.isfinite(y))
    ewma, width = np.full((2, y.size), np.nan)
    from_centre = pd.Series([centre, *y[charted]]).ewm(alpha=EWMA_WEIGHT, adjust=False)
    ewma[charted] = from_centre.mean()[1:]
    settled = 1.0 - (1.0 - EWMA_WEIGHT) ** (2.0 * np.arange(1, charted.size + 1))
    width[charted] = EWMA_WIDTH * sigma * np.sqrt(EWMA_WEIGHT / (2.0 - EWMA_WEIGHT) * settled)
    return {**charts, "ewma": ewma, "ewma_limit": width}
