"""Reports: HTML, PDF, Markdown and JSON from the same content."""

from dahl_ident.reporting.publish import report

__all__ = ["report"]
