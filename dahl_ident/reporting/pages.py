"""A document as one self-contained HTML file, or as Markdown with pictures next to it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.resources import files

import jinja2

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
)

BLANK = "________________"


def html(document: Document) -> bytes:
    """Return the page; text is escaped, and the page's security policy forbids network access."""
    room = files("dahl_ident.reporting")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
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


def markdown(document: Document, folder: str) -> bytes:
    """Return the text, with links to the pictures as PNG files in `folder`."""
    lines = [f"# {_escaped(document.title)}", f"**{document.mark}.**"]
    lines += [_escaped(line) for line in document.verdict]
    if document.header:
        rows = [
            f"| {name} | {_escaped('; '.join(given)) or BLANK} |" for name, given in document.header
        ]
        lines.append("\n".join(("| | |", "| --- | --- |", *rows)))
    if document.identity:
        lines.append(_escaped(document.identity))
    for section in _with_signature(document):
        lines.append(f"## {_escaped(section.title)}")
        lines += [text for block in section.blocks if (text := _block(block, folder))]
    return ("\n\n".join(lines) + "\n").encode(errors="replace")


def _with_signature(document: Document) -> Iterator[Section]:
    """Yield the sections, and before the details a field for the signature."""
    sections, name = document.sections, ", ".join(document.signatory) or BLANK
    signature = Section("Signature", (Paragraph(f"Date {BLANK} Name {name} Signature {BLANK}"),))
    for before, section in zip((None, *sections), sections, strict=False):
        if section.details and not (before and before.details):
            yield signature
        yield section


def _block(block: Block, folder: str) -> str:
    match block:
        case Paragraph(text):
            return _escaped(text)
        case Bullets(items):
            return "\n".join(f"- {_escaped(item)}" for item in items)
        case Listing(text):
            return "\n".join(f"    {line}" for line in text.splitlines())
        case Picture():
            caption = _escaped(block.caption)
            return f"![{_escaped(block.alt)}](<{folder}/{block.name}.png>)\n\n*{caption}*"
        case TextTable():
            return _table(block)


def _table(table: TextTable) -> str:
    rows = [table.header, tuple("---" for _ in table.header)]
    lines = [" | ".join(map(_escaped, rows[0])), " | ".join(rows[1])]
    lines += [" | ".join(map(_cell, row)) for row in table.rows]
    return f"**{_escaped(table.caption)}**\n\n" + "\n".join(f"| {line} |" for line in lines)


def _cell(cell: Cell) -> str:
    return f"~~{_escaped(cell.text)}~~" if cell.struck else _escaped(cell.text)


def _escaped(text: str) -> str:
    """Return text with all markup characters escaped."""
    return re.sub(r"([\\`*_{}\[\]<>|#~$])", r"\\\1", " ".join(text.split()))
