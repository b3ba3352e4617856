"""Draw the picture of the README: loops, the measured response with its fit, the estimate."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt

import dahl_ident as di
from dahl_ident.plots import style


def draw() -> plt.Figure:
    """Return the figure."""
    data = di.load_dataset("noisy")
    fit = di.fit(data, di.Dahl())
    friction = di.Dahl(*(fit.params[name].value for name in ("f_max", "sigma")))
    with mpl.rc_context(style.RC):
        figure = plt.figure(figsize=(9.6, 3.5), layout="constrained")
        grid = figure.add_gridspec(2, 3)
        loops = figure.add_subplot(grid[:, 0])
        gain = figure.add_subplot(grid[0, 1])
        phase = figure.add_subplot(grid[1, 1], sharex=gain)
        ellipse = figure.add_subplot(grid[:, 2])

        levels = (0.001, 0.002, 0.004, 0.008, 0.016)
        for A, colour in zip(levels, style.level_colours(len(levels)), strict=True):
            x, F = friction.loop(A)
            loops.plot(1e3 * x, F, color=colour)
        loops.set(xlabel="displacement [mm]", ylabel="friction force [N]")
        loops.set_title("1  drive it at several amplitudes")

        fit.plot_fit((gain, phase))
        gain.legend(loc="lower left", frameon=False)  # above the axes is the title
        gain.set_xlabel("")
        gain.tick_params(labelbottom=False)
        gain.set_title("2  take gain and phase, fit")

        angle = np.linspace(0.0, 2.0 * np.pi, 201)
        circle = np.linalg.cholesky(fit.covar) @ [np.cos(angle), np.sin(angle)]
        centre = np.array([[fit.params[name].value] for name in fit.var_names])
        for level, alpha in ((0.95, 0.2), (0.68, 0.35)):
            f_max, sigma = centre + np.sqrt(-2.0 * np.log(1.0 - level)) * circle
            label = f"{level:.0%} region"
            ellipse.fill(1e3 * f_max, sigma, color=style.BLUE, alpha=alpha, lw=0, label=label)
        truth = data.provenance["truth"]
        ellipse.plot(
            1e3 * truth["f_max"], truth["sigma"], "*", color=style.VERMILION, markersize=12,
            label="truth", zorder=5,
        )  # fmt: skip
        ellipse.errorbar(
            1e3 * fit.params["f_max"].value, fit.params["sigma"].value,
            xerr=1e3 * fit.params["f_max"].stderr, yerr=fit.params["sigma"].stderr,
            fmt="o", color=style.FIT, capsize=3, label="estimate", zorder=4,
        )  # fmt: skip
        ellipse.set(xlabel="f_max [mN]", ylabel="sigma [N/m]")
        ellipse.set_title("3  parameters, and how well known")
        ellipse.legend(loc="upper right", ncols=2)
        ellipse.set_ylim(29.74, 30.30)
    return figure


if __name__ == "__main__":
    draw().savefig(Path(__file__).with_suffix(".png"), dpi=110)
