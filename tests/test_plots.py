"""Plots: what they draw, against pictures that were looked at, and what stands on their axes.

The pictures are compared without their text, whose rendering depends on fonts; text is compared
as text. After a wanted change:
``pytest tests/test_plots.py --mpl-generate-path=tests/baseline``.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import dahl_ident as di
from dahl_ident import plots
from dahl_ident.elements.linear_dahl import describing_function
from dahl_ident.errors import ValidationError
from dahl_ident.plots import Curve, style
from dahl_ident.units import engineering

FRICTION = di.Dahl(0.1, 30.0)
A = np.geomspace(3e-4, 3e-2, 12)
N = FRICTION.describing_function(A)
SCATTER = np.random.default_rng(4).normal(size=(2, 12))
DRAWS = np.random.default_rng(5).multivariate_normal(
    [1.0, 2.0], [[0.01, 0.006], [0.006, 0.01]], 3000
)

BASELINE_VERSION = "3.11"


def same_picture(draw: Callable[[], Figure]) -> Callable[[], Figure]:
    """Compare the figure with its picture, by the version of matplotlib that drew that."""
    compare = pytest.mark.mpl_image_compare(
        baseline_dir="baseline",
        remove_text=True,
        tolerance=2,
        savefig_kwargs={"dpi": 50},
        style="default",
    )
    same_version = pytest.mark.skipif(
        not mpl.__version__.startswith(f"{BASELINE_VERSION}."),
        reason=f"layout moves by a pixel between versions; the pictures are {BASELINE_VERSION}'s",
    )
    compared: Callable[[], Figure] = same_version(compare(draw))
    return compared


def the_figure(axes: Any) -> Figure:
    """Return the figure of some axes, rid of its words."""
    figure: Figure = np.ravel(np.asarray(axes, dtype=object))[0].figure
    for ax in figure.axes:
        ax.set(xlabel="", ylabel="")
        ax.set_title("", loc="left")
        for artist in (*ax.texts, ax.get_legend()):
            if artist is not None:
                artist.remove()
    return figure


@same_picture
def test_amplitude_response() -> Figure:
    fine = np.geomspace(A[0], A[-1], 60)
    R = FRICTION.describing_function(fine)
    gain, phase = np.abs(R), np.angle(R)
    curve = Curve(fine, R, (0.9 * gain, 1.1 * gain), (phase - 0.1, phase + 0.1))
    noisy = N * np.exp(0.05 * (SCATTER[0] + 1j * SCATTER[1]))
    axes = plots.plot_amplitude_response(
        A, noisy, gain_std=0.05 * np.abs(N), phase_std=np.full(12, 0.05), curve=curve
    )
    return the_figure(axes)


@same_picture
def test_universal_curve() -> Figure:
    beta = np.geomspace(1e-3, 1e4, 200)
    marks = [(1.0, complex(describing_function(np.array([1.0]))[0]))]
    axes = plots.plot_universal_curve(N / 30.0, curve=describing_function(beta), marked_beta=marks)
    return the_figure(axes)


@same_picture
def test_loops() -> Figure:
    sizes = (1e-3, 3e-3, 1e-2)
    loops = [(*FRICTION.loop(size), f"{size:g} m") for size in sizes]
    measured = [(x, 1.05 * force) for x, force in (FRICTION.loop(size, 60) for size in sizes)]
    return the_figure(plots.plot_loops(loops, measured=measured))


@same_picture
def test_frequency_response_of_figure_7() -> Figure:
    plant = FRICTION + di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3)
    f = np.geomspace(0.05, 5.0, 40)
    levels = []
    for drive in np.geomspace(1e-3, 10.0, 9):
        X = di.response(plant, f, np.full(40, drive)).displacement
        levels.append((f"{drive:.2g} N", f, X / drive))
    return the_figure(plots.plot_frequency_response(levels))


@same_picture
def test_residuals() -> Figure:
    return the_figure(plots.plot_residuals(A, SCATTER[0], SCATTER[1], suspicious=[3]))


@same_picture
def test_profile() -> Figure:
    value = np.linspace(0.09, 0.11, 21)
    axes = plots.plot_profile(
        value, ((value - 0.1) / 0.004) ** 2, best=0.1, limits={"68 %": 1.0, "95 %": 4.0},
        label="f_max [N]",
    )  # fmt: skip
    return the_figure(axes)


@same_picture
def test_correlation() -> Figure:
    return the_figure(plots.plot_correlation(["f_max", "sigma"], [[1.0, -0.7], [-0.7, 1.0]]))


@same_picture
def test_information() -> Figure:
    share = A / A.sum()
    return the_figure(plots.plot_information(A, {"f_max": share, "sigma": share[::-1]}))


@same_picture
def test_corner() -> Figure:
    return the_figure(plots.plot_corner(["a [N]", "b [m]"], DRAWS, truth={"a [N]": 1.05}))


@same_picture
def test_trace() -> Figure:
    chain = DRAWS.reshape(100, 30, 2)
    return the_figure(plots.plot_trace(["a", "b"], chain, discard=20))


@same_picture
def test_cycles() -> Figure:
    decay = 0.5 ** np.arange(8)
    axes = plots.plot_cycles(
        30.0 + 5j + decay * (1 - 2j), 1e-3 * decay, left_out=2, response_std=0.05, mean_std=1e-5
    )
    return the_figure(axes)


def _amplitude(ax: Any) -> Any:
    return plots.plot_amplitude_response(A, N, ax=ax)


def _frequency(ax: Any) -> Any:
    return plots.plot_frequency_response([("1 N", A, N)], ax=ax)


def _cycles(ax: Any) -> Any:
    return plots.plot_cycles(N, A, ax=ax)


PAIRS = (_amplitude, _frequency, _cycles)
SINGLES: dict[str, Callable[[Axes], Axes]] = {
    "universal curve": lambda ax: plots.plot_universal_curve(N, curve=N, ax=ax),
    "loops": lambda ax: plots.plot_loops([(A, A, "a")], ax=ax),
    "residuals": lambda ax: plots.plot_residuals(A, A, A, ax=ax),
    "profile": lambda ax: plots.plot_profile(A, A, best=1.0, limits={"1": 1.0}, label="k", ax=ax),
    "correlation": lambda ax: plots.plot_correlation(["a"], [[1.0]], ax=ax),
    "information": lambda ax: plots.plot_information(A, {"a": A}, ax=ax),
}


def test_residuals_are_joined_along_each_curve_only() -> None:
    axis = plots.plot_residuals([1, 2, 1, 2], [1, 2, 3, 4], [0, 0, 0, 0], group=[0, 0, 1, 1])
    joined = [list(np.asarray(x.get_ydata())) for x in axis.lines if x.get_linestyle() == "-"]
    assert [1, 2] in joined
    assert [3, 4] in joined
    assert [1, 2, 3, 4] not in joined
    plt.close("all")


def test_a_fitted_phase_lies_on_the_turn_of_its_points() -> None:
    x = np.array([1.0, 2.0, 3.0])
    measured = np.exp(1j * np.radians([179.0, 181.0, 183.0]))
    fitted = plots.Curve(x, np.exp(1j * np.radians([-181.5, -179.5, -177.5])))
    _, bottom = plots.plot_frequency_response([("a", x, measured)], fitted=[fitted])
    (curve,) = (line for line in bottom.lines if line.get_linestyle() == "-")
    np.testing.assert_allclose(np.asarray(curve.get_ydata()), [178.5, 180.5, 182.5])
    plt.close("all")


@pytest.mark.parametrize("draw", SINGLES.values(), ids=SINGLES.keys())
def test_single_plots_draw_on_the_axes_given(draw: Callable[[Axes], Axes]) -> None:
    figure, ax = plt.subplots()
    assert draw(ax) is ax
    assert figure.axes == [ax]
    plt.close(figure)


@pytest.mark.parametrize("draw", PAIRS)
def test_plots_of_two_parts_draw_on_the_axes_given(draw: Callable[[Any], Any]) -> None:
    figure, pair = plt.subplots(2, 1)
    assert list(draw(pair)) == list(pair)
    assert len(figure.axes) == 2
    plt.close(figure)
    figure, ax = plt.subplots()
    with pytest.raises(ValidationError, match="ax holds 1 axes; expected two"):
        draw(ax)
    plt.close(figure)


def test_corner_refuses_axes_of_another_shape() -> None:
    figure, grid = plt.subplots(1, 2)
    with pytest.raises(ValidationError, match=r"ax has shape \(2,\); expected \(2, 2\)"):
        plots.plot_corner(["a", "b"], DRAWS, ax=grid)
    plt.close(figure)


def test_only_wide_ranges_are_drawn_over_their_logarithm() -> None:
    draws = np.stack([DRAWS[:, 0], np.exp(20.0 * DRAWS[:, 1])], axis=-1)
    grid = plots.plot_corner(["narrow", "wide"], draws, log=[True, True])
    assert (grid[1, 0].get_xscale(), grid[1, 0].get_yscale()) == ("linear", "log")
    rows = plots.plot_trace(["narrow", "wide"], draws.reshape(100, 30, 2), log=[True, True])
    assert [axis.get_yscale() for axis in rows] == ["linear", "log"]
    plt.close("all")


def test_every_axis_has_its_unit() -> None:
    top, bottom = _amplitude(None)
    assert (top.get_ylabel(), bottom.get_ylabel()) == ("gain [N/m]", "phase [degrees]")
    assert bottom.get_xlabel() == "displacement amplitude [m]"
    top, bottom = _frequency(None)
    assert (top.get_ylabel(), bottom.get_xlabel()) == ("gain [m/N]", "frequency [Hz]")
    loops = plots.plot_loops([(A, A, "a")])
    assert (loops.get_xlabel(), loops.get_ylabel()) == ("displacement [m]", "force [N]")
    residuals = plots.plot_residuals(A, A, A)
    assert residuals.get_ylabel() == "residual [standard deviations]"
    information = plots.plot_information(A, {"a": A / A.sum()})
    assert information.get_xlabel() == "displacement amplitude [m]"
    assert information.get_title(loc="left") == "share of the information, by area"
    plt.close("all")


def test_series_differ_for_every_reader() -> None:
    """Also without green receptors (Machado, Oliveira and Fernandes 2009), and by their markers."""
    deuteranopia = np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]])
    colours = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in style.SERIES]) / 255.0
    for seen in (colours, colours @ deuteranopia.T):
        distance = np.linalg.norm(seen[:, None] - seen[None], axis=-1)
        assert distance[np.triu_indices(len(seen), 1)].min() > 0.15
    assert len(set(style.MARKERS)) == len(style.MARKERS) == len(style.SERIES)


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (3.33e-3, "m", "3.33 mm"), (2e-7, "m", "200 nm"), (0.0, "N", "0 N"),
        (5.0, "N/m", "5 N/m"), (2.5e3, "N", "2.5 kN"), (float("inf"), "N", "inf N"),
    ],
)  # fmt: skip
def test_engineering_notation(value: float, unit: str, text: str) -> None:
    assert engineering(value, unit) == text


def test_the_house_style_stays_in_its_figures() -> None:
    before = dict(mpl.rcParams)
    plots.plot_residuals(A, A, A)
    assert dict(mpl.rcParams) == before
    plt.close("all")


def test_a_notebook_stays_interactive_after_the_first_picture(tmp_path: Path) -> None:
    backend = tmp_path / "notebook_like.py"
    backend.write_text(
        "import matplotlib\n"
        "from matplotlib.backends.backend_agg import *\n"
        "matplotlib.interactive(True)\n"
    )
    code = (
        "import matplotlib; from dahl_ident.plots import plot_loops, plot_corner;"
        "import numpy as np;"
        "{draw}; assert 'notebook_like' in matplotlib.get_backend();"
        "assert matplotlib.is_interactive()"
    )
    environment = os.environ | {
        "MPLBACKEND": "module://notebook_like", "PYTHONPATH": str(tmp_path)
    }  # fmt: skip
    for draw in ("plot_loops([([0, 1], [0, 1], 'a')])", "plot_corner(['a'], np.eye(9)[:, :1])"):
        subprocess.run([sys.executable, "-c", code.format(draw=draw)], check=True, env=environment)
