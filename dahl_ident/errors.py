"""The errors and warnings of this package.

All errors derive from :class:`DahlIdentError`, so one ``except`` catches all errors of the package
and nothing else. A message says what was found, what was expected and what to do.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any

__all__ = [
    "DahlIdentError",
    "DataError",
    "DataWarning",
    "ExtractionError",
    "FitError",
    "FitInterrupted",
    "MissingDependencyError",
    "ModelError",
    "MultipleSolutionsWarning",
    "NoSteadyMotionWarning",
    "SamplingError",
    "UnitError",
    "ValidationError",
]


class DahlIdentError(Exception):
    """Base class of the errors of this package.

    Examples
    --------
    >>> import dahl_ident as di
    >>> try:
    ...     di.fit(di.load_dataset("microslip"), di.Dahl() + di.Spring())
    ... except di.errors.DahlIdentError as error:
    ...     print(type(error).__name__)
    FitError
    """


class ValidationError(DahlIdentError, ValueError):
    """An argument has an invalid value, type or shape.

    Examples
    --------
    >>> import dahl_ident as di
    >>> di.FrequencyResponse(frequency_hz=[1.0], response=[30.0], amplitude=[-1e-3])
    Traceback (most recent call last):
    ...
    dahl_ident.errors.ValidationError: ...
    """


class ModelError(DahlIdentError, ValueError):
    """A model cannot be built or evaluated: clashing names, or a parameter without a value.

    Parameters
    ----------
    fault : str
        What is wrong.
    advice : str, optional
        What to do; it follows the fault in the message.

    Examples
    --------
    >>> import dahl_ident as di
    >>> di.Dahl(f_max=0.1).gain(1e-3)
    Traceback (most recent call last):
    ...
    dahl_ident.errors.ModelError: ... has no value for sigma; ...
    """

    def __init__(self, fault: str, advice: str = "") -> None:
        super().__init__(f"{fault}; {advice}" if advice else fault)
        self.fault = fault


class UnitError(DahlIdentError, ValueError):
    """A unit is missing, unknown, or of the wrong dimension.

    Examples
    --------
    >>> from dahl_ident.units import parse_unit
    >>> parse_unit("newtonne")
    Traceback (most recent call last):
    ...
    dahl_ident.errors.UnitError: [newtonne] is not a known unit: ...
    """


class DataError(DahlIdentError, ValueError):
    """A file or table cannot be used; the message names file, row and column.

    Examples
    --------
    >>> import dahl_ident as di
    >>> di.read_frequency_response("nowhere.csv")
    Traceback (most recent call last):
    ...
    dahl_ident.errors.DataError: nowhere.csv: the file cannot be read: ...
    """


class DataWarning(UserWarning):
    r"""Data that can be used but look wrong; the message names the rows.

    Examples
    --------
    Turned into an error, it stops a pipeline:

    >>> import warnings
    >>> from pathlib import Path
    >>> from tempfile import mkdtemp
    >>> import dahl_ident as di
    >>> table = Path(mkdtemp()) / "pivot.csv"
    >>> _ = table.write_text(
    ...     "frequency_hz,amplitude [um],gain [N/m],phase_deg\n1,5,30,0.5\n1,50,29,1.2\n"
    ... )
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", di.errors.DataWarning)
    ...     di.read_frequency_response(table)
    Traceback (most recent call last):
    ...
    dahl_ident.errors.DataWarning: ... is in degrees, yet no phase is above 2 pi; ...
    """


class ExtractionError(DahlIdentError, ValueError):
    """A record holds no usable sine response; the message says what it holds instead.

    Examples
    --------
    >>> import numpy as np
    >>> import dahl_ident as di
    >>> time, rest = np.arange(100) / 10.0, np.zeros(100)
    >>> di.extract(di.Record(time, displacement=rest, force=rest))
    Traceback (most recent call last):
    ...
    dahl_ident.errors.ExtractionError: no segment of constant amplitude and frequency ...
    """


class FitError(DahlIdentError, RuntimeError):
    """An estimate cannot be made, or has no finite optimum and ``throw=True``.

    Parameters
    ----------
    message : str
        What happened, and what to do.
    result : FitResult, optional
        The result as far as it is determined: status, and identifiable combinations.

    Examples
    --------
    >>> import dahl_ident as di
    >>> try:
    ...     di.fit(di.load_dataset("microslip"), di.Dahl() + di.Spring())
    ... except di.errors.FitError as error:
    ...     print(error.result.success)
    False
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
        The chain so far, if there is one.

    Examples
    --------
    >>> import dahl_ident as di
    >>> di.posterior(di.load_dataset("noisy"), di.Dahl(alpha=None) + di.Mass(), method="grid")
    Traceback (most recent call last):
    ...
    dahl_ident.errors.SamplingError: 4 parameters are free ...
    """

    def __init__(self, message: str, posterior: Any = None) -> None:
        super().__init__(message)
        self.posterior = posterior


class FitInterrupted(KeyboardInterrupt):
    """A fit to records was stopped from the keyboard; the best values so far are kept.

    Parameters
    ----------
    message : str
        What happened.
    result : FitResult
        The best values so far, with status "not described", because no minimum was reached.

    Examples
    --------
    >>> import dahl_ident as di
    >>> issubclass(di.errors.FitInterrupted, KeyboardInterrupt)
    True
    """

    def __init__(self, message: str, result: Any) -> None:
        super().__init__(message)
        self.result = result


class MissingDependencyError(DahlIdentError, ImportError):
    """An optional package is needed; the message gives the command that installs it.

    Examples
    --------
    >>> import dahl_ident as di
    >>> issubclass(di.errors.MissingDependencyError, ImportError)
    True
    """


class MultipleSolutionsWarning(UserWarning):
    """A plant with negative damping, or a gap, has several steady amplitudes; one was chosen.

    Examples
    --------
    With ``all_roots=True`` all of them are returned, without a warning:

    >>> import dahl_ident as di
    >>> plant = di.Dahl(0.1, 30.0) + di.Mass(0.3) + di.Damper(-0.05) + di.Spring(0.3)
    >>> response = di.response(plant, 0.16, 0.02, all_roots=True)
    >>> int((response.amplitude > 0.0).sum())
    3
    """


class NoSteadyMotionWarning(UserWarning):
    """Points of a response have no steady motion, or none that is stable, and hold NaN.

    Examples
    --------
    An undamped resonance, driven by more than friction can take up:

    >>> import warnings
    >>> import dahl_ident as di
    >>> plant = di.Dahl(1.0, 1.0) + di.Mass(1.0) + di.Spring(1.0)
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", di.errors.NoSteadyMotionWarning)
    ...     exists = di.response(plant, 0.5 / 3.141592653589793, 2.0).found
    >>> bool(exists)
    False
    """


def choices(known: Iterable[str], *words: object) -> str:
    """Return the known names for a message, and those similar to unknown words.

    Examples
    --------
    >>> choices(["f_max", "sigma"], "fmax")
    "f_max, sigma; did you mean 'f_max'?"
    """
    names = list(known)
    near = [repr(name) for word in words for name in get_close_matches(str(word), names, 1)]
    return ", ".join(names) + (f"; did you mean {', '.join(near)}?" if near else "")


_FIELDS: ContextVar[Mapping[str, str] | None] = ContextVar("fields", default=None)
"""None in Python; otherwise the labels of those options that a form has as fields."""


@contextmanager
def arguments_as_options(fields: Mapping[str, str] = MappingProxyType({})) -> Iterator[None]:
    """Name arguments in messages as options of the command line, or as `fields` of a form."""
    before = _FIELDS.set(fields)
    try:
        yield
    finally:
        _FIELDS.reset(before)


def names_options() -> bool:
    """Return whether messages name options or fields instead of arguments."""
    return _FIELDS.get() is not None


def name_options(on: bool) -> None:
    """Set whether messages name options, in a process that works for another one."""
    _FIELDS.set({} if on else None)


def spelled(python: str, options: str, form: str | None = None) -> str:
    """Return the text for Python, or that for the command line or a form if it is in use.

    Examples
    --------
    >>> spelled("fit(record, model)", "dahl-ident fit --record")
    'fit(record, model)'
    """
    if form is not None and _FIELDS.get():
        return form
    return options if names_options() else python


class Placeholder(str):
    """Text in a message that stands for a value of the user's choice."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


LOW, HIGH, ANY = Placeholder("low"), Placeholder("high"), Placeholder("...")


def argument(name: str, value: Any = None, *, option: str | None = None) -> str:
    """Return an argument for a message: ``name=value``, ``--name value`` or ``"Field" value``.

    A mapping becomes one option for each name; `option` is the option's name if it differs.

    Examples
    --------
    >>> argument("frequency"), argument("mode", "sweep"), argument("ranges", {"f_max": (LOW, HIGH)})
    ('frequency=', "mode='sweep'", "ranges={'f_max': (low, high)}")
    >>> with arguments_as_options():
    ...     argument("frequency"), argument("ranges", {"mass": (LOW, HIGH)})
    ('--frequency', '--ranges mass=low:high')
    >>> with arguments_as_options({"frequency": "Frequency of all rows"}):
    ...     argument("frequency", 5)
    '"Frequency of all rows" 5'
    """
    fields = _FIELDS.get() or {}
    typed = f'"{fields[name]}"' if name in fields else f"--{(option or name).replace('_', '-')}"
    if isinstance(value, Mapping):
        return spelled(
            f"{name}={dict(value)!r}",
            " ".join(f"{typed} {n}={_typed(v)}" for n, v in value.items()),
        )
    if value is None or value is True:
        return spelled(f"{name}=" + ("True" if value else ""), typed)
    return spelled(f"{name}={value!r}", f"{typed} {_typed(value)}")


def _typed(value: Any) -> str:
    if isinstance(value, tuple):
        return ":".join(map(str, value))
    return str(value) if isinstance(value, Placeholder) else shlex.quote(str(value))
