"""The text of every finding, by its code."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from string import Formatter
from typing import Any

from dahl_ident.diagnostics.confidence_levels import CONFIDENCE, coverage_factor, level_text
from dahl_ident.diagnostics.formatting import listed, p_text, with_unit
from dahl_ident.errors import argument, spelled
from dahl_ident.units import counted, percent

_MOST_ROWS = 3  # rows listed in the verdict; the details list all
_LEVEL = level_text(CONFIDENCE)


def sentence(code: str, values: Mapping[str, Any]) -> str:
    """Return a finding in words."""
    text = _TEXT[code]
    return (
        text(**values) if callable(text) else _WORDS.vformat(text, (), {"level": _LEVEL, **values})
    )


class _Words(Formatter):
    """Formatter with the additional formats of `_FIELDS`."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec in _FIELDS:
            return _FIELDS[format_spec](value)
        return str(format(value, format_spec))


_WORDS = _Words()
_FIELDS: Mapping[str, Callable[[Any], str]] = {
    "percent": percent,
    "list": listed,
    "parts": "; ".join,
}


def joined(parts: Sequence[str], most: int = 100) -> str:
    """Return at most so many parts as one text, and how many others there are."""
    others = len(parts) - most
    return "; ".join([*parts[:most], *([f"{others} more"] if others > 0 else [])])


def departures(objections: Sequence[str]) -> str:
    """Return the most serious objection, and the number of others."""
    first, *others = objections
    more = len(others)
    return f"{first}; {counted(more, 'more test')} failed" if more else first


def _are(names: Sequence[str]) -> str:
    return f"{listed(names)} {'is' if len(names) == 1 else 'are'}"


# Determined?


def _identified(identified: Sequence[str], weak: Sequence[str], by_prior: Sequence[str]) -> str:
    if weak:
        return f"Every parameter is determined, but {listed(weak)} only weakly."
    if not by_prior:
        return "Every parameter is identified."
    others = f"{_are(identified)} identified; " if identified else ""
    priors = "its prior" if len(by_prior) == 1 else "their priors"
    return f"{others}{_are(by_prior)} known from {priors}."


def _undetermined(determined: Sequence[str], weak: Sequence[str], lost: Sequence[str]) -> str:
    if weak and not determined:
        return f"Only {_are(weak)} determined, and only weakly; not {listed(lost)}."
    if not determined:
        return f"Nothing is determined of {listed(lost)}."
    weakly = f", {listed(weak)} weakly" if weak else ""
    return f"Only {_are(determined)} determined{weakly}; not {listed(lost)}."


# Described?


def _noise(rms: float, hints: Sequence[str], scatter: str) -> str:
    hint = f", with a hint that {joined(hints)}" if hints else ""
    but = f", but {scatter}" if scatter else ""
    return f"The residuals are consistent with noise ({percent(rms)} rms misfit){hint}{but}."


def _rows_apart(names: Sequence[str], rows: int, rms: float, remaining: str) -> str:
    which = joined(names, _MOST_ROWS)
    them, these, named = (
        "them",
        "these rows",
        f"Only {len(names)} of {counted(rows, 'row')} ({which}) contradict",
    )
    if len(names) == 1:
        them, these, named = "it", "this row", f"Only the row at {names[0]} contradicts"
    left = remaining[0].lower() + remaining[1:].rstrip(".")
    return (
        f"{named} the model ({percent(rms)} rms misfit): without {them} {left}. The fit includes "
        f"{these}: check {them}, or fit with {argument('loss', 'huber')}, which down-weights "
        f"{them}."
    )


def _jenkins_bound(least: float, law: bool) -> str:
    share = f"{percent(least)} (rms of the fundamental)"
    if law:
        return (
            "The best symmetric rate-independent law of parallel Jenkins elements (MaxwellSlip, "
            f"Iwan) leaves {share}."
        )
    return (
        "No symmetric rate-independent law of parallel Jenkins elements leaves less than "
        f"{share}: the rest is noise, rate, asymmetry, a gap, or a loop of another shape."
    )


def _prior_influence(name: str, width: float, ends: Sequence[str], contradicted: bool) -> str:
    if contradicted:
        return (
            f"PRIOR AGAINST DATA: {name} lies beyond 99 % of its prior's probability, at the "
            f"{ends[0]} end; check the prior, its unit, and the data."
        )
    reach = f", and it reaches the prior's {' and '.join(ends)} end" if ends else ""
    return f"{name} is known from its prior: posterior width {width:.2f} of the prior's{reach}."


def _jump(places: Sequence[tuple[float, float, float]], unit: str) -> str:
    there = [
        f"at {drive:.3g} {unit} " + (f"and {a:.4g} Hz" if a == b else f"from {a:.4g} to {b:.4g} Hz")
        for drive, a, b in places
    ]
    return (
        f"The response jumps: {listed(there)} the plant has more than one stable motion; each row "
        "there is fitted on the branch that the order of the rows follows."
    )


def _distorted_force(row: str, distortion: float, files: Sequence[str]) -> str:
    plant = ("--mass", "free", "--damping", "free", "--stiffness", "free")
    command = shlex.join(["dahl-ident", "fit", "--record", *(files or ["FILE"]), *plant])
    return (
        f"The force at {row} is {percent(distortion)} away from the sine that it is taken for; "
        f"fit the waveforms instead: {command}."
    )


# Assumed?


def _assumed(
    ranges: Sequence[Mapping[str, Any]],
    stated: Mapping[str, float],
    constraints: Sequence[str],
    exact: Sequence[str],
    noise_alone: bool,
    single_run: bool,
    passes: int = 0,
    no_drift: bool = False,
    unfound: Sequence[str] = (),
) -> str:
    parts = []
    for r in ranges:
        within = r["low"] <= r["value"] <= r["high"]
        where = "here" if within else "the data ask for"
        value = with_unit(r["value"], r["stderr"], r["unit"])
        parts.append(f"{r['name']} between {r['low']:g} and {r['high']:g} ({where} {value})")
    other = ", though it was not given: with another no motion was found"
    parts += [f"{n} = {value:g} exactly{other * (n in unfound)}" for n, value in stated.items()]
    parts += [f"the constraint {listed(constraints)}"] if constraints else []
    parts += [f"{listed(exact)} exact"] if exact else []
    parts += [f"each of {passes} passes over the levels a run of its own"] if passes else []
    drift = " without drift" if no_drift else ""
    parts += [f"a single run{drift}"] if single_run else [f"runs{drift}"] * no_drift
    if noise_alone:
        parts.append("no error but noise (stated uncertainties are from noise alone)")
    return f"Assumed: {'; '.join(parts)}."


_TEXT: Mapping[str, str | Callable[..., str]] = {
    "identified": _identified,
    "undetermined": _undetermined,
    "combinations": "Determined: {combinations:parts}.",
    "undetermined_parameters": lambda shown, why: (
        f"{'; '.join(f'{name}: {known}' for name, known in shown.items())}"
        f"{f', not determined, {why}' if why else ''}."
    ),
    "solver": "{message}",
    "no_degrees_of_freedom": lambda numbers, parameters, scale_known: (
        f"{numbers} numbers and {counted(parameters, 'parameter')} leave no degree of freedom to "
        f"judge {'the model' if scale_known else 'noise and model'}: measure more points."
    ),
    "sign": "{convention}. Do not use the numbers of this fit.",
    "rows_apart": _rows_apart,
    "misfit": lambda rms, objections, counted: (
        (
            f"The stated uncertainties include a misfit of {percent(rms)} rms: "
            if counted
            else f"The model does not describe these data ({percent(rms)} rms misfit): "
        )
        + f"{departures(objections)}."
    ),
    "large_misfit": "The misfit is {rms:percent} rms, more than half of the response: no "
    "uncertainty can be stated.",
    "too_few_points": lambda rms, dof: (
        f"With {counted(dof, 'degree of freedom')} a wrong model cannot be distinguished from "
        f"noise ({percent(rms)} rms misfit): measure more points, or repeat them so that their "
        "covariance is known."
    ),
    "one_amplitude": "One amplitude gives no more numbers than friction has parameters, so any "
    "model fits ({rms:percent} rms misfit): measure at other amplitudes as well.",
    "noise": _noise,
    "suspicious": lambda names, neighbours: (
        f"Suspicious rows: {joined(names, _MOST_ROWS)}; "
        + (
            f"without them the model describes the data, but {neighbours}: check them, or the "
            "model is wrong there."
            if neighbours
            else "check them (a robust loss down-weights these rows)."
        )
    ),
    "jenkins_bound": _jenkins_bound,
    "flagged": lambda points, every: (
        f"The extraction flagged {'every point' if every else f'{len(points)} of the points'} "
        f"fitted ({joined(points, 1)}): measure them again"
        f"{'' if every else ', or select the good ones'}."
    ),
    "beyond_limit": "At {row} the force held exceeds friction's limit ({limit}) by more than the "
    "other elements carry ({carried}): the limit is wrong, or an element is missing.",
    "beyond_slip": "At {row} friction's fundamental is {force}, more than full slip can give "
    "({limit}): an element is missing.",
    "held_out": lambda tests, available, gains, phases, rows, width: (
        f"Without each of {tests}{f' of {available}' * (tests != available)} tests in turn, "
        f"{gains} of {rows} held-out gains and {phases} of {rows} phases of fundamentals are "
        f"inside their {_LEVEL} bands (half width {percent(width)})."
    ),
    "narrow_bands": "The {level} bands (half width {width:percent}) do not cover the misfit "
    "({misfit:percent} rms): no uncertainty can be stated.",
    "constraint": lambda texts, rise, noise_known, p_value: (
        f"The data contradict the constraint {listed(texts)} ({p_text(p_value)}): it raises the "
        f"sum of squares by {rise:.3g} times the {'known' if noise_known else 'estimated'} "
        "variance of the noise. Check the constraint, or the model."
    ),
    "prior": lambda name, value, mean, std: (
        f"The data contradict the prior of {name}: {value:.4g} against {mean:g} ± {std:g}, "
        f"{abs(value - mean) / std:.1f} standard deviations: check the calibration, or the model."
    ),
    "beyond_range": lambda name, value, stderr, low, high: (
        f"The data ask for {name} = {with_unit(value, stderr, '')}, beyond the range that is "
        f"assumed ({low:g} to {high:g}): estimate it ({spelled(f'{name}=None', f'{name}=free')}), "
        "or use another law."
    ),
    "moved": lambda names, rows: (
        f"A robust fit moves {listed(names)} by more than one standard uncertainty: check the "
        f"{'suspicious rows' if rows else 'rows with the largest residuals'}, or fit with "
        f"{argument('loss', 'huber')}."
    ),
    "negative": lambda name, value, stderr, unit, instead: (
        f"{name} is negative ({with_unit(value, stderr or None, unit)}), as of no device: it "
        f"stands for what the model lacks, and is not {instead}."
    ),
    "slight": lambda name, value, stderr, unit, share, misfit: (
        f"{name} = {with_unit(value, stderr, unit)} rests on {percent(share)} rms of the force, "
        f"less than the model misses ({percent(misfit)}): give it, or leave it out."
    ),
    "steady": "The force was held, and the exact steady motion fitted; the describing function "
    "would be up to {difference:percent} off, at {row}.",
    "jump": _jump,
    "unstable_rows": lambda rows: (
        f"The predicted motion is not stable at {listed(rows)}: the device moves otherwise there, "
        f"and the steady response cannot describe {'it' if len(rows) == 1 else 'them'}; leave "
        f"{'this row' if len(rows) == 1 else 'these rows'} out."
    ),
    "distorted_force": _distorted_force,
    "no_steady_motion": "The force was held, but the describing function predicts the motion: the "
    "plant would drive itself, and no steady motion is there.",
    "describing_function": "The force was held, but the describing function predicts the motion: "
    "{why}.",
    "records_not_described": lambda rms: (
        f"The model does not describe the records ({percent(rms)} rms misfit)"
        + (
            ": at rest it would miss less. Check the values given, or give initial ones, "
            f"{argument('start', {'f_max': 0.1})}."
            if rms > 1.0
            else "."
        )
    ),
    "motion_may_be_imposed": lambda: (
        "If the exciter imposed the motion, fit the force instead "
        f"({argument('output', 'force', option='predicted')}): what it moves hardly depends on the "
        "force, and the model cannot follow it."
    ),
    "records_misfit": lambda follows, remedy: (
        "The misfit exceeds the noise"
        + (f": the residuals follow {follows}; {remedy}." if follows else ".")
    ),
    "slow_misfit": "The residuals, {rms:percent} rms, vary slowly. So does some noise, and so does "
    "the error of a law that is not right: the records cannot tell which it is.",
    "unphysical": "Physically doubtful: {objection}.",
    "stated_exponent": "The records contradict {name} = {held:g}, which was stated: they ask for "
    "{wanted}.",
    "few_effective_samples": "The residuals are so slow that they are worth {effective:.0f} "
    "samples, few for {unknowns} unknowns: record for longer.",
    "clipped": "The {channel} is clipped in {share:percent} of the samples: it repeats an extreme "
    "value exactly, in spite of its noise. Measure again with a larger range.",
    "delay": lambda delay, samples, doubtful: (
        f"The motion {'lags' if delay > 0.0 else 'leads'} the force by {abs(samples):.2g} samples "
        f"({abs(delay):.2g} s): taken out."
        + doubtful
        * " A damper missing in the model acts alike; state the sensors' delay."
    ),
    "record_residuals": "The residuals are {rms:percent} rms of the measured {output}; {worst}.",
    "slow_residuals": "Most of this varies slowly, as noise in the drive causes it: {rms:percent} "
    "rms remains at the drive's frequencies, and the residuals are weighted by their spectrum.",
    "displacement_noise": "The displacement's noise of {noise:.2g} {unit} (standard deviation) is "
    "{treatment}; it would add {travel:percent} of travel, and the residuals are smaller without "
    "it. A quieter displacement would determine more.",
    "effective_samples": lambda effective, samples: (
        "Error bars take the residuals' correlation into account: "
        f"{effective:.0f} effective of {counted(samples, 'sample')}."
    ),
    "not_converged": "{message}",
    "sampled": "{message}",
    "prior_influence": _prior_influence,
    "predictive_check": "{text}",
    "counted": "Counted: {sources:parts}.",
    "noise_alone": "Noise alone is counted; with every source of its budget, u of the fit is "
    "{compared:list}.",
    "evidence": "ln evidence: {ln:.4f}",
    "warning": "Warning on reading: {text}.",
    "more_warnings": lambda count: f"{counted(count, 'more warning')} on reading.",
    "few_runs": lambda k, runs: (
        f"The scatter of {runs} runs has {counted(runs - 1, 'degree of freedom')}, so the coverage "
        f"factor k is up to {k:.3g}"
        + (f"; with another run, about {less:.2g}." if (less := coverage_factor(runs)) < k else ".")
    ),
    "assumed": _assumed,
}
