"""A manual that needs no network: formulas as MathML, a search that shows where words stand.

Sphinx's search fetches each page that it found, to quote from it, and a browser does not fetch
pages that lie on a disk. So the text of all pages is written into one script next to the search. At
the end it is checked that no page fetches anything from elsewhere.
"""

from __future__ import annotations

import json
import re
from html import escape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from docutils.nodes import SkipNode
from latex2mathml.converter import convert
from sphinx.util import logging

_FETCHING_LINKS = {"stylesheet", "preload", "modulepreload", "prefetch", "icon", "manifest"}
_EXTERNAL = re.compile(r"(?:https?:)?//", re.IGNORECASE)
_TEXTS = "page_texts.js"
_SCRIPT = """const pageTexts = %s;
const fetchOnline = window.fetch;
window.fetch = (address, ...more) => {
  const page = String(address).replace(/^\\.\\//, "").replace(/\\.html.*$/, "");
  return page in pageTexts
    ? Promise.resolve(new Response(pageTexts[page]))
    : fetchOnline(address, ...more);
};
"""


def setup(app: Any) -> dict[str, Any]:
    """Add the renderer and the check to a build."""
    app.add_html_math_renderer(
        "mathml", inline_renderers=(_inline, None), block_renderers=(_block, None)
    )
    app.connect("html-page-context", _add_texts)
    app.connect("build-finished", _write_texts)
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


def _add_texts(app: Any, pagename: str, *_: Any) -> None:
    """Let the search page alone load the texts."""
    if pagename == "search":
        app.add_js_file(_TEXTS)


def _write_texts(app: Any, exception: Exception | None) -> None:
    """Write the text of every page, section by section."""
    if exception is None and app.builder.format == "html":
        out = Path(app.outdir)
        pages = {name: (out / f"{name}.html").read_text("utf-8") for name in app.env.found_docs}
        texts = json.dumps({name: article(page) for name, page in sorted(pages.items())})
        (out / "_static" / _TEXTS).write_text(_SCRIPT % texts, encoding="utf-8")


def article(page: str) -> str:
    """Return the text of a page's article, with the names of its sections, as HTML."""
    parser = _Article()
    parser.feed(page)
    return f'<main role="main">{" ".join("".join(parser.parts).split())}</main>'


class _Article(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.parts: list[str] = []
        self._inside, self._silent = False, 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "article":
            self._inside = True
        elif tag == "section" and self._inside:
            self.parts.append(f'<section id="{escape(given.get("id") or "")}">')
        elif tag in ("script", "style") or given.get("class") == "headerlink":
            self._silent += 1

    def handle_endtag(self, tag: str) -> None:
        if tag == "article":
            self._inside = False
        elif tag == "section" and self._inside:
            self.parts.append("</section>")
        elif self._silent and tag in ("script", "style", "a"):
            self._silent -= 1

    def handle_data(self, data: str) -> None:
        if self._inside and not self._silent:
            self.parts.append(escape(data, quote=False))


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
