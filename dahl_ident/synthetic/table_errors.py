"""Tables of response as extracted by a laboratory, with their errors.

With the true phasors X and F and relative errors e of each part, the table holds
F (1 + e_F) over X (1 + e_X) and the amplitude |X (1 + e_X)|, so that response and amplitude share
the displacement's error, and the covariance includes this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray, non_negative_number, whole_number
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.columns import one_of
from dahl_ident.errors import ValidationError
from dahl_ident.steady_state import STEADY, Steady
from dahl_ident.synthetic.randomness import Draws


@dataclass(frozen=True)
class Table:
    """Request for a table of response with given errors.

    Parameters
    ----------
    displacement_std, force_std : float, default 0
        Relative standard deviation of the real and of the imaginary part of each phasor; of
        the fundamental's size for higher harmonics.
    harmonics : sequence of int, default (1,)
        Harmonics that get a row: of the force where displacement is controlled, of the
        displacement, up to 9, where the force is.
    outlier_fraction : float, default 0
        Share of the rows, chosen at random, with a gross error.
    outlier_size : float, default 0.5
        That error relative to the response, in a random direction of the complex plane.
    steady : {"exact", "describing function"}, default "exact"
        Where force is controlled: the motion of the plant, or what the paper's describing function
        makes of it, which no plant does.

    Raises
    ------
    ValidationError
        If a value is not as said here.

    Examples
    --------
    >>> Table(force_std=0.01).harmonics
    (1,)
    """

    displacement_std: float = 0.0
    force_std: float = 0.0
    harmonics: Sequence[int] = (1,)
    outlier_fraction: float = 0.0
    outlier_size: float = 0.5
    steady: Steady = "exact"

    def __post_init__(self) -> None:
        for name in ("displacement_std", "force_std", "outlier_fraction", "outlier_size"):
            object.__setattr__(self, name, non_negative_number(getattr(self, name), name))
        one_of(self.steady, "steady", STEADY)
        if self.outlier_fraction > 1.0:
            raise ValidationError(
                f"outlier_fraction is {self.outlier_fraction!r}; expected a share from 0 to 1"
            )
        harmonics = tuple(whole_number(k, "harmonics", 1) for k in self.harmonics)
        if not harmonics:
            raise ValidationError("harmonics is empty; expected at least the fundamental, (1,)")
        object.__setattr__(self, "harmonics", harmonics)

    def outlier_rows(self, rows: int, draws: Draws) -> list[int]:
        """Return the rows that get a gross error, rising."""
        count = round(self.outlier_fraction * rows)
        return sorted(draws.permutation("outlier rows", rows)[:count])


class Phasors(NamedTuple):
    """The measured phasors of each row, without noise; F_k, or X_k, is referred to t = 0."""

    frequency_hz: FloatArray
    level: FloatArray
    harmonic: NDArray[np.int64]
    step: NDArray[np.int64]
    displacement: ComplexArray
    force: ComplexArray
    displacement_size: FloatArray
    force_size: FloatArray


def stiffness_table(phasors: Phasors, table: Table, draws: Draws) -> FrequencyResponse:
    """Return F_k/X_1, its phase referred to k times the displacement's (displacement held)."""
    k = phasors.harmonic
    X = _shared_error("displacement", phasors.displacement, table.displacement_std, phasors, draws)
    F = _own_error("force", phasors.force, table.force_std * phasors.force_size, draws)
    response = _referred(F, X, k)
    # of the true response: a covariance that followed each row's error would bias every fit
    true = _referred(phasors.force, phasors.displacement, k)
    force_part = table.force_std * phasors.force_size / np.abs(phasors.displacement)
    covariance = _covariance(true, k, table.displacement_std, force_part)
    data = FrequencyResponse(
        phasors.frequency_hz, response, np.abs(X), harmonic=k, level=phasors.level,
        controlled="displacement",
    )  # fmt: skip
    return _finished(data, covariance, -true, np.abs(phasors.displacement), table, draws)


def receptance_table(phasors: Phasors, table: Table, draws: Draws) -> FrequencyResponse:
    """Return X_k/F_1, its phase referred to k times the force's (force held)."""
    k = phasors.harmonic
    X = _own_error(
        "displacement", phasors.displacement, table.displacement_std * phasors.displacement_size,
        draws,
    )  # fmt: skip
    F = _shared_error("force", phasors.force, table.force_std, phasors, draws)
    amplitude = np.abs(X)[np.flatnonzero(k == 1)[phasors.step]]
    response = _referred(X, F, k)
    # of the true response: a covariance that followed each row's error would bias every fit
    true = _referred(phasors.displacement, phasors.force, k)
    motion_part = table.displacement_std * phasors.displacement_size / np.abs(phasors.force)
    covariance = _covariance(true, k, table.force_std, motion_part)
    data = FrequencyResponse(
        phasors.frequency_hz, response, amplitude, np.abs(F), level=phasors.level, harmonic=k,
        controlled="force", quantity="receptance",
    )  # fmt: skip
    shared = np.where(k == 1, true, 0.0)
    return _finished(data, covariance, shared, phasors.displacement_size, table, draws)


def _covariance(
    true: ComplexArray, k: NDArray[np.int64], shared_std: float, std: FloatArray
) -> FloatArray:
    """Return the covariance of responses: the error of what was held, and that of the answer."""
    along, across = true, 1j * k * true  # changes with the size of what was held, and its phase
    shared = shared_std**2 * (_outer(along) + _outer(across))
    return np.asarray(shared + std[:, None, None] ** 2 * np.eye(2))


def _referred(answer: ComplexArray, held: ComplexArray, k: NDArray[np.int64]) -> ComplexArray:
    """Return a harmonic over the size of what was held, turned by k times its phase."""
    return np.asarray(answer / np.abs(held) * np.exp(-1j * k * np.angle(held)))


def _shared_error(
    name: str, held: ComplexArray, std: float, phasors: Phasors, draws: Draws
) -> ComplexArray:
    """Return the phasors with one relative error for all rows of a step."""
    steps, which = np.unique(phasors.step, return_inverse=True)
    return np.asarray(
        held * (1.0 + std * _complex_normal(f"{name} phasor", steps.size, draws)[which])
    )


def _own_error(name: str, answer: ComplexArray, std: FloatArray, draws: Draws) -> ComplexArray:
    """Return the phasors with an error for every row."""
    turned = np.exp(1j * np.angle(answer))
    return np.asarray(answer + std * turned * _complex_normal(f"{name} phasor", answer.size, draws))


def _finished(
    data: FrequencyResponse,
    covariance: FloatArray,
    with_amplitude: ComplexArray,
    amplitude: FloatArray,
    table: Table,
    draws: Draws,
) -> FrequencyResponse:
    """Add the covariance of the errors, and the outliers, which it does not include."""
    rows = table.outlier_rows(data.n, draws)
    angle = 2.0 * np.pi * draws.uniform("outlier direction", data.n)[rows]
    response = data.response.copy()
    response[rows] *= 1.0 + table.outlier_size * np.exp(1j * angle)
    data = replace(data, response=response)
    if data.amplitude is None or table.displacement_std == table.force_std == 0.0:
        return data
    shared = table.displacement_std**2 * amplitude * with_amplitude
    return replace(
        data,
        covariance=covariance,
        dof=np.full(data.n, np.inf),
        amplitude_std=table.displacement_std * amplitude,
        amplitude_covariance=np.column_stack([shared.real, shared.imag]),
    )


def _complex_normal(purpose: str, n: int, draws: Draws) -> ComplexArray:
    return np.asarray(
        draws.normal(f"{purpose}, real", n) + 1j * draws.normal(f"{purpose}, imaginary", n)
    )


def _outer(v: ComplexArray) -> FloatArray:
    """Return the (n, 2, 2) products of a complex vector's parts with each other."""
    parts = np.column_stack([v.real, v.imag])
    return np.asarray(parts[:, :, None] * parts[:, None, :])
