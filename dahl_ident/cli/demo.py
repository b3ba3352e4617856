"""``dahl-ident demo``: the whole chain on shipped data."""

from __future__ import annotations

from dahl_ident.cli import telling
from dahl_ident.cli.fit import show


def demo() -> None:
    """Run the whole chain on shipped data, with the true values beside the estimates.

    Example: dahl-ident demo
    """
    from dahl_ident.data import FrequencyResponse
    from dahl_ident.elements import Dahl
    from dahl_ident.results import fit
    from dahl_ident.synthetic.shipped import load_dataset

    data = load_dataset("noisy")
    assert isinstance(data, FrequencyResponse)
    telling.heading("data")
    telling.say(repr(data))
    telling.heading("fit")
    result = fit(data, Dahl(), throw=False)
    show(result, json=False)
    truth = (data.provenance or {})["truth"]
    telling.say("the truth: " + ", ".join(f"{k} = {v:g}" for k, v in truth.items()))
    telling.finish(result.success, result.message)
