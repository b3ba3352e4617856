"""The Dahl friction element: describing function, harmonics, loop and force, exactly.

Under x = A cos(omega t) the force settles into a loop that depends on beta = sigma A / f_max
alone, up to scale, and not on the frequency. Its Fourier coefficients have closed forms for
alpha = 1, see :mod:`dahl_ident.elements.linear_dahl`; any other exponent takes one quadrature, see
:mod:`dahl_ident.elements.general_dahl`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    array_between,
    non_negative_array,
)
from dahl_ident.elements import general_dahl, hysteresis, linear_dahl
from dahl_ident.elements.backlash import Backlash
from dahl_ident.elements.bouc_wen import BoucWen
from dahl_ident.elements.element import Alternative
from dahl_ident.elements.facts import (
    Asymptote,
    Combination,
    HistoryGradient,
    Path,
    Sine,
    StiffnessGradient,
    UniversalCurve,
    Values,
    each_harmonic,
)
from dahl_ident.elements.friction import Friction
from dahl_ident.elements.iwan import Iwan
from dahl_ident.elements.lugre import LuGre
from dahl_ident.elements.maxwell_slip import MaxwellSlip
from dahl_ident.elements.parameter import Assumed, Parameter
from dahl_ident.errors import ValidationError

_EXPONENTS = (1e-9, 1e3)  # beyond them the loop equals that of the limit
_ALPHA = Assumed(1.0)  # linear Dahl, the law of the closed forms; a user may give another
_JENKINS = 3  # elements of Maxwell slip compared with Dahl: six numbers, more than most tables give
_AT_REST = 1e-30  # smaller beta count as rest: the difference is below rounding
_NO_LOSS, _MICROSLIP, _GROSS_SLIP = 1e9, 1e5, 1e-16
"""x_c over the largest amplitude, twice, and over the smallest: the limits, to every digit."""
_SHARP, _SOFT = 1e-6, 1e3  # alpha
_ONE_SIDED = 0.9  # asymmetry
_NO_DERIVATIVE: ComplexArray = np.zeros((), dtype=np.complex128)  # not asked for
_TWO_LIMITS = (
    "dF/dx = sigma |1 - s F/f|^alpha sgn(1 - s F/f), f = f_max (1 + s asymmetry), s = sgn(dx/dt)"
)


class Dahl(Friction):
    """Dahl friction: dF/dx = sigma abs(z)^alpha sgn(z), z = 1 - s F/f_max, s = sgn(dx/dt).

    Parameters
    ----------
    f_max : float, optional
        Friction limit, N (N m in rotation), > 0. Given: fixed; left out: free.
    sigma : float, optional
        Contact stiffness at zero force, N/m (N m/rad), > 0. Given: fixed; left out: free.
    alpha : float or None, default 1
        Exponent, from 1e-9 to 1000: 1 is the linear Dahl model. None: free.
    asymmetry : float or None, default 0
        a, between -1 and 1: the limits are f_max (1 + a) while the displacement rises and
        f_max (1 - a) while it falls. None: free. At exactly 0 it is not a parameter of the element.
        It hardly affects the fundamental, but it determines the mean force and the even harmonics.
    name : str, optional
        Prefix of the parameters' names, such as "pivot" for ``pivot_f_max``; needed where a
        model has several Dahl elements.

    Raises
    ------
    ValidationError
        If f_max or sigma is not a number from 1e-90 to 1e90, alpha or asymmetry is outside its
        range, or `name` is not an identifier.

    Notes
    -----
    Eqn. 2 of Helmick and Messner, *Describing Function Analysis of Dahl Model Friction*.
    ``Im N > 0`` for dissipation, so the phase of N lies between 0 and 90 degrees.

    Examples
    --------
    >>> pivot = Dahl(f_max=0.1, sigma=30.0)
    >>> round(pivot.characteristic_displacement, 6)
    0.003333
    >>> N = pivot.describing_function([1e-6, 1e-3, 1.0])
    >>> abs(N).round(4).tolist()
    [30.0, 29.2562, 0.1272]
    >>> damper = Dahl(f_max=1.0, sigma=2000.0, asymmetry=0.2)
    >>> print(f"{damper.dynamic_stiffness(1e-3, harmonic=0).real * 1e-3:.6f} N of mean force")
    0.118069 N of mean force
    """

    kind = "dahl"
    equation = "dF/dx = sigma |1 - s F/f_max|^alpha sgn(1 - s F/f_max), s = sgn(dx/dt)"
    unique_response = True
    parameters: tuple[Parameter, ...] = (
        Parameter("f_max", "N", "friction limit", lower=0.0, transform="log"),
        Parameter("sigma", "N/m", "contact stiffness", lower=0.0, transform="log"),
        Parameter(
            "alpha",
            "",
            "exponent of the Dahl model",
            _ALPHA,
            lower=0.0,
            transform="log",
            scan=(0.25, 0.5, 1.0, 2.0, 4.0),
            prior=(0.5, 2.0),
        ),
    )
    optional = (
        Parameter(
            "asymmetry",
            "",
            "difference of the limits over their sum",
            lower=-1.0,
            upper=1.0,
            scan=(-0.3, 0.0, 0.3),
            prior=(-0.5, 0.5),
        ),
        0.0,
    )
    scale_parameters = ("f_max", "sigma")
    softens = True

    def __init__(
        self,
        f_max: float | None = None,
        sigma: float | None = None,
        alpha: float | None = _ALPHA,
        *,
        asymmetry: float | None = 0.0,
        name: str | None = None,
    ) -> None:
        numbers = {"f_max": f_max, "sigma": sigma, "alpha": alpha, "asymmetry": asymmetry}
        self._bind(numbers, name)
        if alpha is not None:
            array_between(alpha, self.parameters[2].name, *_EXPONENTS)
        if self.has_optional:
            self.equation, self.unique_response = _TWO_LIMITS, False

    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx (Eqn. 2), with the limit of the direction."""
        f_max, sigma, alpha, *asymmetry = values
        if asymmetry:
            f_max = f_max * (1.0 + direction * asymmetry[0])
        margin = 1.0 - direction * force / f_max
        return sigma * np.sign(margin) * np.fabs(margin) ** alpha

    @property
    def characteristic_displacement(self) -> float:
        """x_c = f_max/sigma, m: the displacement at which friction changes from elastic to slip."""
        f_max, sigma, *_ = self.known_values()
        return float(f_max / sigma)

    def gradient(
        self, amplitude: ArrayLike, names: Iterable[str] | None = None
    ) -> dict[str, ComplexArray]:
        """Return dN/dp for each parameter p of the element, and dN/dA as ``"amplitude"``.

        Parameters
        ----------
        amplitude : array_like
            Zero-to-peak displacement A >= 0, m.
        names : iterable of str, optional
            The derivatives to return; by default all of them. Without alpha, which takes a
            quadrature, an element with alpha = 1 uses closed forms, which are some twenty
            times faster.

        Returns
        -------
        dict of str to ndarray of complex
            Derivatives in N/m per unit of the parameter, by the parameter's name.

        Raises
        ------
        ModelError
            If a parameter has no value.
        ValidationError
            If an amplitude is negative, NaN, infinite or complex, or a name is unknown.

        Examples
        --------
        >>> sorted(Dahl(f_max=1.0, sigma=2.0).gradient(1.0))
        ['alpha', 'amplitude', 'f_max', 'sigma']
        """
        A = non_negative_array(amplitude, "amplitude")
        known = [*(p.name for p in self.parameters), "amplitude"]
        chosen = known if names is None else list(names)
        unknown = [name for name in chosen if name not in known]
        if unknown:
            raise ValidationError(f"names has {unknown[0]!r}; expected some of {', '.join(known)}")
        values = self.known_values()
        parameters = [replace(p, free=p.name in chosen) for p in self.parameters]
        result = self.copy_with(tuple(parameters)).settled(values, Sine(A, np.zeros(())), 2)
        every = dict(zip(known, (*result.by_parameter, result.by_amplitude), strict=True))
        return {name: every[name][()] for name in chosen}

    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return F_k/X_1 at `values`, unchecked; by the engine where there are two limits.

        The derivative with respect to alpha costs a quadrature; while alpha is fixed it is left at
        zero, which no estimate uses.
        """
        if self.has_optional:
            return super().settled(values, sine, derivatives)
        if bool(np.equal(values[2], 1.0).all()):
            return self._settled_linear(values, sine, derivatives)
        beta = _beta(values, sine)
        parts = general_dahl.stiffness(beta, values[2], sine.harmonic, derivatives)
        return _scaled(values, beta, parts)

    @each_harmonic
    def _settled_linear(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        beta, k = _beta(values, sine), int(sine.harmonic)
        parts: tuple[ComplexArray, ...]
        if k != 1:
            c, rise = linear_dahl.harmonic_gradient(beta, k)
            parts = (c / beta, (c - rise) / beta, rise / beta)
        elif derivatives:
            parts = linear_dahl.describing_function_gradient(beta)
        else:
            parts = (linear_dahl.describing_function(beta),)
        if derivatives > 1:
            if self.parameters[2].free:
                by_alpha = general_dahl.stiffness(beta, values[2], k, derivatives)[3]
            else:
                by_alpha = np.zeros(beta.shape, dtype=np.complex128)
            parts = (*parts, by_alpha)
        return _scaled(values, beta, parts[: general_dahl.COUNTS[derivatives]])

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample, exactly (Eqn. 3, segment by segment), unchecked."""
        if self.has_optional:
            return super().history(values, path, state, slopes=slopes)
        f_max, sigma, alpha = (float(v) for v in values)
        if not slopes:
            force = hysteresis.force_history(path.displacement, f_max, sigma, alpha, state)
            return HistoryGradient(force, force, ())
        if alpha != 1.0 or self.parameters[2].free:
            return super().history(values, path, state, slopes=True)
        linear = hysteresis.linear_history_gradient(path.displacement, f_max, sigma, state)
        zero = np.zeros(linear.value.shape)
        return linear._replace(by_parameter=(*linear.by_parameter, zero))

    def _top(self, values: Sequence[float], amplitude: float) -> float:
        if self.has_optional:
            return super()._top(values, amplitude)
        f_max, sigma, alpha = values
        beta = np.asarray(sigma * amplitude / f_max)
        return f_max * float(general_dahl.turning_force(beta, np.asarray(alpha)))

    def force_limits(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return f_max, with its asymmetry, for both directions."""
        f_max, _, _, *asymmetry = values
        a = asymmetry[0] if asymmetry else 0.0
        return np.asarray(f_max * (1.0 + a)), np.asarray(f_max * (1.0 - a))

    def force_bounds(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return 4 sigma/pi and 4/pi of the larger limit.

        The range of the force over a cycle is at most that of the limits and, since z^-alpha is
        convex, at most 2 sigma A. The fundamental of a wave of height 1 is at most 4/pi, that of
        the square wave.
        """
        steepest = np.asarray(4.0 / np.pi * values[1])
        return steepest, np.asarray(4.0 / np.pi * np.maximum(*self.force_limits(values)))

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the larger limit over sigma twice."""
        x_c = np.asarray(np.maximum(*self.force_limits(values)) / values[1])
        return x_c, x_c

    def transient_decay(
        self, values: Values, amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return the factor by which a deviation from the steady loop shrinks in one cycle."""
        if self.has_optional:
            return super().transient_decay(values, amplitude, omega)
        f_max, sigma, alpha = values
        beta = np.asarray(sigma * amplitude / f_max)
        return hysteresis.transient_decay(beta, alpha) + 0.0 * omega

    def combinations(self) -> tuple[Combination, ...]:
        """Return what microslip and the knee determine."""
        kappa = {"sigma": 2.0, "f_max": -1.0}
        if self.parameters[2].free:
            loss = Combination("alpha sigma^2/f_max", {"alpha": 1.0, **kappa}, "loss in microslip")
        else:
            loss = Combination("sigma^2/f_max", kappa, "loss in microslip")
        x_c = Combination("f_max/sigma", {"f_max": 1.0, "sigma": -1.0}, "where slip sets in")
        return loss, x_c

    def asymptotes(self, low: float, high: float) -> tuple[Asymptote, ...]:
        """Return the limits at infinity, for amplitudes from `low` to `high`, m.

        The distances are those at which the model is its limit to five digits or more, three for
        no full slip.
        """
        labels = [self.label(p) for p in self.parameters if p.free]
        linear = {"alpha": 1.0} if "alpha" in labels else {}
        alike = linear | ({"asymmetry": 0.0} if "asymmetry" in labels else {})
        loss = self.combinations()[0]
        f_max, sigma = ("f_max", {"f_max": 1.0}), ("sigma", {"sigma": 1.0})
        limits = [
            Asymptote(
                "no_loss",
                "a spring",
                alike,
                ("f_max", "sigma", _NO_LOSS * high),
                {"f_max": np.inf},
                (sigma,),
            ),
            Asymptote(
                "microslip",
                "a spring with a loss that grows with the amplitude",
                alike,
                ("f_max", "sigma", _MICROSLIP * high),
                {"f_max": np.inf, "sigma": np.inf},
                ((loss.expression, loss.powers),),
                adds_to_spring="sigma",
            ),
            Asymptote(
                "gross_slip",
                "Coulomb friction",
                linear,
                ("sigma", "f_max", 1.0 / (_GROSS_SLIP * low)),
                {"sigma": np.inf},
                (f_max,),
            ),
            Asymptote(
                "sharp_knee",
                "elastic up to f_max, then full slip",
                {"alpha": _SHARP},
                None,
                {"alpha": 0.0},
                (f_max, sigma),
            ),
            Asymptote(
                "no_full_slip",
                "dF/dx = sigma exp(-s F/phi), which never slips fully",
                {"alpha": _SOFT},
                None,
                {"f_max": np.inf, "alpha": np.inf},
                (("f_max/alpha", {"f_max": 1.0, "alpha": -1.0}), sigma),
            ),
        ]
        return tuple(limits if linear else limits[:3])

    def alternatives(self, values: Sequence[float], smallest: float) -> dict[str, Alternative]:
        """Return the other exponent, two elements, and laws that real devices may need."""
        f_max, sigma = values[:2]
        alpha, name = self.parameter("alpha"), self.name
        exponent = "exponent 1" if alpha.free else "exponent free"
        other_alpha = alpha.fixed(1.0) if alpha.free else alpha.freed()
        changed = self.copy_with(tuple(other_alpha if p is alpha else p for p in self.parameters))
        two = [
            Dahl(name=label).started_at((force * f_max, stiffness * sigma, 1.0))
            for label, force, stiffness in (("early", 0.3, 0.6), ("late", 0.7, 0.4))
        ]
        alternatives = {
            exponent: Alternative((changed.started_at((f_max, sigma, 1.0, *values[3:])),)),
            "two Dahl elements": Alternative(tuple(two)),
        }
        if not alpha.assumed and (alpha.free or alpha.value != 1.0):
            return alternatives
        limits = Dahl(asymmetry=None, name=name).started_at((f_max, sigma, 1.0, 0.01))
        if not self.has_optional:
            alternatives["two limits"] = Alternative((limits,), "asymmetry")
        gap = min(0.3 * f_max / sigma, smallest)
        behind = self.started_at(values)
        alternatives["gap"] = Alternative((Backlash(behind).started_at((*values, gap)),))
        rates = sigma, sigma / f_max, sigma / f_max
        alternatives["Bouc-Wen"] = Alternative((BoucWen(name=name).started_at(rates),))
        alternatives["Bouc-Wen, exponent free"] = Alternative(
            (BoucWen(exponent=None, name=name).started_at((*rates, 1.0)),)
        )
        alternatives["Iwan"] = Alternative((Iwan(name=name).started_at((f_max, sigma, 0.0, 0.5)),))
        alternatives["LuGre"] = Alternative((LuGre(name=name),), "speed")
        alternatives["Maxwell slip"] = Alternative((MaxwellSlip(_JENKINS, name=name),), "masing")
        if not self.has_optional:
            both = Backlash(limits).started_at((f_max, sigma, 1.0, 0.01, gap))
            alternatives["two limits and gap"] = Alternative((both,), "asymmetry")
        return alternatives

    def universal_curve(self) -> UniversalCurve | None:
        """Return h(beta) = N/sigma of the linear Dahl model; None for another exponent."""
        _, sigma, alpha, *asymmetry = (float(v) for v in self.known_values())
        if alpha != 1.0 or asymmetry:
            return None
        return UniversalCurve(sigma, linear_dahl.describing_function)

    def physical_objections(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return an objection to an almost vanishing limit."""
        if not self.has_optional or abs(values[3]) < _ONE_SIDED:
            return ()
        return (f"{self.parameters[3].name} leaves almost no friction in one direction",)


def _beta(values: Values, sine: Sine) -> FloatArray:
    """Return sigma A/f_max, above 0, so that derivatives with respect to A have their limits."""
    f_max, sigma, _ = values
    return np.maximum(sigma * sine.amplitude / f_max, _AT_REST)


def _scaled(values: Values, beta: FloatArray, parts: Sequence[ComplexArray]) -> StiffnessGradient:
    """Return the stiffness and its derivatives from those over sigma.

    The derivatives are with respect to ln f_max, ln sigma and alpha, as many as were computed; the
    first also gives the derivative with respect to the amplitude.
    """
    f_max, sigma, _ = values
    by_amplitude: ComplexArray = _NO_DERIVATIVE
    by_parameter: tuple[ComplexArray, ...] = ()
    if len(parts) > 1:
        by_amplitude = np.asarray(parts[1] * (-sigma / f_max * sigma / beta))
    if np.any(beta <= _AT_REST):
        parts = [np.where(beta > _AT_REST, part, part.round()) for part in parts]  # 0 or 1
    if len(parts) > 2:
        by_parameter = (sigma / f_max * parts[1], parts[2], sigma * parts[3])
    return StiffnessGradient(sigma * parts[0], by_amplitude, by_parameter)
