"""The result of a least-squares fit, as users hold it: report, pictures and storage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dahl_ident.diagnostics.confidence_levels import LEVELS
from dahl_ident.diagnostics.intervals import ConfidenceIntervals, Method
from dahl_ident.errors import ValidationError
from dahl_ident.results import fit_report, fit_storage
from dahl_ident.results.judged_fit import JudgedFit

if TYPE_CHECKING:
    import pandas as pd

    from dahl_ident.plots import Axes


class FitResult(JudgedFit):
    """What a fit found: estimates, their errors, and whether to trust them.

    Made by :func:`dahl_ident.fit`. Names follow lmfit's ``ModelResult`` where both have the
    same thing; the covariance is never rescaled silently: `scale` is 1 where the
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
