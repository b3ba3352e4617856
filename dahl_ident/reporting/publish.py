"""``report(results, path)`` writes results as HTML, PDF, Markdown or JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from dahl_ident.data import Record
from dahl_ident.data.laboratory import Metadata, metadata_of
from dahl_ident.data.storage import make_folder, place_of, plain_data, refuse_existing, write_whole
from dahl_ident.errors import ValidationError, argument, spelled
from dahl_ident.reporting.comparison import of_kind
from dahl_ident.reporting.document import Document
from dahl_ident.reporting.sections import Result, document
from dahl_ident.results import FitResult, Posterior

SCHEMA = 2  # version of the JSON report, raised when readers have to change
_LONGEST_TITLE = 200  # characters
FORMATS = (".html", ".pdf", ".md", ".json")


def report(
    results: Result | Sequence[Result],
    path: str | Path,
    *,
    title: str | None = None,
    command: str | None = None,
    record: Record | None = None,
    metadata: Mapping[str, Any] | str | Path | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a report on one or several results.

    Results on the same data are reported together. Fits of different data (devices, dates) are
    overlaid, and the changes of their parameters are listed with their significance. If a fit of a
    table and one of the waveforms of the same test are given, their parameters are compared, and
    the report begins with whether they agree.

    Parameters
    ----------
    results : FitResult, Posterior, or sequence of them
        The results to report. Results on different data have to be fits.
    path : path
        Ending in ``.html`` (one file, no network), ``.pdf``, ``.md`` (pictures in a folder
        next to it) or ``.json``.
    title : str, optional
        First line; by default the file's name.
    command : str, optional
        The command that reproduces the report; by default the one that fits the same model.
    record : Record, optional
        The waveforms from which the data were extracted; the report shows how a point settled.
    metadata : mapping or path of a TOML file, optional
        Metadata from the laboratory: title, number, laboratory, customer, specimen, method,
        received and measured (dates), place, ambient, instruments, traceability, operator,
        authorised_by, role, remarks. Missing usual fields are printed as lines to fill in.
        An instrument's channel, uncertainty and k are its calibration, which the fit must have
        counted: ``sensors=Sensors.from_metadata(metadata)``.
    overwrite : bool, default False
        Whether to replace an existing report.
    progress : callable, optional
        Called with the number of pictures drawn, and the number of all pictures.

    Returns
    -------
    Path
        The file, complete; an interrupted run leaves none.

    Raises
    ------
    ValidationError
        If there is no result, the path has another ending, the record is of other data, a field of
        the metadata is unknown, an instrument states an uncertainty that the fit did not count,
        a posterior is on other data than the first result, or fits of records are given together
        with fits of several tables.
    DataError
        If the metadata cannot be read, the file exists and `overwrite` is not set, or the place
        cannot be written to.

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
    refuse_existing(place, overwrite=overwrite)
    listed = list(results) if isinstance(results, Sequence) else [results]
    stated = metadata_of(metadata)
    _check(listed)
    _check_calibrations(listed, stated)
    of_tables = of_kind("table", listed)
    if record is not None and not of_tables:
        raise ValidationError(
            f"{argument('record', option='waveforms')} gives the waveforms of a table, but there "
            "is no result on a table; leave it out"
        )
    apart = any(not np.array_equal(t.data.response, of_tables[0].data.response) for t in of_tables)
    if apart and len(of_tables) < len(listed):
        raise ValidationError(
            "fits of several tables are reported together with no fit of records; give those of "
            "one table, or write a report for each"
        )
    draft = document(
        listed, title=title, command=command, record=record, metadata=stated, apart=apart
    )
    finished = draft.finished(_one_line(draft.title), progress)
    kind = place.suffix.lower()
    if kind == ".md":
        folder = place.with_name(f"{place.stem}_pictures")
        _write_pictures(finished, folder, overwrite)
        content = markdown(finished, folder.name)
    else:
        content = content_of(finished, kind)
    write_whole(place, content, overwrite=overwrite)
    return place


def _check(results: Sequence[object]) -> None:
    """Refuse objects that are not results."""
    if not results:
        raise ValidationError("there is no result to report on; expected at least one")
    for i, result in enumerate(results):
        if not isinstance(result, FitResult | Posterior):
            raise ValidationError(
                f"result {i} is a {type(result).__name__}; expected a FitResult or a Posterior"
            )


def _check_calibrations(results: Sequence[Result], stated: Metadata) -> None:
    """Refuse results that do not count the uncertainties which the instruments state."""
    fit_with = spelled("sensors=Sensors.from_metadata(metadata)", "--metadata and this file")
    for name, u in stated.calibrations().items():
        for result in results:
            counted = result.problem.calibrations.get(name, 0.0)
            if not math.isclose(counted, u, rel_tol=0.01):
                taken = f"a standard uncertainty of {counted:.3g}" if counted else "it as exact"
                raise ValidationError(
                    f"the instruments state a standard uncertainty of {u:.3g} for {name}, but the "
                    f"fit takes {taken}; fit with {fit_with}, and report on that fit"
                )


def _one_line(title: str) -> str:
    """Return a short title for every format, without surrogates and control characters."""
    clean = re.sub(r"[\s\x00-\x1f\x7f]+", " ", title.encode(errors="replace").decode())
    return clean if len(clean) <= _LONGEST_TITLE else f"{clean[:_LONGEST_TITLE]}..."


def content_of(whole: Document, kind: str) -> bytes:
    """Return the bytes of a file of a kind: ".html", ".pdf" or ".json"."""
    if kind == ".html":
        return html(whole)
    if kind == ".pdf":
        from dahl_ident.reporting.pdf import pdf

        return pdf(whole)
    return machine_readable(whole)


def _write_pictures(whole: Document, folder: Path, overwrite: bool) -> None:
    places = {folder / f"{picture.name}.png": picture for picture in whole.pictures}
    for place in places:
        refuse_existing(place, overwrite=overwrite)
    make_folder(folder, parents=False)
    for place, picture in places.items():
        write_whole(place, picture.rendered("png"), overwrite=overwrite)


def machine_readable(whole: Document) -> bytes:
    """Return title, verdict and facts as JSON; numbers that are not finite become null."""
    facts = {
        "schema": SCHEMA,
        "title": whole.title,
        "status": whole.status,
        "trusted": whole.trusted,
        "verdict": list(whole.verdict),
        **whole.facts,
    }
    plain = plain_data(facts, not_finite=lambda _: None)
    return json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False).encode(errors="replace")


def html(document: Document) -> bytes:
    """Return the page; text is escaped, and the page's security policy forbids network access."""
    return _rendered(
        "page.html.j2",
        {"autoescape": True},
        document=document,
        foot=_css_text(f"{document.title} {document.identity}".strip()),
        style=_file("page.css"),
        script=_file("page.js"),
    )


def _css_text(text: str) -> str:
    """Return a text as a string for a style sheet, of letters, digits and escapes only."""
    return '"' + "".join(c if c.isalnum() else f"\\{ord(c):x} " for c in text) + '"'


def markdown(document: Document, folder: str) -> bytes:
    """Return the text, with links to the pictures as PNG files in `folder`."""
    options = {"lstrip_blocks": True, "finalize": _escaped}
    text = _rendered("page.md.j2", options, document=document, folder=folder)
    return re.sub(rb" +$", b"", text, flags=re.MULTILINE).rstrip() + b"\n"


def _rendered(name: str, options: Mapping[str, Any], **values: Any) -> bytes:
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, **options)
    return environment.from_string(_file(name)).render(**values).encode(errors="replace")


def _file(name: str) -> str:
    return (files("dahl_ident.reporting") / name).read_text(encoding="utf-8")


def _escaped(text: object) -> str:
    """Return text with all markup characters escaped, but what a template calls safe."""
    if hasattr(text, "__html__"):
        return str(text)
    return re.sub(r"([\\`*_{}\[\]<>|#~$])", r"\\\1", " ".join(str(text).split()))
