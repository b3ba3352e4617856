"""The common interface of results: parameters, verdicts, predictions, plots and storage."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from numpy.typing import ArrayLike

from dahl_ident.data.storage import place_of, write_whole
from dahl_ident.diagnostics.bands import DerivedQuantity
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.verdict_status import VerdictStatus
from dahl_ident.units import Quantity

if TYPE_CHECKING:
    import pandas as pd

    from dahl_ident.diagnostics import Budget

FORMATS = (".json",)


@dataclass(frozen=True)
class Estimate:
    """One parameter of a fit.

    Attributes
    ----------
    name, unit, description : str
        As declared beside the element; the unit is that of the data's motion.
    value : float
        The estimate, or the fixed value.
    stderr : float or None
        Standard error, first order (Wald); infinite where undetermined, None where fixed.
    init_value : float or None
        The start that the user gave.
    min, max : float
        Bounds.
    vary : bool
        Whether it was estimated.
    """

    name: str
    unit: str
    description: str
    value: float
    stderr: float | None
    init_value: float | None
    min: float
    max: float
    vary: bool

    @classmethod
    def of_scale(cls, value: float, stderr: float) -> Estimate:
        """Return the estimate of an unknown noise scale."""
        return cls("noise_scale", "", "noise scale", value, stderr, None, 0.0, math.inf, True)

    def __str__(self) -> str:
        if not self.vary:
            return f"{self.name} = {self.value:g} {self.unit}".rstrip() + " (fixed)"
        return f"{self.name} = {with_unit(self.value, self.stderr, self.unit)}"


class Result(ABC):
    """The outcome of an estimation: of a fit, a Markov chain, a grid, or a fit to a record.

    Examples
    --------
    >>> import dahl_ident as di
    >>> data = di.load_dataset("noisy")
    >>> for result in (di.fit(data, di.Dahl()), di.posterior(data, di.Dahl(), method="grid")):
    ...     print(result.status, result.params["f_max"])
    trusted f_max = 0.10002 +- 0.00039 N
    trusted f_max = 0.10002 +- 0.00039 N
    """

    _called: ClassVar[str] = "a result"

    @property
    @abstractmethod
    def status(self) -> VerdictStatus:
        """Trusted, approximate, not determined, or not described."""

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the numbers."""
        return self.status is VerdictStatus.TRUSTED

    @property
    @abstractmethod
    def statements(self) -> tuple[str, ...]:
        """The verdict sentence by sentence: the first says whether to trust, the others why."""

    @property
    def verdict(self) -> str:
        """Whether to trust the numbers, in words, and what speaks against it."""
        return " ".join(self.statements)

    @property
    @abstractmethod
    def findings(self) -> tuple[str, ...]:
        """Further statements on data, model and assumptions."""

    @property
    @abstractmethod
    def params(self) -> Mapping[str, Estimate]:
        """Every parameter by name, fixed ones included."""

    @abstractmethod
    def summary(self) -> pd.DataFrame:
        """Return a table, one row a parameter."""

    @abstractmethod
    def budget(self) -> Budget:
        """Return the uncertainty budget: each parameter's sources, combined and expanded."""

    @abstractmethod
    def predict(
        self,
        frequency_hz: Any,
        /,
        *,
        amplitude: ArrayLike | None = None,
        drive: ArrayLike | None = None,
        quantity: Quantity | None = None,
    ) -> Any:
        """Return the response at other frequencies, or another record, with its bands."""

    @abstractmethod
    def derived(
        self, amplitudes: Sequence[float] = (), frequency_hz: float | None = None
    ) -> tuple[DerivedQuantity, ...]:
        """Return x_c, energy per cycle, equivalent stiffness and damping, with their errors."""

    @abstractmethod
    def plot(self, kind: str | None = None, ax: Any = None) -> Any:
        """Draw the result; each class names its kinds."""

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
            Replace a file that is there already.

        Returns
        -------
        Path
            The file, complete; an interrupted run leaves none.

        Raises
        ------
        ValidationError
            If the ending is another one.
        DataError
            If a file is there already, or the place cannot be written to.
        """
        place = place_of(path, self._called, FORMATS)
        write_whole(place, self.to_json().encode(), overwrite=overwrite)
        return place
