"""The posterior of a model's parameters, given records of any motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Literal

import numpy as np

from dahl_ident.arrays import whole_number
from dahl_ident.bayes.record_density import RecordDensity
from dahl_ident.bayes.sample import Sample
from dahl_ident.data import Record
from dahl_ident.diagnostics.bands import DerivedQuantity
from dahl_ident.diagnostics.budget import Budget
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus
from dahl_ident.diagnostics.record_errors import record_assumptions, record_derived
from dahl_ident.results.posterior_result import Posterior, doubts_of
from dahl_ident.results.record_fit import RecordBand, RecordFit
from dahl_ident.results.result import Parameters


class RecordPosterior(Posterior):
    """Draws from the posterior given records, with the verdict on whether they can be trusted.

    Made by :func:`dahl_ident.posterior`. Its parameters are the model's; states, offsets and
    drifts of the records are projected out.

    Attributes
    ----------
    fit : RecordFit
        The least-squares fit of the same records, around which the chain started.

    Examples
    --------
    >>> import dahl_ident as di
    >>> x = 1e-3 * np.cumsum(np.random.default_rng(0).standard_normal(200))
    >>> force = di.Dahl(0.1, 30.0).force(x) + 1e-3 * np.random.default_rng(1).standard_normal(200)
    >>> record = di.Record(np.arange(200) / 100.0, displacement=x, force=force)
    >>> chain = di.posterior(record, di.Dahl(), seed=1, steps=50, walkers=32)
    >>> chain.names, chain.steps
    (('f_max', 'sigma'), 50)
    """

    def __init__(self, fit: RecordFit, density: RecordDensity, sample: Sample) -> None:
        self.fit, self._density, self.sample = fit, density, sample

    @property
    def units(self) -> tuple[str, ...]:
        """SI units of the parameters."""
        return tuple(self.fit.params[p.name].unit for p in self.fit.problem.free)

    @cached_property
    def params(self) -> Parameters:
        """Every parameter of the model, posterior mean and standard deviation."""
        mean = dict(zip(self.names, self.mean().tolist(), strict=True))
        std = dict(zip(self.names, self.std().tolist(), strict=True))
        every = Parameters.of(self.fit.problem, mean, std)
        return Parameters({p.name: every[p.name] for p in self.fit.problem.model.parameters})

    @property
    def provenances(self) -> tuple[Mapping[str, Any] | None, ...]:
        """Where each record comes from."""
        return self.fit.provenances

    @property
    def _counted_fit(self) -> RecordFit:  # type: ignore[override]
        return self.fit

    @property
    def _misfits(self) -> tuple[Finding, ...]:
        return doubts_of(self.fit)

    @property
    def _notes(self) -> tuple[Finding, ...]:
        errors, note = self.fit.errors, (Question.ASSUMED, VerdictStatus.TRUSTED)
        sources = tuple(name for name, part in errors.contributions.items() if part.any())
        counted = Finding(*note, "counted", {"sources": sources})
        return (counted, record_assumptions(self.fit.problem, errors))

    def budget(self) -> Budget:
        """Return the uncertainty budget of the least-squares fit."""
        return self.fit.budget()

    def predict(
        self,
        record: Any,
        *,
        initial: Literal["fitted", "rest"] = "fitted",
        size: int = 100,
        seed: int = 0,
        **other: Any,
    ) -> RecordBand:
        """Return what another record of the same device should show, at draws.

        Parameters
        ----------
        record, initial
            As for ``RecordFit.predict``.
        size, seed : int, default 100 and 0
            Of the draws.

        Returns
        -------
        RecordBand
        """
        if other or not isinstance(record, Record):
            return self.fit.predict(record, **other)  # says what can be predicted
        outputs = []
        for values in self.draws(whole_number(size, "size", 2), seed):
            problem, full = self.fit.started(record, values, initial)
            outputs.append(problem.predict(full, 0, derivatives=False).output)
        return self.fit.band(problem, np.mean(outputs, axis=0), np.var(outputs, axis=0, ddof=1))

    def derived(
        self, amplitudes: Sequence[float] = (), frequency_hz: float | None = None
    ) -> tuple[DerivedQuantity, ...]:
        """Return x_c, energy per cycle, equivalent stiffness and damping at the posterior mean."""
        full = self.fit.optimum.values.copy()
        count = len(self.names)
        full[:count] = self.mean()
        covariance = np.zeros((full.size, full.size))
        covariance[:count, :count] = np.cov(self.values, rowvar=False)
        return record_derived(self.fit.problem, full, covariance, amplitudes, frequency_hz)
