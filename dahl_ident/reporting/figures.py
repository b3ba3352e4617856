"""The figures of a report, each with a caption and a description in words."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident import plots
from dahl_ident.arrays import ComplexArray, FloatArray, unit_diagonal
from dahl_ident.data import curves
from dahl_ident.diagnostics.bands import ENERGY
from dahl_ident.diagnostics.confidence_levels import LEVELS, level_text, thresholds
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.information import shares
from dahl_ident.diagnostics.judgement import VerdictStatus
from dahl_ident.diagnostics.profile import Profiler
from dahl_ident.elements import Friction, UniversalCurve
from dahl_ident.errors import ValidationError
from dahl_ident.plots.style import new_axes
from dahl_ident.reporting.document import Picture
from dahl_ident.reporting.provenance import parts, sources
from dahl_ident.results.fit_plots import draw_budget, standardized_residuals
from dahl_ident.units import engineering, percent, si_unit

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse, Record
    from dahl_ident.diagnostics.budget import Budget
    from dahl_ident.results import FitResult, Posterior

_MARKED_BETA = (0.3, 1.0, 2.2, 5.0, 20.0)  # spread over the curve from stick to slip
_LEVELS, _POINTS = 5, 160  # of the plant's response at several levels
_SWEPT = 1.2  # ratio of the largest frequency to the smallest above which there are several
_PROFILE_POINTS = 41
_STRAIGHT = 1.5  # log of a profile's range beyond which its axis is logarithmic
_WIDE = 20.0  # ratio of amplitudes above which loops are drawn over displacement / amplitude
_INTEGRATIONS = {"displacement": 0, "velocity": 1, "acceleration": 2}
_LOOP_POINTS = 73  # of a measured loop, every 5 degrees; the model's are six times denser


def pictures_of(fit: FitResult) -> Iterator[Picture]:
    """Yield the pictures of a fit."""
    return _PICTURES[fit.problem.kind](fit)


def _of_table(fit: FitResult) -> Iterator[Picture]:
    """Yield the figures of a fit of a table."""
    yield _response(fit)
    if fit.success and _is_plant_over_amplitude(fit):
        yield _over_levels(fit)
    yield _residuals(fit)
    friction = [e for e in fit.model.elements if isinstance(e, Friction)]
    if fit.success and _is_friction_alone(fit):
        universal = friction[0].universal_curve()
        if universal is not None:
            yield _universal(fit, universal)
    finite = all(np.isfinite(estimate.value) for estimate in fit.params.values())
    if len(friction) == 1 and friction[0].rate_independent and finite:
        yield _loops(fit, friction[0])
    if fit.success and fit.status is not VerdictStatus.NOT_DESCRIBED:
        yield _profiles(fit)
    if fit.nvarys > 1 and np.isfinite(fit.covar).all():
        yield _correlation(fit)
    yield _information(fit)


def _of_records(fit: FitResult) -> Iterator[Picture]:
    """Yield the figures of the record that a fit describes worst."""
    worst = fit.goodness.worst_record - 1
    of_record = f" of record {worst + 1}, which is described worst" if len(fit.data) > 1 else ""
    share = percent(fit.goodness.rms_misfit)
    draw_residuals = partial(fit.plot_residuals, record=worst)
    figures: dict[str, tuple[str, Callable[[], Any]]] = {
        "time": (f"Measured and fitted {fit.problem.output}", partial(fit.plot_fit, record=worst)),
        "residuals": ("Residuals over time", draw_residuals),
    }
    if fit.data[worst].displacement is not None:
        figures["loop"] = "Force over displacement", partial(fit.plot, "loop", record=worst)
        figures["residuals_displacement"] = (
            "Residuals over displacement",
            partial(draw_residuals, against="displacement"),
        )
    for kind, (caption, draw) in figures.items():
        yield Picture(
            f"record_{kind}",
            f"{caption}{of_record}.",
            f"{caption}{of_record}: the residuals are {share} rms of the measured signal.",
            draw,
        )


_PICTURES = {"table": _of_table, "records": _of_records}


def budget_picture(budget: Budget) -> Picture:
    """Return the picture of the shares of the sources in each parameter's variance."""
    largest = (
        f"{p.name}: {p.rows[0].source}, {100.0 * p.rows[0].share:.0f} %" for p in budget.parameters
    )
    return Picture(
        "budget",
        "Share of each source in the variance of each parameter.",
        "Bars with the shares of the sources. The largest source is, for "
        f"{'; for '.join(largest)}.",
        lambda: draw_budget(budget),
    )


def _response(fit: FitResult) -> Picture:
    data = fit.data.select(harmonic=1)
    gain, phase = data.gain, np.degrees(data.phase)
    worst = float(np.nanmax(np.abs(standardized_residuals(fit))))
    alt = (
        f"Gain above phase, as points with fitted lines: gain from {gain.min():.3g} to "
        f"{gain.max():.3g} {data.unit}, phase from {phase.min():.1f} to {phase.max():.1f} degrees; "
        f"the farthest point lies {worst:.1f} standard deviations from the fit."
    )
    over_frequency = curves.is_over_frequency(data)
    over = "frequency" if over_frequency else "amplitude"
    if len(curves.curves(data)) > 1:
        over += ", by level" if over_frequency else ", by frequency"
    caption = (
        f"Data (points, with error bars) and fit (lines) over {over}. Bands are the "
        f"{level_text(LEVELS[1])} confidence bands of the fit."
    )
    return Picture("response", caption, alt, fit.plot_fit)


def _over_levels(fit: FitResult) -> Picture:
    data = fit.data.select(harmonic=1)
    drives = np.geomspace(*_ends(curves.held_amplitude(data)), _LEVELS)
    grid = np.geomspace(*_ends(data.frequency_hz), _POINTS)
    unit = si_unit("force", data.motion)
    responses = [
        fit.predict(grid, drive=np.full(_POINTS, drive), quantity="receptance").response
        for drive in drives
    ]
    peaks = [f"{np.abs(R).max():.3g}" for R in (responses[0], responses[-1])]
    gain_unit = si_unit("receptance", data.motion)

    def draw() -> Any:
        levels = [(engineering(u, unit), grid, R) for u, R in zip(drives, responses, strict=True)]
        return plots.plot_frequency_response(levels, gain_label=f"receptance [{gain_unit}]")

    return Picture(
        "levels",
        "The fitted plant over the frequencies of the data, at five levels of the drive: friction "
        "makes the response depend on its level.",
        f"Receptance against frequency, five lines; the largest is {peaks[0]} {gain_unit} at the "
        f"smallest drive and {peaks[1]} {gain_unit} at the largest.",
        draw,
    )


def _is_plant_over_amplitude(fit: FitResult) -> bool:
    """Return whether a plant was driven by force at a few widely spaced frequencies."""
    data = fit.data.select(harmonic=1)
    low, high = _ends(data.frequency_hz)
    return (
        len(fit.model.elements) > 1
        and high > _SWEPT * low
        and curves.is_force_controlled(data)
        and not curves.is_over_frequency(data)
    )


def _ends(values: FloatArray) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def _residuals(fit: FitResult) -> Picture:
    residuals = standardized_residuals(fit)
    present = residuals[np.isfinite(residuals)]
    beyond = int(np.sum(np.abs(present) > 3.0))
    alt = (
        f"Residuals as points: {present.size} with a standard deviation of {present.std():.2f}; "
        f"{beyond} of them beyond three standard deviations. {fit.goodness.headline}"
    )
    caption = (
        "Residuals of every point; the grey band is two standard deviations, suspicious points "
        "are ringed."
    )
    return Picture("residuals", caption, alt, fit.plot_residuals)


def _universal(fit: FitResult, curve: UniversalCurve) -> Picture:
    sigma = curve.stiffness
    normalised = fit.data.select(harmonic=1).to("dynamic_stiffness").response / sigma
    largest = float(np.max(np.abs(normalised - fit.best_fit[fit.data.harmonic == 1] / sigma)))

    def draw() -> Any:
        marks = [(b, complex(curve.response(np.array([b]))[0])) for b in _MARKED_BETA]
        return plots.plot_universal_curve(
            normalised, curve=curve.response(np.geomspace(1e-3, 1e4, 400)), marked_beta=marks
        )

    return Picture(
        "universal_curve",
        "Data divided by the fitted stiffness, and the universal curve h(beta), which every set of "
        "parameters of this law follows; numbers are beta.",
        f"Points in the complex plane along the curve; the farthest is {largest:.2g} from it, in "
        "units of the stiffness.",
        draw,
    )


def _profiles(fit: FitResult) -> Picture:
    """Return the picture of all parameters' profiles, two panels in each row."""
    optimum = fit.assessment.by_noise
    best = [f"{name} is {v:.4g}" for name, v in zip(fit.var_names, optimum.values, strict=True)]

    def draw() -> Any:
        rows = -(-fit.nvarys // 2)
        grid = new_axes(rows, 2, size=(4.8, 1.9 * rows), sharex=False)
        for index, axis in enumerate(grid.flat):
            if index < fit.nvarys:
                _draw_profile(fit.assessment.profiler, index, axis)
            else:
                axis.set_axis_off()
        return grid

    return Picture(
        "profiles",
        "Profile likelihood of each parameter, from noise alone: where the curve meets a dashed "
        "line is the limit at that confidence.",
        f"One curve for each parameter; at the minima {', '.join(best)}.",
        draw,
    )


def _draw_profile(profiler: Profiler, index: int, axis: plots.Axes) -> None:
    """Draw a profile out to its widest limit, or over three decades if that is open."""
    optimum = profiler.optimum
    name, parameter = optimum.names[index], optimum.problem.parameters[index]
    q = thresholds(optimum, np.array(LEVELS))
    best = float(optimum.theta[index])
    reach = np.log(1e3) if parameter.positive else abs(best) + 1.0
    lower, upper = (side[-1, index] for side in profiler.limits(q))
    low = lower if np.isfinite(lower) else best - reach
    high = upper if np.isfinite(upper) else best + reach
    coordinate = np.linspace(low, high, _PROFILE_POINTS)
    plots.plot_profile(
        np.exp(coordinate) if parameter.positive else coordinate,
        profiler.curve(index, coordinate),
        best=float(optimum.values[index]),
        limits={level_text(c): float(t**2) for c, t in zip(LEVELS, q, strict=True)},
        label=f"{name} [{parameter.unit}]" if parameter.unit else name,
        log=bool(parameter.positive and np.ptp(coordinate) > _STRAIGHT),
        ax=axis,
    )


def _correlation(fit: FitResult) -> Picture:
    names = fit.var_names
    matrix = np.array([[1.0 if a == b else fit.correl[a][b] for b in names] for a in names])
    i, j = np.unravel_index(np.argmax(np.abs(np.triu(matrix, 1))), matrix.shape)
    return Picture(
        "correlation",
        "Correlation of the estimates.",
        f"Matrix of numbers; the strongest correlation is {matrix[i, j]:.2f}, between {names[i]} "
        f"and {names[j]}.",
        lambda: plots.plot_correlation(names, matrix),
    )


def _information(fit: FitResult) -> Picture:
    share = shares(fit.optimum)
    x = fit.problem.stiffness_data.amplitude
    unit = si_unit("displacement", fit.data.motion)
    findings = [
        f"{name} is determined mostly at an amplitude of {x[int(np.argmax(row))]:.3g} {unit}"
        for name, row in zip(fit.var_names, share, strict=True)
        if np.isfinite(row).all()
    ]
    return Picture(
        "information",
        "Amplitudes that carry the information on each parameter: the area of a disc is the "
        "share of one point, and the largest share is written.",
        "Discs on one line for each parameter; " + "; ".join(findings) + "."
        if findings
        else "No point distinguishes the parameters.",
        lambda: plots.plot_information(
            x,
            dict(zip(fit.var_names, share, strict=True)),
            x_label=f"displacement amplitude [{unit}]",
        ),
    )


def _is_friction_alone(fit: FitResult) -> bool:
    """Return whether the data are the dynamic stiffness of one law, with exact channels."""
    elements, data = fit.model.elements, fit.data
    return (
        len(elements) == 1
        and elements[0].has_memory
        and fit.problem.sensors.are_exact
        and not curves.is_force_controlled(data)
        and bool((data.harmonic == 1).all())
        and data.quantity == "dynamic_stiffness"
        and all(not p.free or p.dimension[0] for p in elements[0].parameters)
    )


def _loops(fit: FitResult, friction: Friction) -> Picture:
    """Return the picture of the loops at the smallest, a middle and the largest amplitude."""
    sizes, measured = _measured_loops(fit, friction)
    unit, force_unit = (si_unit(kind, fit.data.motion) for kind in ("displacement", "force"))
    lost = [
        f"{with_unit(q.value, q.stderr, 'J')} at {q.amplitude:.3g} {unit}"
        for q in fit.derived(sizes.tolist())
        if q.name == ENERGY
    ]
    fitted = [friction.loop(float(A), 6 * (_LOOP_POINTS - 1) + 1) for A in sizes]
    over_amplitude = bool(sizes[-1] > _WIDE * sizes[0])

    def draw() -> Any:
        scale = sizes if over_amplitude else np.ones_like(sizes)
        loops = [
            (x / by, force, engineering(A, unit))
            for A, by, (x, force) in zip(sizes, scale, fitted, strict=True)
        ]
        return plots.plot_loops(
            loops,
            measured=[(x / by, force) for by, (x, force) in zip(scale, measured, strict=False)],
            displacement_label="displacement over amplitude"
            if over_amplitude
            else f"displacement [{unit}]",
            force_label=f"friction [{force_unit}]",
        )

    caption = "Lines: friction of the fitted element at three amplitudes of the data. "
    finding = f"A cycle loses {lost[0]} and {lost[-1]} (standard uncertainties)."
    if not measured:
        alone = bool((fit.data.harmonic == 1).all())
        why = (
            "the data hold no higher harmonics of the force"
            if alone
            else "a calibration is not exact"
        )
        caption += f"There is no measured loop, because {why}."
        return Picture("loops", caption, finding, draw)
    caption += "Dots: the sum of the measured harmonics, less the force of the other elements."
    deviations = [
        np.sqrt(np.mean((force - model[:: (model.size - 1) // (force.size - 1)]) ** 2))
        / np.abs(force).max()
        for (_, model), (_, force) in zip(fitted, measured, strict=True)
    ]
    finding += f" The measured loops are within {percent(max(deviations))} rms of the model's."
    return Picture("loops", caption, finding, draw)


def _measured_loops(
    fit: FitResult, friction: Friction
) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """Return three amplitudes, and their measured loops if harmonics were measured."""
    data = fit.data
    fundamental = data.harmonic == 1
    if fundamental.all() or not fit.problem.sensors.are_exact:
        amplitude = fit.problem.stiffness_data.amplitude[fundamental]
        return np.geomspace(amplitude.min(), amplitude.max(), 3), []
    A = data.amplitude
    assert A is not None  # harmonics belong to a displacement
    run = np.zeros(data.n) if data.run is None else np.unique(data.run, return_inverse=True)[1]
    points = np.stack([data.frequency_hz, A, run])
    rows_of = [np.flatnonzero((points[:, i] == points.T).all(axis=1)) for i in range(data.n)]
    with_harmonics = [i for i in np.flatnonzero(fundamental) if rows_of[i].size > 1]
    ranked = [with_harmonics[i] for i in np.argsort(A[with_harmonics])]
    three = [ranked[0], ranked[len(ranked) // 2], ranked[-1]]
    others = fit.best_fit - friction.dynamic_stiffness(A, 2.0 * np.pi * data.frequency_hz)
    friction_alone = np.where(fundamental, data.response - others, data.response)
    theta = np.linspace(0.0, 2.0 * np.pi, _LOOP_POINTS)
    cycles = []
    for i in three:  # rows are F_k/X_1, with X_1 real
        turning = np.exp(1j * np.outer(data.harmonic[rows_of[i]], theta))
        force = A[i] * (friction_alone[rows_of[i]] @ turning).real
        cycles.append((A[i] * np.cos(theta), force))
    return A[three], cycles


def settling(data: FrequencyResponse, record: Record) -> Picture:
    """Return the figure of how the point with the largest ratio of bias to error settled."""
    _check_origin(data, record)
    points = data.select(harmonic=1)
    assert points.covariance is not None  # extraction gives it
    assert points.amplitude is not None
    error = np.sqrt(0.5 * np.trace(points.covariance, axis1=1, axis2=2))
    excess = np.hypot(points.quality["bias_real"], points.quality["bias_imag"]) / error
    i = int(np.argmax(excess))
    f, omitted = float(points.frequency_hz[i]), int(points.quality["settling_periods"][i])
    start, end = (float(points.quality[name][i]) for name in ("start_time", "end_time"))
    response, mean = cycle_by_cycle(record, f, start - omitted / f, end)
    one_cycle = float(error[i]) * np.sqrt(max(response.size - omitted, 1))
    used = response[omitted:]
    scatter = float(np.std(used) / np.abs(np.mean(used)))
    point = f"{f:.4g} Hz, {points.amplitude[i]:.3g} {si_unit('displacement', data.motion)}"
    return Picture(
        "cycles",
        f"Settling of the point at {point}, which has the largest ratio of bias to error: "
        f"{omitted} of {response.size} cycles are left out. The grey band is two standard "
        "deviations of one cycle.",
        f"The response of the {used.size} cycles used scatters by {percent(scatter)}; the bias is "
        f"{excess[i]:.2g} standard errors.",
        lambda: plots.plot_cycles(response, mean, left_out=omitted, response_std=one_cycle),
    )


def cycle_by_cycle(
    record: Record, frequency_hz: float, start: float, end: float
) -> tuple[ComplexArray, FloatArray]:
    """Return dynamic stiffness and mean force of each whole cycle between two times."""
    omega = 2.0 * np.pi * frequency_hz
    edges = start + np.arange(np.floor((end - start) * frequency_hz + 0.5) + 1.0) / frequency_hz
    bounds = np.searchsorted(record.time, edges)
    channels = np.stack([record.motion_samples, record.force_samples], axis=-1)
    cycles = []
    for rows in itertools.starmap(slice, itertools.pairwise(bounds)):
        angle = omega * (record.time[rows] - start)
        design = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=-1)
        offset, cosine, sine = np.linalg.lstsq(design, channels[rows], rcond=None)[0]
        motion, force = cosine - 1j * sine
        cycles.append((force / motion, offset[1]))
    ratio, mean = (np.array(column) for column in zip(*cycles, strict=True))
    return ratio * (1j * omega) ** _INTEGRATIONS[record.motion_channel], mean.real


def _check_origin(data: FrequencyResponse, record: Record) -> None:
    digest = dict(record.provenance or {}).get("sha256")
    hashes = [source.sha256 for source in sources([data.provenance]) if source.sha256]
    if (
        "start_time" not in data.quality
        or len(parts([data.provenance])) > 1
        or digest not in (*hashes, None)
    ):
        raise ValidationError(
            "the data were not extracted from this record alone; give the one from which they were "
            "extracted, or none"
        )


def corner(posterior: Posterior) -> Picture:
    """Return the picture of the densities of a posterior's parameters and of pairs of them."""
    covariance = np.atleast_2d(np.cov(posterior.values.T, aweights=posterior.weights))
    correlation, _ = unit_diagonal(covariance)
    i, j = np.unravel_index(np.argmax(np.abs(np.triu(correlation, 1))), correlation.shape)
    finding = (
        f"The strongest correlation is {correlation[i, j]:.2f}, between {posterior.names[i]} and "
        f"{posterior.names[j]}."
        if len(posterior.names) > 1
        else f"One parameter, {posterior.names[0]}."
    )
    return Picture(
        "corner",
        "Posterior density of each parameter (dashed: 16, 50 and 84 %) and of each pair.",
        finding,
        posterior.plot_corner,
    )


def trace(posterior: Posterior) -> Picture:
    """Return the picture of the paths of a chain's walkers."""
    return Picture(
        "trace",
        "Paths of the walkers; the shaded warm-up is not used in any result.",
        f"{posterior.steps} steps, of which the first {posterior.warm_up} are warm-up. "
        f"{'The chain has converged' if posterior.converged else 'The chain has NOT converged'}.",
        posterior.plot_trace,
    )
