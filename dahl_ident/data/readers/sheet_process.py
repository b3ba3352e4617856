"""Program that reads the cells of a workbook, run in a process of its own.

The library that reads workbooks is compiled, and lays out a sheet as large as its last cell: a
damaged or hostile file may end the process or ask for all memory, and here that is an error
like others. ``python sheet_process.py PATH MEGABYTES`` writes the sheets to standard output.
"""

from __future__ import annotations

import contextlib
import marshal
import sys
from typing import Any


def main(path: str, megabytes: int) -> None:
    """Write [(sheet, rows), ...] in Python's marshal format."""
    with contextlib.suppress(ImportError):  # not on Windows
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (megabytes << 20, megabytes << 20))
    import python_calamine

    book = python_calamine.CalamineWorkbook.from_path(path)
    sheets = [
        (name, [[_plain(cell) for cell in row] for row in _rows(book, name)])
        for name in book.sheet_names
    ]
    sys.stdout.buffer.write(marshal.dumps(sheets))


def _rows(book: Any, name: str) -> Any:
    try:
        return book.get_sheet_by_name(name).to_python(skip_empty_area=False)
    except Exception as exc:
        if "worksheet" in type(exc).__name__.lower() or "chart" in str(exc).lower():
            return []  # a sheet of diagrams
        raise


def _plain(cell: Any) -> Any:
    """Return numbers, text and truth values as they are, dates as text."""
    return cell if isinstance(cell, (float, int, str, bool)) else str(cell)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
