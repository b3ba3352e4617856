"""Warnings about estimates that fit the data but are physically impossible or unsafe."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import special

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.rows import row_names
from dahl_ident.diagnostics.formatting import percent, with_unit
from dahl_ident.diagnostics.parameters import parameter_values
from dahl_ident.diagnostics.plausible_units import implausible_units
from dahl_ident.diagnostics.steady_motion import steady_difference
from dahl_ident.diagnostics.third_harmonic import third_harmonic_share
from dahl_ident.elements import Element
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.status import Status
from dahl_ident.units import shown_unit

_LEVEL = 1e-3  # false-alarm rate, low: such a fit is called physically impossible
_OFF = 0.02  # relative error of a prediction: as large as a good measurement's
_HARMONIC_SHARE = 0.1  # of the fundamental; describing functions assume a pure sine


def physical_warnings(optimum: Optimum, scatter: float = 0.0) -> Iterator[str]:
    """Yield a sentence for everything in an estimate that physics forbids or that is unsafe.

    `scatter` is the relative standard deviation of the force between runs.
    """
    yield from negative_parameters(optimum)
    if optimum.status is Status.AT_BOUND:
        yield optimum.message.removeprefix(Status.AT_BOUND.value).strip()
    yield from _beyond_friction_limit(optimum, scatter)
    yield from _not_a_sine(optimum)
    yield from implausible_units(optimum)


def _not_a_sine(optimum: Optimum) -> Iterator[str]:
    """Yield where the motion of a driven plant is far from the sine that is assumed."""
    problem = optimum.problem
    if problem.is_exact or not (problem.data.controlled == "force").any():
        return
    found = steady_difference(optimum)
    if found is not None:
        if found[1] > _OFF:
            (name,) = row_names(problem.data, [found[0]])
            yield (
                "the describing function, which takes the motion for a sine, is "
                f"{percent(found[1])} off at {name}: fit with steady='exact'"
            )
        return
    share = third_harmonic_share(optimum)
    if share.size and share.max() > _HARMONIC_SHARE:
        data = problem.data
        (name,) = row_names(data, [int(np.flatnonzero(data.controlled == "force")[share.argmax()])])
        yield (
            f"the displacement's third harmonic is predicted to be {percent(share.max())} of "
            f"its fundamental at {name}: a describing function, which assumes a sine, is "
            "inaccurate there; control the displacement, or leave such points out"
        )


def negative_parameters(optimum: Optimum) -> Iterator[str]:
    """Yield every mass, damping or stiffness below zero, with its number."""
    problem = optimum.problem
    values = parameter_values(optimum)
    values |= dict(zip(optimum.names, optimum.values.tolist(), strict=True))
    for element in problem.model.elements:
        if not (element.is_linear and element.linear_parameters):
            continue
        (parameter,) = element.parameters
        value, error = values[parameter.name], optimum.stderr.get(parameter.name, 0.0)
        if value < 0.0 and np.isfinite(value):
            unit = shown_unit(parameter.unit, problem.data.motion)
            within = " (zero is within two standard errors)" if -value < 2.0 * error else ""
            given = parameter.name not in optimum.names
            size = f"as given: {value:g} {unit}" if given else with_unit(value, error or None, unit)
            yield f"{parameter.name} is negative, {size}{within}"


def _beyond_friction_limit(optimum: Optimum, scatter: float) -> Iterator[str]:
    """Yield where friction's fundamental exceeds what slip can give, 4/pi of its force limits."""
    values = parameter_values(optimum)
    limit = 0.0
    for element in optimum.problem.model.elements:
        if not element.is_linear:
            own = [np.asarray(values[p.name]) for p in element.parameters]
            limit += float(element.force_bounds(own)[1])
    if not 0.0 < limit < np.inf:
        return
    force, error = friction_force(optimum)
    error = np.hypot(error, scatter * limit)
    excess = (force - limit) / error
    rows = np.flatnonzero(np.isfinite(excess))
    if not rows.size:
        return
    row = int(rows[np.argmax(excess[rows])])
    dof = 1e9 if optimum.scale_known else max(optimum.dof, 1)
    if excess[row] > special.stdtrit(dof, 1.0 - _LEVEL / rows.size):
        unit = shown_unit("N", optimum.problem.data.motion)
        (name,) = row_names(optimum.problem.data, [row])
        yield (
            f"at {name} friction's fundamental is {with_unit(force[row], error[row], unit)}, "
            f"more than full slip can give ({limit:.3g} {unit}, 4/pi of its limit): something "
            "besides the model carries force"
        )


def friction_force(optimum: Optimum) -> tuple[FloatArray, FloatArray]:
    """Return the fundamental of the friction force of each row and its standard deviation.

    The modelled linear part is subtracted from the measured dynamic stiffness. NaN in rows of
    harmonics.
    """
    N, scale = friction_stiffness(optimum), optimum.scale
    view = optimum.problem.stiffness_data
    error = np.sqrt(2.0) * scale / view.weights * view.amplitude
    force = np.where(view.harmonic == 1, np.abs(N) * view.amplitude, np.nan)
    return force, error


def is_spring(element: Element) -> bool:
    """Return whether an element is a stiffness that depends neither on amplitude nor frequency."""
    return element.is_linear and element.rate_independent


def friction_stiffness(optimum: Optimum, *, with_springs: bool = False) -> ComplexArray:
    """Return the measured dynamic stiffness, sensors corrected, of friction (and springs).

    The modelled parts of all linear elements are subtracted, or of all but springs.
    """
    problem = optimum.problem
    view = problem.stiffness_data
    ratio = _sensed(optimum)
    linear = np.zeros(len(view.amplitude), dtype=np.complex128)
    values = parameter_values(optimum)
    for element in problem.model.elements:
        if element.is_linear and not (with_springs and is_spring(element)):
            linear += view.of(element, [np.asarray(values[p.name]) for p in element.parameters])
    return np.asarray(view.stiffness * ratio - linear)


def _sensed(optimum: Optimum) -> ComplexArray:
    """Return the factor from stiffness at the sensors' starts to that at their estimates."""
    problem = optimum.problem
    if problem.sensors.are_exact:
        return np.ones(1, dtype=np.complex128)
    values, view = parameter_values(optimum), problem.stiffness_data
    start = {p.name: p.value or 0.0 for p in problem.sensors.parameters}
    gain = values["force_gain"] / values["displacement_gain"]
    gain /= start["force_gain"] / start["displacement_gain"]
    lag = values["delay"] - start["delay"]
    return np.asarray(np.exp(-1j * view.harmonic * view.omega * lag) / gain)
