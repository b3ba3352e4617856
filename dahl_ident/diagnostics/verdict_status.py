"""What a result may be used for, in one word."""

from __future__ import annotations

from enum import StrEnum


class VerdictStatus(StrEnum):
    """The judgement of a result; its value is what users read."""

    TRUSTED = "trusted"
    """Every parameter is determined and the model describes the data."""
    APPROXIMATE = "approximate"
    """The model misses more than noise, and the stated uncertainty includes it."""
    NOT_DETERMINED = "not determined"
    """The data leave a parameter open, or the computation has not converged."""
    NOT_DESCRIBED = "not described"
    """The model misses the data so far that no uncertainty can be stated."""

    @property
    def usable(self) -> bool:
        """Whether the numbers hold with their stated uncertainty."""
        return self in (VerdictStatus.TRUSTED, VerdictStatus.APPROXIMATE)
