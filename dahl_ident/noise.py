r"""Noise models, which turn measured minus predicted responses into residuals of equal variance.

Each row of data is one complex number R and gives two residuals, stored as the real and imaginary
part of one complex residual y. There are three models:

``measured``
    The data's covariance C of (Re R, Im R), row by row: ``y = L^-1 (R - R_model)``, C = L L'.
    The scale is known. A row whose C was estimated with finite `dof` nu counts as
    ``(nu - 2) ln(1 + |y|^2/nu)`` in place of ``|y|^2``; see below.
``relative``
    Constant unknown variance of (ln gain, phase): ``y = ln(R / R_model)``. Weights do not
    depend on the parameters, so least squares is maximum likelihood; least squares of
    R - R_model over |R| or |R_model| would not be. A harmonic's error is proportional to the
    fundamental of the same point: ``y = (R_k - R_k,model) / |R_1|``, R_1 as measured.
``absolute``
    Constant unknown variance of (Re R, Im R), in the data's own quantity: ``y = R - R_model``.

**Estimated covariances.** Rows whose error was by chance estimated too small must not dominate the
fit: with nu = 6, weights 1/C give 95 % intervals with a coverage of 60 to 75 %. With W = nu C and r
the residual, the loss a ln(1 + r' W^-1 r) has the score a (W + r r')^-1 r. W + r r' is a Wishart
matrix of nu + 1 degrees of freedom in which r is one of nu + 1 equivalent terms. Hence, for any
true covariance V, the score has the variance a^2 V^-1/((nu + 1)(nu - 2)) and the mean derivative
a V^-1/(nu + 1). The two agree, as they do for a likelihood, if a = nu - 2. Then curvature,
likelihood ratios and stated covariances are correct, even for rows of different nu. (A Jeffreys
prior of V leads to Student's t with a = nu + 1, which states variances too small by a factor of
(nu + 1)/(nu - 2).) An unbiased estimate of V^-1 is (nu - 2) (W + r r')^-1, so the information of a
row is (nu - 2)^2/(nu + 1) J' (W + r r')^-1 J. The row of a mean force (k = 0), which is real, has
nu - 1 instead of nu - 2.

**Noise in the measured amplitude** (``measured`` only). The true ln A of a row is unknown; its
measured value has an error of known variance, correlated with that of R because R is a quotient
with the displacement. For given parameters, the best true amplitude minimises the joint chi-square
of both; the minimum is

    |y|^2 = r' V^-1 r,    r = R - R_model - e d,    V = C - c d' - d c' + s^2 d d',

with d = dR_model/dln A at the best amplitude, s and c the standard deviation of ln A and its
covariance with R, and e = (c - s^2 d)' V^-1 r the estimated error. This is the profile likelihood
over the true amplitudes; integration under their Jeffreys prior gives the same. Although V depends
on the parameters, the sum must not include ln det V: with it, or with fixed weights and the model
evaluated at the measured amplitudes, estimates would be biased towards a flatter curve for any
number of rows (the attenuation of errors-in-variables regression).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray
from dahl_ident.data.columns import one_of
from dahl_ident.data.rows import Rows
from dahl_ident.errors import DataError, argument

Rho = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""A loss: z -> rho(z), rho'(z), rho''(z)."""

ROUNDING = 2.0**-46  # relative rounding error of a response when its residual is computed
_GAUSSIAN = 1e15  # degrees of freedom at which the loss is z to rounding
_AMPLITUDE_STEPS = 40  # most iterations, if they do not converge
_AMPLITUDE_TOLERANCE = 1e-7  # in standard deviations; residuals err by less than its square
_ROUNDED = 0.01  # standard deviations; a shorter step that does not shrink is a rounding error


@dataclass(frozen=True)
class Relative:
    """Constant unknown variance of (ln gain, phase)."""

    response: ComplexArray
    fundamental: FloatArray | None
    """|R_1| in rows of harmonics, 0 in rows of the fundamental; None without harmonics."""
    log_area: FloatArray
    """Sum over rows of ln abs(dy/dR), the log of the whitening's determinant, plus constants."""
    name: ClassVar = "relative"
    scale_known: ClassVar = False
    rounding: ClassVar = np.asarray(ROUNDING)  # of a logarithm
    tail: ClassVar = None
    amplitude: ClassVar = None

    @property
    def weights(self) -> FloatArray:
        """1/|R|, for harmonics of the fundamental."""
        size = np.abs(self.response)
        if self.fundamental is not None:
            size = np.where(self.fundamental > 0.0, self.fundamental, size)
        return 1.0 / size

    def residual(self, predicted: ComplexArray) -> ComplexArray:
        """Return ln(R/R_model), or the scaled difference in rows of harmonics."""
        if self.fundamental is None:
            return _logarithm(self.response / predicted)
        harmonic = self.fundamental > 0.0
        ratio = np.where(harmonic, 1.0, self.response / np.where(harmonic, 1.0, predicted))
        size = np.where(harmonic, self.fundamental, 1.0)
        return np.where(harmonic, (self.response - predicted) / size, _logarithm(ratio))

    def change(self, predicted: ComplexArray, by: ComplexArray) -> ComplexArray:
        """Return the derivative of the residual for a derivative `by` of the prediction."""
        if self.fundamental is None:
            return -by / predicted
        return -by / np.where(self.fundamental > 0.0, self.fundamental, predicted)

    def replicate(self, predicted: ComplexArray, residual: ComplexArray) -> ComplexArray:
        """Return the response that has the given residual."""
        fundamental = predicted * np.exp(residual)
        if self.fundamental is None:
            return np.asarray(fundamental)
        harmonic = self.fundamental > 0.0
        return np.where(harmonic, predicted + self.fundamental * residual, fundamental)


@dataclass(frozen=True)
class Measured:
    """Covariance of (Re R, Im R), and of ln A if `amplitude` is not None.

    "absolute" noise, whose scale is unknown, has the unit matrix.
    """

    response: ComplexArray
    covariance: Covariance
    whitening: Whitening
    log_area: FloatArray
    dof: FloatArray | None = None
    amplitude: AmplitudeError | None = None
    name: str = "measured"
    rounding: FloatArray = field(default_factory=lambda: np.zeros(()))
    """Size of residuals that may be mere rounding errors, () or (S,); 0 if the scale is known."""

    @property
    def scale_known(self) -> bool:
        """Whether residuals have unit variance."""
        return self.name == "measured"

    @property
    def weights(self) -> FloatArray:
        """One over the root mean square of the standard deviations of both parts."""
        parts = np.where(self.covariance.ii == 0.0, 1.0, 2.0)
        return np.sqrt(parts / (self.covariance.rr + self.covariance.ii))

    @property
    def tail(self) -> Student | None:
        """The loss of rows whose covariance was estimated; None if all covariances are known."""
        if self.dof is None:
            return None
        return Student(self.dof, np.where(self.covariance.ii == 0.0, 1.0, 2.0))

    def widened(self, variance: FloatArray) -> Measured:
        """Return Gaussian noise with a further `variance` of both parts of every row, (n,).

        A covariance of few degrees of freedom is replaced by that of Student's t.
        """
        t = 1.0 if self.dof is None else self.dof / (self.dof - 2.0)
        rr, ri, ii = self.covariance
        covariance = Covariance(
            t * rr + variance, t * ri, np.where(ii == 0.0, 0.0, t * ii + variance)
        )
        whitening, amplitude = Whitening.of(covariance), self.amplitude
        area = np.log(whitening.a) + np.log(np.where(whitening.c == 0.0, 1.0, whitening.c))
        if amplitude is not None:
            amplitude = AmplitudeError(t * amplitude.variance, t * amplitude.cross)
        return Measured(self.response, covariance, whitening, area.sum(axis=-1), None, amplitude)

    def residual(self, predicted: ComplexArray) -> ComplexArray:
        """Return L^-1 (R - R_model)."""
        return self.whitening(self.response - predicted)

    def change(self, predicted: ComplexArray, by: ComplexArray) -> ComplexArray:
        """Return the derivative of the residual for a derivative `by` of the prediction."""
        return -self.whitening(by)

    def replicate(self, predicted: ComplexArray, residual: ComplexArray) -> ComplexArray:
        """Return R_model + L y."""
        return predicted + self.whitening.inverse(residual)


Noise = Relative | Measured


class Covariance(NamedTuple):
    """Rows' symmetric matrices [[rr, ri], [ri, ii]]."""

    rr: FloatArray
    ri: FloatArray
    ii: FloatArray


class Whitening(NamedTuple):
    """Inverse Cholesky factors [[a, 0], [b, c]], which act on a complex number's two parts.

    c is 0 in rows of one part, that is of a real number.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray

    @classmethod
    def of(cls, covariance: Covariance) -> Whitening:
        """Return the whitening of `covariance`; NaN or infinite where it is singular.

        Where only the real part has a covariance, only that part is whitened.
        """
        rr, ri, ii = covariance
        real = (ri == 0.0) & (ii == 0.0)
        first = np.sqrt(rr)
        lower = ri / first
        second = np.where(real, 1.0, np.sqrt(ii - lower**2))
        return cls(1.0 / first, -lower / first / second, np.where(real, 0.0, 1.0 / second))

    def __call__(self, value: ComplexArray) -> ComplexArray:
        """Return the whitened real and imaginary parts."""
        x, y = value.real, value.imag
        return np.asarray(self.a * x + 1j * (self.b * x + self.c * y))

    def inverse(self, whitened: ComplexArray) -> ComplexArray:
        """Return the number that whitens to these parts."""
        x = whitened.real / self.a
        y = (whitened.imag - self.b * x) / np.where(self.c == 0.0, np.inf, self.c)
        return np.asarray(x + 1j * y)

    def solve(self, value: ComplexArray) -> ComplexArray:
        """Return V^-1 value, that is L'^-1 L^-1 value."""
        w = self(value)
        return np.asarray(self.a * w.real + self.b * w.imag + 1j * (self.c * w.imag))


class AmplitudeError(NamedTuple):
    """Error of ln A: its variance, and its covariance with Re R (real part) and Im R."""

    variance: FloatArray
    cross: ComplexArray

    def whitening(self, covariance: Covariance, by_ln_amplitude: ComplexArray) -> Whitening:
        """Return the whitening of V = C - c d' - d c' + s^2 d d'."""
        d, c, s2 = by_ln_amplitude, self.cross, self.variance
        return Whitening.of(
            Covariance(
                covariance.rr + (s2 * d.real - 2.0 * c.real) * d.real,
                covariance.ri + s2 * d.real * d.imag - c.real * d.imag - c.imag * d.real,
                covariance.ii + (s2 * d.imag - 2.0 * c.imag) * d.imag,
            )
        )


def _logarithm(ratio: ComplexArray) -> ComplexArray:
    """Return ln(ratio) to absolute rounding; numpy's is more accurate near 1, but slower."""
    result = np.empty_like(ratio)
    result.real = 0.5 * np.log(ratio.real**2 + ratio.imag**2)
    result.imag = np.arctan2(ratio.imag, ratio.real)
    return result


def correct_amplitude(
    noise: Measured,
    predict: Callable[[FloatArray], tuple[ComplexArray, ComplexArray]],
) -> tuple[ComplexArray, Whitening, FloatArray]:
    """Return residuals at the best true amplitudes, their whitening, and the errors of ln A.

    `predict` takes the error e of ln A; it returns the response and its derivative with respect to
    ln A, at the measured amplitude over exp(e). Each row is a fixed-point iteration of one number,
    accelerated by the secant of its last two steps unless it hardly contracts.
    """
    error = noise.amplitude
    assert error is not None
    spread = np.sqrt(error.variance)
    ln_error = last = step = np.zeros(noise.response.shape)
    size, longest = np.where(spread > 0.0, spread, np.inf), np.inf
    for _ in range(_AMPLITUDE_STEPS):
        predicted, slope = predict(ln_error)
        r = noise.response - predicted - slope * ln_error
        whitening = error.whitening(noise.covariance, slope)
        lever = whitening.solve(r)
        shift = error.cross - error.variance * slope
        new = shift.real * lever.real + shift.imag * lever.imag - ln_error
        before, longest = longest, float(np.max(np.abs(new) / size, initial=0.0))
        if not longest > _AMPLITUDE_TOLERANCE or _ROUNDED > longest >= before:
            break
        secant = (new - step) / (ln_error - last)  # -1 where one plain step is enough
        stretch = np.where((-np.inf < secant) & (secant < -0.1), -1.0 / secant, 1.0)
        ln_error, last, step = ln_error + stretch * new, ln_error, new
    return whitening(r), whitening, ln_error


@dataclass(frozen=True)
class Student:
    """The loss of rows whose covariance was estimated: rho(z) = (dof - p) ln(1 + z/dof)."""

    dof: FloatArray
    parts: FloatArray | float = 2.0
    """p, the number of parts of a row: real and imaginary part, or the real part alone."""

    def __call__(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rho and its first two derivatives."""
        size = self.dof - self.parts
        slope = size / (self.dof + z)
        return size * np.log1p(z / self.dof), slope, -slope / (self.dof + z)

    def information(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return a, b of a row's information a J' J + b (J' y)(J' y)', in whitened residuals."""
        size = (self.dof - self.parts) ** 2 / ((self.dof + 1.0) * self.dof)
        return size, -size / (self.dof + z)


def noise_for(rows: Rows, kind: str | None) -> Noise:
    """Return the noise model `kind` for `rows`.

    None means ``measured`` if the data have a covariance, else ``relative``.
    """
    if kind is None:
        kind = "relative" if rows.covariance is None else "measured"
    one_of(kind, "noise", ("measured", "relative", "absolute"))
    if kind == "relative":
        return _relative(rows)
    if kind == "absolute":
        empty = ~rows.response.any(axis=-1)
        if empty.any():
            table = f" of table {int(np.argmax(empty))}" if empty.ndim else ""
            raise DataError(f"every response{table} is 0; there is nothing to estimate from")
        one, zero = np.ones(rows.response.shape), np.zeros(rows.response.shape)
        return Measured(
            rows.response,
            Covariance(one, zero, one),
            Whitening(one, zero, one),
            zero.sum(axis=-1),
            name="absolute",
            rounding=np.asarray(ROUNDING * np.sqrt(np.mean(np.abs(rows.response) ** 2, axis=-1))),
        )
    return _measured(rows)


def _relative(rows: Rows) -> Relative:
    size = np.abs(rows.response)
    fundamental = None
    if (rows.harmonic != 1).any():
        fundamental = _fundamental(rows, size)
        size = np.where(rows.harmonic != 1, fundamental, size)
    if not size.all():
        raise DataError(
            f"response{_first(size == 0.0)} is 0, which has no logarithm; relative noise needs a "
            f"response other than 0 in every row: take {argument('noise', 'absolute')}, or leave "
            "the row out"
        )
    return Relative(rows.response, fundamental, -2.0 * np.log(size).sum(axis=-1))


def _fundamental(rows: Rows, size: FloatArray) -> FloatArray:
    """Return |R_1| of the same point in rows of harmonics, 0 elsewhere."""
    harmonic = np.broadcast_to(rows.harmonic != 1, size.shape)
    lost = harmonic & np.broadcast_to(rows.fundamental < 0, size.shape)
    if lost.any():
        raise DataError(
            f"row {_first(lost)} is a harmonic, but no row holds the fundamental of the same "
            "frequency and amplitude, to which relative noise refers; add it, or use "
            f"{argument('noise', 'absolute')}"
        )
    return np.where(harmonic, rows.of_fundamental(size), 0.0)


def _measured(rows: Rows) -> Measured:
    if rows.covariance is None:
        raise DataError(
            f"{argument('noise', 'measured')} needs a covariance, and the data have none; "
            f"give it, or take {argument('noise', 'relative')}"
        )
    C = rows.covariance
    covariance = Covariance(C[..., 0, 0], C[..., 0, 1], C[..., 1, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        whitening = Whitening.of(covariance)
        mean = rows.harmonic == 0  # real, so that its imaginary part has no error
        log_area = np.log(whitening.a) + np.log(np.where(mean, 1.0, whitening.c))
    singular = ~np.isfinite(log_area)
    if singular.any():
        raise DataError(
            f"covariance{_first(singular)} is singular, {C[singular][0].tolist()}: some "
            "combination of real and imaginary part would be free of error; give every row a "
            f"regular covariance, or take {argument('noise', 'relative')}"
        )
    dof = rows.dof if rows.dof is not None and np.isfinite(rows.dof).any() else None
    if dof is not None:
        few = dof <= 2.0
        if few.any():
            raise DataError(
                f"dof{_first(few)} is {dof[few][0]:g}; a covariance of two parts needs more than 2 "
                "degrees of freedom to weigh a row: measure more cycles, or take "
                f"{argument('noise', 'relative')}"
            )
        dof = np.minimum(dof, _GAUSSIAN)
    return Measured(
        rows.response, covariance, whitening, log_area.sum(axis=-1), dof, _amplitude_error(rows)
    )


def _amplitude_error(rows: Rows) -> AmplitudeError | None:
    """Return the error of ln A, or of ln of the drive in force-controlled rows; None if 0."""
    variance, cross = np.zeros(rows.n), np.zeros(rows.n, dtype=np.complex128)
    for level, std, covariance, held in (
        (rows.amplitude, rows.amplitude_std, rows.amplitude_covariance, ~rows.forced),
        (rows.drive, rows.drive_std, rows.drive_covariance, rows.forced),
    ):
        if std is None or level is None:
            continue
        relative = np.where(held, 1.0 / level, 0.0)
        variance = variance + (std * relative) ** 2
        if covariance is not None:
            cross = cross + covariance @ np.array([1.0, 1.0j]) * relative
    return AmplitudeError(variance, cross) if variance.any() else None


def _first(bad: BoolArray) -> str:
    """Return the index of the first bad row, after that of its table if several are stacked."""
    return str([int(i) for i in np.argwhere(bad)[0]])


def squares_of(residuals: FloatArray, parts: int = 2) -> FloatArray:
    """Return the sum of squares of the residuals of each row, (..., parts n) -> (..., n)."""
    return np.asarray((residuals.reshape(*residuals.shape[:-1], -1, parts) ** 2).sum(axis=-1))


def weighted(
    rows: FloatArray, m: int, size: FloatArray, along: FloatArray, parts: int = 2
) -> FloatArray:
    """Return size y for the residuals y of each row, and size d + along y (y' d) for derivatives d.

    `rows` are residuals and, below them, their derivatives, (..., 1 + P, k). Those after the first
    `m`, of priors, do not change.
    """
    y, by = rows[..., :1, :m], rows[..., 1:, :m]
    lever = along[..., None, :] * sum(y[..., i::parts] * by[..., i::parts] for i in range(parts))
    result = rows.copy()
    result[..., :m] *= np.repeat(size, parts, axis=-1)[..., None, :]
    for i in range(parts):
        result[..., 1:, i:m:parts] += y[..., i::parts] * lever
    return result


def bend(rows: FloatArray, m: int, rho: Rho, parts: int = 2) -> FloatArray:
    """Return `rows`, see `weighted`, with residuals scaled so that |y|^2 becomes rho(|y|^2)."""
    z = squares_of(rows[..., 0, :m], parts)
    loss, slope, _ = rho(z)
    flat = z <= 1e-12  # here rho(z) = rho'(0) z to rounding
    safe = np.where(flat, 1.0, z)
    factor = np.sqrt(np.where(flat, slope, loss / safe))
    by_z = np.where(flat, 0.0, (slope - loss / safe) / (safe * factor))  # 2 d factor/dz
    return weighted(rows, m, factor, by_z, parts)
