"""Legibility of figures: colours, ends of axes, legends, titles."""

import colorsys
from itertools import combinations, pairwise

import numpy as np
import pytest

from mortarbench.reports.document.figure import (
    Axis,
    Figure,
    Key,
    Legend,
    Panel,
    Row,
    Series,
    limits,
)
from mortarbench.reports.figures.style import COLOURS, look
from mortarbench.reports.render.drawing import draw_curves
from mortarbench.reports.render.plots import panels

#: normal vision and colour blindness as matrices on linear RGB (Machado, Oliveira,
#: Fernandes 2009, severity 1)
SIGHTS = {
    "normal": np.eye(3),
    "deuteranopia": np.array([[0.367322, 0.860646, -0.227968],
                              [0.280085, 0.672501, 0.047413],
                              [-0.011820, 0.042940, 0.968881]]),
    "protanopia": np.array([[0.152286, 1.052583, -0.204868],
                            [0.114503, 0.786281, 0.099216],
                            [-0.003882, -0.048116, 1.051998]]),
}  # fmt: skip


def rgb(colour):
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255


def linear(colour):
    c = rgb(colour)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def oklab(light):
    """Return OKLab coordinates (Ottosson 2020)."""
    lms = np.array([[0.4122214708, 0.5363325363, 0.0514459929],
                    [0.2119034982, 0.6806995451, 0.1073969566],
                    [0.0883024619, 0.2817188376, 0.6299787005]]) @ light  # fmt: skip
    return np.array([[0.2104542553, 0.7936177850, -0.0040720468],
                     [1.9779984951, -2.4285922050, 0.4505937099],
                     [0.0259040371, 0.7827717662, -0.8086757660]]
                    ) @ np.cbrt(lms)  # fmt: skip


@pytest.mark.parametrize(("count", "degrees"), [(8, 27), (14, 14), (len(COLOURS), 6)])
def test_no_two_solvers_of_a_figure_share_a_hue(count, degrees):
    hues = [360 * colorsys.rgb_to_hsv(*rgb(look(i).colour))[0] for i in range(count)]
    gaps = [abs((a - b + 180) % 360 - 180) for a, b in combinations(hues, 2)]
    assert min(gaps) > degrees


@pytest.mark.parametrize("sight", SIGHTS)
def test_the_first_eight_colours_differ_for_colour_blind_readers(sight):
    """A distance of 0.02 in OKLab is about one just noticeable difference."""
    seen = [oklab(np.clip(SIGHTS[sight] @ linear(c), 0, 1)) for c in COLOURS[:8]]
    assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > 0.06


@pytest.mark.parametrize("paper", ["#fffefb", "#15181c"])
def test_all_colours_contrast_with_light_and_dark_pages(paper):
    def luminance(colour):
        return np.array([0.2126, 0.7152, 0.0722]) @ linear(colour) + 0.05

    ratios = [luminance(paper) / luminance(c) for c in COLOURS]
    assert min(max(r, 1 / r) for r in ratios) > 2.3


def test_neighbouring_solvers_also_differ_in_marker_and_dashes():
    looks = [look(i) for i in range(40)]
    for a, b in pairwise(looks):
        assert a.marker != b.marker
        assert a.dash != b.dash


@pytest.mark.parametrize("values", [(19, 22, 22), (5.0, 5.0), (1e-3, 9e-3), (1, 1e6)])
def test_a_logarithmic_axis_spans_a_decade_at_least_and_all_points(values):
    series = Series(x=tuple(range(len(values))), y=values, look=look(0))
    panel = Panel(x=Axis(), y=Axis(log=True), marks=(series,))
    low, high = limits([panel], "y")
    assert high / low >= 10 * (1 - 1e-12)
    assert low < min(values) <= max(values) < high
    assert low * high == pytest.approx(min(values) * max(values))


@pytest.mark.parametrize("log", [False, True])
def test_a_legend_within_a_panel_does_not_hide_curves(log):
    """The highest point of each curve is on the left, like the legend."""
    series = [Series(x=(1, 2, 3), y=(10.0**k, 3, 2), look=look(k)) for k in range(1, 5)]
    keys = tuple(Key(label=f"curve {k}", look=look(k)) for k in range(1, 5))
    panel = Panel(
        x=Axis(), y=Axis(log=log, low=1, high=1e4), marks=tuple(series),
        legend=Legend(keys=keys, place="upper left"),
    )  # fmt: skip
    canvas = draw_curves(Figure(rows=(Row(panels=(panel,)),), height=2.5))
    canvas.draw_without_rendering()
    (axes,) = canvas.axes
    box = axes.get_legend().get_window_extent()
    for line in axes.lines:
        points = axes.transData.transform(line.get_xydata())
        assert (points[:, 1] < box.y0).all()
    assert axes.get_ylim()[0] == 1


def test_the_title_of_a_figure_is_printed_and_shown_on_the_page():
    panel = Panel(x=Axis(), y=Axis(), marks=(Series(x=(1,), y=(2,), look=look(0)),))
    figure = Figure(rows=(Row(panels=(panel,)),), height=2, title="dual, tol 1e-8")
    assert draw_curves(figure).get_suptitle() == "dual, tol 1e-8"
    assert panels(figure, {})[0]["heading"] == "dual, tol 1e-8"
