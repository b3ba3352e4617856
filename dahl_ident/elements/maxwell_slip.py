"""Maxwell slip: a few parallel Jenkins elements, in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, positive_array, whole_number
from dahl_ident.elements.element import Element, prefixed
from dahl_ident.elements.facts import (
    HistoryGradient,
    Path,
    Sine,
    StiffnessGradient,
    Values,
    each_harmonic,
)
from dahl_ident.elements.held_motion import force_along
from dahl_ident.elements.masing import Masing, jenkins
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ValidationError


class MaxwellSlip(Masing):
    """n parallel springs, each of which slips at a different displacement.

    F = sum of f_i, df_i/dx = stiffness_i, abs(f_i) <= stiffness_i slip_i. N is linear in the
    stiffnesses.

    Parameters
    ----------
    slips : int or array_like
        Slip displacements, m (rad in rotation), each > 0 and rising: fixed. Or how many there
        are: free, `slip_1` to `slip_n`, which rise in every
        estimate.
    stiffnesses : array_like, optional
        Of the springs, N/m (N m/rad), > 0. Given: fixed; left out: free.
    name : str, optional
        Prefix of the parameters' names.

    Raises
    ------
    ValidationError
        If the slip displacements are not positive and rising, or there are not as many
        stiffnesses.

    Notes
    -----
    Many elements can describe any symmetric rate-independent law that has no memory at full slip (a
    Masing law). To find such a law from data, see
    ``dahl_ident.diagnostics.slip_density.slip_density``. At an amplitude equal to a slip
    displacement, where N has a kink, derivatives are those below it.

    Examples
    --------
    >>> law = MaxwellSlip([1e-3, 4e-3], [2000.0, 500.0])
    >>> law.force([0.0, 1e-3, 2e-3, 0.0]).tolist()
    [0.0, 2.5, 3.0, -2.0]
    >>> print(f"{law.describing_function(2e-3):.3f}")
    1500.000+636.620j
    """

    kind = "maxwell_slip"
    equation = "F = sum of f_i, df_i/dx = k_i, |f_i| <= k_i d_i"

    def __init__(
        self,
        slips: int | Sequence[float] | FloatArray,
        stiffnesses: Sequence[float] | FloatArray | None = None,
        *,
        name: str | None = None,
    ) -> None:
        displacements: FloatArray | None = None
        if isinstance(slips, int):
            n = whole_number(slips, "slips", 1)
        else:
            displacements = np.atleast_1d(positive_array(slips, "slips"))
            n = displacements.size
            if displacements.ndim != 1 or np.any(np.diff(displacements) <= 0.0):
                raise ValidationError(f"slips are {list(slips)}; expected rising displacements")
        stiff = None if stiffnesses is None else positive_array(stiffnesses, "stiffnesses")
        if stiff is not None and stiff.shape != (n,):
            raise ValidationError(
                f"stiffnesses have shape {stiff.shape}; expected one for each of {n} slips"
            )
        self._name = name
        self.parameters = tuple(
            Parameter(
                prefixed(name, f"{label}_{i + 1}"), unit, f"{meaning} {i + 1}",
                None if values is None else float(values[i]), lower=0.0, transform="log",
            )
            for label, unit, meaning, values in (
                ("stiffness", "N/m", "stiffness of Jenkins element", stiff),
                ("slip", "m", "slip displacement of Jenkins element", displacements),
            )
            for i in range(n)
        )  # fmt: skip
        self.linear_parameters = self.scale_parameters = self.labels[:n]
        self.like_parts = tuple(zip(self.labels[n:], self.labels[:n], strict=True))

    @classmethod
    def from_description(cls, rest: Mapping[str, Any], name: str | None) -> Element:
        """Return the element that :meth:`describe` described."""
        n = max(1, sum(str(label).startswith("slip_") for label in rest))
        return cls(n, name=name)._described(rest)

    def backbone(self, values: Values, displacement: FloatArray) -> FloatArray:
        """Return the sum of k_i min(x, d_i)."""
        stiffnesses, slips = self.sliders(values)
        forces = [k * np.minimum(displacement, d) for k, d in zip(stiffnesses, slips, strict=True)]
        return np.asarray(sum(forces))

    @each_harmonic
    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives in closed form."""
        A = np.asarray(sine.amplitude, dtype=np.float64)
        shape = np.broadcast_shapes(*(np.shape(v) for v in (*values, A, sine.omega)))
        N = np.zeros(shape, dtype=np.complex128)
        by_A, by_k, by_d = np.zeros_like(N), [], []
        for k, d in zip(*self.sliders(values), strict=True):
            with np.errstate(divide="ignore", over="ignore"):
                unit, by_ratio = jenkins(np.asarray(d) / A, int(sine.harmonic))
            N += k * unit
            if derivatives:
                safe = np.where(A > 0.0, A, 1.0)
                slope = k * by_ratio / safe
                by_A -= slope * (d / safe)
                by_k.append(np.broadcast_to(unit, shape))
                by_d.append(np.broadcast_to(slope, shape))
        return StiffnessGradient(N, by_A, (*by_k, *by_d) if derivatives > 1 else ())

    def rest_stiffness(self, values: Values) -> FloatArray:
        """Return the sum of all stiffnesses."""
        return np.asarray(sum(np.asarray(k) for k in self.sliders(values)[0]))

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the smallest and the largest slip displacement."""
        slips = np.array(np.broadcast_arrays(*self.sliders(values)[1]))
        return slips.min(axis=0), slips.max(axis=0)

    @property
    def n_states(self) -> int:
        """The force of every spring is a state."""
        return len(self.parameters) // 2

    def sliders(self, values: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any]]:
        """Return stiffnesses and slip displacements."""
        n = len(values) // 2
        return values[:n], values[n:]

    @property
    def starts(self) -> tuple[tuple[str, str, str], ...]:  # type: ignore[override]  # as many as springs
        """A load of every spring."""
        meaning = "force of a spring at the first sample, over that at which it slips"
        return tuple((f"initial_load_{i + 1}", "", meaning) for i in range(self.n_states))

    def initial_states(self, values: Sequence[Any], starts: Sequence[Any]) -> Sequence[Any]:
        """Return the springs' forces."""
        return [k * d * load for k, d, load in zip(*self.sliders(values), starts, strict=True)]

    def history(
        self, values: Sequence[Any], path: Path, state: float | FloatArray, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample, unchecked: from a load of every spring, or of all."""
        if not isinstance(state, np.ndarray):
            return super().history(values, path, state, slopes=slopes)
        free = [i for i, p in enumerate(self.parameters) if p.free]
        return force_along(self, values, path, state, free if slopes else None)

    def __repr__(self) -> str:
        arguments = {
            self.label(p): "free" if p.value is None else f"{p.value:g}" for p in self.parameters
        }
        name = f", name={self.name!r}" if self.name else ""
        return f"MaxwellSlip({', '.join(f'{k}={v}' for k, v in arguments.items())}{name})"
