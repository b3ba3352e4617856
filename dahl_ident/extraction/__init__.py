"""From sampled waveforms to a frequency response with covariance and verdicts."""

from dahl_ident.extraction.sources import extract

__all__ = ["extract"]
