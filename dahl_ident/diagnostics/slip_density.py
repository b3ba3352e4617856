r"""The density of slip displacements, and the smallest misfit of such laws.

A symmetric rate-independent Masing law is a sum of Jenkins elements over their slip
displacements, and N is linear in their stiffnesses, none of which is negative:

    N(A) = sum over i of k_i J(d_i/A),    k_i >= 0.

Finding the best of these laws is a convex problem, non-negative least squares, which has a unique
solution and needs no initial values. Parallel masses, dampers and springs are linear as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.text import sentence
from dahl_ident.elements import Element, MaxwellSlip, Model
from dahl_ident.elements.element import as_model
from dahl_ident.elements.masing import jenkins
from dahl_ident.errors import DahlIdentError, DataError, ModelError
from dahl_ident.fitting import Optimum
from dahl_ident.problem import TableProblem

_PER_DECADE = 48  # 5 % apart
_BELOW = 100.0  # smallest amplitude over the smallest slip displacement, where all elements slip
_SMOOTHING = 10.0 ** np.arange(1.0, -6.5, -0.5)  # tried in this order, the smoothest first
_ALLOWED = 1.05  # misfit of a smooth density over the least misfit
_FEWEST_ROWS = 6  # for which a misfit is informative
_NO_MISFIT = 1e-4  # misfit that is rounding
FAR_LESS = 0.5  # of a model's misfit, below which another law is far better


@dataclass(frozen=True)
class SlipDensity:
    """Stiffness over slip displacement, and its misfit."""

    # (n,): slip displacements d, m, evenly spaced in their logarithm; the first represents all
    # smaller ones, for which only the product of both is determined
    slip: FloatArray
    # (n,): stiffness that slips at each, N/m; smooth, as far as the misfit allows
    stiffness: FloatArray
    spring: float  # stiffness that slips nowhere within the amplitudes, N/m
    parallel: dict[str, float]  # the free linear parameters
    # root mean square of abs(measured - fitted)/abs(measured) over the fundamentals, for the best
    # law of this kind without smoothing
    least_misfit: float
    misfit: float  # the same for the smooth density

    @property
    def statement(self) -> str:
        """The least misfit in words."""
        return sentence("jenkins_bound", {"least": self.least_misfit, "law": False})

    def law(self) -> MaxwellSlip:
        """Return the density as an element: Jenkins elements and the spring, as fixed values."""
        slips, stiff = self.slip, self.stiffness
        if self.spring > 0.0:
            slips = np.append(slips, 1e6 * slips[-1])
            stiff = np.append(stiff, self.spring)
        some = stiff > 0.0
        if not some.any():
            raise ModelError("no Jenkins element has any stiffness; the data show no friction")
        return MaxwellSlip(slips[some], stiff[some])


def slip_density(data: FrequencyResponse, parallel: Element | None = None) -> SlipDensity:
    """Return the density of slip displacements that describes the fundamentals best.

    Errors are relative to the measured response.

    Parameters
    ----------
    data : FrequencyResponse
        With known displacement amplitudes, or drives from which they follow.
    parallel : Element, optional
        Linear elements in parallel, such as ``Mass() + Damper()``; free parameters take any sign,
        unless their bounds exclude it. A free spring is always included.

    Returns
    -------
    SlipDensity

    Raises
    ------
    DataError
        If fewer than three fundamentals remain.
    ModelError
        If an element of `parallel` is not linear.

    Notes
    -----
    The bound is exact for sums of Jenkins elements (Masing, Iwan and Maxwell-slip laws) up to a
    grid of 48 slip displacements a decade. The Dahl and Bouc-Wen laws are not such sums: their
    loops soften less than Masing's for the same loss, and exact tables of them leave 5 to 15 %.

    Examples
    --------
    >>> law = MaxwellSlip([1e-4, 1e-3], [3e4, 1e4])
    >>> A = np.geomspace(3e-5, 3e-3, 20)
    >>> density = slip_density(FrequencyResponse(np.ones(20), law.describing_function(A), A))
    >>> print(f"{density.least_misfit:.3f}, {density.stiffness.sum() + density.spring:.0f} N/m")
    0.001, 39999 N/m
    """
    linear = [] if parallel is None else list(as_model(parallel).elements)
    wrong = [e for e in linear if not e.is_linear]
    if wrong:
        raise ModelError(f"parallel has {wrong[0]!r}; expected linear elements, such as Mass()")
    system = _system(data, linear)
    n = system.slip.size
    _, least = _solved(system, 0.0)
    coefficients, misfit = next(
        (
            pair
            for s in _SMOOTHING
            if (pair := _solved(system, s))[1] <= max(_ALLOWED * least, _NO_MISFIT)
        ),
        _solved(system, 0.0),
    )
    parallel_values = dict.fromkeys(system.names, 0.0)
    for name, sign, value in zip(system.names, system.signs, coefficients[n + 1 :], strict=True):
        parallel_values[name] += sign * float(value)
    return SlipDensity(
        system.slip, coefficients[:n], float(coefficients[n]), parallel_values, least, misfit
    )


def least_misfit(optimum: Optimum) -> float | None:
    """Return the least misfit if parallel Jenkins elements replace a model's friction.

    None with few rows, unknown calibrations, no friction, or a displacement that is not a sine.
    """
    problem = optimum.problem
    linear = [e for e in problem.model.elements if e.is_linear]
    unknown = any(p.free for p in problem.sensors.parameters)
    few = (problem.data.harmonic == 1).sum() < _FEWEST_ROWS
    if few or unknown or problem.is_exact or len(linear) == len(problem.model.elements):
        return None
    try:
        return _solved(_system(problem.data, linear), 0.0)[1]
    except DahlIdentError:
        return None


class _SlipSystem(NamedTuple):
    """Equations matrix coefficients = target, relative to the response, coefficients >= 0."""

    slip: FloatArray  # of the first columns; the next is a spring, the others are `names`
    matrix: ComplexArray
    target: ComplexArray
    names: list[str]
    signs: list[float]


def _system(data: FrequencyResponse, linear: Sequence[Element]) -> _SlipSystem:
    rows = data.harmonic == 1
    if rows.sum() < 3:
        raise DataError(f"{int(rows.sum())} rows are fundamentals; a density needs at least three")
    friction = MaxwellSlip(1, name="slip_density")  # a problem needs one
    view = TableProblem(data.select(harmonic=1), Model(*linear, friction)).stiffness_data
    A, Z = view.amplitude, view.stiffness
    if np.any(Z == 0.0):
        raise DataError("a response is zero; errors cannot count relative to it")
    ratio = _BELOW * A.max() / A.min()
    n = int(np.ceil(_PER_DECADE * np.log10(ratio))) + 1
    slip = np.geomspace(A.min() / _BELOW, A.max(), n)[:-1]
    columns: list[ComplexArray] = [
        jenkins(slip / A[:, None], 1)[0],
        np.ones((A.size, 1), dtype=np.complex128),
    ]
    target, names = Z.copy(), []
    signs: list[float] = []
    for element in linear:
        for i, p in enumerate(element.parameters):
            values = [np.asarray(float(j == i)) for j in range(len(element.parameters))]
            unit = element.stiffness(values, A, view.omega)
            if not p.free:
                target -= cast(float, p.value) * unit
                continue
            for sign in (1.0, -1.0) if p.lower < 0.0 else (1.0,):
                columns.append(sign * unit[:, None])
                names.append(p.name)
                signs.append(sign)
    matrix: ComplexArray = np.concatenate(columns, axis=1) / np.abs(Z)[:, None]
    return _SlipSystem(slip, matrix, target / np.abs(Z), names, signs)


def _solved(system: _SlipSystem, smoothing: float) -> tuple[FloatArray, float]:
    """Return non-negative coefficients, whose density is smooth, and the misfit."""
    matrix, target, n = system.matrix, system.target, system.slip.size
    size = np.linalg.norm(matrix, axis=0)
    scaled = matrix / size
    rows = np.concatenate([scaled.real, scaled.imag])
    values = np.concatenate([target.real, target.imag])
    # second differences of the stiffnesses, to be small
    bend = np.diff(np.eye(n), n=2, axis=0) / size[:n] * float(size[n - 1])
    rough = np.zeros((n - 2, matrix.shape[1]))
    rough[:, :n] = smoothing * np.sqrt(len(target) / n) * bend
    from scipy.optimize import nnls

    coefficients, _ = nnls(
        np.concatenate([rows, rough]), np.append(values, np.zeros(n - 2)), maxiter=10000
    )
    misfit = float(np.sqrt(np.mean(np.abs(scaled @ coefficients - target) ** 2)))
    return coefficients / size, misfit
