"""``report(results, path)``: results to a file that others can read, trust and repeat."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dahl_ident.data import Record
from dahl_ident.data.storage import place_of, refuse_existing, write_whole
from dahl_ident.errors import DataError, ValidationError
from dahl_ident.reporting.contents import Result, document
from dahl_ident.reporting.document import Document, Picture
from dahl_ident.reporting.html import html
from dahl_ident.reporting.markdown import markdown
from dahl_ident.results import FitResult, Posterior

SCHEMA = 1
FORMATS = (".html", ".pdf", ".md", ".json")


def report(
    results: Result | Sequence[Result],
    path: str | Path,
    *,
    title: str | None = None,
    command: str | None = None,
    record: Record | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a report on one or several results.

    Parameters
    ----------
    results : FitResult, Posterior, or sequence of them
        What to report on; all on the same data.
    path : path
        Ending in ``.html`` (one file, no network), ``.pdf``, ``.md`` (pictures in a folder
        beside it) or ``.json``.
    title : str, optional
        First line; by default the file's name.
    command : str, optional
        The command that repeats it; by default the one that fits the same model.
    record : Record, optional
        The waveforms that the data were extracted from; the report shows how a point settled.
    overwrite : bool, default False
        Replace a report that is there already.

    Returns
    -------
    Path
        The file, complete; an interrupted run leaves none.

    Raises
    ------
    ValidationError
        If there is no result, the ending is another one, or the record is of other data.
    DataError
        If a file is there already and `overwrite` is not set, or the place cannot be written to.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> import dahl_ident as di
    >>> from dahl_ident.synthetic import load_dataset
    >>> fit = di.fit(load_dataset("noisy"), di.Dahl())
    >>> report(fit, Path(mkdtemp()) / "report.json").name
    'report.json'
    """
    place = place_of(path, "a report", FORMATS)
    if not overwrite:
        refuse_existing(place)
    told = _checked(list(results) if isinstance(results, Sequence) else [results])
    whole = document(told, title=title, command=command, record=record)
    kind = place.suffix.lower()
    if kind == ".md":
        folder = place.with_name(f"{place.stem}_pictures")
        _write_pictures(whole, folder, overwrite)
        content = markdown(whole, folder.name)
    else:
        content = _content(whole, kind)
    write_whole(place, content, overwrite=overwrite)
    return place


def _checked(results: list[Any]) -> list[Result]:
    """Return the results, which have to be of kinds that are reported, and on the same data."""
    if not results:
        raise ValidationError("there is no result to report on; expected at least one")
    for i, result in enumerate(results):
        if not isinstance(result, (FitResult, Posterior)):
            raise ValidationError(
                f"result {i} is a {type(result).__name__}; expected a FitResult or a Posterior"
            )
        if not np.array_equal(result.data.response, results[0].data.response):
            raise ValidationError(
                f"result {i} is on other data than the first; write a report for each"
            )
    return results


def _content(whole: Document, kind: str) -> bytes:
    if kind == ".html":
        return html(whole)
    if kind == ".pdf":
        from dahl_ident.reporting.pdf import pdf

        return pdf(whole)
    return machine_readable(whole)


def _write_pictures(whole: Document, folder: Path, overwrite: bool) -> None:
    places = {folder / f"{picture.name}.png": picture for picture in _pictures(whole)}
    if not overwrite:
        for place in places:
            refuse_existing(place)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as exc:
        raise DataError(f"{folder}: cannot be made: {exc.strerror or exc}") from exc
    for place, picture in places.items():
        write_whole(place, picture.rendered("png"), overwrite=overwrite)


def machine_readable(whole: Document) -> bytes:
    """Return title, verdict and facts as JSON; numbers that are not finite become null."""
    facts = {
        "schema": SCHEMA,
        "title": whole.title,
        "trusted": whole.trusted,
        "verdict": list(whole.verdict),
        **whole.facts,
    }
    return json.dumps(_finite(facts), indent=2, ensure_ascii=False, allow_nan=False).encode()


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _pictures(whole: Document) -> list[Picture]:
    blocks = (block for section in whole.sections for block in section.blocks)
    return [block for block in blocks if isinstance(block, Picture)]
