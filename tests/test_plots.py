"""Plots: what they draw, against pictures that were looked at, and what stands on their axes.

Pictures are compared with their labels, which must not collide. After a wanted change:
``pytest tests/test_plots.py --mpl-generate-path=tests/baseline``.
"""

import itertools
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

import dahl_ident as di
from dahl_ident import plots
from dahl_ident.control_interop import LoopMargins
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


def same_picture(draw):
    """Compare the figure, labels included, with its picture by the same matplotlib."""
    compare = pytest.mark.mpl_image_compare(
        baseline_dir="baseline", tolerance=4, savefig_kwargs={"dpi": 90}, style="default"
    )
    same_version = pytest.mark.skipif(
        not mpl.__version__.startswith(f"{BASELINE_VERSION}."),
        reason=f"layout moves by a pixel between versions; the pictures are {BASELINE_VERSION}'s",
    )
    compared: Callable[[], Figure] = same_version(compare(draw))
    return compared


def the_figure(axes):
    """Return the figure of some axes, in which no labels collide."""
    figure: Figure = np.ravel(np.asarray(axes, dtype=object))[0].figure
    assert colliding_labels(figure) == []
    return figure


def colliding_labels(figure):
    """Return the pairs of texts that overlap, and those that leave the page."""
    page = figure.bbox.padded(1.0)
    boxes = [(t.get_text(), t.get_window_extent(), t.get_rotation() % 90) for t in _drawn(figure)]
    found = [(text, "edge of the page") for text, box, _ in boxes if not _inside(box, page)]
    for (a, one, turned), (b, other, also) in itertools.combinations(boxes, 2):
        # the boxes of slanted neighbours overlap where their letters do not
        shrunk = (box.shrunk(0.5 if turned or also else 0.98, 0.9) for box in (one, other))
        if Bbox.intersection(*shrunk) is not None:
            found.append((a, b))
    return found


def _drawn(figure):
    """Return the texts that are drawn: tick labels beyond the limits, for one, are not."""
    drawn: list[Text] = []
    draw = Text.draw

    def noted(self, renderer):
        if self.get_visible() and self.get_text().strip():
            drawn.append(self)
        draw(self, renderer)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Text, "draw", noted)
        figure.canvas.draw()
    return drawn


def _inside(box, page):
    return bool(page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0 and box.y1 <= page.y1)


@same_picture
def test_amplitude_response():
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
def test_universal_curve():
    beta = np.geomspace(1e-3, 1e4, 200)
    marks = [(1.0, complex(describing_function(np.array([1.0]))[0]))]
    axes = plots.plot_universal_curve(N / 30.0, curve=describing_function(beta), marked_beta=marks)
    return the_figure(axes)


@same_picture
def test_loops():
    sizes = (1e-3, 3e-3, 1e-2)
    loops = [(*FRICTION.loop(size), f"{size:g} m") for size in sizes]
    measured = [(x, 1.05 * force) for x, force in (FRICTION.loop(size, 60) for size in sizes)]
    return the_figure(plots.plot_loops(loops, measured=measured))


@same_picture
def test_frequency_response_of_figure_7():
    plant = FRICTION + di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3)
    f = np.geomspace(0.05, 5.0, 40)
    levels = []
    for drive in np.geomspace(1e-3, 10.0, 9):
        drives = np.full(40, drive)
        X = di.response(plant, f, drives, steady="describing function").displacement
        levels.append((f"{drive:.2g} N", f, X / drive))
    return the_figure(plots.plot_frequency_response(levels))


@same_picture
def test_residuals():
    return the_figure(plots.plot_residuals(A, SCATTER[0], SCATTER[1], suspicious=[3]))


@same_picture
def test_profile():
    value = np.linspace(0.09, 0.11, 21)
    axes = plots.plot_profile(
        value, ((value - 0.1) / 0.004) ** 2, best=0.1, limits={"68 %": 1.0, "95 %": 4.0},
        label="f_max [N]",
    )  # fmt: skip
    return the_figure(axes)


@same_picture
def test_correlation():
    return the_figure(plots.plot_correlation(["f_max", "sigma"], [[1.0, -0.7], [-0.7, 1.0]]))


@same_picture
def test_information():
    share = A / A.sum()
    return the_figure(plots.plot_information(A, {"f_max": share, "sigma": share[::-1]}))


@same_picture
def test_corner():
    return the_figure(plots.plot_corner(["a [N]", "b [m]"], DRAWS, truth={"a [N]": 1.05}))


@same_picture
def test_trace():
    chain = DRAWS.reshape(100, 30, 2)
    return the_figure(plots.plot_trace(["a", "b"], chain, discard=20))


@same_picture
def test_cycles():
    decay = 0.5 ** np.arange(8)
    axes = plots.plot_cycles(
        30.0 + 5j + decay * (1 - 2j), 1e-3 * decay, left_out=2, response_std=0.05, mean_std=1e-5
    )
    return the_figure(axes)


@same_picture
def test_budget():
    shares = {"noise": (0.2, 0.05), "force calibration": (0.75, 0.9), "between runs": (0.05, 0.05)}
    rows = [
        (name, source, share)
        for source, both in shares.items()
        for name, share in zip(("f_max", "sigma"), both, strict=True)
    ]
    return the_figure(plots.plot_budget(rows))


def test_long_names_of_sources_are_not_cut_off():
    sources = "scatter between runs", "force calibration", "noise", "exponent"
    rows = [("force_gain", source, 0.2) for source in (*sources, "scatter between repeated levels")]
    the_figure(plots.plot_budget(rows))


def test_the_legends_of_plans_and_devices_hide_no_data():
    time = np.array([100.0, 1000.0])
    curves = dict.fromkeys(("f_max", "sigma", "alpha"), (time, 1.0 / time, 2.0 / time))
    own = np.array([0.05, 0.10, 0.11])
    devices = {"own": own, "shrunken": own, "u": 0.1 * own, "outlying": own < 0.1}
    for axis in (
        plots.plot_bench_time(curves),
        plots.plot_devices(pd.DataFrame(devices), 0.1, label="f_max [N]"),
    ):
        the_figure(axis)
        assert axis.get_legend().get_window_extent().y0 >= axis.bbox.y1


@same_picture
def test_margins():
    gain = np.where(A > 1e-2, np.inf, 1.0 / A)
    return the_figure(plots.plot_margins(A, gain, 50.0 + 1e3 * A))


@same_picture
def test_nichols():
    f = np.geomspace(0.1, 10.0, 50)
    levels = [(f"{k} N", 1.0 / (1.0 - f**2 + 0.2j * k * f)) for k in (1, 2, 4)]
    return the_figure(plots.plot_nichols(levels, gain_label="receptance [m/N]"))


@same_picture
def test_waveforms():
    t = np.linspace(0.0, 2.0, 400)
    x = 1e-2 * np.sin(2 * np.pi * t)
    force = FRICTION.force(x)
    channels = [("displacement [m]", x), ("force [N]", force)]
    return the_figure(plots.plot_waveforms(t, channels, fitted=[None, 0.97 * force]))


@pytest.mark.versions
def test_records_draw_themselves():
    record = di.Record([0.0, 0.1, 0.2], velocity=[0.0, 1.0, 0.0], force=[0.0, 2.0, 1.0])
    rows = record.plot()
    assert [axis.get_ylabel() for axis in rows] == ["velocity [m/s]", "force [N]"]
    np.testing.assert_array_equal(rows[1].lines[0].get_ydata(), record.force)
    loop = record.plot("loops")
    assert (loop.get_xlabel(), loop.get_ylabel()) == ("velocity [m/s]", "force [N]")
    with pytest.raises(ValidationError, match="kind is 'bode'; expected 'waveforms' or 'loops'"):
        record.plot("bode")  # type: ignore[arg-type]
    with pytest.raises(ValidationError, match="ax holds 1 axes; expected 2"):
        record.plot(ax=[loop])


def test_margins_that_are_infinite_everywhere_are_drawn():
    margins = LoopMargins(A, np.full(12, np.inf), np.full(12, 60.0), np.ones(12))
    top, _ = margins.plot()
    assert [text.get_text() for text in top.get_legend().get_texts()] == ["infinite"]
    assert colliding_labels(top.figure) == []
    draws = LoopMargins(A, np.full((5, 12), np.inf), np.full((5, 12), np.inf), np.ones((5, 12)))
    assert colliding_labels(draws.plot()[0].figure) == []
    top, _ = LoopMargins(A, np.full(12, 10.0), np.full(12, 60.0), np.ones(12)).plot()
    np.testing.assert_allclose(np.asarray(top.lines[0].get_ydata()), 20.0)
    assert (top.get_yscale(), top.get_ylabel()) == ("linear", "gain margin [dB]")


AWKWARD = {  # name, centre, spread, logarithmic
    "narrow": ("f_max [N]", 0.09982, 3e-5, False),
    "tiny": ("damping [N s/m]", 3.2e-7, 4e-9, False),
    "large": ("stiffness [N/m]", 1.23456e6, 20.0, False),
    "wide": ("exponent", 0.0, 2.5, True),
    "two decades": ("another.sigma [N m/rad]", 0.0, 1.0, True),
}


def _spread(name, z):
    """Return values of a parameter whose name, spread and logarithm are awkward."""
    _, centre, spread, log = AWKWARD[name]
    return np.exp(centre + spread * z) if log else centre + spread * z


@pytest.mark.parametrize(
    "count", [1, 5, *(pytest.param(n, marks=pytest.mark.long) for n in (2, 3))]
)
@pytest.mark.versions
def test_labels_of_corner_and_trace_do_not_collide(count):
    chosen = list(AWKWARD)[:count]
    normal = np.random.default_rng(3).standard_normal((3200, count))
    draws = np.column_stack([_spread(name, z) for name, z in zip(chosen, normal.T, strict=True)])
    names, log = [AWKWARD[name][0] for name in chosen], [AWKWARD[name][3] for name in chosen]
    grid = plots.plot_corner(names, draws, log=log)
    assert colliding_labels(grid[0, 0].figure) == []
    rows = plots.plot_trace(names, draws.reshape(100, 32, count), log=log, discard=20)
    assert colliding_labels(rows[0].figure) == []


@pytest.mark.parametrize("name", AWKWARD)
@pytest.mark.parametrize("width", [2.4, 4.6])
def test_labels_of_profiles_do_not_collide(name, width):
    label, _, _, log = AWKWARD[name]
    z = np.linspace(-3.2, 3.2, 21)
    value = _spread(name, z)
    axis = style.new_axes(1, 1, size=(width, 1.9), sharex=False)[0, 0]
    limits = {"68.27 %": 1.0, "95.45 %": 4.0, "99.73 %": 9.0}
    best = float(value[10])
    plots.plot_profile(value, z**2, best=best, limits=limits, label=label, log=log, ax=axis)
    assert colliding_labels(axis.figure) == []
    ticks = set(axis.get_xticklabels())
    assert len(ticks.intersection(_drawn(axis.figure))) >= 2


PAIRS: dict[str, Callable[[Any], Any]] = {
    "amplitude": lambda ax: plots.plot_amplitude_response(A, N, ax=ax),
    "frequency": lambda ax: plots.plot_frequency_response([("1 N", A, N)], ax=ax),
    "cycles": lambda ax: plots.plot_cycles(N, A, ax=ax),
}
SINGLES: dict[str, Callable[[Axes], Axes]] = {
    "universal curve": lambda ax: plots.plot_universal_curve(N, curve=N, ax=ax),
    "loops": lambda ax: plots.plot_loops([(A, A, "a")], ax=ax),
    "residuals": lambda ax: plots.plot_residuals(A, A, A, ax=ax),
    "profile": lambda ax: plots.plot_profile(A, A, best=1.0, limits={"1": 1.0}, label="k", ax=ax),
    "correlation": lambda ax: plots.plot_correlation(["a"], [[1.0]], ax=ax),
    "information": lambda ax: plots.plot_information(A, {"a": A}, ax=ax),
}


def test_residuals_are_joined_along_each_curve_only():
    axis = plots.plot_residuals([1, 2, 1, 2], [1, 2, 3, 4], [0, 0, 0, 0], group=[0, 0, 1, 1])
    joined = [list(np.asarray(x.get_ydata())) for x in axis.lines if x.get_linestyle() == "-"]
    assert [1, 2] in joined
    assert [3, 4] in joined
    assert [1, 2, 3, 4] not in joined


def test_a_fitted_phase_lies_on_the_turn_of_its_points():
    x = np.array([1.0, 2.0, 3.0])
    measured = np.exp(1j * np.radians([179.0, 181.0, 183.0]))
    fitted = plots.Curve(x, np.exp(1j * np.radians([-181.5, -179.5, -177.5])))
    _, bottom = plots.plot_frequency_response([("a", x, measured)], fitted=[fitted])
    (curve,) = (line for line in bottom.lines if line.get_linestyle() == "-")
    np.testing.assert_allclose(np.asarray(curve.get_ydata()), [178.5, 180.5, 182.5])


@pytest.mark.parametrize("draw", SINGLES.values(), ids=SINGLES)
@pytest.mark.versions
def test_single_plots_draw_on_the_axes_given(draw):
    figure, ax = plt.subplots()
    assert draw(ax) is ax
    assert figure.axes == [ax]


@pytest.mark.parametrize("draw", PAIRS.values(), ids=PAIRS)
@pytest.mark.versions
def test_plots_of_two_parts_draw_on_the_axes_given(draw):
    figure, pair = plt.subplots(2, 1)
    assert list(draw(pair)) == list(pair)
    assert len(figure.axes) == 2
    with pytest.raises(ValidationError, match="ax holds 1 axes; expected 2"):
        draw(pair[0])


def test_corner_refuses_axes_of_another_shape():
    with pytest.raises(ValidationError, match=r"ax has shape \(2,\); expected \(2, 2\)"):
        plots.plot_corner(["a", "b"], DRAWS, ax=plt.subplots(1, 2)[1])


def test_only_wide_ranges_are_drawn_over_their_logarithm():
    draws = np.stack([DRAWS[:, 0], np.exp(20.0 * DRAWS[:, 1])], axis=-1)
    grid = plots.plot_corner(["narrow", "wide"], draws, log=[True, True])
    assert (grid[1, 0].get_xscale(), grid[1, 0].get_yscale()) == ("linear", "log")
    rows = plots.plot_trace(["narrow", "wide"], draws.reshape(100, 30, 2), log=[True, True])
    assert [axis.get_yscale() for axis in rows] == ["linear", "log"]


SEEN_BY = {  # matrices of Machado, Oliveira and Fernandes 2009, for missing receptors
    "all receptors": np.eye(3),
    "no red": np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]),
    "no green": np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]),
    "no blue": np.array([[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]]),
}


def _luminance(colours):
    """Return the relative luminance of sRGB colours (WCAG 2)."""
    c = np.asarray(colours)
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def _distances(colours):
    return np.linalg.norm(colours[:, None] - colours[None], axis=-1)


def test_lines_and_markers_stand_out_from_the_page():
    """At least 3 to 1 against white (WCAG 2, graphical objects)."""
    levels = [c for n in range(1, 30) for c in style.level_colours(n)]
    for colour in (*style.SERIES, style.FIT, style.GREY, *levels):
        assert 1.05 / (_luminance(mpl.colors.to_rgb(colour)) + 0.05) >= 3.0, colour


@pytest.mark.parametrize("reader", SEEN_BY)
def test_series_differ_for_every_reader(reader):
    colours = np.array([mpl.colors.to_rgb(c) for c in style.SERIES])
    seen = np.clip(colours @ SEEN_BY[reader].T, 0.0, 1.0)
    assert _distances(seen)[np.triu_indices(len(seen), 1)].min() > 0.12
    assert len(set(style.MARKERS)) == len(style.MARKERS) == len(style.SERIES)


@pytest.mark.parametrize("reader", [*SEEN_BY, "grey print"])
@pytest.mark.parametrize("count", [2, 5, 9, 12])
def test_levels_differ_for_every_reader(reader, count):
    """Two levels of one line style or marker differ in colour, in a grey print in lightness."""
    colours = np.array([mpl.colors.to_rgb(c) for c in style.level_colours(count)])
    if reader == "grey print":
        lightness = 116.0 * np.cbrt(_luminance(colours)) - 16.0
        apart, least = np.abs(lightness[:, None] - lightness[None]), 10.0
    else:
        apart, least = _distances(np.clip(colours @ SEEN_BY[reader].T, 0.0, 1.0)), 0.12
    looks = (
        [str(look["linestyle"]) for look in style.level_lines(count)],
        [look["marker"] for look in style.level_markers(count)],
    )
    for own in looks:
        for i, j in itertools.combinations(range(count), 2):
            assert own[i] != own[j] or apart[i, j] > least, (i, j, apart[i, j])


def test_repeated_measurements_of_a_level_are_not_joined():
    top, _ = plots.plot_frequency_response(
        [("curve", [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]), ("repeats", [1.0, 1.0, 2.0], [1.0, 3.0, 2.0])]
    )
    assert [line.get_linestyle() for line in top.lines] == ["-", "None"]


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (3.33e-3, "m", "3.33 mm"), (2e-7, "m", "200 nm"), (0.0, "N", "0 N"),
        (5.0, "N/m", "5 N/m"), (2.5e3, "N", "2.5 kN"), (float("inf"), "N", "inf N"),
        (9.997e-7, "m", "1 \u00b5m"),
    ],
)  # fmt: skip
def test_engineering_notation(value, unit, text):
    assert engineering(value, unit) == text


def test_the_house_style_stays_in_its_figures():
    before = dict(mpl.rcParams)
    plots.plot_residuals(A, A, A)
    assert dict(mpl.rcParams) == before


def test_axes_of_the_user_are_drawn_on_in_the_house_style():
    with mpl.rc_context({"legend.fontsize": 13.0, "lines.linewidth": 4.0}):
        _, ax = plt.subplots()
        plots.plot_loops([(A, A, "a")], ax=ax)
        assert mpl.rcParams["legend.fontsize"] == 13.0
    (line,), legend = ax.lines, ax.get_legend()
    assert line.get_linewidth() == style.RC["lines.linewidth"]
    assert legend.get_texts()[0].get_fontsize() == style.RC["legend.fontsize"]


@pytest.mark.versions
def test_a_notebook_stays_interactive_after_the_first_picture(tmp_path):
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


def test_residuals_of_a_fit_over_amplitude_frequency_and_velocity():
    f = np.linspace(0.5, 3.0, 12)
    data = di.FrequencyResponse(f, N * np.exp(0.01 * (SCATTER[0] + 1j * SCATTER[1])), A)
    fit = di.fit(data, di.Dahl(), throw=False)
    places: dict[Any, Any] = {"amplitude": A, "frequency": f, "velocity": 2.0 * np.pi * f * A}
    for against, x in places.items():
        axis = fit.plot_residuals(against=against)
        assert against in axis.get_xlabel()
        drawn = next(line for line in axis.lines if line.get_label() == "ln gain")
        np.testing.assert_allclose(np.asarray(drawn.get_xdata()), x)
    with pytest.raises(ValidationError, match="against is 'time'; expected one of amplitude"):
        fit.plot_residuals(against="time")


def test_a_legend_of_long_names_leaves_the_axes_their_width():
    levels = [(f"ForceControl[{i}]", [79.0, 80.0, 81.0], [1.0, 2.0 - 1.0j, 0.5]) for i in range(4)]
    top, _ = plots.plot_frequency_response(levels)
    top.figure.draw_without_rendering()
    assert top.get_window_extent().width > 0.7 * top.figure.bbox.width
    assert top.get_legend().get_window_extent().x1 < top.figure.bbox.x1
