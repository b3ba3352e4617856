"""The status of a result."""

from __future__ import annotations

from enum import StrEnum


class VerdictStatus(StrEnum):
    """The judgement of a result; its value is what users read."""

    TRUSTED = "trusted"
    """Every parameter is determined and the model describes the data."""
    APPROXIMATE = "approximate"
    """The misfit exceeds the noise, and the stated uncertainty includes it."""
    NOT_DETERMINED = "not determined"
    """The data do not determine a parameter, or the computation has not converged."""
    NOT_DESCRIBED = "not described"
    """The misfit is so large that no uncertainty can be stated."""

    @property
    def usable(self) -> bool:
        """Whether the numbers can be used with their stated uncertainty."""
        return self in (VerdictStatus.TRUSTED, VerdictStatus.APPROXIMATE)
