"""A PDF on A4, made by fpdf2: pure Python, so pip installs all of it.

Letters come from the DejaVu fonts that matplotlib brings along, so Greek and accents print.
"""

from __future__ import annotations

import io
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
_FACES = {"": "DejaVuSans.ttf", "B": "DejaVuSans-Bold.ttf", "I": "DejaVuSans-Oblique.ttf"}
_PICTURE_WIDTH = 110.0  # mm
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
        page.ln(4)
        page.set_font(_FONT, "B", 13)
        page.start_section(section.title)
        page.multi_cell(0, 7, section.title, new_x="LMARGIN", new_y="NEXT")
        for block in section.blocks:
            _block(page, block)
    return bytes(page.output())


def _page(document: Document) -> FPDF:
    from fpdf import FPDF

    page = FPDF(format="A4")
    page.set_margins(16, 16, 16)
    page.set_auto_page_break(True, 16)
    page.set_title(document.title)
    page.set_lang("en")
    fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
    for face, file in _FACES.items():
        page.add_font(_FONT, face, fonts / file)
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
            page.multi_cell(0, 5, text, fill=True, new_x="LMARGIN", new_y="NEXT")
        case Picture():
            _picture(page, block)
        case Table():
            _table(page, block)


def _text(page: FPDF, text: str) -> None:
    page.multi_cell(0, 5, text, new_x="LMARGIN", new_y="NEXT")
    page.ln(1)


def _picture(page: FPDF, picture: Picture) -> None:
    from PIL import Image

    content = io.BytesIO(picture.rendered("png"))
    with Image.open(content) as image:
        height = _PICTURE_WIDTH * image.height / image.width
    if page.get_y() + height + 12 > page.h - page.b_margin:
        page.add_page()
    page.image(content, w=_PICTURE_WIDTH, alt_text=picture.alt)
    page.set_font(_FONT, "I", 8.5)
    _text(page, picture.caption)


def _table(page: FPDF, table: Table) -> None:
    page.set_font(_FONT, "B", 9.5)
    _text(page, table.caption)
    page.set_font(_FONT, "", 7.5)
    with page.table(
        text_align="LEFT", line_height=4, padding=0.8, borders_layout="HORIZONTAL_LINES"
    ) as drawn:
        for row in (table.header, *(tuple(cell.text for cell in row) for row in table.rows)):
            line = drawn.row()
            for text in row:
                line.cell(text)
    page.ln(2)
