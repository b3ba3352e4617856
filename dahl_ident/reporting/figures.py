"""The pictures of a report, each with a caption and a text that states its finding."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident import plots
from dahl_ident.arrays import FloatArray
from dahl_ident.data.quantities import polar_std
from dahl_ident.diagnostics.information import shares
from dahl_ident.diagnostics.levels import LEVELS, percent, thresholds
from dahl_ident.diagnostics.profile import Profiler
from dahl_ident.elements import Dahl
from dahl_ident.elements.linear_dahl import describing_function
from dahl_ident.plots import style
from dahl_ident.reporting.document import Picture
from dahl_ident.reporting.predictions import (
    displacement_amplitude,
    held_amplitude,
    is_force_controlled,
    over_amplitude,
    over_frequency,
)
from dahl_ident.units import si_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dahl_ident.data import FrequencyResponse
    from dahl_ident.results import FitResult

_LOOPS = 3
_SAME_FREQUENCY = 5e-3  # relative
_WIDE = 20.0  # of amplitudes beyond which loops are drawn over displacement / amplitude
_MARKED_BETA = (0.3, 1.0, 2.2, 5.0, 20.0)
_STRAIGHT = 1.5  # log of a profile's range beyond which its axis is logarithmic


def pictures_of_fit(fit: FitResult) -> Iterator[Picture]:
    """Yield what a fit has to show."""
    yield _response(fit)
    yield _residuals(fit)
    friction = [e for e in fit.model.elements if isinstance(e, Dahl)]
    if _is_linear_dahl_alone(fit) and fit.success:
        yield _universal(fit, friction[0])
    if len(friction) == 1 and _all_finite(fit):
        yield _loops(fit, friction[0])
    if fit.success:
        yield from (_profile(fit, i) for i in range(fit.nvarys))
    if fit.nvarys > 1 and np.isfinite(fit.covar).all():
        yield _correlation(fit)
    yield _information(fit)


def _response(fit: FitResult) -> Picture:
    data = fit.data.select(harmonic=1)
    gain, phase = data.gain, np.degrees(data.phase)
    worst = float(np.abs(_whitened_pairs(fit)).max())
    alt = (
        f"Gain of the data from {gain.min():.3g} to {gain.max():.3g} {data.unit}, phase from "
        f"{phase.min():.1f} to {phase.max():.1f} degrees; the farthest point lies {worst:.1f} "
        "standard deviations from the fit."
    )
    if len(_groups(data)) == 1 and not _over_frequency(data):
        caption = (
            "Data with error bars and fit over amplitude. The band is the "
            f"{percent(LEVELS[1])} confidence band of the fit."
        )
        return Picture("response", caption, alt, partial(_draw_amplitudes, fit))
    over = "frequency, by level" if _over_frequency(data) else "amplitude, by frequency"
    caption = f"Data (points) and fit (lines) over {over}."
    return Picture("response", caption, alt, partial(_draw_groups, fit))


def _draw_amplitudes(fit: FitResult) -> Figure:
    data = fit.data.select(harmonic=1)
    gain_std = phase_std = None
    if data.covariance is not None:
        gain_std, phase_std = polar_std(data.response, data.covariance)
    elif fit.noise == "relative":
        gain_std, phase_std = fit.scale * data.gain, np.full(data.n, fit.scale)
    top, _ = plots.plot_amplitude_response(
        held_amplitude(data),
        data.response,
        gain_std=gain_std,
        phase_std=phase_std,
        curve=over_amplitude(fit, data),
        amplitude_label=_held_label(data),
        gain_label=_gain_label(data),
    )
    return _figure(top)


def _draw_groups(fit: FitResult) -> Figure:
    """Draw one curve a level over frequency, or one a frequency over amplitude."""
    data = fit.data.select(harmonic=1)
    groups = _groups(data)
    fine = over_frequency if _over_frequency(data) else over_amplitude
    curves = [fine(fit, part) for _, part in groups if part.n > 1]
    top, _ = plots.plot_frequency_response(
        [(label, _abscissa(part, data)[0], part.response) for label, part in groups],
        fitted=[(curve.amplitude, curve.response) for curve in curves],
        gain_label=_gain_label(data),
        x_label=_abscissa(data, data)[1],
    )
    return _figure(top)


def _groups(data: FrequencyResponse) -> list[tuple[str, FrequencyResponse]]:
    """Return the parts of the data that make one curve each, with their labels."""
    if _over_frequency(data):
        parts = [(_level(label, data), data.select(level=label)) for label in data.levels]
        return parts or [("", data)]
    nominal = _nominal_frequency(data.frequency_hz)
    return [(f"{f:.4g} Hz", data.select(rows=nominal == f)) for f in np.unique(nominal)]


def _residuals(fit: FitResult) -> Picture:
    pairs = _whitened_pairs(fit)
    beyond = int(np.sum(np.abs(pairs) > 3.0))
    alt = (
        f"{pairs.size} residuals with a standard deviation of {pairs.std():.2f}; {beyond} of them "
        f"beyond three standard deviations. {fit.goodness.headline}"
    )
    caption = (
        "Residuals of every point; the grey band is two standard deviations, suspicious points "
        "are ringed."
    )
    return Picture("residuals", caption, alt, lambda: _figure(fit.plot_residuals()))


def _universal(fit: FitResult, friction: Dahl) -> Picture:
    sigma = fit.params[friction.parameters[1].name].value
    normalised = fit.data.select(harmonic=1).to("dynamic_stiffness").response / sigma
    off = float(np.max(np.abs(normalised - fit.problem.predict(fit.optimum.theta) / sigma)))

    def draw() -> Figure:
        beta = np.geomspace(1e-3, 1e4, 400)
        marks = [(b, complex(describing_function(np.array([b]))[0])) for b in _MARKED_BETA]
        return _figure(
            plots.plot_universal_curve(
                normalised, curve=describing_function(beta), marked_beta=marks
            )
        )

    return Picture(
        "universal_curve",
        "Data over the fitted sigma on the universal curve h(beta); numbers are beta. Data off "
        "the curve are not linear Dahl friction.",
        f"The farthest point lies {off:.2g} from the curve, where 1 is the response at rest.",
        draw,
    )


def _loops(fit: FitResult, friction: Dahl) -> Picture:
    amplitude = displacement_amplitude(fit.data.select(harmonic=1))
    sizes = np.geomspace(amplitude.min(), amplitude.max(), _LOOPS)
    unit = si_unit("displacement", fit.data.motion)
    energy = [float(v) for v in friction.dissipated_energy(sizes)]

    normal = sizes[-1] > _WIDE * sizes[0]

    def draw() -> Figure:
        loops = []
        for A in sizes.tolist():
            x, force = friction.loop(A)
            loops.append((x / A if normal else x, force, style.engineering(A, unit)))
        label = "displacement over amplitude" if normal else f"displacement [{unit}]"
        force_label = f"friction [{si_unit('force', fit.data.motion)}]"
        return _figure(plots.plot_loops(loops, displacement_label=label, force_label=force_label))

    return Picture(
        "loops",
        "Friction of the fitted element over displacement, at the smallest, a middle and the "
        "largest amplitude of the data.",
        f"A cycle loses {energy[0]:.3g} J at {sizes[0]:.3g} {unit} and {energy[-1]:.3g} J at "
        f"{sizes[-1]:.3g} {unit}.",
        draw,
    )


def _profile(fit: FitResult, index: int) -> Picture:
    name = fit.var_names[index]
    estimate = fit.params[name]
    parameter = fit.problem.parameters[index]

    def draw() -> Figure:
        profiler = Profiler(fit.optimum)
        q = thresholds(fit.optimum, np.array(LEVELS))
        coordinate = _profile_range(fit, index, profiler, q)
        values = np.exp(coordinate) if parameter.transform == "log" else coordinate
        return _figure(
            plots.plot_profile(
                values,
                profiler.curve(index, coordinate),
                best=estimate.value,
                limits={percent(c): float(t**2) for c, t in zip(LEVELS, q, strict=True)},
                label=_with_unit(name, estimate.unit),
                log=bool(np.ptp(coordinate) > _STRAIGHT and parameter.transform == "log"),
            )
        )

    return Picture(
        f"profile_{name}",
        f"Profile likelihood of {name}: where the curve meets a dashed line is the limit at that "
        "confidence.",
        f"The best {name} is {estimate.value:.4g} {estimate.unit}.",
        draw,
    )


def _profile_range(
    fit: FitResult, index: int, profiler: Profiler, q: FloatArray, points: int = 41
) -> FloatArray:
    """Return search coordinates out to the widest limit; three decades where it is open."""
    lower, upper = (side[-1, index] for side in profiler.limits(q))
    best = float(fit.optimum.theta[index])
    reach = np.log(1e3) if fit.problem.parameters[index].transform == "log" else abs(best) + 1.0
    low = lower if np.isfinite(lower) else best - reach
    high = upper if np.isfinite(upper) else best + reach
    return np.linspace(low, high, points)


def _correlation(fit: FitResult) -> Picture:
    names = fit.var_names
    matrix = np.array([[1.0 if a == b else fit.correl[a][b] for b in names] for a in names])
    i, j = np.unravel_index(np.argmax(np.abs(np.triu(matrix, 1))), matrix.shape)
    return Picture(
        "correlation",
        "Correlation of the estimates.",
        f"The strongest correlation is {matrix[i, j]:.2f}, between {names[i]} and {names[j]}.",
        lambda: _figure(plots.plot_correlation(names, matrix)),
    )


def _information(fit: FitResult) -> Picture:
    share = shares(fit.optimum)
    x, label = fit.data.frequency_hz, "frequency [Hz]"
    if not _over_frequency(fit.data):
        x = displacement_amplitude(fit.data)
        label = f"displacement amplitude [{si_unit('displacement', fit.data.motion)}]"
    places = [
        f"{name} is told most by the point at {x[int(np.argmax(row))]:.3g}"
        for name, row in zip(fit.var_names, share, strict=True)
        if np.isfinite(row).all()
    ]
    return Picture(
        "information",
        "Which points carry the information on which parameter.",
        "; ".join(places) + "." if places else "No point tells the parameters apart.",
        lambda: _figure(
            plots.plot_information(x, dict(zip(fit.var_names, share, strict=True)), x_label=label)
        ),
    )


def _whitened_pairs(fit: FitResult) -> FloatArray:
    """Return the residuals of each row in standard deviations, shape (n, 2)."""
    scale = 1.0 if fit.scale_known or not fit.scale > 0.0 else fit.scale
    return fit.residual[: fit.ndata].reshape(-1, 2) / scale


def _abscissa(part: FrequencyResponse, data: FrequencyResponse) -> tuple[FloatArray, str]:
    """Return the numbers of some rows on the axis that suits the whole table."""
    if _over_frequency(data):
        return part.frequency_hz, "frequency [Hz]"
    return held_amplitude(part), _held_label(part)


def _over_frequency(data: FrequencyResponse) -> bool:
    """Return whether a curve over frequency suits the data better than one over amplitude."""
    parts = [data.select(level=label) for label in data.levels] or [data]
    return all(
        2 * np.unique(_nominal_frequency(part.frequency_hz)).size > part.n > 1 for part in parts
    )


def _nominal_frequency(f: FloatArray) -> FloatArray:
    """Return frequencies that differ by measurement alone as one; those of a fine grid as given."""
    order = np.argsort(f)
    jump = np.diff(f[order], prepend=f[order][0]) > _SAME_FREQUENCY * f[order]
    group = np.empty(f.size, dtype=int)
    group[order] = np.cumsum(jump)
    members = [f[group == g] for g in range(group.max() + 1)]
    if any(np.ptp(m) > 2.0 * _SAME_FREQUENCY * m.min() for m in members):
        return f
    return np.array([np.median(m) for m in members])[group]


def _is_linear_dahl_alone(fit: FitResult) -> bool:
    elements = fit.model.elements
    alone = len(elements) == 1 and isinstance(elements[0], Dahl) and "alpha" not in fit.var_names
    exact = fit.problem.sensors.are_exact and not is_force_controlled(fit.data)
    whole = bool((fit.data.harmonic == 1).all()) and fit.data.quantity == "dynamic_stiffness"
    return alone and exact and whole and fit.params[elements[0].parameters[2].name].value == 1.0


def _all_finite(fit: FitResult) -> bool:
    return all(np.isfinite(estimate.value) for estimate in fit.params.values())


def _held_label(data: FrequencyResponse) -> str:
    kind = "force" if is_force_controlled(data) else "displacement"
    return f"{kind} amplitude [{si_unit(kind, data.motion)}]"


def _gain_label(data: FrequencyResponse) -> str:
    return f"{data.quantity.replace('_', ' ')} [{data.unit}]"


def _level(label: Any, data: FrequencyResponse) -> str:
    if isinstance(label, (int, float)):
        kind = "force" if is_force_controlled(data) else "displacement"
        return style.engineering(float(label), si_unit(kind, data.motion))
    return "" if label is None else str(label)


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _figure(axes: Any) -> Figure:
    figure: Figure = np.ravel(np.asarray(axes, dtype=object))[0].figure
    return figure
