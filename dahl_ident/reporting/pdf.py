"""Reports as PDF on A4 paper, written by fpdf2, which is pure Python and installed by pip.

The fonts are the DejaVu fonts shipped with matplotlib, which have Greek letters and accents.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

import matplotlib as mpl
from fpdf import FPDF
from fpdf import table as fpdf_table
from fpdf.fonts import FontFace
from fpdf.structure_tree import StructElem, StructureTreeBuilder
from fpdf.syntax import Name, PDFArray, PDFObject

from dahl_ident.reporting.document import (
    Block,
    Bullets,
    Cell,
    Document,
    Listing,
    Paragraph,
    Picture,
    Section,
    TextTable,
    words,
)

_FONT = "DejaVu"
_FONTS = Path(mpl.get_data_path()) / "fonts" / "ttf"
_FACES = {"": "DejaVuSans.ttf", "B": "DejaVuSans-Bold.ttf", "I": "DejaVuSans-Oblique.ttf"}
_PICTURE_WIDTH, _GAP, _CAPTION_HEIGHT = 86.0, 6.0, 16.0  # mm
_HEADING_HEIGHT, _KEPT_HEIGHT = 10.0, 28.0  # mm; of a heading, and of the text kept below it
_LONGEST_TITLE = 60  # letters at the foot of a page
_WHOLE = 20.0  # mm; paragraphs up to this height are not divided between pages
_MARGIN = 16.0  # mm, of the pages
_SIGNATURE = 26.0  # mm, height of the fields for date and signature
_WIDEST_COLUMN = 75.0  # mm, largest width of a column of a table
_PADDING = 3.5  # mm, on both sides of a column's text
_NAME_WIDTH = 38.0  # mm, width of the fields' names in the header
_COLOURS = {
    "trusted": (17, 99, 41),
    "approximate": (122, 77, 0),
    "not determined": (164, 14, 38),
    "not described": (164, 14, 38),
}
_STRUCK = FontFace(emphasis="STRIKETHROUGH", color=(110, 110, 110))


def pdf(document: Document) -> bytes:
    """Return the content of a PDF file."""
    page = _page(document)
    _heading(page, document.title, 1)
    page.ln(2)
    page.set_font(_FONT, "B", 11)
    page.set_text_color(*_COLOURS[document.status])
    _text(page, document.mark)
    page.set_text_color(0, 0, 0)
    page.set_font(_FONT, "", 10)
    for line in document.verdict:
        _text(page, line)
    _header(page, document)
    before: Section | None = None
    for section, after in zip_longest(document.sections, document.sections[1:]):
        signed = not section.details and after is not None and after.details
        page.set_auto_page_break(True, _MARGIN + _SIGNATURE * signed)  # not alone on a page
        if section.details and not (before and before.details):
            _signature(page, document.signatory)
            page.add_page()
        before = section
        pictures = [_Drawn(block) for block in section.blocks if isinstance(block, Picture)]
        if not section.blocks:
            continue
        page.ln(3)
        match section.blocks[0]:
            case Picture():
                below = _row_height(pictures[:2])
            case TextTable() as table:
                below = _beginning(page, table, _widths(page, table))
            case _:
                below = _KEPT_HEIGHT
        _keep_together(page, _HEADING_HEIGHT + below)
        page.start_section(section.title)
        _heading(page, section.title, 2)
        for block in section.blocks:
            if not isinstance(block, Picture):
                _block(page, block)
        for i in range(0, len(pictures), 2):
            _pictures(page, pictures[i : i + 2])
    return bytes(page.output())


def _page(document: Document) -> FPDF:
    title = document.title
    if len(title) > _LONGEST_TITLE:
        title = f"{title[:_LONGEST_TITLE]}..."
    identity = " \u00b7 ".join(text for text in (title, document.identity) if text)

    class Page(FPDF):
        """A page that shows codes for characters that its font lacks, which fpdf2 would omit."""

        def normalize_text(self, text: str) -> str:
            known = _known_characters()
            return super().normalize_text(
                "".join(c if ord(c) in known or c.isspace() else f"<U+{ord(c):04X}>" for c in text)
            )

        def footer(self) -> None:
            self.set_y(-12)
            self.set_font(_FONT, "", 6.5)
            self.cell(0.85 * self.epw, 4, identity)
            self.cell(0, 4, f"Page {self.page_no()} of {{nb}}", align="R")

    page = Page(format="A4")
    page.struct_builder = _Structure()
    page.set_margins(_MARGIN, _MARGIN, _MARGIN)
    page.set_auto_page_break(True, _MARGIN)
    page.set_title(document.title)
    page.set_lang("en")
    for face, file in _FACES.items():
        page.add_font(_FONT, face, _FONTS / file)
    page.add_page()
    return page


def _heading(page: FPDF, text: str, level: int) -> None:
    """Print a heading, tagged for screen readers."""
    page.set_font(_FONT, "B", 17 if level == 1 else 12)
    height = 8 if level == 1 else 6
    _keep_together(page, 3.0 * height)  # a marked sequence must not cross pages
    with page._marked_sequence(title=text) as element:  # the only way in fpdf2
        element.s = Name(f"H{level}")
        page.multi_cell(0, height, text, new_x="LMARGIN", new_y="NEXT")


def _header(page: FPDF, document: Document) -> None:
    """Print specimen, model, data and so on, with a line to fill in for empty fields."""
    page.ln(1)
    for name, lines in document.header:
        page.set_font(_FONT, "B", 8)
        page.set_x(page.l_margin)
        page.cell(_NAME_WIDTH, 4.4, name)
        page.set_font(_FONT, "", 8)
        left = page.l_margin + _NAME_WIDTH
        if not lines:
            page.line(left, page.get_y() + 4.2, page.w - page.r_margin, page.get_y() + 4.2)
            page.ln(5.4)
        for line in lines:
            page.set_x(left)
            page.multi_cell(0, 4.4, line, align="L", new_x="LMARGIN", new_y="NEXT")


def _signature(page: FPDF, signatory: Sequence[str]) -> None:
    _keep_together(page, _SIGNATURE)
    page.ln(12)
    page.set_font(_FONT, "", 8)
    width = (page.epw - 2 * _GAP) / 3.0
    top = page.get_y()
    authorised = ", ".join(("Authorised by", *signatory)) if signatory else "Name"
    for i, name in enumerate(("Date", authorised, "Signature")):
        x = page.l_margin + i * (width + _GAP)
        page.line(x, top, x + width, top)
        page.set_xy(x, top + 1.0)
        page.multi_cell(width, 4, name, align="L")
    page.set_xy(page.l_margin, top + 6.0)


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
        case TextTable():
            _table(page, block)


def _text(page: FPDF, text: str) -> None:
    """Print a paragraph; a short one is not divided between pages."""
    height = page.multi_cell(0, 5, text, align="L", dry_run=True, output="HEIGHT")
    assert isinstance(height, float | int)
    if height <= _WHOLE:
        _keep_together(page, height)
    page.multi_cell(0, 5, text, align="L", new_x="LMARGIN", new_y="NEXT")
    page.ln(1)


class _Drawn:
    """A picture as PNG, with its height on the page."""

    def __init__(self, picture: Picture) -> None:
        from PIL import Image

        self.picture = picture
        self.content = io.BytesIO(picture.rendered("png"))
        with Image.open(self.content) as image:
            self.height = _PICTURE_WIDTH * image.height / image.width


def _pictures(page: FPDF, row: Sequence[_Drawn]) -> None:
    """Draw up to two pictures side by side, their captions below."""
    _keep_together(page, _row_height(row))
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


def _keep_together(page: FPDF, height: float) -> None:
    """Begin a new page if this height does not fit on the current one."""
    if page.get_y() + height > page.h - page.b_margin:
        page.add_page()


def _table(page: FPDF, table: TextTable) -> None:
    widths = _widths(page, table)
    _keep_together(page, _beginning(page, table, widths))
    page.set_font(_FONT, "B", 9.5)
    _text(page, table.caption)
    page.set_font(_FONT, "", 7.5)
    drawn = _TaggedTable(
        page,
        col_widths=widths,
        text_align="LEFT",
        line_height=4,
        padding=0.5,
        borders_layout="HORIZONTAL_LINES",
    )
    for row in (words(*table.header), *table.rows):
        line = drawn.row()
        for cell in row:
            line.cell(cell.text, style=_STRUCK if cell.struck else None)
    drawn.render()
    page.ln(2)


class _TaggedTable(fpdf_table.Table):
    """A table whose cells are tagged for screen readers."""

    def render(self) -> None:
        self._marked: set[tuple[int, int]] = set()
        structure = self._fpdf.struct_builder
        assert isinstance(structure, _Structure)
        self._structure = structure
        self._structure.tables.append([[] for _ in self.rows])
        super().render()

    def _render_table_cell(
        self, i: int, j: int, cell: Any, row_height: float, *args: Any, **kwargs: Any
    ) -> Any:
        draw = super()._render_table_cell
        measured_only = kwargs.get("cell_height_info") is None
        if measured_only or (i, j) in self._marked:  # headings are repeated on the next page
            return draw(i, j, cell, row_height, *args, **kwargs)
        self._marked.add((i, j))
        with self._fpdf._marked_sequence() as element:
            element.s = Name("TD" if i else "TH")
            self._structure.tables[-1][i].append(element)
            return draw(i, j, cell, row_height, *args, **kwargs)


class _Structure(StructureTreeBuilder):
    """The tags of the pages, with cells in rows and rows in tables; fpdf2 has a flat list."""

    def __init__(self) -> None:
        super().__init__()
        self.tables: list[list[list[StructElem]]] = []

    def __iter__(self) -> Iterator[PDFObject]:
        document = StructElem("/Document", self.struct_tree_root, [])
        self.struct_tree_root.k = PDFArray([document])
        groups, first, inside = [document], {}, set()
        for rows in self.tables:
            table = StructElem("/Table", document, [])
            groups.append(table)
            first[id(rows[0][0])] = table
            for cells in rows:
                row = StructElem("/TR", table, [])
                groups.append(row)
                table.k.append(row)
                for cell in cells:
                    inside.add(id(cell))
                    cell.p = row
                    row.k.append(cell)
        for element in self.doc_struct_elem.k:
            if id(element) in first:
                document.k.append(first[id(element)])
            if id(element) not in inside:
                element.p = document
                document.k.append(element)
        yield from (self.struct_tree_root, *groups, self.struct_tree_root.parent_tree)
        yield from self.doc_struct_elem.k


def _beginning(page: FPDF, table: TextTable, widths: Sequence[float]) -> float:
    """Return the height of a table's caption, header and first row, which stay together."""
    rows = (words(*table.header), *table.rows[:1])
    return _CAPTION_HEIGHT + sum(_height(page, row, widths) for row in rows)


def _height(page: FPDF, row: Sequence[Cell], widths: Sequence[float]) -> float:
    """Return the approximate height of a row with wrapped texts."""
    page.set_font(_FONT, "B", 7.5)
    inner = (page.epw * width / sum(widths) - _PADDING for width in widths)
    lines = (page.get_string_width(c.text) / width for c, width in zip(row, inner, strict=True))
    return 4.0 * (1 + int(max(lines))) + 1.0


def _widths(page: FPDF, table: TextTable) -> list[float]:
    """Return the widths of columns, such that words are not broken if they fit on the page."""
    texts = [tuple(cell.text for cell in row) for row in table.rows]
    least, preferred = [], []
    for name, *column in zip(table.header, *texts, strict=True):
        page.set_font(_FONT, "B", 7.5)
        widest = max((page.get_string_width(word) for word in name.split()), default=0.0)
        page.set_font(_FONT, "", 7.5)
        words_of = {word for text in column for word in text.split()}
        longest = max((page.get_string_width(word) for word in words_of), default=0.0)
        whole = max(map(page.get_string_width, column), default=0.0)
        least.append(min(max(widest, longest), _WIDEST_COLUMN) + _PADDING)
        preferred.append(max(widest, longest, min(whole, _WIDEST_COLUMN)) + _PADDING)
    room, more = page.epw - sum(least), sum(preferred) - sum(least)
    if room >= more:
        return preferred
    if room <= 0.0:
        return least  # scaled down by the table
    return [low + (high - low) * room / more for low, high in zip(least, preferred, strict=True)]


@cache
def _known_characters() -> frozenset[int]:
    from matplotlib.ft2font import FT2Font

    return frozenset(FT2Font(str(_FONTS / _FACES[""])).get_charmap())
