"""Every failure that a user can meet, by name.

All derive from :class:`DahlIdentError`, so one ``except`` catches the toolkit's own errors
and nothing else. A message says what was found, what was expected and what to do.
"""

from __future__ import annotations

from typing import Any

__all__ = [
    "DahlIdentError",
    "DataError",
    "DataWarning",
    "ExtractionError",
    "FitError",
    "MissingDependencyError",
    "ModelError",
    "MultipleSolutionsWarning",
    "SamplingError",
    "UnitError",
    "ValidationError",
]


class DahlIdentError(Exception):
    """Base of every error that this package raises on purpose."""


class ValidationError(DahlIdentError, ValueError):
    """An argument has a value, type or shape that gives no meaningful number."""


class ModelError(DahlIdentError, ValueError):
    """A model cannot be built or evaluated: clashing names, or a parameter without a value."""


class UnitError(DahlIdentError, ValueError):
    """A unit is missing, unknown, or of the wrong dimension."""


class DataError(DahlIdentError, ValueError):
    """A file or table cannot be used; the message names file, row and column."""


class DataWarning(UserWarning):
    """Data that can be used but look wrong; the message lists the rows."""


class ExtractionError(DahlIdentError, ValueError):
    """A record holds no usable sine response; the message says what it holds instead."""


class FitError(DahlIdentError, RuntimeError):
    """An estimate cannot be made, or has no finite optimum and ``throw=True``.

    Parameters
    ----------
    message : str
        What happened, and what to do.
    result : FitResult, optional
        What was found all the same: status, and the combinations that are determined.
    """

    def __init__(self, message: str, result: Any = None) -> None:
        super().__init__(message)
        self.result = result


class SamplingError(DahlIdentError, RuntimeError):
    """A Markov chain cannot be run, resumed or used.

    Parameters
    ----------
    message : str
        What happened, and what to do.
    posterior : Posterior, optional
        The chain all the same, where there is one.
    """

    def __init__(self, message: str, posterior: Any = None) -> None:
        super().__init__(message)
        self.posterior = posterior


class MissingDependencyError(DahlIdentError, ImportError):
    """An optional package is needed; the message gives the command that installs it."""


class MultipleSolutionsWarning(UserWarning):
    """A plant with negative damping has several steady amplitudes, and one was chosen."""
