"""Measured data: frequency responses, records, and the files they come from."""

from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.data.readers import inspect, read_frequency_response, read_record
from dahl_ident.data.record import Record

__all__ = [
    "FrequencyResponse",
    "Record",
    "inspect",
    "read_frequency_response",
    "read_record",
]
