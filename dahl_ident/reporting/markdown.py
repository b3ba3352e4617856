"""Markdown for wikis and version control; pictures lie in a folder beside it."""

from __future__ import annotations

import re

from dahl_ident.reporting.document import (
    Block,
    Bullets,
    Document,
    Listing,
    Paragraph,
    Picture,
    Table,
)


def markdown(document: Document, folder: str) -> bytes:
    """Return the text, with links to the pictures as PNG files in `folder`."""
    mark = "Can be trusted" if document.trusted else "Not to be trusted"
    lines = [f"# {_escaped(document.title)}", f"**{mark}.**"]
    lines += [_escaped(line) for line in document.verdict]
    for section in document.sections:
        lines.append(f"## {_escaped(section.title)}")
        lines += [text for block in section.blocks if (text := _block(block, folder))]
    return ("\n\n".join(lines) + "\n").encode()


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
        case Table():
            return _table(block)


def _table(table: Table) -> str:
    rows = [table.header, tuple("---" for _ in table.header)]
    lines = [" | ".join(map(_escaped, rows[0])), " | ".join(rows[1])]
    lines += [" | ".join(_escaped(cell.text) for cell in row) for row in table.rows]
    return f"**{_escaped(table.caption)}**\n\n" + "\n".join(f"| {line} |" for line in lines)


def _escaped(text: str) -> str:
    """Return text in which nothing is taken for markup."""
    return re.sub(r"([\\`*_{}\[\]<>|#~$])", r"\\\1", " ".join(text.split()))
