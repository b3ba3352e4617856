"""The estimation problem: data, model, noise and sensors, and what follows from them.

A :class:`Problem` is the one source of predictions, residuals, derivatives and likelihood; every
solver and sampler sees nothing else, so they cannot disagree about what is estimated. It works
in **search coordinates** theta: the logarithm of positive parameters, the number itself for the
others. Every method takes one vector, shape (P,), or many, shape (S, P).

The model gives the dynamic stiffness Z_k(A, omega) = F_k/X_1. From it follow, with the sensors'
factor g (see :mod:`dahl_ident.sensors`), all six quantities:

    R = (j omega)^p (g Z)^q,    q = 1 or -1,  p from -2 to 2.

Rows whose displacement was controlled take the measured amplitude as A: an explicit model. Rows
whose force was controlled take the measured drive u_0, and A solves A |Z(A, omega)| = u_0; its
derivatives come from the implicit function theorem,

    d ln A = (d ln u_0 - Re(dZ/Z)) / (1 + Re(A Z_A/Z)).

The measured amplitude of such a row serves only to choose among several solutions.

Residuals are whitened by the noise model (see :mod:`dahl_ident.noise`), so that the sum of their
squares is -2 ln L up to a constant: exactly where the scale of the noise is known, after division
by scale^2 where it is not.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident import steady_state
from dahl_ident.arrays import ComplexArray, FloatArray, positive_array, real_array
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.rows import Rows
from dahl_ident.elements import Dahl, Element, Model, Parameter
from dahl_ident.elements.model import as_model
from dahl_ident.errors import DataError, ModelError, ValidationError
from dahl_ident.noise import Measured, Noise, bend, correct_amplitude, noise_for, student
from dahl_ident.sensors import Prior, Sensors, measured_stiffness_factor

_POWERS = {
    "receptance": (0, -1),
    "mobility": (1, -1),
    "accelerance": (2, -1),
    "dynamic_stiffness": (0, 1),
    "mechanical_impedance": (-1, 1),
    "apparent_mass": (-2, 1),
}


_NONE: ComplexArray = np.zeros((), dtype=np.complex128)


class _Group(NamedTuple):
    """Rows that are computed together."""

    rows: slice | NDArray[np.intp]
    harmonic: int
    forced: bool


class Prediction(NamedTuple):
    """The response R with its derivatives, by search coordinate and by ln A (explicit rows)."""

    value: ComplexArray
    changes: list[ComplexArray]
    by_ln_amplitude: ComplexArray


class Problem:
    """Data, model, noise and sensors: residuals, Jacobian and likelihood of one estimate.

    Parameters
    ----------
    data : FrequencyResponse
        Displacement-controlled rows need an amplitude, force-controlled rows a drive.
    model : Element
        One element or a sum, such as ``Dahl() + Mass(0.3)``.
    noise : {"measured", "relative", "absolute"}, optional
        Default: "measured" where the data have a covariance, else "relative".
    sensors : Sensors, optional
        Gains and delay; left out, the channels are taken as exact.
    free : iterable of str, optional
        Names of given parameters to estimate all the same, from their values.
    fixed : mapping of str to float, optional
        Parameters to hold at a value.

    Attributes
    ----------
    parameters : tuple of Parameter
        The free ones, the model's first, then the sensors'. P is their number.
    names : tuple of str
    priors : dict of str to Prior
        Those of `sensors`.
    scale_known : bool
        Whether the residuals have unit variance as they are.
    n_residuals : int
        Residuals of the data, two a row; rows for priors come on top.

    Raises
    ------
    ModelError
        If nothing is free, or a name is unknown.
    DataError
        If the rows lack what their model needs.
    ValidationError
        If `noise` is unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl
    >>> from dahl_ident.data import FrequencyResponse
    >>> A = np.array([1e-4, 1e-3, 1e-2])
    >>> N = Dahl(f_max=0.1, sigma=30.0).describing_function(A)
    >>> problem = Problem(FrequencyResponse(np.ones(3), N, A), Dahl())
    >>> problem.names
    ('f_max', 'sigma')
    >>> theta = problem.to_search([0.1, 30.0])
    >>> bool(np.all(np.abs(problem.residuals(theta)) < 1e-14))
    True
    """

    def __init__(
        self,
        data: FrequencyResponse,
        model: Element,
        *,
        noise: str | None = None,
        sensors: Sensors | None = None,
        free: Iterable[str] = (),
        fixed: Mapping[str, float] | None = None,
    ) -> None:
        self.data = data
        self._set_up(Rows.of(data), model, noise, sensors, free, fixed)

    def _set_up(
        self,
        rows: Rows,
        model: Element,
        noise: str | None,
        sensors: Sensors | None,
        free: Iterable[str],
        fixed: Mapping[str, float] | None,
    ) -> None:
        self.model, self.sensors = _with_changes(
            as_model(model), sensors or Sensors(), list(free), dict(fixed or {})
        )
        own, sensed = self.model.parameters, self.sensors.parameters
        self.parameters: tuple[Parameter, ...] = tuple(p for p in own + sensed if p.free)
        self.names = tuple(p.name for p in self.parameters)
        if not self.parameters:
            raise ModelError(
                f"{self.model!r} has no free parameter; leave one out, or name it in free="
            )
        free_names = set(self.names)
        self.priors: dict[str, Prior] = {
            name: prior for name, prior in self.sensors.priors.items() if name in free_names
        }
        self._positive = np.array([p.transform == "log" for p in self.parameters])
        self._slots = [_slot(p, self.names) for p in own + sensed]
        self._neutral = all(
            not p.free and p.value == neutral
            for p, neutral in zip(sensed, (1.0, 1.0, 0.0), strict=True)
        )
        self._set_rows(rows, noise)

    def _set_rows(self, rows: Rows, noise: str | None) -> None:
        self._rows = rows
        self._groups = _groups(rows)
        power, self._exponent = _POWERS[rows.quantity]
        self._operator: ComplexArray = np.asarray((1j * rows.omega) ** power, dtype=np.complex128)
        self._noise: Noise = noise_for(rows, noise)
        self._guess = _measured_amplitude(rows, self._operator, self._exponent)
        self.noise = type(self._noise).__name__.lower()
        self.scale_known = self._noise.scale_known
        self.n_residuals = 2 * rows.n

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__}: {self._rows.n} rows of {self._rows.quantity}, "
            f"{self.noise} noise, free {', '.join(self.names)}>"
        )

    # Coordinates

    def to_search(self, values: ArrayLike) -> FloatArray:
        """Return the search coordinates of parameter values, in the order of `names`.

        Parameters
        ----------
        values : array_like, shape (P,) or (S, P)

        Returns
        -------
        ndarray of the same shape

        Raises
        ------
        ValidationError
            If the shape is wrong or a positive parameter is not above zero.
        """
        array = self._checked(values, "values")
        for index, parameter in enumerate(self.parameters):
            if parameter.transform == "log":
                positive_array(array[..., index], parameter.name)
        return np.where(self._positive, np.log(np.where(self._positive, array, 1.0)), array)

    def to_values(self, theta: ArrayLike) -> FloatArray:
        """Return the parameter values at search coordinates, shape (P,) or (S, P)."""
        array = self._checked(theta, "theta")
        return np.where(self._positive, np.exp(np.where(self._positive, array, 0.0)), array)

    def value_slopes(self, theta: ArrayLike) -> FloatArray:
        """Return d value / d theta for each parameter: the value itself for positive ones."""
        array = self._checked(theta, "theta")
        return np.where(self._positive, np.exp(np.where(self._positive, array, 0.0)), 1.0)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the parameters' lower and upper bounds in search coordinates."""
        with np.errstate(divide="ignore"):
            low, high = (
                np.array([np.log(b) if p.transform == "log" else b for p, b in pairs])
                for pairs in (
                    [(p, max(p.lower, 0.0) if p.transform == "log" else p.lower)
                     for p in self.parameters],
                    [(p, p.upper) for p in self.parameters],
                )
            )  # fmt: skip
        return low, high

    def in_order(self, theta: ArrayLike) -> FloatArray:
        """Return theta with interchangeable Dahl elements ordered by rising x_c.

        Elements are interchangeable where both f_max and sigma of each are free and their
        exponents are alike; without an order their labels could switch.
        """
        array = self._checked(theta, "theta").copy()
        for columns in _interchangeable(self.model, self.names):
            x_c = array[..., columns[:, 0]] - array[..., columns[:, 1]]
            order = np.argsort(x_c, axis=-1)
            for kind in columns.T:
                array[..., kind] = np.take_along_axis(array[..., kind], order, axis=-1)
        return array

    # Predictions

    def predict(self, theta: ArrayLike) -> ComplexArray:
        """Return the response that the model predicts, in the data's quantity.

        Parameters
        ----------
        theta : array_like, shape (P,) or (S, P)
            Search coordinates.

        Returns
        -------
        ndarray of complex, shape (n,) or (S, n)
            Sensors included; NaN where a driven plant has no steady amplitude.
        """
        return self.prediction(self._checked(theta, "theta"), derivatives=False).value

    def prediction_jacobian(self, theta: ArrayLike) -> ComplexArray:
        """Return dR/dtheta, shape (n, P) or (S, n, P)."""
        theta = self._checked(theta, "theta")
        changes = self.prediction(theta).changes
        lead = self._lead(theta)
        return np.stack([np.broadcast_to(d, (*lead, self._rows.n)) for d in changes], axis=-1)

    def prediction(
        self,
        theta: FloatArray,
        *,
        derivatives: bool = True,
        amplitude_error: FloatArray | None = None,
    ) -> Prediction:
        """Return the response and its derivatives at checked search coordinates.

        `amplitude_error` is the error of ln A of explicit rows: A is the measured amplitude over
        its exponential.
        """
        values = self._values(theta)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
            parts = [
                self._predict_group(group, values, derivatives, amplitude_error)
                for group in self._groups
            ]
        if len(parts) == 1:
            return parts[0]
        shape = (*self._lead(theta), self._rows.n)
        whole = [np.empty(shape, dtype=np.complex128) for _ in range(2 + len(parts[0].changes))]
        for group, part in zip(self._groups, parts, strict=True):
            pieces = (part.value, part.by_ln_amplitude, *part.changes)
            for target, piece in zip(whole, pieces, strict=True):
                target[..., group.rows] = piece
        return Prediction(whole[0], whole[2:], whole[1])

    def _predict_group(
        self,
        group: _Group,
        values: list[FloatArray],
        derivatives: bool,
        amplitude_error: FloatArray | None,
    ) -> Prediction:
        own, sensed = values[:-3], values[-3:]
        rows, harmonic = group.rows, group.harmonic
        omega, operator = self._rows.omega[..., rows], self._operator[..., rows]
        amplitude, found = self._amplitude(group, own, sensed, amplitude_error)
        factor = operator if self._neutral else operator * self._factor(sensed, omega, harmonic)
        if not derivatives:
            Z = self.model.stiffness(own, amplitude, omega, harmonic)
            Z = Z if found is None else np.where(found, Z, np.nan)
            return Prediction(factor * Z**self._exponent, [], _NONE)
        Z, by_amplitude, by_parameter = self.model.stiffness_gradient(
            own, amplitude, omega, harmonic
        )
        Z = Z if found is None else np.where(found, Z, np.nan)
        by_ln_amplitude = amplitude * by_amplitude
        response = factor * Z if self._exponent == 1 else factor / Z
        slope = factor if self._exponent == 1 else -response / Z
        stretch = 1.0 / (1.0 + (by_ln_amplitude / Z).real) if group.forced else None
        changes = []
        for (index, _), value, d in zip(self._slots, own, by_parameter, strict=False):
            if index is None:
                continue
            change = d * value if self._positive[index] else d
            if stretch is not None:
                change = change - by_ln_amplitude * ((change / Z).real * stretch)
            changes.append(slope * change)
        if not self._neutral:
            direct = slope * by_ln_amplitude * (1.0 if stretch is None else stretch)
            changes += self._sensor_changes(group, response, direct, omega)
        return Prediction(response, changes, slope * by_ln_amplitude)

    def _sensor_changes(
        self, group: _Group, response: ComplexArray, direct: ComplexArray, omega: FloatArray
    ) -> list[ComplexArray]:
        """Return dR by the free sensor parameters; `direct` is dR/dln A or dR/dln u_0."""
        own = self._exponent * response
        moved = np.zeros_like(direct)
        by_sensor = (
            own - (direct if group.forced else moved),
            -own - (moved if group.forced else direct),
            1j * group.harmonic * omega * own,
        )
        used = (index is not None for index, _ in self._slots[-3:])
        return [d for d, free in zip(by_sensor, used, strict=True) if free]

    def _factor(
        self, sensed: Sequence[FloatArray], omega: FloatArray, harmonic: int
    ) -> ComplexArray:
        return measured_stiffness_factor(sensed, omega, harmonic) ** self._exponent

    def _amplitude(
        self,
        group: _Group,
        own: Sequence[FloatArray],
        sensed: Sequence[FloatArray],
        error: FloatArray | None,
    ) -> tuple[FloatArray, NDArray[np.bool_] | None]:
        """Return the true amplitude of each row, and where there is one unless everywhere."""
        rows = group.rows
        if not group.forced:
            assert self._rows.amplitude is not None
            amplitude = self._rows.amplitude[..., rows]
            if error is not None:
                amplitude = amplitude * np.exp(-error[..., rows])
            return (amplitude if self._neutral else amplitude / sensed[1]), None
        assert self._rows.drive is not None
        amplitude = steady_state.solve(
            self.model,
            own,
            self._rows.omega[..., rows],
            self._rows.drive[..., rows] / sensed[0],
            self._guess[..., rows] / sensed[1],
        )
        found = np.isfinite(amplitude)
        return (amplitude, None) if found.all() else (np.where(found, amplitude, 1.0), found)

    # Residuals

    def residuals(self, theta: ArrayLike, scale: ArrayLike = 1.0) -> FloatArray:
        """Return the whitened residuals, measured minus predicted.

        Parameters
        ----------
        theta : array_like, shape (P,) or (S, P)
            Search coordinates.
        scale : array_like, shape () or (S,), default 1
            Noise scale by which the data's residuals are divided; leave at 1 where it is known.

        Returns
        -------
        ndarray, shape (m,) or (S, m)
            Two numbers a row of data, in its order, then one for each prior:
            (value - mean)/std.
        """
        theta = self._checked(theta, "theta")
        y, _ = self.whitened(theta, derivatives=False)
        return self._with_priors(theta, y, [], scale)[0]

    def jacobian(self, theta: ArrayLike, scale: ArrayLike = 1.0) -> FloatArray:
        """Return the residuals' derivative by theta, shape (m, P) or (S, m, P)."""
        return self.residuals_and_jacobian(theta, scale)[1]

    def residuals_and_jacobian(
        self, theta: ArrayLike, scale: ArrayLike = 1.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return residuals and Jacobian, for the price of the Jacobian.

        With noise in the amplitude the residuals are defined up to a rotation of each pair. The
        Jacobian leaves that out, so that J' r is the exact gradient of half the sum of squares.
        """
        theta = self._checked(theta, "theta")
        y, changes = self.whitened(theta)
        residuals, jacobian = self._with_priors(theta, y, changes, scale)
        return residuals, jacobian.swapaxes(-1, -2)

    def whitened(
        self, theta: FloatArray, *, derivatives: bool = True, tails: bool = True
    ) -> tuple[ComplexArray, list[ComplexArray]]:
        """Return the complex residual of each row of data, and its derivatives, unchecked.

        Without `tails` a covariance of few degrees of freedom counts as if it were known.
        """
        noise = self._noise
        amplitude = noise.amplitude if isinstance(noise, Measured) else None
        with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
            if isinstance(noise, Measured) and amplitude is not None:
                y, whiten, e = correct_amplitude(
                    noise, amplitude, lambda e: self._value_and_slope(theta, e)
                )
                changes = []
                if derivatives:
                    by = self.prediction(theta, amplitude_error=e).changes
                    changes = [-whiten(d) for d in by]
            else:
                predicted, by, _ = self.prediction(theta, derivatives=derivatives)
                y = noise.residual(predicted)
                changes = [noise.change(predicted, d) for d in by]
            if tails and isinstance(noise, Measured) and noise.dof is not None:
                dof = noise.dof
                y, changes = bend(y, changes, lambda z: student(z, dof))
        return y, changes

    def _value_and_slope(
        self, theta: FloatArray, error: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        value, _, slope = self.prediction(theta, amplitude_error=error)
        return value, slope

    def _with_priors(
        self, theta: FloatArray, y: ComplexArray, changes: list[ComplexArray], scale: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Return real residuals and the transposed Jacobian, prior rows last."""
        lead, m = self._lead(theta), self.n_residuals
        residuals = np.empty((*lead, m + len(self.priors)))
        jacobian = np.zeros((*lead, len(changes), m + len(self.priors)))
        size = np.asarray(scale)[..., None]
        residuals[..., :m] = _parts(y) / size
        for index, change in enumerate(changes):
            jacobian[..., index, :m] = _parts(change) / size
        if self.priors:
            values, slopes = self.to_values(theta), self.value_slopes(theta)
            for row, (name, prior) in enumerate(self.priors.items(), start=m):
                index = self.names.index(name)
                mean, std = _normal(name, prior)
                residuals[..., row] = (values[..., index] - mean) / std
                if changes:
                    jacobian[..., index, row] = slopes[..., index] / std
        return residuals, jacobian

    # Likelihood

    def log_likelihood(self, theta: ArrayLike, scale: ArrayLike | None = None) -> FloatArray:
        """Return ln of the density of the data, per unit of Re R and Im R of every row.

        Parameters
        ----------
        theta : array_like, shape (P,) or (S, P)
            Search coordinates.
        scale : array_like, shape () or (S,), optional
            The noise's scale, where it is unknown: standard deviation of ln gain and of phase
            (rad) for "relative", of Re R and Im R for "absolute". Left out, the scale of the
            highest likelihood, (sum of squares / 2n)^(1/2), at each theta.

        Returns
        -------
        ndarray, shape () or (S,)
            Priors not included; -inf where the model has no prediction. All noise models give
            densities of the same numbers, so their likelihoods compare.

        Raises
        ------
        ValidationError
            If `scale` is given where it is known.
        """
        theta = self._checked(theta, "theta")
        y, _ = self.whitened(theta, derivatives=False)
        squares = np.sum(y.real**2 + y.imag**2, axis=-1)
        n = self._rows.n
        constant = self._noise.log_area - n * np.log(2.0 * np.pi)
        if self.scale_known:
            if scale is not None:
                raise ValidationError(
                    "scale is given, but measured noise has a known scale; leave it out"
                )
            result = constant - 0.5 * squares
        else:
            with np.errstate(divide="ignore"):
                s2 = squares / (2.0 * n) if scale is None else np.asarray(scale) ** 2
                result = constant - 0.5 * squares / s2 - n * np.log(s2)
        return np.where(np.isnan(result), -np.inf, result)[()]

    def information(self, theta: ArrayLike, scale: ArrayLike = 1.0) -> FloatArray:
        """Return the Fisher information of theta, shape (P, P) or (S, P, P), priors included.

        J' J of the whitened residuals; a row whose covariance was estimated with nu degrees of
        freedom counts (nu + 1)(nu - 1)/(nu (nu + 3)), the expectation for Student's t.
        """
        theta = self._checked(theta, "theta")
        y, changes = self.whitened(theta, tails=False)
        dof = self._noise.dof if isinstance(self._noise, Measured) else None
        if dof is not None:
            weight = np.sqrt((dof + 1.0) * (dof - 1.0) / (dof * (dof + 3.0)))
            changes = [weight * d for d in changes]
        _, jacobian = self._with_priors(theta, y, changes, scale)
        return jacobian @ jacobian.swapaxes(-1, -2)

    # Inside

    def _checked(self, theta: ArrayLike, name: str) -> FloatArray:
        array = real_array(theta, name)
        P = len(self.parameters)
        if array.ndim not in (1, 2) or array.shape[-1] != P:
            raise ValidationError(
                f"{name} has shape {array.shape}; expected ({P},) or (S, {P}) for "
                f"{', '.join(self.names)}"
            )
        return array

    def _lead(self, theta: FloatArray) -> tuple[int, ...]:
        return theta.shape[:-1]

    def _values(self, theta: FloatArray) -> list[FloatArray]:
        """Return all parameter values, model's then sensors', broadcasting with the rows."""
        values = self.value_slopes(theta)
        values = np.where(self._positive, values, theta)[..., None]
        return [
            constant if index is None else values[..., index, :] for index, constant in self._slots
        ]


def _slot(parameter: Parameter, names: tuple[str, ...]) -> tuple[int | None, FloatArray]:
    """Return where a parameter's value comes from: an index into theta, or a constant."""
    if parameter.free:
        return names.index(parameter.name), np.empty(0)
    return None, np.asarray(parameter.value)


def _with_changes(
    model: Model, sensors: Sensors, free: list[str], fixed: dict[str, float]
) -> tuple[Model, Sensors]:
    """Free and fix parameters by name, wherever they live."""
    both = set(free) & set(fixed)
    if both:
        raise ModelError(f"{', '.join(sorted(both))} is both in free= and in fixed=; choose one")
    sensed = {p.name for p in sensors.parameters}
    model = model.with_free([n for n in free if n not in sensed])
    model = model.with_fixed({n: v for n, v in fixed.items() if n not in sensed})
    sensors = sensors.with_free([n for n in free if n in sensed])
    return model, sensors.with_fixed({n: v for n, v in fixed.items() if n in sensed})


def _groups(rows: Rows) -> list[_Group]:
    """Split rows by harmonic and by what was controlled, and check that each can be predicted."""
    _require(rows.amplitude, ~rows.forced, "displacement", "amplitude")
    _require(rows.drive, rows.forced, "force", "drive")
    bad = rows.forced & (rows.harmonic > 1)
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(
            f"row {row} is force-controlled and holds harmonic {rows.harmonic[row]}; the steady "
            "state of a driven plant is solved for its fundamental only: leave such rows out, or "
            "say controlled='displacement' if the measured amplitude is to be used"
        )
    kinds = sorted({*zip(rows.harmonic.tolist(), rows.forced.tolist(), strict=True)})
    if len(kinds) == 1:
        return [_Group(slice(None), *kinds[0])]
    return [
        _Group(np.flatnonzero((rows.harmonic == k) & (rows.forced == forced)), k, forced)
        for k, forced in kinds
    ]


def _require(
    column: FloatArray | None, needed: NDArray[np.bool_], controlled: str, name: str
) -> None:
    if column is None and needed.any():
        other = {"displacement": "force", "force": "displacement"}[controlled]
        raise DataError(
            f"row {int(np.argmax(needed))} is {controlled}-controlled, but the data have no "
            f"{name}; give it, or say controlled={other!r} if the laboratory held the {other}"
        )


def _measured_amplitude(rows: Rows, operator: ComplexArray, exponent: int) -> FloatArray:
    """Return the measured amplitude, from the drive where it was not recorded."""
    if rows.amplitude is not None:
        return rows.amplitude
    assert rows.drive is not None
    with np.errstate(divide="ignore"):
        return np.asarray(rows.drive / np.abs(rows.response / operator) ** exponent)


def _interchangeable(model: Model, names: tuple[str, ...]) -> list[NDArray[np.intp]]:
    """Return, for each set of like Dahl elements, their columns in theta: f_max, sigma, alpha."""
    alike: dict[tuple[object, ...], list[list[int]]] = {}
    for element in model.elements:
        if not isinstance(element, Dahl) or not all(p.free for p in element.parameters[:2]):
            continue
        alpha = element.parameters[2]
        bounds = tuple((p.lower, p.upper) for p in element.parameters)
        columns = [names.index(p.name) for p in element.parameters if p.free]
        alike.setdefault((None if alpha.free else alpha.value, bounds), []).append(columns)
    return [np.array(columns) for columns in alike.values() if len(columns) > 1]


def _normal(name: str, prior: Prior) -> tuple[float, float]:
    """Return mean and standard deviation of a normal prior, the only kind least squares takes."""
    kind = getattr(getattr(prior, "dist", None), "name", type(prior).__name__)
    if kind != "norm":
        raise ValidationError(
            f"the prior of {name} is {kind}; least squares takes normal priors "
            "(scipy.stats.norm), any other needs sampling"
        )
    return float(prior.mean()), float(prior.std())


def _parts(values: ComplexArray) -> FloatArray:
    """Return real and imaginary parts side by side in the last axis."""
    return np.ascontiguousarray(values).view(np.float64)
