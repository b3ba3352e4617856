"""A manual that needs no network: formulas as MathML, and a check that no page fetches anything."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from docutils.nodes import SkipNode
from latex2mathml.converter import convert
from sphinx.util import logging

_FETCHING_LINKS = {"stylesheet", "preload", "modulepreload", "prefetch", "icon", "manifest"}
_EXTERNAL = re.compile(r"(?:https?:)?//", re.IGNORECASE)


def setup(app: Any) -> dict[str, Any]:
    """Add the renderer and the check to a build."""
    app.add_html_math_renderer(
        "mathml", inline_renderers=(_inline, None), block_renderers=(_block, None)
    )
    app.connect("build-finished", _check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _inline(translator: Any, node: Any) -> None:
    translator.body.append(mathml(node.astext(), "inline"))
    raise SkipNode


def _block(translator: Any, node: Any) -> None:
    translator.body.append(translator.starttag(node, "div", CLASS="math"))
    if node["number"]:
        translator.body.append(f'<span class="eqno">({node["number"]})</span>')
    translator.body.append(mathml(node.astext(), "block") + "</div>\n")
    raise SkipNode


def mathml(latex: str, display: str) -> str:
    """Return a formula as MathML; several lines become a table."""
    text = latex.strip()
    if "\\\\" in text and "\\begin" not in text:
        text = rf"\begin{{aligned}}{text}\end{{aligned}}"
    return convert(text, display=display)


def fetched(page: str) -> list[str]:
    """Return the addresses outside of a page's own folder that a browser fetches to show it."""
    parser = _Fetched()
    parser.feed(page)
    return parser.found


class _Fetched(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        places = [given.get("src", ""), given.get("srcset", ""), given.get("data", "")]
        if tag == "link" and _FETCHING_LINKS & set(given.get("rel", "").split()):
            places.append(given.get("href", ""))
        self.found += [place for place in places if _EXTERNAL.match(place)]
        self._in_style(given.get("style", ""))

    def handle_data(self, data: str) -> None:
        if self.lasttag == "style":
            self._in_style(data)

    def _in_style(self, text: str) -> None:
        self.found += external_in_style(text)


def external_in_style(text: str) -> list[str]:
    """Return the external addresses that a style sheet fetches."""
    places = re.findall(r"(?:@import\s+|url\()\s*[\"']?([^\"')\s;]+)", text)
    return [place for place in places if _EXTERNAL.match(place)]


def _check(app: Any, exception: Exception | None) -> None:
    """Warn of every page or style sheet that fetches something from elsewhere."""
    if exception is not None or app.builder.format != "html":
        return
    log = logging.getLogger(__name__)
    for path in sorted(Path(app.outdir).rglob("*.[hc][ts][ms]*")):
        if path.suffix in (".html", ".css"):
            text = path.read_text(encoding="utf-8")
            for place in fetched(text) if path.suffix == ".html" else external_in_style(text):
                log.warning("%s fetches %s", path.relative_to(app.outdir), place)
