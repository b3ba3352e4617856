"""The content of a report, independent of its format.

Every writer (HTML, PDF, Markdown, JSON) takes the same :class:`Document`, so that all formats have
the same content.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Cell:
    """A cell of a table: its text, and the number for copying and sorting.

    A struck cell is printed grey and crossed out, with the reason next to it. A link is the address
    of another page, relative to this one.
    """

    text: str
    value: float | None = None
    struck: bool = False
    link: str | None = None


Row = dict[str, Cell | str]
"""Cells, or texts, by the names in the header of their table."""


@dataclass(frozen=True)
class Paragraph:
    """Running text."""

    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of sentences."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Listing:
    """Text to be copied unchanged, such as a command or a program."""

    text: str


@dataclass(frozen=True)
class TextTable:
    """Rows of cells under a header; units are in the header."""

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @classmethod
    def of(cls, caption: str, rows: Sequence[Row]) -> TextTable:
        """Return a table of rows, at least one, with their cells by the names in the header."""
        cells = ([c if isinstance(c, Cell) else Cell(c) for c in row.values()] for row in rows)
        return cls(caption, tuple(rows[0]), tuple(map(tuple, cells)))


@dataclass(frozen=True)
class Picture:
    """A figure, which is drawn when a writer needs it."""

    name: str  # of a file
    caption: str
    alt: str  # alternative text: the kind of plot and its result
    draw: Callable[[], Any]  # function that plots on new axes, and returns them

    def rendered(self, kind: str) -> bytes:
        """Return the picture as "svg" or "png", reproducibly."""
        import matplotlib as mpl
        import matplotlib.pyplot as plt

        buffer = io.BytesIO()
        with mpl.rc_context({"svg.hashsalt": "dahl_ident", "svg.fonttype": "path"}):
            figure = figure_of(self.draw())
            metadata = {"Date": None} if kind == "svg" else None
            figure.savefig(buffer, format=kind, dpi=160, metadata=metadata)
            plt.close(figure)
        return buffer.getvalue()

    def address(self, kind: str) -> str:
        """Return the picture as a data URL, for an HTML page."""
        media = {"svg": "image/svg+xml", "png": "image/png"}[kind]
        return f"data:{media};base64,{base64.b64encode(self.rendered(kind)).decode()}"


Block = Paragraph | Bullets | Listing | TextTable | Picture


@dataclass(frozen=True)
class Section:
    """A heading with its content; details follow the signature."""

    title: str
    blocks: tuple[Block, ...]
    details: bool = False


MARKS = {
    "trusted": "Trusted",
    "approximate": "Approximate",
    "not determined": "Not determined",
    "not described": "Not described",
}


@dataclass(frozen=True)
class Document:
    """A whole report; a field of the header without lines is to be filled in by hand."""

    title: str
    status: str  # one of MARKS
    verdict: tuple[str, ...]  # the result, and the objections to it
    sections: tuple[Section, ...]  # in reading order, details last
    header: tuple[tuple[str, tuple[str, ...]], ...] = ()  # specimen, model, data and so on
    facts: Mapping[str, Any] = field(default_factory=dict)  # the content of the JSON file
    identity: str = ""  # number and data of the report, on every page
    signatory: tuple[str, ...] = ()  # name and role; empty to be filled in by hand

    @property
    def trusted(self) -> bool:
        """Whether the stated uncertainties can be used."""
        return self.status in ("trusted", "approximate")

    @property
    def mark(self) -> str:
        """The status, as a heading."""
        return MARKS[self.status]

    @property
    def pictures(self) -> list[Picture]:
        """All pictures, in reading order."""
        blocks = (block for section in self.sections for block in section.blocks)
        return [block for block in blocks if isinstance(block, Picture)]

    def finished(self, title: str, progress: Callable[[int, int], None] | None) -> Document:
        """Return the document with a title and numbers before captions of figures and tables.

        Pictures of one name, such as those of two fits, get numbers as well. `progress` is called
        with the numbers of pictures drawn and in all.
        """
        counts = {Picture: 0, TextTable: 0}
        names: dict[str, int] = {}
        total = len(self.pictures)
        drawn = set[str]()

        def finished(block: Block) -> Block:
            if not isinstance(block, TextTable | Picture):
                return block
            counts[type(block)] += 1
            kind = "Table" if isinstance(block, TextTable) else "Figure"
            caption = f"{kind} {counts[type(block)]}. {block.caption}"
            if isinstance(block, TextTable):
                return replace(block, caption=caption)
            names[block.name] = count = names.get(block.name, 0) + 1
            name = f"{block.name}_{count}" if count > 1 else block.name

            def draw() -> Any:
                axes = block.draw()
                drawn.add(name)
                if progress is not None:
                    progress(len(drawn), total)
                return axes

            return replace(block, name=name, caption=caption, draw=draw)

        changed = (replace(s, blocks=tuple(map(finished, s.blocks))) for s in self.sections)
        return replace(self, title=title, sections=tuple(changed))


def words(*texts: str) -> tuple[Cell, ...]:
    """Return a row of texts."""
    return tuple(Cell(text) for text in texts)


def number(value: float, digits: int = 4) -> Cell:
    """Return a number shown with some digits, and stored with all of them."""
    return Cell(f"{value:.{digits}g}", float(value))


def estimated(value: float, text: str, *, struck: bool = False) -> Cell:
    """Return an estimate as text; "none finite" for an infinite one."""
    return Cell(text, value, struck) if np.isfinite(value) else Cell("none finite")


def figure_of(axes: Any) -> Figure:
    """Return the figure of some axes."""
    figure: Figure = np.ravel(np.asarray(axes, dtype=object))[0].figure
    return figure
