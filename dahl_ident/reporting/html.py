"""One self-contained HTML file, including styles, script and figures."""

from __future__ import annotations

import base64
from importlib.resources import files

import jinja2

from dahl_ident.reporting.document import Document, Picture


def html(document: Document) -> bytes:
    """Return the page; text is escaped, and the page's security policy forbids network access."""
    room = files("dahl_ident.reporting")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    environment.filters["svg"] = _as_uri
    page = environment.from_string((room / "page.html.j2").read_text(encoding="utf-8"))
    return page.render(
        document=document,
        foot=_css_text(f"{document.title} {document.identity}".strip()),
        style=(room / "page.css").read_text(encoding="utf-8"),
        script=(room / "page.js").read_text(encoding="utf-8"),
    ).encode(errors="replace")


def _css_text(text: str) -> str:
    """Return a string of a style sheet that holds nothing but letters, digits and escapes."""
    return '"' + "".join(c if c.isalnum() else f"\\{ord(c):x} " for c in text) + '"'


def _as_uri(picture: Picture) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(picture.rendered("svg")).decode()
