"""Results in the form that other programs read: simulators, controllers, papers, other budgets.

Each format says which laws it can carry; another one is refused by name, and what a format leaves
out stands as a comment in the file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from dahl_ident.data.storage import write_whole
from dahl_ident.errors import ValidationError, choices
from dahl_ident.results.export import numbers, simulators

FORMATS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "mujoco": ("joint with LuGre friction, MJCF", simulators.mujoco),
    "mujoco-frictionloss": ("joint with its friction limit alone, MJCF", simulators.frictionloss),
    "urdf": ("joint dynamics: friction limit and damping", simulators.urdf),
    "modelica": ("model of the friction, Modelica", simulators.modelica),
    "matlab": ("struct of parameters for Simulink, MATLAB", simulators.matlab),
    "c": ("friction force as a function for feed-forward, C99 header", simulators.c_header),
    "gtc": ("uncertain numbers with their influences, archive of GTC", numbers.gtc_archive),
    "ufloat": ("correlated numbers of the package uncertainties, Python", numbers.ufloat),
    "latex": ("table of parameters", numbers.latex),
}
"""What each format holds, and what makes its text; "draws" has options of its own."""
DRAWS = "draws"


def export(
    result: Any,
    to: str,
    path: str | Path | None = None,
    *,
    overwrite: bool = False,
    size: int = 1000,
    seed: int = 0,
) -> str | Path:
    """Return a result in another form, or write it to a file; see :meth:`Result.export`."""
    if to == DRAWS:
        content = numbers.draws(result, size, seed, path)
    elif to in FORMATS:
        if not hasattr(result, "model"):
            raise ValidationError(f"to is {to!r}, but a posterior is exported as {DRAWS!r} alone")
        content = FORMATS[to][1](result).encode()
    else:
        raise ValidationError(f"to is {to!r}; expected one of {choices([*FORMATS, DRAWS], to)}")
    if path is None:
        return content.decode()
    place = Path(path)
    write_whole(place, content, overwrite=overwrite)
    return place
