"""What a problem refuses before it looks at a number."""

from __future__ import annotations

from dahl_ident.data import FrequencyResponse
from dahl_ident.errors import DataError, ValidationError
from dahl_ident.sensors import Prior


def checked_table(data: object) -> FrequencyResponse:
    """Return `data` if it is a table, or say what it is instead."""
    if isinstance(data, FrequencyResponse):
        return data
    raise DataError(
        f"data is a {type(data).__name__}; expected a FrequencyResponse, as "
        "read_frequency_response gives it, or extract from a Record"
    )


def normal_moments(name: str, prior: Prior) -> tuple[float, float]:
    """Return mean and standard deviation of a normal prior, the only kind least squares takes."""
    kind = getattr(getattr(prior, "dist", None), "name", type(prior).__name__)
    if kind != "norm":
        raise ValidationError(
            f"the prior of {name} is {kind}; least squares takes normal priors "
            "(scipy.stats.norm), any other needs sampling"
        )
    return float(prior.mean()), float(prior.std())
