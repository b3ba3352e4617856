"""Thumbnails of the pictures of a page, each leading to its section."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective


class Place(nodes.General, nodes.Element):  # type: ignore[misc]  # docutils has no types
    """Where the thumbnails go."""


class Thumbnails(SphinxDirective):
    """Marks the place."""

    def run(self) -> list[Any]:
        """Return the mark."""
        return [Place()]


def setup(app: Any) -> dict[str, Any]:
    """Add the directive ``thumbnails``."""
    app.add_node(Place)
    app.add_directive("thumbnails", Thumbnails)
    app.connect("doctree-resolved", fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def fill(_app: Any, doctree: Any, _page: str) -> None:
    """Put the first picture of each section in the place."""
    for place in list(doctree.findall(Place)):
        grid = nodes.bullet_list(classes=["thumbnails"])
        for section in doctree.findall(nodes.section):
            picture = next(section.findall(nodes.image), None)
            title = section.next_node(nodes.title)
            if picture is not None and section.parent is not doctree:
                link = nodes.reference("", "", picture.deepcopy(), internal=True)
                link["refid"] = section["ids"][0]
                link += nodes.inline(text=title.astext())
                grid += nodes.list_item("", nodes.paragraph("", "", link))
        place.replace_self(grid)
