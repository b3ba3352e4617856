"""Estimates that may agree with the data, but are physically impossible or unsafe."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy import special

from dahl_ident.arrays import ComplexArray
from dahl_ident.control_interop import response
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.rows import row_names
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.information import parameter_values
from dahl_ident.diagnostics.judgement import Finding, VerdictStatus, described
from dahl_ident.elements import Element, Friction, Model, Parameter
from dahl_ident.elements.facts import Values
from dahl_ident.elements.parameter import FORCE, STIFFNESS
from dahl_ident.errors import argument
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.optimum import Status, values_at_bounds
from dahl_ident.problem import Problem
from dahl_ident.problem.steady_rows import levels
from dahl_ident.units import engineering, percent, shown_unit, si_unit

_WORTH_STATING = 1e-3  # relative difference that is worth stating
_DISTORTED = 0.05  # distortion of a force that matters: less changes the fundamental below 1 %
_OBJECTION_BY_CHANCE = 1e-3  # false-alarm rate, low as such a fit is called physically impossible
_OFF = 0.02  # relative error of a prediction: as large as a good measurement's
_CLEARLY = 2.0  # standard uncertainties below zero
_IMPOSSIBLE = 3.0  # standard errors of a limit by which a force has to exceed it
_WITH_HARMONICS = 4.0  # a mass at three times the frequency carries nine times as much of a third
_APPROXIMATE = VerdictStatus.APPROXIMATE
_FALLING = "fit a law whose force falls with speed (LuGre)"
_INSTEAD = {
    (1, -1, 2): "a mass: leave it out, or give its value",
    (1, -1, 1): f"a damper: {_FALLING}, leave the damper out, or give its value",
    STIFFNESS: "a spring, except a buckled one: leave it out, or give its value",
}
# Ranges in SI units within which mechanisms lie, from micromachines to bridge bearings.
_TYPICAL = {"x_c": (1e-9, 0.1), "force limit": (1e-9, 1e8), "contact stiffness": (1e-2, 1e12)}
_TYPICAL_ROTATION = {
    "x_c": (1e-7, 1.0),
    "force limit": (1e-10, 1e8),
    "contact stiffness": (1e-4, 1e12),
}
_DIMENSIONS = {FORCE: "force limit", STIFFNESS: "contact stiffness"}
_RATIOS = {2.0: "peak-to-peak", 2.0**-0.5: "root-mean-square"}
_NEAR_RATIO = 0.05  # largest relative difference from such a ratio
_TABULATED = 3  # amplitudes at which the energy of a cycle is tabulated
OF_FRICTION = "force limit", "stiffness at zero force"  # the same in all laws
Estimates = tuple[Mapping[str, float], Mapping[str, float]]
"""Values and their standard uncertainties, by name."""


def _largest_difference(optimum: Optimum) -> tuple[int, float]:
    """Return the row with the largest relative error of the describing function, and that error.

    It is zero if no row has both responses.
    """
    problem = optimum.problem
    forced = (problem.data.controlled == "force") & (problem.data.harmonic == 1)
    if problem.obstacle_to_exact or not np.isfinite(optimum.values).all():
        return 0, 0.0
    exact, sine = (
        problem.with_steady(steady).predict(optimum.theta)
        for steady in ("exact", "describing function")
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(forced & np.isfinite(exact), np.abs(sine / exact - 1.0), 0.0)
    row = int(np.nanargmax(error))
    return row, float(error[row])


def steady_findings(optimum: Optimum, model: Model) -> Iterator[Finding]:
    """Yield how responses to a force were predicted, how much it matters, and jumps.

    `model` has the estimates put in.
    """
    problem = optimum.problem
    if not (problem.data.controlled == "force").any():
        return
    if problem.is_exact:
        row, error = _largest_difference(optimum)
        if error >= _WORTH_STATING:
            yield described("steady", difference=error, row=row_names(problem.data, [row])[0])
        yield from _distorted(problem.data)
        yield from _jumps(problem.data, model)
        if unstable := problem.unstable_rows(optimum.theta):
            names = tuple(row_names(problem.data, unstable))
            yield described("unstable_rows", _APPROXIMATE, rows=names)
        return
    why = problem.obstacle_to_exact
    if not why and not problem.takes_energy(optimum.theta):
        yield described("no_steady_motion")
    if why and problem.steady == "exact" and any(not e.is_linear for e in problem.model.elements):
        yield described("describing_function", why=why)


def _distorted(data: FrequencyResponse) -> Iterator[Finding]:
    """Yield the row with the largest distortion of the force, if that matters."""
    harmonics = data.quality.get("force_distortion")
    if harmonics is None:
        return
    distortion = np.nan_to_num(np.where(data.controlled == "force", harmonics, 0.0))
    row = int(np.argmax(distortion))
    if distortion[row] > _DISTORTED:
        (name,) = row_names(data, [row])
        provenance = data.provenance or {}
        parts = provenance.get("parts", (provenance,))
        files = tuple(dict.fromkeys(str(p["file"]) for p in parts if "file" in p))
        yield described("distorted_force", row=name, distortion=float(distortion[row]), files=files)


def _jumps(data: FrequencyResponse, model: Model) -> Iterator[Finding]:
    """Yield the drives and ranges of frequencies with several stable motions."""
    if data.drive is None:
        return
    rows = np.flatnonzero((data.controlled == "force") & (data.harmonic == 1))
    f, drive = data.frequency_hz, data.drive
    sines = response(model, f[rows], drive[rows], all_roots=True, steady="describing function")
    if not (np.asarray(sines.number_of_solutions) > 1).any():
        return
    places = []
    for level in levels(drive[rows]):
        at_level = rows[level]
        exact = response(model, f[at_level], drive[at_level], all_roots=True)
        several = f[at_level[np.asarray(exact.stable).sum(axis=1) > 1]]
        if several.size:
            middle = float(np.median(drive[at_level]))
            places.append((middle, float(several.min()), float(several.max())))
    if places:
        yield described("jump", places=tuple(places), unit=shown_unit("N", data.motion))


def physical_warnings(optimum: Optimum) -> Iterator[str]:
    """Yield a sentence for each property of an estimate that is impossible or unsafe."""
    for p in (e.parameters[0] for e in optimum.problem.model.elements if is_single(e)):
        if not p.free and p.value is not None and p.value < 0.0:  # findings name estimated ones
            unit = shown_unit(p.unit, optimum.problem.motion)
            yield f"{p.name} is negative, as given: {p.value:g} {unit}"
    if optimum.status is Status.AT_BOUND:
        at_bounds = values_at_bounds(optimum.problem, optimum.theta, optimum.values)
        yield at_bounds or optimum.message  # that of constraints states them
    yield from _not_a_sine(optimum)
    yield from _sizes(optimum)
    yield from _levels(optimum)


def _not_a_sine(optimum: Optimum) -> Iterator[str]:
    """Yield the largest error of the describing function of a driven plant, if it matters."""
    problem = optimum.problem
    if problem.is_exact or not (problem.data.controlled == "force").any():
        return
    row, error = _largest_difference(optimum)
    if error > _OFF:
        (name,) = row_names(problem.data, [row])
        yield (
            "the describing function, which takes the motion for a sine, is "
            f"{percent(error)} off at {name}: fit with {argument('steady', 'exact')}"
        )


def beyond_friction_limit(
    optimum: Optimum, scatter: float, ignored: Sequence[int]
) -> Iterator[Finding]:
    """Yield where friction would have to exceed its limits, except in the rows `ignored`.

    The fundamental of friction is at most 4/pi times its limit. The peak of a sinusoidal force is
    at most the limit and what the linear elements carry: a few times their fundamental. Near a
    resonance, where the fundamentals of mass and spring cancel, they still carry harmonics, by
    which the fundamental of friction may exceed its limit. `scatter` is the relative standard
    deviation of the force between runs.
    """
    problem, bound, u = optimum.problem, 0.0, 0.0
    for element, values in _with_values(optimum):
        if not element.is_linear:
            bound += float(element.force_bounds(values)[1])
            forces = (p for p in element.parameters if p.dimension == FORCE)
            u += sum(optimum.stderr.get(p.name, 0.0) for p in forces)
    if not 0.0 < bound < np.inf:
        return
    limit = 0.25 * np.pi * bound
    unit, view = shown_unit("N", problem.data.motion), problem.stiffness_data
    names = partial(row_names, problem.data)
    friction = friction_stiffness(optimum)
    size = view.amplitude
    seen = view.weights > 0.0
    force = np.where((view.harmonic == 1) & seen, np.abs(friction) * size, np.nan)
    noise = np.sqrt(2.0) * optimum.scale / np.where(seen, view.weights, np.nan) * size
    error = np.hypot(noise, scatter * bound)
    force[ignored] = np.nan
    excess = np.nan_to_num((force - bound) / error, nan=-np.inf)
    row, tests = int(np.argmax(excess)), max(np.isfinite(excess).sum(), 1)
    dof = 1e9 if optimum.scale_known else max(optimum.dof, 1)
    if excess[row] > special.stdtrit(dof, 1.0 - _OBJECTION_BY_CHANCE / tests):
        shown = {"force": with_unit(force[row], error[row], unit), "limit": f"{bound:.3g} {unit}"}
        yield described("beyond_slip", _APPROXIMATE, row=names([row])[0], **shown)
    if problem.data.drive is None:
        return
    driven = (problem.data.controlled == "force") & np.isfinite(force)
    fundamental = np.abs(view.stiffness * problem.sensor_factor(optimum.theta) - friction) * size
    third = sum(
        element.stiffness(values, size, 3.0 * view.omega)
        for element, values in _with_values(optimum)
        if element.is_linear
    )
    harmonics = np.minimum(np.abs(third) * size, bound - limit)
    carried = np.maximum(_WITH_HARMONICS * fundamental, fundamental + harmonics)
    beyond = np.where(driven, problem.data.drive - carried - limit, -np.inf)
    row = int(np.argmax(beyond))
    if beyond[row] > _IMPOSSIBLE * np.hypot(u, scatter * limit):
        shown = {"carried": f"{carried[row]:.2g} {unit}", "limit": f"{limit:.3g} {unit}"}
        yield described("beyond_limit", _APPROXIMATE, row=names([row])[0], **shown)


def is_spring(element: Element) -> bool:
    """Return whether an element is a stiffness that depends neither on amplitude nor frequency."""
    return element.is_linear and element.rate_independent


def friction_stiffness(optimum: Optimum, *, with_springs: bool = False) -> ComplexArray:
    """Return the measured dynamic stiffness of friction (and springs), sensors corrected.

    The model's linear elements, with or without springs, are subtracted.
    """
    problem = optimum.problem
    view = problem.stiffness_data
    linear = np.zeros(len(view.amplitude), dtype=np.complex128)
    for element, values in _with_values(optimum):
        if element.is_linear and not (with_springs and is_spring(element)):
            linear += view.stiffness_of(element, values)
    return np.asarray(view.stiffness * problem.sensor_factor(optimum.theta) - linear)


def friction_quantities(problem: Problem, values: Mapping[str, float]) -> dict[str, float]:
    """Return the quantities of friction that are common to all laws, at the parameters' values."""
    A, rates = problem.unit_sizes((0, 1, 0)), problem.unit_sizes((0, 0, -1))
    sizes = np.geomspace(A.min(), A.max(), _TABULATED if A.max() > A.min() else 1)
    omega = np.asarray(np.exp(np.mean(np.log(rates))))
    limit, stiffness, energy = 0.0, 0.0, np.zeros(sizes.size)
    for element in problem.model.elements:
        if not isinstance(element, Friction):
            continue
        at_element = [np.asarray(values[p.name]) for p in element.parameters]
        with np.errstate(all="ignore"):
            limit += float(np.mean(element.force_limits(at_element)))
            contact = float(element.rest_stiffness(at_element))
            if not contact:  # behind a gap
                contact = float(element.quasi_static_slope(np.zeros(()), 1.0, at_element))
            stiffness += contact
            energy += np.pi * sizes**2 * np.imag(element.stiffness(at_element, sizes, omega))
    unit = si_unit("displacement", problem.motion)
    return dict(zip(OF_FRICTION, (limit, stiffness), strict=True)) | {
        f"energy a cycle at {size:.2g} {unit}": float(e)
        for size, e in zip(sizes, energy, strict=True)
    }


def _with_values(optimum: Optimum) -> Iterator[tuple[Element, Values]]:
    """Yield every element with the values of its parameters at the optimum."""
    values, model = parameter_values(optimum), optimum.problem.model
    yield from model.of([np.asarray(values[p.name]) for p in model.parameters])


def is_single(element: Element) -> bool:
    """Return whether an element is a mass, a damper or a spring."""
    return bool(
        element.is_linear
        and element.linear_parameters
        and len(element.parameters) == 1
        and element.parameters[0].dimension in _INSTEAD
    )


def _estimated_singles(
    problem: Any, known: Estimates
) -> Iterator[tuple[Element, Parameter, dict[str, Any]]]:
    """Yield every mass, damper and spring that is estimated, with its parameter and estimate."""
    values, stderr = known
    for element in problem.model.elements:
        if is_single(element) and element.parameters[0].free:
            (parameter,) = element.parameters
            name = parameter.name
            unit = shown_unit(parameter.unit, problem.motion)
            estimate = {"value": values[name], "stderr": stderr[name], "unit": unit}
            yield element, parameter, {"name": name, **estimate}


def negative_elements(problem: Any, known: Estimates) -> Iterator[Finding]:
    """Yield a finding for every mass, damping or stiffness clearly below zero, with what to do."""
    for _, parameter, estimate in _estimated_singles(problem, known):
        value, instead = estimate["value"], _INSTEAD[parameter.dimension]
        if np.isfinite(value) and value < -_CLEARLY * estimate["stderr"]:
            yield described("negative", _APPROXIMATE, **estimate, instead=instead)


def weak_elements(
    problem: Any,
    known: Estimates,
    share_of: Callable[[Element, float], float],
    misfit_within: float,
    misfit: float,
) -> Iterator[Finding]:
    """Yield a finding for every mass, damper or spring whose force is smaller than the misfit.

    `share_of` returns the rms force of an element at its value over the whole force, which is
    compared with `misfit_within`, that within runs; the finding states the whole `misfit`.
    """
    for element, _, estimate in _estimated_singles(problem, known):
        share = share_of(element, estimate["value"])
        if share < misfit_within and estimate["value"] >= -_CLEARLY * estimate["stderr"]:
            yield described("slight", **estimate, share=share, misfit=misfit)


def _sizes(optimum: Optimum) -> Iterator[str]:
    """Yield force limits, contact stiffnesses and x_c that no mechanism has."""
    motion, values = optimum.problem.data.motion, parameter_values(optimum)
    typical = _TYPICAL if motion == "translation" else _TYPICAL_ROTATION
    for element in optimum.problem.model.elements if optimum.success else ():
        at_element = [float(values[p.name]) for p in element.parameters]
        sizes = [
            (p.name, p.unit, _DIMENSIONS[p.dimension], value)
            for p, value in zip(element.parameters, at_element, strict=True)
            if element.has_memory and p.free and p.dimension in _DIMENSIONS
        ]
        if sizes:
            low, high = element.knee([np.asarray(v) for v in at_element])
            sizes += [("x_c", "m", "x_c", float(low))] * bool(low == high)
        for name, unit, kind, value in sizes:
            least, most = typical[kind]
            if np.isfinite(value) and not least <= value <= most:
                size, low, high = (
                    engineering(v, shown_unit(unit, motion)) for v in (value, least, most)
                )
                yield (
                    f"{name} is {size}, where mechanisms have {low} to {high}: check the units of "
                    "displacement and force"
                )


def _levels(optimum: Optimum) -> Iterator[str]:
    """Yield that amplitudes are not zero-to-peak values, if nominal levels show it."""
    data = optimum.problem.data
    driven = bool((data.controlled == "force").all())
    size = data.drive if driven else data.amplitude
    if size is None or data.level is None or data.level.dtype.kind not in "if":
        return
    level = np.asarray(data.level, dtype=np.float64)
    if not (level > 0.0).all() or np.ptp(level) == 0.0:
        return
    ratio = size / level
    for wrong, name in _RATIOS.items():
        if np.all(np.abs(ratio / wrong - 1.0) < _NEAR_RATIO):
            yield (
                f"every {'drive' if driven else 'amplitude'} is {np.median(ratio):.3g} times its "
                f"nominal level: {name} values, where zero-to-peak is meant?"
            )
