"""A PDF on A4, made by fpdf2: pure Python, so pip installs all of it.

Letters come from the DejaVu fonts that matplotlib brings along, so Greek and accents print.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl

from dahl_ident.reporting.document import (
    Block,
    Bullets,
    Document,
    Listing,
    Paragraph,
    Picture,
    Table,
)

if TYPE_CHECKING:
    from fpdf import FPDF

_FONT = "DejaVu"
_FONTS = Path(mpl.get_data_path()) / "fonts" / "ttf"
_FACES = {"": "DejaVuSans.ttf", "B": "DejaVuSans-Bold.ttf", "I": "DejaVuSans-Oblique.ttf"}
_PICTURE_WIDTH, _GAP, _CAPTION_HEIGHT = 86.0, 6.0, 16.0  # mm
_HEADING_HEIGHT, _BEGINNING = 10.0, 28.0  # mm; what a heading or a caption has below itself
_WIDEST = 26  # characters that a column of a table has room for
_MARGIN, _BOLD = 3.0, 1.25  # characters beside the text; how much wider bold ones are
_GOOD, _BAD = (17, 99, 41), (164, 14, 38)


def pdf(document: Document) -> bytes:
    """Return the whole file."""
    page = _page(document)
    page.set_font(_FONT, "B", 17)
    page.multi_cell(0, 8, document.title, new_x="LMARGIN", new_y="NEXT")
    page.ln(2)
    page.set_font(_FONT, "B", 11)
    page.set_text_color(*(_GOOD if document.trusted else _BAD))
    _text(page, "Can be trusted" if document.trusted else "Not to be trusted")
    page.set_text_color(0, 0, 0)
    page.set_font(_FONT, "", 10)
    for line in document.verdict:
        _text(page, line)
    for section in document.sections:
        pictures = [_Drawn(block) for block in section.blocks if isinstance(block, Picture)]
        page.ln(4)
        begins_drawn = isinstance(section.blocks[0], Picture)
        below = _row_height(pictures[:2]) if begins_drawn else _BEGINNING
        _turn_unless_room(page, _HEADING_HEIGHT + below)
        page.set_font(_FONT, "B", 13)
        page.start_section(section.title)
        page.multi_cell(0, 7, section.title, new_x="LMARGIN", new_y="NEXT")
        for block in section.blocks:
            if not isinstance(block, Picture):
                _block(page, block)
        for i in range(0, len(pictures), 2):
            _pictures(page, pictures[i : i + 2])
    return bytes(page.output())


def _page(document: Document) -> FPDF:
    from fpdf import FPDF

    class Page(FPDF):
        """A page that shows what its font lacks, where fpdf2 would leave it out."""

        def normalize_text(self, text: str) -> str:
            return super().normalize_text(_printable(text))

    page = Page(format="A4")
    page.set_margins(16, 16, 16)
    page.set_auto_page_break(True, 16)
    page.set_title(document.title)
    page.set_lang("en")
    for face, file in _FACES.items():
        page.add_font(_FONT, face, _FONTS / file)
    page.add_page()
    return page


def _block(page: FPDF, block: Block) -> None:
    page.set_font(_FONT, "", 9.5)
    match block:
        case Paragraph(text):
            _text(page, text)
        case Bullets(items):
            for item in items:
                _text(page, f"\u2022 {item}")
        case Listing(text):
            page.set_fill_color(244, 244, 244)
            page.multi_cell(0, 5, text, align="L", fill=True, new_x="LMARGIN", new_y="NEXT")
        case Table():
            _table(page, block)


def _text(page: FPDF, text: str) -> None:
    page.multi_cell(0, 5, text, align="L", new_x="LMARGIN", new_y="NEXT")
    page.ln(1)


class _Drawn:
    """A picture as PNG, with the height that it takes on the page."""

    def __init__(self, picture: Picture) -> None:
        from PIL import Image

        self.picture = picture
        self.content = io.BytesIO(picture.rendered("png"))
        with Image.open(self.content) as image:
            self.height = _PICTURE_WIDTH * image.height / image.width


def _pictures(page: FPDF, row: Sequence[_Drawn]) -> None:
    """Draw up to two pictures side by side, their captions below."""
    _turn_unless_room(page, _row_height(row))
    top, ends = page.get_y(), []
    for i, drawn in enumerate(row):
        x = page.l_margin + i * (_PICTURE_WIDTH + _GAP)
        page.image(drawn.content, x=x, y=top, w=_PICTURE_WIDTH, alt_text=drawn.picture.alt)
        page.set_xy(x, top + drawn.height + 1.0)
        page.set_font(_FONT, "I", 8)
        page.multi_cell(_PICTURE_WIDTH, 4, drawn.picture.caption, align="L", new_y="NEXT")
        ends.append(page.get_y())
    page.set_xy(page.l_margin, max(ends) + 3.0)


def _row_height(row: Sequence[_Drawn]) -> float:
    return max(drawn.height for drawn in row) + _CAPTION_HEIGHT


def _turn_unless_room(page: FPDF, height: float) -> None:
    """Begin a new page where so much does not fit below."""
    if page.get_y() + height > page.h - page.b_margin:
        page.add_page()


def _table(page: FPDF, table: Table) -> None:
    _turn_unless_room(page, _BEGINNING)
    page.set_font(_FONT, "B", 9.5)
    _text(page, table.caption)
    page.set_font(_FONT, "", 7.5)
    rows = [tuple(cell.text for cell in row) for row in table.rows]
    widths = [_width(name, texts) for name, *texts in zip(table.header, *rows, strict=True)]
    with page.table(
        col_widths=widths,
        text_align="LEFT",
        line_height=4,
        padding=0.8,
        borders_layout="HORIZONTAL_LINES",
    ) as drawn:
        for row in (table.header, *rows):
            line = drawn.row()
            for text in row:
                line.cell(text)
    page.ln(2)


def _width(name: str, texts: Sequence[str]) -> float:
    """Return the width of a column in characters; its name may be wrapped between words."""
    longest = max(_BOLD * max(map(len, name.split())), *map(len, texts))
    return min(longest, _WIDEST) + _MARGIN


@cache
def _known_characters() -> frozenset[int]:
    from matplotlib.ft2font import FT2Font

    return frozenset(FT2Font(str(_FONTS / _FACES[""])).get_charmap())


def _printable(text: str) -> str:
    """Return text with the codes of characters in place of those that the font has not."""
    known = _known_characters()
    return "".join(c if ord(c) in known or c.isspace() else f"<U+{ord(c):04X}>" for c in text)
