"""Maxwell slip: a few parallel Jenkins elements, in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np

from dahl_ident.arrays import FloatArray, positive_array, whole_number
from dahl_ident.elements.facts import (
    HistoryGradient,
    Path,
    Sine,
    StiffnessGradient,
    Values,
    each_harmonic,
)
from dahl_ident.elements.force_law import prefixed
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
        The slip displacements, m (rad in rotation), > 0 and rising, which are then fixed. Or their
        number n: then `slip_1` to `slip_n` are free, and rise in every estimate.
    stiffnesses : array_like, optional
        Stiffnesses of the springs, N/m (N m/rad), > 0. Given: fixed; left out: free.
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
        d: FloatArray | None = None
        if isinstance(slips, int):
            n = whole_number(slips, "slips", 1)
        else:
            d = np.atleast_1d(positive_array(slips, "slips"))
            n = d.size
            if d.ndim != 1 or np.any(np.diff(d) <= 0.0):
                raise ValidationError(f"slips are {list(slips)}; expected rising displacements")
        k = None if stiffnesses is None else positive_array(stiffnesses, "stiffnesses")
        if k is not None and k.shape != (n,):
            raise ValidationError(
                f"stiffnesses have shape {k.shape}; expected one for each of {n} slips"
            )
        self.name = name
        self.parameters = tuple(
            Parameter(
                prefixed(name, f"{label}_{i + 1}"),
                unit,
                f"{meaning} {i + 1}",
                None if values is None else float(values[i]),
                lower=0.0,
                transform="log",
            )
            for label, unit, meaning, values in (
                ("stiffness", "N/m", "stiffness of Jenkins element", k),
                ("slip", "m", "slip displacement of Jenkins element", d),
            )
            for i in range(n)
        )
        self.linear_parameters = self.scale_parameters = self.labels[:n]
        self.like_parts = tuple(zip(self.labels[n:], self.labels[:n], strict=True))

    @classmethod
    def from_description(cls, description: Mapping[str, Any], name: str | None) -> Self:
        """Return the element that :meth:`describe` described."""
        n = max(1, sum(str(label).startswith("slip_") for label in description))
        return cls(n, name=name)._described(description)

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
                nonzero = np.where(A > 0.0, A, 1.0)
                slope = k * by_ratio / nonzero
                by_A -= slope * (d / nonzero)
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
        """Number of springs; the force of each is a state."""
        return len(self.parameters) // 2

    def sliders(self, values: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any]]:
        """Return stiffnesses and slip displacements."""
        n = len(values) // 2
        return values[:n], values[n:]

    @property
    def starts(self) -> tuple[tuple[str, str, str], ...]:  # type: ignore[override]  # as many as springs
        """One load for each spring."""
        meaning = "force of a spring at the first sample, over that at which it slips"
        return tuple((f"initial_load_{i + 1}", "", meaning) for i in range(self.n_states))

    def initial_states(self, values: Sequence[Any], starts: Sequence[Any]) -> Sequence[Any]:
        """Return the springs' forces."""
        return [k * d * load for k, d, load in zip(*self.sliders(values), starts, strict=True)]

    def history(
        self, values: Sequence[Any], path: Path, state: float | FloatArray, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample; `state` is one load of all springs, or one of each."""
        if not isinstance(state, np.ndarray):
            return super().history(values, path, state, slopes=slopes)
        free = [i for i, p in enumerate(self.parameters) if p.free]
        return force_along(self, values, path, state, free if slopes else None)
