"""Draw the rooms of the package, which imports run through, and the data's way, as SVG."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

# Rooms side by side with what they do, and what the data have become when they leave the layer.
LAYERS = (
    ((("cli", "commands"),), ""),
    ((("app", "the page in the browser"),), ""),
    ((("campaigns", "many devices"),), "one table"),
    ((("reporting", "reports"),), "HTML, PDF, Markdown, JSON"),
    ((("results", "what users hold"),), "FitResult, Posterior"),
    ((("diagnostics", "judge"),), "verdicts, intervals"),
    ((("fitting", "optimum"), ("bayes", "posterior")), "optimum, chain"),
    ((("problem", "residuals, likelihood"),), "Problem"),
    ((("noise", "weights"), ("sensors", "gains, delay")), ""),
    ((("extraction", "from waveforms"), ("synthetic", "simulated lab")), "FrequencyResponse"),
    ((("control_interop", "responses and loops"),), ""),
    ((("elements", "the model"),), ""),
    ((("engine", "motions of equations"),), ""),
    ((("data", "tables, records, readers"),), "Record, FrequencyResponse"),
    ((("units", "conversion at the edge"),), "file: numbers with units"),
    ((("plots", "pictures of plain numbers"),), ""),
    ((("arrays", "checks"),), ""),
    ((("errors", "what can go wrong"), ("version", "")), ""),
)
WIDTH, HEIGHT, GAP, LEFT, TOP = 420, 30, 8, 110, 20
BLUE, VERMILION = "#0072b2", "#d55e00"


def draw() -> str:
    """Return the picture."""
    bottom = TOP + len(LAYERS) * (HEIGHT + GAP)
    right = LEFT + WIDTH + 24
    first, last = (
        TOP + row * (HEIGHT + GAP) + HEIGHT // 2
        for row in (_rows_with_data()[0], _rows_with_data()[-1])
    )
    parts = [
        *_rooms(),
        *_data(right),
        _arrow(LEFT - 24, TOP + 4, bottom - 18, VERMILION),
        _arrow(right, last + 12, first - 12, BLUE),
        f'<text x="10" y="{bottom // 2 - 8}" fill="{VERMILION}">imports</text>',
        f'<text x="10" y="{bottom // 2 + 8}" fill="{VERMILION}">run down</text>',
    ]
    heads = "".join(
        f'<marker id="h{colour[1:]}" markerWidth="8" markerHeight="8" refX="4" refY="4" '
        f'orient="auto"><path d="M0 0L8 4L0 8z" fill="{colour}"/></marker>'
        for colour in (BLUE, VERMILION)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {right + 190} {bottom}" '
        f'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="white"/>'
        f"<defs>{heads}</defs>{''.join(parts)}</svg>\n"
    )


def _rooms() -> Iterator[str]:
    for row, (rooms, _) in enumerate(LAYERS):
        y = TOP + row * (HEIGHT + GAP)
        width = (WIDTH - GAP * (len(rooms) - 1)) / len(rooms)
        for column, (name, purpose) in enumerate(rooms):
            x = LEFT + column * (width + GAP)
            yield (
                f'<rect x="{x:g}" y="{y}" width="{width:g}" height="{HEIGHT}" rx="5" '
                f'fill="#e8f1f8" stroke="{BLUE}"/>'
                f'<text x="{x + 10:g}" y="{y + 20}" font-weight="bold">{name}</text>'
                f'<text x="{x + width - 10:g}" y="{y + 20}" text-anchor="end" '
                f'fill="#555">{purpose}</text>'
            )


def _rows_with_data() -> list[int]:
    return [row for row, (_, leaves) in enumerate(LAYERS) if leaves]


def _data(x: int) -> Iterator[str]:
    for row in _rows_with_data():
        y = TOP + row * (HEIGHT + GAP) + HEIGHT // 2
        yield (
            f'<circle cx="{x}" cy="{y}" r="4" fill="{BLUE}"/>'
            f'<text x="{x + 12}" y="{y + 4}">{LAYERS[row][1]}</text>'
        )


def _arrow(x: int, start: int, end: int, colour: str) -> str:
    return (
        f'<path d="M{x} {start}V{end}" stroke="{colour}" stroke-width="2" '
        f'marker-end="url(#h{colour[1:]})"/>'
    )


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(draw(), encoding="utf-8")
