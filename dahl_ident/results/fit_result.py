"""The result of a least-squares fit: its numbers, and how far to trust them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.diagnostics.bands import (
    DerivedQuantity,
    ResponseBand,
    derived,
    describing_function_band,
    response_band,
)
from dahl_ident.diagnostics.bootstrap import REPLICATES, bootstrap_intervals
from dahl_ident.diagnostics.budget import Budget, budget
from dahl_ident.diagnostics.confidence_levels import LEVELS, checked_levels
from dahl_ident.diagnostics.cross_validation import CrossValidation, cross_validation
from dahl_ident.diagnostics.goodness import Goodness, goodness
from dahl_ident.diagnostics.intervals import (
    METHODS,
    ConfidenceIntervals,
    IntervalComparison,
    Method,
    combined_intervals,
    compare,
    profile_intervals,
    wald_intervals,
)
from dahl_ident.diagnostics.statements import statements, verdict_status
from dahl_ident.diagnostics.verdict_status import VerdictStatus
from dahl_ident.diagnostics.verdicts import Identifiability, judged
from dahl_ident.errors import ValidationError
from dahl_ident.fitting.optimum import Optimum
from dahl_ident.results import fit_report, fit_storage
from dahl_ident.results.fit_numbers import FitNumbers
from dahl_ident.units import Quantity

if TYPE_CHECKING:
    import pandas as pd

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
    success, message : bool, str
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

    _called = "a fit"

    def __init__(self, optimum: Optimum, *, first_order: bool = False) -> None:
        super().__init__(optimum)
        self._first_order = first_order
        self._intervals: dict[tuple[Any, ...], ConfidenceIntervals] = {}

    # Judging

    def conf_interval(
        self,
        method: Method = "combined",
        levels: Sequence[float] | float = LEVELS,
        *,
        replicates: int = REPLICATES,
        seed: int = 0,
    ) -> ConfidenceIntervals:
        """Return confidence intervals of every free parameter.

        Parameters
        ----------
        method : {"combined", "profile", "wald", "bootstrap"}, default "combined"
            "combined" counts every source of the budget, the others noise alone; see
            :mod:`dahl_ident.diagnostics.intervals`, which says what to use when.
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
        if method == "combined":
            profile = self.conf_interval("profile", levels)
            return combined_intervals(profile, self._optimum, self.errors)
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
        return judged(self._optimum, self.conf_interval("profile"), self.errors)

    @cached_property
    def goodness(self) -> Goodness:
        """Whether the residuals are noise, and the estimates physically possible."""
        return goodness(self._optimum)

    @cached_property
    def cross_validation(self) -> CrossValidation | None:
        """Held-out tests against their bands; None without tests to hold out."""
        return None if self.errors is None else cross_validation(self.errors)

    @cached_property
    def status(self) -> VerdictStatus:
        """Whether the numbers can be used."""
        return verdict_status(self)

    @cached_property
    def _budget(self) -> Budget:
        return budget(self._optimum, self.errors)

    def budget(self) -> Budget:
        """Return the uncertainty budget: each parameter's sources, combined and expanded.

        Returns
        -------
        Budget
            Printed, a table: source, type A or B, standard uncertainty, degrees of freedom and
            share; then the combined and the expanded uncertainty.
        """
        return self._budget

    @property
    def findings(self) -> tuple[str, ...]:
        """What the tests of residuals and values remark."""
        return tuple(self.goodness.warnings)

    @cached_property
    def statements(self) -> tuple[str, ...]:
        """The verdict sentence by sentence: the first says whether to trust, the others why."""
        return statements(self)

    # What follows from the estimate

    def predict(
        self,
        frequency_hz: ArrayLike,
        *,
        amplitude: ArrayLike | None = None,
        drive: ArrayLike | None = None,
        quantity: Quantity | None = None,
        noise: bool = True,
    ) -> ResponseBand:
        """Return the response that the estimate predicts, with its bands.

        Bands count every source of the budget, and what the device departs from the model.

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
        noise : bool, default True
            The band holds what one more test would measure, its noise and scatter included;
            False: the device's response itself.

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
        return response_band(
            self._optimum, frequency_hz, amplitude, drive, quantity, self.errors, of_a_test=noise
        )

    def describing_function(self, amplitude: ArrayLike) -> ResponseBand:
        """Return N(A) of the friction alone, with bands that hold the device's.

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
            If the model has no friction law.
        """
        return describing_function_band(self._optimum, amplitude, self.errors)

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
        return tuple(derived(self._optimum, amplitudes, frequency_hz, self.errors))

    # Telling

    def fit_report(
        self, method: Method = "combined", level: float = 0.9545, *, details: bool = True
    ) -> str:
        """Return the report as text, the verdict first.

        Parameters
        ----------
        method : {"combined", "profile", "wald", "bootstrap"}, default "combined"
            How the intervals are made.
        level : float, default 0.9545
            Their confidence level.
        details : bool, default True
            False: verdict and parameters alone, on at most 15 lines.

        Returns
        -------
        str
        """
        return fit_report.fit_report(self, self._reported(method, level), details=details)

    def _reported(self, method: Method, level: float) -> ConfidenceIntervals:
        if level in LEVELS:
            return self.conf_interval(method).only(level)
        return self.conf_interval(method, (level,))

    def __str__(self) -> str:
        return self.fit_report()

    def _repr_html_(self) -> str:
        return fit_report.as_html(self, self._reported("combined", LEVELS[1]))

    def summary(self) -> pd.DataFrame:
        """Return a table, one row a parameter, with its combined 95.45 % interval.

        Returns
        -------
        pandas.DataFrame
            Columns ``value, stderr, lower, upper, unit, vary, description, init_value, min, max``.
        """
        import pandas as pd

        limits = self.conf_interval().at(LEVELS[1])
        rows = {}
        for name, p in self.params.items():
            known = {"lower": limits[name].lower, "upper": limits[name].upper} if p.vary else {}
            rows[name] = {**asdict(p), **known}
        found = pd.DataFrame.from_dict(rows, orient="index").rename_axis("parameter")
        columns = ["value", "stderr", "lower", "upper", "unit", "vary", "description"]
        return found.reindex(columns=[*columns, "init_value", "min", "max"])

    def plot(self, kind: str | None = None, ax: Any = None) -> Any:
        """Draw the fit.

        Parameters
        ----------
        kind : {"fit", "residuals", "budget"}, optional
            "fit" (the default): data and fit, see :meth:`plot_fit`. "residuals": see
            :meth:`plot_residuals`. "budget": shares of the uncertainty as bars.
        ax : matplotlib Axes, or two of them for "fit", optional
            New ones where left out.

        Returns
        -------
        Axes, or a tuple of Axes
        """
        if kind in (None, "fit"):
            return self.plot_fit(ax)
        if kind == "residuals":
            return self.plot_residuals(ax)
        if kind == "budget":
            from dahl_ident.plots import plot_budget

            table = self.budget()
            shares = [(name, row.source, row.share) for name in table for row in table[name].rows]
            return plot_budget(shares, ax=ax)
        raise ValidationError(f"kind is {kind!r}; expected fit, residuals or budget")

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
        from dahl_ident.results.fit_plots import draw_fit

        return draw_fit(self, ax)

    def plot_residuals(
        self,
        ax: Axes | None = None,
        *,
        against: Literal["amplitude", "frequency", "velocity"] | None = None,
    ) -> Axes:
        """Draw the residuals of every row, suspicious points ringed.

        Parameters
        ----------
        against : {"amplitude", "frequency", "velocity"}, optional
            What to draw them over: the amplitude of displacement, the frequency, or the amplitude
            of velocity. By default amplitude or frequency, as suits the table.
        ax : matplotlib Axes, optional
            New where left out.

        Returns
        -------
        Axes
        """
        from dahl_ident.results.fit_plots import draw_residuals

        return draw_residuals(self, against, ax)

    # Storage

    def to_json(self) -> str:
        """Return the fit as JSON: data, model, noise, sensors and optimum."""
        return fit_storage.to_json(self._optimum, self._first_order)

    @classmethod
    def from_json(cls, text: str) -> FitResult:
        """Return the fit that :meth:`to_json` wrote, also by an earlier version.

        Raises
        ------
        DataError
            If the text holds no fit, or one of a later version's schema.
        """
        optimum, first_order = fit_storage.from_json(text)
        return cls(optimum, first_order=first_order)

    @classmethod
    def load(cls, path: str | Path) -> FitResult:
        """Return the fit that :meth:`save` wrote, also by an earlier version.

        Raises
        ------
        DataError
            If the file cannot be read, holds no fit, or one of a later version's schema.
        """
        optimum, first_order = fit_storage.load(path)
        return cls(optimum, first_order=first_order)

    def __repr__(self) -> str:
        estimates = ", ".join(str(self.params[name]) for name in self.var_names)
        return f"<FitResult: {estimates}; {self._optimum.status.name.lower()}>"
