"""The numbers of a least-squares fit, of tables and of records alike, under lmfit's names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.diagnostics.assessment import TableAssessment
from dahl_ident.diagnostics.bands import (
    DerivedQuantity,
    ResponseBand,
    describing_function_band,
    predicted_backbone,
    response_band,
)
from dahl_ident.diagnostics.budget import Budget
from dahl_ident.diagnostics.checks import judgement
from dahl_ident.diagnostics.confidence_levels import LEVELS
from dahl_ident.diagnostics.intervals import (
    ConfidenceIntervals,
    IntervalComparison,
    Method,
    compare,
)
from dahl_ident.diagnostics.judgement import Judgement
from dahl_ident.diagnostics.record_assessment import RecordAssessment
from dahl_ident.diagnostics.verdicts import Identifiability
from dahl_ident.elements import Model
from dahl_ident.errors import FitError
from dahl_ident.fitting.optimum import DeterminedCombination, Optimum
from dahl_ident.problem import refuse_options
from dahl_ident.results.result import Parameters, Result, part
from dahl_ident.units import Quantity

if TYPE_CHECKING:
    import pandas as pd


_ASSESSMENTS: Mapping[str, type[TableAssessment | RecordAssessment]] = {
    "table": TableAssessment,
    "records": RecordAssessment,
}


class FittedModel(Result):
    """A model fitted to a table or to records: its estimates, their errors, its predictions."""

    def __init__(self, optimum: Optimum, *, first_order: bool = False) -> None:
        self.optimum = optimum  #: The solver's plain result.
        #: Whether errors are only of first order, as in fits with constraints.
        self.first_order = first_order

    @cached_property
    def assessment(self) -> TableAssessment | RecordAssessment:
        """The assessment of the estimate by the data."""
        kind = _ASSESSMENTS[self.problem.kind]
        return kind(self.optimum, first_order=self.first_order)

    @cached_property
    def judgement(self) -> Judgement:
        """Every finding, and the status that follows from them."""
        return judgement(self.assessment)

    problem: Any = part("optimum.problem", "Data, model, noise, sensors as fitted.")
    method: str = part("optimum.method", "The solver.")
    message: str = part("optimum.message", "How the search ended, in words.")
    scale_known: bool = part("optimum.scale_known", "Whether the noise's scale was known.")
    ndata: int = part("problem.n_nonzero", "Real numbers: two a row, one for a mean force.")
    nfree: int = part("optimum.dof", "Degrees of freedom.")
    nfev: int = part("optimum.nfev", "Evaluations of the residuals.")
    combinations: tuple[DeterminedCombination, ...] = part(
        "optimum.combinations", "What the data determine if single parameters run away."
    )
    log_likelihood: float = part(
        "optimum.log_likelihood",
        "Log-density of the data at the optimum, at the likeliest scale where unknown; with a "
        "robust loss rho, that of the density proportional to exp(-rho/2).",
    )
    aic: float = part(
        "optimum.aic",
        "Akaike's criterion, -2 ln L + 2 k; k counts an estimated noise scale, and no parameter "
        "whose optimum lies at infinity.",
    )
    bic: float = part("optimum.bic", "Schwarz's criterion, -2 ln L + k ln(ndata); k as for `aic`.")

    # What was fitted

    data: Any = part("problem.data", "What was fitted: the table, or a tuple of the records.")
    noise: str = part(
        "problem.noise",
        "The noise model of a table; of records, whether residuals count as they are, as white "
        'noise ("white"), or filtered by their spectrum ("spectrum").',
    )

    # What the data show

    success: bool = part(
        "assessment.success", "Whether the search found an optimum; of tables, a finite one."
    )
    errors: Any = part(
        "assessment.errors", "The sources of error; None if a table does not determine them."
    )
    errors_of_combinations: Any = part(
        "assessment.errors_of_combinations",
        "Of tables: the same, also if only combinations of parameters are determined.",
    )
    goodness: Any = part("assessment.goodness", "Statistics and tests of the residuals.")
    cross_validation: Any = part(
        "assessment.cross_validation", "Of tables: held-out tests against their bands, or None."
    )
    identifiability: Identifiability = part(
        "assessment.identifiability",
        "Which parameters, or which combinations of them, the data determine.",
    )
    assumed: tuple[str, ...] = part(
        "assessment.assumed",
        "Names of parameters that the user did not give; the uncertainty counts their ranges.",
    )
    model: Model = part(
        "assessment.model", "The model with the estimates put in; free parameters stay free."
    )
    covar: FloatArray = part(
        "assessment.covar", "Covariance of the free values, by every source of error, first order."
    )
    stderr_noise: Mapping[str, float] = part(
        "assessment.stderr_noise", "Standard errors of the estimate from noise alone, by name."
    )
    residual: FloatArray = part(
        "assessment.estimate.residuals", "Whitened residuals at the estimate."
    )
    redchi: float = part(
        "assessment.redchi",
        "`chisqr` over its degrees of freedom; the squared scale if that was estimated.",
    )
    scale: float = part(
        "assessment.estimate.scale",
        "Standard deviation of the residuals: 1 if the noise is known.",
    )
    residuals: tuple[FloatArray, ...] = part(
        "assessment.residuals", "Of records: measured minus predicted, record by record."
    )
    effective_samples: float = part(
        "assessment.effective_samples",
        "Of records: number of independent samples with as much information.",
    )

    @cached_property
    def params(self) -> Parameters:
        """Every parameter by name, with combined uncertainties.

        Assumed exponents of tables have their estimates, so that the values together are a model.
        """
        return Parameters.of(self.problem, *self.assessment.known)

    @cached_property
    def best_fit(self) -> Any:
        """Prediction at the estimate: the response of each row, (n,), or a wave a record."""
        estimate = self.assessment.estimate
        return estimate.problem.fitted(estimate.theta)

    @property
    def var_names(self) -> list[str]:
        """Names of the free parameters."""
        return list(self.optimum.problem.names)

    @cached_property
    def correl(self) -> Mapping[str, Mapping[str, float]]:
        """Correlation of each pair of free parameters, by both names."""
        std = np.sqrt(np.diagonal(self.covar))
        with np.errstate(invalid="ignore", divide="ignore"):
            matrix = self.covar / np.outer(std, std)
        names = self.var_names
        return {
            a: {b: float(matrix[i, j]) for j, b in enumerate(names) if j != i}
            for i, a in enumerate(names)
        }

    @property
    def chisqr(self) -> float:
        """Sum of squared residuals; chi-square of `goodness` where the noise is known."""
        return self.assessment.chi_square[0]

    @property
    def nvarys(self) -> int:
        """Number of free parameters."""
        return len(self.optimum.names)

    # Intervals

    def conf_interval(
        self,
        method: Method = "combined",
        levels: Sequence[float] | float = LEVELS,
        *,
        replicates: int | None = None,
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
            Of the bootstrap. By default there are fewer replicates of records, as each is a search.

        Returns
        -------
        ConfidenceIntervals
            A mapping from the parameter's name to its intervals; a side on which the data set no
            limit is open. Profiles never raise, however badly a parameter is determined. If the
            fit had constraints, "combined" returns Wald intervals, and says so.

        Raises
        ------
        ValidationError
            If `method` is unknown, a level is not between 0 and 1, the fit had a robust loss and
            `method` is "bootstrap", or it had constraints and `method` is "bootstrap" or "profile".
        FitError
            If there is no optimum to repeat.
        """
        return self.assessment.intervals(method, levels, replicates, seed)

    def compare_intervals(
        self,
        methods: Sequence[Method] = ("wald", "bootstrap", "profile"),
        levels: Sequence[float] | float = LEVELS,
    ) -> IntervalComparison:
        """Return the intervals of several methods side by side, and where they disagree.

        Parameters
        ----------
        methods : sequence of str, default ("wald", "bootstrap", "profile")
            Methods that count noise alone. Each is compared with the last, which is the most
            trusted. The combined intervals come first in the table.
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
        intervals = [self.conf_interval(method, levels) for method in methods]
        return compare(self.assessment.by_noise, intervals, self.conf_interval(levels=levels))

    def budget(self) -> Budget:
        """Return the uncertainty budget: each parameter's sources, combined and expanded.

        Returns
        -------
        Budget
            Printed, a table: source, type A or B, standard uncertainty, degrees of freedom and
            share; then the combined and the expanded uncertainty.

        Raises
        ------
        FitError
            If a parameter is undetermined, or the fit had constraints.
        """
        limits = self.conf_interval().at(LEVELS[1])
        return self.assessment.budget().within({n: (i.lower, i.upper) for n, i in limits.items()})

    @cached_property
    def stated_budget(self) -> Budget | None:
        """The uncertainty budget; None if there is none."""
        try:
            return self.budget()
        except FitError:
            return None

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
            ends = limits[name]._asdict() if name in limits else {}
            rows[name] = {**asdict(p), **ends}
        frame = pd.DataFrame.from_dict(rows, orient="index").rename_axis("parameter")
        columns = ["value", "stderr", "lower", "upper", "unit", "vary", "description"]
        return frame.reindex(columns=[*columns, "init_value", "min", "max"])

    # What follows from the estimate

    def predict(
        self,
        at: Any,
        /,
        *,
        amplitude: ArrayLike | None = None,
        drive: ArrayLike | None = None,
        quantity: Quantity | None = None,
        noise: bool = True,
        initial: Literal["fitted", "rest"] = "fitted",
    ) -> Any:
        """Return what another measurement of the device should show, with its bands.

        Bands count every source of the budget, and the departure of the device from the model.

        Parameters
        ----------
        at : array_like, shape (n,), or Record
            Of a fit of a table: frequencies, Hz. Of a fit of records: another record, with the
            same channels.
        amplitude : array_like, shape (n,), optional
            Displacement amplitude, m or rad, if that is controlled.
        drive : array_like, shape (n,), optional
            Force amplitude, N or N m, if that is controlled. Give one of the two.
        quantity : str, optional
            One of the six standard quantities; by default that of the data.
        noise : bool, default True
            True: the band holds what one more test would measure, noise and scatter included.
            False: it holds the response of the device. A fit of records, which do not show the
            noise of a table, always predicts the response of the device.
        initial : {"fitted", "rest"}, default "fitted"
            Whether the state at a record's first sample and its offset are fitted, the model's
            parameters held, or taken as zero.

        Returns
        -------
        ResponseBand or RecordBand
            Sensors included: what would be measured. NaN where a drive has no steady amplitude.

        Raises
        ------
        DataError
            If the record lacks a channel.
        FitError
            If the motion grows beyond all bounds.
        ValidationError
            If the fit is of the other kind of data, both or neither of amplitude and drive are
            given, a value is not above zero, or the shapes do not go together.
        """
        if isinstance(at, Record):
            return self.assessment.predict_record(at, initial)
        optimum, _, errors = self.assessment.device
        return response_band(optimum, at, amplitude, drive, quantity, errors, of_a_test=noise)

    def simulate(self, record: Record) -> FloatArray:
        """Return the output for a record's input, from rest; its measured output is not used."""
        output: FloatArray = self.predict(record, initial="rest").output
        return output

    def hold_out(self, parts: int | None = None) -> Any:
        """Return how well parts of the data are predicted by fits to the others.

        Parameters
        ----------
        parts : int, optional
            Number of parts into which each record is cut. By default several records are left
            out as a whole, one at a time, and a single one is cut into four parts. Tests of tables
            are left out one at a time.

        Returns
        -------
        HoldOut or CrossValidation
            Each part left out in turn; printed, a table or a sentence.

        Raises
        ------
        DataError
            If a part is too short to be fitted.
        FitError
            If nothing is left to fit, or the fit had constraints.
        ValidationError
            If parts are given with a table.
        """
        refuse_options(type(self.problem), {"parts": parts}, FittedModel.hold_out)
        return self.assessment.hold_out(parts)

    def backbone(self, amplitude: ArrayLike) -> FrequencyResponse:
        """Return natural frequency and damping ratio of the estimate against amplitude.

        Parameters
        ----------
        amplitude : array_like, shape (n,)
            Displacement amplitude, m or rad.

        Returns
        -------
        FrequencyResponse
            Of the quantity "backbone", with standard deviations for the device.

        Raises
        ------
        ModelError
            If the model has no mass, or no natural frequency at an amplitude.
        """
        optimum, errors, _ = self.assessment.device
        return predicted_backbone(optimum, self.model, amplitude, errors)

    def describing_function(self, amplitude: ArrayLike) -> ResponseBand:
        """Return N(A) of the friction alone, with bands for the device.

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
        optimum, errors, _ = self.assessment.device
        return describing_function_band(optimum, amplitude, errors)

    def derived(
        self, amplitudes: Sequence[float] = (), frequency_hz: float | None = None
    ) -> tuple[DerivedQuantity, ...]:
        """Return x_c, energy per cycle, equivalent stiffness and damping, with their errors.

        Parameters
        ----------
        amplitudes : sequence of float, optional
            Amplitudes at which to return energy, stiffness and damping, m or rad.
        frequency_hz : float, optional
            For the equivalent damping, which needs it.

        Returns
        -------
        tuple of DerivedQuantity
        """
        return tuple(self.assessment.derived(amplitudes, frequency_hz))
