"""Hold-out checks of a fit to records: parts that were left out are predicted from the rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.diagnostics.formatting import percent, table


@dataclass(frozen=True)
class HeldOutPart:
    """A part of the records, predicted by a fit to the others.

    Attributes
    ----------
    record : int
        Which one, from 1.
    start, stop : float
        s.
    samples : int
    rms_share : float
        Of the prediction errors, over the standard deviation of the part's output.
    inside : float
        Share of its samples within the 95 % band.
    """

    record: int
    start: float
    stop: float
    samples: int
    rms_share: float
    inside: float


@dataclass(frozen=True)
class HoldOut:
    """The hold-out check of a fit; made by :meth:`dahl_ident.FitResult.hold_out`.

    Attributes
    ----------
    parts : tuple of HeldOutPart
        Each left out in turn.

    Examples
    --------
    >>> HoldOut((HeldOutPart(1, 0.0, 5.0, 500, 0.021, 0.95),)).inside
    0.95
    """

    parts: tuple[HeldOutPart, ...]

    @property
    def inside(self) -> float:
        """Share of all samples within the 95 % bands of their predictions."""
        samples = [part.samples for part in self.parts]
        return float(np.average([part.inside for part in self.parts], weights=samples))

    def __str__(self) -> str:
        rows = [["record", "from (s)", "to (s)", "error (% rms)", "inside 95 % band"]]
        rows += [
            [
                str(part.record), f"{part.start:.4g}", f"{part.stop:.4g}",
                percent(part.rms_share).removesuffix(" %"), f"{100.0 * part.inside:.1f} %",
            ]
            for part in self.parts
        ]  # fmt: skip
        return f"{table(rows, ())}\nall samples: {100.0 * self.inside:.1f} % inside"
