"""From sampled waveforms to a frequency response with covariance and verdicts."""

from dahl_ident.extraction.from_record import extract

__all__ = ["extract"]
