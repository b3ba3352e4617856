"""Draw the rooms of the package and the data's way through them, as SVG."""

from __future__ import annotations

from pathlib import Path

LAYERS = (
    (("cli", "commands"),),
    (("reporting", "reports"),),
    (("results", "what users hold"),),
    (("plots", "pictures"),),
    (("diagnostics", "judge"),),
    (("fitting", "optimum"), ("bayes", "posterior")),
    (("problem", "residuals, likelihood"),),
    (("noise", "weights"), ("sensors", "gains, delay")),
    (("extraction", "waveforms to table"), ("synthetic", "simulated laboratory")),
    (("steady_state", "plants"), ("control_interop", "loops")),
    (("elements", "the model"),),
    (("data", "tables, records, readers"), ("units", "conversion")),
    (("arrays", "checks"), ("errors", "named errors")),
)
WIDTH, HEIGHT, GAP, LEFT = 420, 30, 8, 30


def draw() -> str:
    """Return the picture."""
    parts = []
    for row, rooms in enumerate(LAYERS):
        y = 20 + row * (HEIGHT + GAP)
        width = (WIDTH - GAP * (len(rooms) - 1)) / len(rooms)
        for column, (name, purpose) in enumerate(rooms):
            x = LEFT + column * (width + GAP)
            parts.append(
                f'<rect x="{x:g}" y="{y}" width="{width:g}" height="{HEIGHT}" rx="5" '
                f'fill="#e8f1f8" stroke="#0072b2"/>'
                f'<text x="{x + 10:g}" y="{y + 20}" font-weight="bold">{name}</text>'
                f'<text x="{x + width - 10:g}" y="{y + 20}" text-anchor="end" '
                f'fill="#555">{purpose}</text>'
            )
    bottom = 20 + len(LAYERS) * (HEIGHT + GAP)
    arrow = LEFT + WIDTH + 24
    parts.append(
        f'<path d="M{arrow} 24V{bottom - 18}" stroke="#d55e00" stroke-width="2" '
        f'marker-end="url(#head)"/><text x="{arrow + 12}" y="{bottom // 2}">imports run</text>'
        f'<text x="{arrow + 12}" y="{bottom // 2 + 16}">downwards only</text>'
    )
    head = (
        '<defs><marker id="head" markerWidth="8" markerHeight="8" refX="4" refY="4" '
        'orient="auto"><path d="M0 0L8 4L0 8z" fill="#d55e00"/></marker></defs>'
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {arrow + 120} {bottom}" '
        f'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="white"/>'
        f"{head}{''.join(parts)}</svg>\n"
    )


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(draw(), encoding="utf-8")
