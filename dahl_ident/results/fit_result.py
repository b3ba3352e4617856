"""The result of a least-squares fit: its numbers, and how far to trust them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.data.storage import place_of, write_whole
from dahl_ident.diagnostics.bands import (
    DerivedQuantity,
    ResponseBand,
    derived,
    describing_function_band,
    response_band,
)
from dahl_ident.diagnostics.bootstrap import REPLICATES, bootstrap_intervals
from dahl_ident.diagnostics.goodness import Goodness, goodness
from dahl_ident.diagnostics.intervals import (
    METHODS,
    ConfidenceIntervals,
    IntervalComparison,
    Method,
    compare,
    profile_intervals,
    wald_intervals,
)
from dahl_ident.diagnostics.levels import LEVELS, checked_levels
from dahl_ident.diagnostics.verdicts import Identifiability, judged
from dahl_ident.errors import ValidationError
from dahl_ident.fitting.optimum import Optimum
from dahl_ident.results import report, storage
from dahl_ident.results.fit_numbers import FitNumbers
from dahl_ident.units import Quantity

if TYPE_CHECKING:
    from dahl_ident.plots import Axes


class FitResult(FitNumbers):
    """What a fit found: estimates, their errors, and whether to trust them.

    Made by :func:`dahl_ident.fit`. Names follow lmfit's ``ModelResult`` where both have the
    same thing; nothing rescales the covariance behind the user's back: `scale` is 1 where the
    noise is known, else estimated and reported.

    Attributes
    ----------
    params : mapping of str to Estimate
        Every parameter of model and sensors, fixed ones included.
    var_names : list of str
        The free ones; they order `covar`.
    covar : ndarray, shape (nvarys, nvarys)
        Covariance of the free values, first order; the noise's scale is in it.
    residual : ndarray, shape (m,)
        Whitened residuals, two a row of data (in units of the noise where its scale is known),
        then those of priors.
    chisqr, redchi : float
        Sum of squared residuals, and the same over `nfree`.
    aic, bic : float
        From the likelihood, with a robust loss from that which it stands for; an estimated noise
        scale counts as a parameter, one at infinity does not.
    ndata, nvarys, nfree, nfev : int
        Real numbers measured (two a row), free parameters, degrees of freedom, evaluations.
    scale, scale_known : float, bool
        The noise's scale, and whether it was known beforehand.
    success, message, status : bool, str, Status
        Whether a finite optimum was found, and how the search ended.
    best_fit : ndarray of complex, shape (n,)
        Predicted response at the estimate.
    model : Model
        The model with the estimates put in.

    Examples
    --------
    >>> import dahl_ident as di
    >>> fit = di.fit(di.load_dataset("noisy"), di.Dahl())
    >>> fit.trusted, round(fit.params["f_max"].value, 3)
    (True, 0.1)
    """

    def __init__(self, optimum: Optimum, *, first_order: bool = False) -> None:
        super().__init__(optimum)
        self._first_order = first_order
        self._intervals: dict[tuple[Any, ...], ConfidenceIntervals] = {}

    # Judging

    def conf_interval(
        self,
        method: Method = "profile",
        levels: Sequence[float] | float = LEVELS,
        *,
        replicates: int = REPLICATES,
        seed: int = 0,
    ) -> ConfidenceIntervals:
        """Return confidence intervals of every free parameter.

        Parameters
        ----------
        method : {"profile", "wald", "bootstrap"}, default "profile"
            See :mod:`dahl_ident.diagnostics.intervals`, which says what to use when.
        levels : float or sequence of float, default 0.6827, 0.9545, 0.9973
            Confidence levels.
        replicates, seed : int
            Of the bootstrap.

        Returns
        -------
        ConfidenceIntervals
            A mapping from the parameter's name to its intervals; a side on which the data set no
            limit is open. Profiles never raise, however badly a parameter is determined. Where
            the fit had constraints or noise in the drive, intervals are those of Wald.

        Raises
        ------
        ValidationError
            If `method` is unknown, a level is not between 0 and 1, or repetitions of a fit with
            a robust loss are wanted.
        FitError
            If there is no optimum to repeat.
        """
        if method not in METHODS:
            raise ValidationError(f"method is {method!r}; expected one of {', '.join(METHODS)}")
        levels = tuple(checked_levels(levels).tolist())
        key = (method, levels, replicates, seed)
        if key not in self._intervals:
            self._intervals[key] = self._new_intervals(method, levels, replicates, seed)
        return self._intervals[key]

    def intervals_run(self, level: float) -> list[ConfidenceIntervals]:
        """Return the intervals at a level of every method that has been asked for until now."""
        found = (one for one in self._intervals.values() if np.isclose(one.levels, level).any())
        return list({one.method: one for one in found}.values())

    def _new_intervals(
        self, method: Method, levels: Sequence[float], replicates: int, seed: int
    ) -> ConfidenceIntervals:
        if self._first_order:
            note = "first order: the fit had constraints or noise in the drive"
            return wald_intervals(self._optimum, levels).noted(note)
        if method == "bootstrap":
            return bootstrap_intervals(self._optimum, levels, replicates, seed)
        quick = wald_intervals if method == "wald" else profile_intervals
        return quick(self._optimum, levels)

    def compare_intervals(
        self,
        methods: Sequence[Method] = ("wald", "bootstrap", "profile"),
        levels: Sequence[float] | float = LEVELS,
    ) -> IntervalComparison:
        """Return the intervals of several methods side by side, and where they disagree.

        Parameters
        ----------
        methods : sequence of str, default ("wald", "bootstrap", "profile")
            The last is the most trusted; each of the others is compared with it.
        levels : float or sequence of float, default 0.6827, 0.9545, 0.9973
            Confidence levels.

        Returns
        -------
        IntervalComparison
            Printed, a table with the disagreements.

        Raises
        ------
        ValidationError
            If there are fewer than two methods, one is unknown, or a level is impossible.
        """
        return compare(self._optimum, [self.conf_interval(method, levels) for method in methods])

    @cached_property
    def identifiability(self) -> Identifiability:
        """Which parameters, or which combinations of them, the data determine."""
        return judged(self._optimum, self.conf_interval())

    @cached_property
    def goodness(self) -> Goodness:
        """Whether what is left is noise, and what was fitted is physics."""
        return goodness(self._optimum)

    @property
    def trusted(self) -> bool:
        """Whether there is an optimum, every parameter is identified, and the residuals noise."""
        return bool(
            self.success
            and self.nfree > 0
            and self.goodness.acceptable
            and self.identifiability.complete
        )

    @property
    def verdict(self) -> str:
        """Whether to trust the numbers, in words, with what speaks against it."""
        return " ".join(self.statements)

    @cached_property
    def statements(self) -> tuple[str, ...]:
        """The verdict in its parts: the first is what to remember, the others say why."""
        return report.statements(self)

    # What follows from the estimate

    def predict(
        self,
        frequency_hz: ArrayLike,
        *,
        amplitude: ArrayLike | None = None,
        drive: ArrayLike | None = None,
        quantity: Quantity | None = None,
    ) -> ResponseBand:
        """Return the response that the estimate predicts, with its bands.

        Parameters
        ----------
        frequency_hz : array_like, shape (n,)
            Hz.
        amplitude : array_like, shape (n,), optional
            Displacement amplitude, m or rad, where that is controlled.
        drive : array_like, shape (n,), optional
            Force amplitude, N or N m, where that is controlled. Give one of the two.
        quantity : str, optional
            One of the six standard quantities; left out, that of the data.

        Returns
        -------
        ResponseBand
            Sensors included: what would be measured. NaN where a drive has no steady amplitude.

        Raises
        ------
        ValidationError
            If both or neither of amplitude and drive are given, a value is not above zero, or
            the shapes do not go together.
        """
        return response_band(self._optimum, frequency_hz, amplitude, drive, quantity)

    def describing_function(self, amplitude: ArrayLike) -> ResponseBand:
        """Return N(A) of the friction alone, with its bands.

        Parameters
        ----------
        amplitude : array_like
            Displacement amplitude, m or rad.

        Returns
        -------
        ResponseBand

        Raises
        ------
        ModelError
            If the model has no Dahl element.
        """
        return describing_function_band(self._optimum, amplitude)

    def derived(
        self, amplitudes: Sequence[float] = (), frequency_hz: float | None = None
    ) -> tuple[DerivedQuantity, ...]:
        """Return x_c, energy per cycle, equivalent stiffness and damping, with their errors.

        Parameters
        ----------
        amplitudes : sequence of float, optional
            Where energy, stiffness and damping are wanted, m or rad.
        frequency_hz : float, optional
            For the equivalent damping; left out, there is none.

        Returns
        -------
        tuple of DerivedQuantity
        """
        return tuple(derived(self._optimum, amplitudes, frequency_hz))

    # Telling

    def fit_report(self, method: Method = "profile", level: float = 0.9545) -> str:
        """Return the whole report as text, the verdict first.

        Parameters
        ----------
        method : {"profile", "wald", "bootstrap"}, default "profile"
            How the intervals are made.
        level : float, default 0.9545
            Their confidence level.

        Returns
        -------
        str
        """
        return report.fit_report(self, self._reported(method, level))

    def _reported(self, method: Method, level: float) -> ConfidenceIntervals:
        if level in LEVELS:
            return self.conf_interval(method).only(level)
        return self.conf_interval(method, (level,))

    def __str__(self) -> str:
        return self.fit_report()

    def _repr_html_(self) -> str:
        return report.as_html(self, self._reported("profile", LEVELS[1]))

    def to_frame(self) -> Any:
        """Return a pandas table: one row a parameter, with its 95.45 % profile interval."""
        import pandas as pd

        limits = self.conf_interval().at(LEVELS[1])
        rows = []
        for name, p in self.params.items():
            known = {"lower": limits[name].lower, "upper": limits[name].upper} if p.vary else {}
            rows.append({**asdict(p), **known})
        return pd.DataFrame(rows).set_index("name")

    def plot_fit(self, ax: Sequence[Axes] | None = None) -> tuple[Axes, Axes]:
        """Draw data and fit, gain above phase, over amplitude or frequency.

        Parameters
        ----------
        ax : sequence of two matplotlib Axes, optional
            New ones where left out.

        Returns
        -------
        tuple of Axes
        """
        from dahl_ident.results.drawing import draw_fit

        return draw_fit(self, ax)

    def plot_residuals(self, ax: Axes | None = None) -> Axes:
        """Draw the residuals of every row, suspicious points ringed.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            New where left out.

        Returns
        -------
        Axes
        """
        from dahl_ident.results.drawing import draw_residuals

        return draw_residuals(self, ax)

    # Storage

    def to_json(self) -> str:
        """Return the fit as JSON: data, model, noise, sensors and optimum."""
        return storage.to_json(self._optimum, self._first_order)

    @classmethod
    def from_json(cls, text: str) -> FitResult:
        """Return the fit that :meth:`to_json` wrote, also by an earlier version.

        Raises
        ------
        DataError
            If the text holds no fit, or one of a later version's schema.
        """
        optimum, first_order = storage.from_json(text)
        return cls(optimum, first_order=first_order)

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the fit to a file that :meth:`load` reads.

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
        place = place_of(path, "a fit", storage.FORMATS)
        write_whole(place, self.to_json().encode(), overwrite=overwrite)
        return place

    @classmethod
    def load(cls, path: str | Path) -> FitResult:
        """Return the fit that :meth:`save` wrote, also by an earlier version.

        Raises
        ------
        DataError
            If the file cannot be read, holds no fit, or one of a later version's schema.
        """
        optimum, first_order = storage.load(path)
        return cls(optimum, first_order=first_order)

    def __repr__(self) -> str:
        estimates = ", ".join(str(self.params[name]) for name in self.var_names)
        return f"<FitResult: {estimates}; {self.status.name.lower()}>"
