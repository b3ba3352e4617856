"""Estimates that may agree with the data, but are physically impossible or unsafe."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from dahl_ident.control_interop import response
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.rows import row_names
from dahl_ident.diagnostics.information import parameter_values
from dahl_ident.diagnostics.judgement import Finding, VerdictStatus, described
from dahl_ident.elements import Element, Friction, Model
from dahl_ident.elements.parameter import STIFFNESS
from dahl_ident.errors import argument
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.optimum import Status, values_at_bounds
from dahl_ident.problem import Problem
from dahl_ident.problem.steady_rows import levels
from dahl_ident.units import engineering, percent, shown_unit, si_unit

_WORTH_STATING = 1e-3  # relative difference that is worth stating
_DISTORTED = 0.05  # distortion of a force that matters: less changes the fundamental below 1 %
_OFF = 0.02  # relative error of a prediction: as large as a good measurement's
_CLEARLY = 2.0  # standard uncertainties below zero
_APPROXIMATE = VerdictStatus.APPROXIMATE
_FALLING = "fit a law whose force falls with speed (LuGre)"
_INSTEAD = {
    (1, -1, 2): "a mass: leave it out, or give its value",
    (1, -1, 1): f"a damper: {_FALLING}, leave the damper out, or give its value",
    STIFFNESS: "a spring, except a buckled one: leave it out, or give its value",
}
# Range of x_c, m or rad, within which mechanisms lie, from micromachines to bridge bearings.
_TYPICAL = {"translation": (1e-9, 0.1), "rotation": (1e-7, 1.0)}
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


def is_spring(element: Element) -> bool:
    """Return whether an element is a stiffness that depends neither on amplitude nor frequency."""
    return element.is_linear and element.rate_independent


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


def is_single(element: Element) -> bool:
    """Return whether an element is a mass, a damper or a spring."""
    return bool(
        element.is_linear
        and element.linear_parameters
        and len(element.parameters) == 1
        and element.parameters[0].dimension in _INSTEAD
    )


def negative_elements(problem: Any, known: Estimates) -> Iterator[Finding]:
    """Yield a finding for every mass, damping or stiffness clearly below zero, with what to do."""
    values, stderr = known
    for element in problem.model.elements:
        p = element.parameters[0]
        if not (is_single(element) and p.free):
            continue
        value, u = values[p.name], stderr[p.name]
        if np.isfinite(value) and value < -_CLEARLY * u:
            estimate = {"value": value, "stderr": u, "unit": shown_unit(p.unit, problem.motion)}
            instead = _INSTEAD[p.dimension]
            yield described("negative", _APPROXIMATE, name=p.name, **estimate, instead=instead)


def _sizes(optimum: Optimum) -> Iterator[str]:
    """Yield every x_c that no mechanism has."""
    motion, values = optimum.problem.data.motion, parameter_values(optimum)
    least, most = _TYPICAL[motion]
    for element in optimum.problem.model.elements if optimum.success else ():
        low, high = element.knee([np.asarray(values[p.name]) for p in element.parameters])
        if low == high and np.isfinite(low) and not least <= low <= most:
            size, least_size, most_size = (
                engineering(float(v), shown_unit("m", motion)) for v in (low, least, most)
            )
            yield (
                f"x_c is {size}, where mechanisms have {least_size} to {most_size}: check the "
                "units of displacement and force"
            )
