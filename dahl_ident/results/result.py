"""The common interface of results: parameters, verdicts, predictions, plots and storage."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from dahl_ident.data.storage import place_of, write_whole
from dahl_ident.diagnostics.formatting import (
    html_table,
    pair,
    rounded,
    symbol,
    tabular,
    unit,
    with_unit,
)
from dahl_ident.diagnostics.judgement import Finding, Judgement, VerdictStatus
from dahl_ident.problem import Problem
from dahl_ident.units import shown_unit

if TYPE_CHECKING:
    from dahl_ident.diagnostics import Budget

FORMATS = (".json",)


@dataclass(frozen=True)
class Estimate:
    """One parameter of a fit: name, unit and description as the element declares them."""

    name: str
    unit: str  # that of the data's motion
    description: str
    value: float  # the estimate, or the fixed value
    stderr: float | None  # first order (Wald); infinite where undetermined, None where fixed
    init_value: float | None  # the start that the user gave
    min: float  # bounds
    max: float
    vary: bool  # whether it was estimated

    def __str__(self) -> str:
        if not self.vary and self.stderr is None:
            return f"{self.name} = {self.value:g} {self.unit}".rstrip() + " (fixed)"
        assumed = "" if self.vary else " (assumed)"
        return f"{self.name} = {with_unit(self.value, self.stderr, self.unit)}{assumed}"


class Parameters(dict[str, Estimate]):
    r"""The parameters of a result by name; shown as a table, also in notebooks.

    Examples
    --------
    >>> import dahl_ident as di
    >>> fit = di.fit(di.load_dataset("noisy"), di.Dahl(alpha=1.0))
    >>> print(fit.params.to_latex().splitlines()[4])
    $f_\mathrm{max}$ & $0.09982$ & $0.00031$ & N \\
    """

    @classmethod
    def of(
        cls, problem: Problem, values: Mapping[str, float], stderr: Mapping[str, float]
    ) -> Parameters:
        """Return every parameter of a problem, with the values that were estimated."""
        estimates = {}
        for p in problem.all_parameters:
            value = values.get(p.name, p.value)
            estimates[p.name] = Estimate(
                p.name,
                shown_unit(p.unit, problem.motion),
                p.description,
                math.nan if value is None else value,
                stderr.get(p.name),
                init_value=p.value if p.name in values else None,
                min=p.lower,
                max=p.upper,
                vary=bool(p.free),
            )
        return cls(estimates)

    def __repr__(self) -> str:
        return "\n".join(map(str, self.values()))

    def _repr_html_(self) -> str:
        rows = []
        for p in self.values():
            fixed = (f"{p.value:g}", "fixed")
            rows.append(
                (p.name, *(fixed if p.stderr is None else rounded(p.value, p.stderr)), p.unit)
            )
        return html_table(("", "value", "u", "unit"), rows)

    def to_latex(self) -> str:
        """Return a table of values and standard uncertainties; it needs no package of LaTeX."""
        rows = [
            (symbol(p.name), *pair(p.value, p.stderr if p.vary else None), unit(p.unit))
            for p in self.values()
        ]
        return tabular(("", "value", "$u$", "unit"), rows)


def part(path: str, text: str) -> Any:
    """Return a property that reads an attribute of a part of the result."""
    return property(attrgetter(path), doc=text)


class Result(ABC):
    """The outcome of an estimation: of a fit, a Markov chain, a grid, or a fit to a record.

    Examples
    --------
    >>> import dahl_ident as di
    >>> data = di.load_dataset("noisy")
    >>> law = di.Dahl(alpha=1.0)
    >>> for result in (di.fit(data, law), di.posterior(data, law, method="grid")):
    ...     print(result.status, result.params["f_max"])
    trusted f_max = 0.09982 ± 0.00031 N
    trusted f_max = 0.09982 ± 0.00031 N
    """

    _called: ClassVar[str] = "a result"

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy, without values computed from it."""
        kind = type(self)
        return {
            name: value
            for name, value in vars(self).items()
            if not isinstance(getattr(kind, name, None), cached_property)
        }

    @property
    @abstractmethod
    def judgement(self) -> Judgement:
        """Every finding about the numbers, and the status that follows from them."""

    @property
    def status(self) -> VerdictStatus:
        """Trusted, approximate, not determined, or not described."""
        return self.judgement.status

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the numbers."""
        return self.status is VerdictStatus.TRUSTED

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings about data, model and assumptions, the most serious first."""
        return self.judgement.findings

    @property
    def statements(self) -> tuple[str, ...]:
        """The findings in words: the first says whether to trust, the others why."""
        return self.judgement.statements

    @property
    def verdict(self) -> str:
        """Whether to trust the numbers, in words, and what speaks against it."""
        return " ".join(self.statements)

    @property
    @abstractmethod
    def params(self) -> Mapping[str, Estimate]:
        """Every parameter by name, fixed ones included."""

    @property
    @abstractmethod
    def problem(self) -> Problem:
        """Data, model, noise and sensors."""

    @property
    def provenances(self) -> tuple[Mapping[str, Any] | None, ...]:
        """Where the data come from: one for the table, or one for each record."""
        return tuple(self.problem.provenances)

    @abstractmethod
    def budget(self) -> Budget:
        """Return the uncertainty budget: each parameter's sources, combined and expanded."""

    @abstractmethod
    def to_json(self) -> str:
        """Return the result as JSON text."""

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write :meth:`to_json` to a file.

        Parameters
        ----------
        path : path
            Ending in ``.json``.
        overwrite : bool, default False
            Replace an existing file.

        Returns
        -------
        Path
            The file, complete; an interrupted run leaves none.

        Raises
        ------
        ValidationError
            If `path` has another ending.
        DataError
            If the file exists, or cannot be written.
        """
        place = place_of(path, self._called, FORMATS)
        write_whole(place, self.to_json().encode(), overwrite=overwrite)
        return place

    def export(
        self,
        to: str,
        path: str | Path | None = None,
        *,
        overwrite: bool = False,
        size: int = 1000,
        seed: int = 0,
    ) -> str | Path:
        """Return the result as other programs read it, or write it to a file.

        Parameters
        ----------
        to : str
            "mujoco" and "mujoco-frictionloss" (MJCF), "urdf", "modelica", "matlab", "c" (the
            friction force as a function), "gtc" (uncertain numbers with influences), "ufloat",
            "latex", or "draws" (a table of parameter values for domain randomisation). A
            posterior has only "draws".
        path : path, optional
            File; draws as ``.csv`` or ``.parquet``. Left out: the text is returned.
        overwrite : bool, default False
            Replace an existing file.
        size, seed : int
            Number of draws, and seed of their random numbers.

        Returns
        -------
        str or Path

        Raises
        ------
        ModelError
            If the format does not carry a law of the model.
        FitError
            If a parameter has no finite value or, where that is exported, no finite uncertainty.
        ValidationError
            If the format is unknown.

        Examples
        --------
        >>> import dahl_ident as di
        >>> fit = di.fit(di.load_dataset("noisy"), di.Dahl(alpha=1.0) + di.Damper(1e-3))
        >>> print(fit.export("urdf").splitlines()[-1])
        <dynamics damping="0.001" friction="0.0997..."/>
        """
        from dahl_ident.results.export import export

        return export(self, to, path, overwrite=overwrite, size=size, seed=seed)
