r"""Segalman's four-parameter Iwan law of a bolted joint: from microslip to macroslip.

The density of slip displacements is a power law up to the largest one, d_m, at which a stiffness S
slips at once:

    rho(d) = R d^chi for d < d_m;   S = ratio R d_m^g/g at d = d_m,

with g = chi + 1. The backbone curve has the slope

    V'(x) = sigma (1 - (x/d_m)^g/(1 + ratio)) for x < d_m, 0 beyond,
    d_m = (f_max/sigma) (1 + ratio)/(ratio + g/(g + 1)).

So N is that of a Jenkins element that slips at d_m, less sigma/(1 + ratio) times

    P = (2 j/(pi k)) Int_0^t (A u/d_m)^g sin(theta) exp(-j k theta) dtheta,   u = sin^2(theta/2),

with t = pi or, if A > d_m, arccos(1 - 2 d_m/A); by Gauss quadrature. In microslip P is a constant
times (A/d_m)^g, and the loss in a cycle rises with the amplitude to the power chi + 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.facts import SOFTENED, Sine, StiffnessGradient, Values, each_harmonic
from dahl_ident.elements.masing import Masing, jenkins
from dahl_ident.elements.parameter import Parameter

_SLIDERS = 30  # Jenkins elements that replace the law under a driving force; error 2e-4 of f_max
_FEW_SLIDERS = 8  # error 3e-3 of f_max, at a tenth of the cost: for the first part of a search
_REST = 1e-100  # m: replaces smaller amplitudes, so that d_m/A does not overflow
_SMALLEST_KNEE = 1e-6  # least knee over the onset; as chi tends to -1, the knee tends to zero


class Iwan(Masing):
    """Four-parameter Iwan law of Segalman: stiffness falls as a power of amplitude, then slip.

    Parameters
    ----------
    f_max : float, optional
        Force of macroslip, N (N m in rotation), > 0. Given: fixed; left out: free.
    sigma : float, optional
        Tangent stiffness at zero force, N/m (N m/rad), > 0. Given: fixed; left out: free.
    chi : float, optional
        Exponent of the density of slip displacements, above -1, at most 3: in microslip the loss
        in a cycle rises as A^(chi+3) and the stiffness falls as A^(chi+1). Bolted joints have
        -1 < chi <= 0.
    ratio : float, optional
        Stiffness that slips at once at the onset of macroslip, over that which slips before
        (Segalman's beta), > 0.
    name : str, optional
        Prefix of the parameters' names.

    Raises
    ------
    ValidationError
        If a value is outside its range.

    Notes
    -----
    D. J. Segalman, A four-parameter Iwan model for lap-type joints, J. Appl. Mech. 72 (2005)
    752-760. Amplitudes of microslip alone determine sigma (with a spring: its sum with the
    spring's), chi and one coefficient of the power law; f_max and ratio are then not determined.
    Under a driving force over time, 30 Jenkins elements replace it.

    Examples
    --------
    >>> joint = Iwan(f_max=100.0, sigma=1e7, chi=-0.5, ratio=1.0)
    >>> print(f"{joint.onset:.3e} m, {joint.describing_function(1e-6):.5g}")
    1.500e-05 m, 9.1233e+06+2.1917e+05j
    >>> loss = joint.dissipated_energy([1e-6, 2e-6])
    >>> print(f"{np.log2(loss[1] / loss[0]):.3f}")
    2.500
    """

    kind = "iwan"
    equation = (
        "F = sum of Jenkins elements with the density of slip displacements R d^chi up to d_m, "
        "and a step there"
    )
    scale_parameters = ("f_max", "sigma")
    parameters = (
        Parameter("f_max", "N", "force of macroslip", lower=0.0, transform="log"),
        Parameter("sigma", "N/m", "tangent stiffness at zero force", lower=0.0, transform="log"),
        Parameter(
            "chi",
            "",
            "exponent of the slip density",
            lower=-1.0,
            upper=3.0,
            scan=(-0.75, -0.5, -0.25, 0.0, 0.5),
            prior=(-0.95, 0.5),
        ),
        Parameter(
            "ratio",
            "",
            "stiffness that slips at once over that before",
            lower=0.0,
            transform="log",
            scan=(0.1, 1.0, 10.0),
            prior=(0.02, 50.0),
        ),
    )

    n_states = _SLIDERS

    def coarser(self) -> Iwan:
        """Return this law, replaced by fewer Jenkins elements."""
        copy = self.copy_with(self.parameters)
        copy.n_states = _FEW_SLIDERS
        return copy

    def sliders(self, values: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any]]:
        """Return stiffnesses and slip displacements of the Jenkins elements that replace the law.

        The slip displacements are d_m (i/n)^2; the forces there are those of the backbone curve.
        """
        _, sigma, chi, ratio = values
        n = self.n_states
        d = _onset(values)
        slips: list[Any] = [0.0]
        forces: list[Any] = [0.0]
        for fraction in (np.arange(1, n + 1) / n).tolist():
            loss = fraction ** (2.0 * chi + 2.0) / ((1.0 + ratio) * (chi + 2.0))
            slips.append(d * fraction**2)
            forces.append(sigma * slips[-1] * (1.0 - loss))
        slopes = [(forces[i + 1] - forces[i]) / (slips[i + 1] - slips[i]) for i in range(n)]
        stiffnesses = [a - b for a, b in zip(slopes, [*slopes[1:], 0.0], strict=True)]
        return stiffnesses, slips[1:]

    @property
    def onset(self) -> float:
        """d_m, m: the displacement at which macroslip begins."""
        return float(_onset(self.known_values()))

    def backbone(self, values: Values, displacement: FloatArray) -> FloatArray:
        """Return sigma x (1 - (x/d_m)^g/((1 + ratio) (g + 1))), f_max beyond d_m."""
        f_max, sigma, chi, ratio = values
        d = _onset(values)
        x = np.minimum(displacement, d)
        loss = (x / d) ** (chi + 1.0) / ((1.0 + ratio) * (chi + 2.0))
        return np.asarray(np.where(displacement < d, sigma * x * (1.0 - loss), f_max))

    @each_harmonic
    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives, exactly; one-sided at the onset of macroslip."""
        f_max, sigma, chi, ratio = (np.asarray(v, dtype=np.float64) for v in values)
        A = np.maximum(np.asarray(sine.amplitude, dtype=np.float64), _REST) + 0.0 * sine.omega
        g, m = chi + 1.0, _onset(values) / A
        k = int(sine.harmonic)
        jenkins_part, by_m = jenkins(m, k)
        P, P_by_g = _reduction(m, g, k, derivative=derivatives > 1)
        G = jenkins_part - P / (1.0 + ratio)
        # with respect to ln A; the upper ends of both integrals give the same term
        by_lnA = -(m * by_m * ratio + g * P) / (1.0 + ratio)
        slopes: tuple[ComplexArray, ...] = ()
        if derivatives > 1:
            c = ratio + g / (g + 1.0)  # A/d_m = A sigma/f_max c/(1 + ratio)
            ln_by_ratio = 1.0 / c - 1.0 / (1.0 + ratio)
            ln_by_g = 1.0 / ((g + 1.0) ** 2 * c)
            slopes = (
                -sigma * by_lnA / f_max,
                G + by_lnA,
                sigma * (by_lnA * ln_by_g - P_by_g / (1.0 + ratio)),
                sigma * (by_lnA * ln_by_ratio + P / (1.0 + ratio) ** 2),
            )
        return StiffnessGradient(np.asarray(sigma * G), sigma * by_lnA / A, slopes)

    def rest_stiffness(self, values: Values) -> FloatArray:
        """Return sigma."""
        return np.asarray(values[1], dtype=np.float64)

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the amplitude at which 1 % of the stiffness is lost, and the onset of slip."""
        _, _, chi, ratio = (np.asarray(v) for v in values)
        d = _onset(values)
        with np.errstate(divide="ignore", over="ignore"):
            fraction = np.minimum(SOFTENED * (1.0 + ratio), 1.0) ** (1.0 / (chi + 1.0))
        return d * np.maximum(fraction, _SMALLEST_KNEE), d


def _onset(values: Sequence[Any]) -> Any:
    """Return d_m, in plain arithmetic."""
    f_max, sigma, chi, ratio = values
    return f_max / sigma / (1.0 - 1.0 / ((1.0 + ratio) * (chi + 2.0)))


@lru_cache(maxsize=64)
def _rule(harmonic: int) -> tuple[FloatArray, FloatArray]:
    """Return theta/t and weights of Gauss points in s, with theta = t s^3 to smooth theta^(2 g).

    Fewer points would lose digits of the harmonic.
    """
    nodes, weights = np.polynomial.legendre.leggauss(48 + 2 * harmonic)
    s = 0.5 * (1.0 + nodes)
    return s**3, 1.5 * weights * s**2


def _reduction(
    m: FloatArray, g: FloatArray, harmonic: int, *, derivative: bool
) -> tuple[ComplexArray, ComplexArray]:
    """Return P and, if asked for, its derivative with respect to g at constant m = d_m/A."""
    shape = np.broadcast_shapes(np.shape(m), np.shape(g))
    if harmonic % 2 == 0:
        zero = np.zeros(shape, dtype=np.complex128)
        return zero, zero
    t = 2.0 * np.arcsin(np.sqrt(np.minimum(m, 1.0)))[..., None]
    fractions, weights = _rule(harmonic)
    theta = t * fractions
    with np.errstate(under="ignore"):
        log_u = 2.0 * np.log(np.sin(0.5 * theta)) - np.log(np.asarray(m))[..., None]
        power = np.exp(np.asarray(g)[..., None] * log_u)
    integrand = t * weights * np.sin(theta) * power
    real, imag = np.sin(harmonic * theta), np.cos(harmonic * theta)
    factor = 2.0 / (np.pi * harmonic)

    def integral(f: FloatArray) -> ComplexArray:
        total = (f * real).sum(axis=-1) + 1j * (f * imag).sum(axis=-1)
        return np.asarray(np.broadcast_to(factor * total, shape))

    value = integral(integrand)
    return value, integral(integrand * log_u) if derivative else value
