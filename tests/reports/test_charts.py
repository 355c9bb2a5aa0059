"""Plots as SVG: positions, texts and embedding in pages."""

import itertools
import math
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.text import Text
from raising import raises

from counterspin.errors import CounterspinError
from counterspin.reports.blocks import Bars, HeatMap, Plot, PlotSeries, Sphere
from counterspin.reports.chart_layout import (
    date_ticks,
    shorten_text,
    text_width,
    thin_series,
    wrap_text,
)
from counterspin.reports.charts import render_svg, save_figure
from counterspin.reports.drawing import PAPER_COLOURS, draw_pictures, drawing_parameters

LINE = Plot(
    "Drift <&> $x$",
    "time / s",
    "drift / (ppm/h)",
    (
        PlotSeries("fitted", (0.0, 1.0, 2.0), (1.0, 3.0, 2.0), (0.0, 2.0, 1.0), (2.0, 4.0, 3.0)),
        PlotSeries("seen", (0.0, 1.0, 2.0), (1.1, None, 2.2), kind="points"),
        PlotSeries("rejected", (0.5,), (4.0,), kind="points", is_highlighted=True),
    ),
    levels=(0.0,),
)
BARS = Bars("Budget", ("noise", "priors"), (90.0, 10.0), ("90 %", "10 %"))
MAP = HeatMap("Correlations", ("K_F", "K_II"), ((1.0, -0.95), (-0.95, 1.0)))
SPHERE = Sphere(
    "Poses",
    ("X", "Y", "Z"),
    ((0.0, 0.0, 1.0), (0.6, 0.8, 0.0)),
    (0.5, -2.0),
    ("1", "2"),
    "residual, mm/s^2",
    frozenset({1}),
)
PICTURES = [LINE, BARS, MAP, SPHERE]

NAMESPACE = "{http://www.w3.org/2000/svg}"

every_picture = pytest.mark.parametrize(
    "picture", PICTURES, ids=["plot", "bars", "heat map", "sphere"]
)
every_theme = pytest.mark.parametrize("theme", ["light", "page"])


def svg_texts(text):
    return ["".join(node.itertext()) for node in ET.fromstring(text).iter(f"{NAMESPACE}text")]


def number_pairs(path):
    numbers = [float(n) for n in re.findall(r"-?[\d.]+", path)]
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def paths(text, colour, *, kind="stroke"):
    """Return the points of all paths with a paper colour across the drawing."""
    actual_text = ET.fromstring(text).iter(f"{NAMESPACE}path")
    style = f"{kind}: {PAPER_COLOURS[colour]}"
    return [
        number_pairs(p.get("d"))
        for p in actual_text
        if style in p.get("style", "") and "clip" in str(p.attrib)
    ]


@every_picture
@every_theme
def test_svg_can_be_embedded_in_page(picture, theme):
    text = render_svg(picture, theme=theme)
    root = ET.fromstring(text)
    assert root.tag == f"{NAMESPACE}svg"
    assert root.get("width") == "100%"
    assert "height" not in root.attrib
    x, y, width, height = map(float, root.get("viewBox").split())
    assert (x, y, width) == (0.0, 0.0, 504.0)
    assert height > 20.0
    assert root[0].tag == f"{NAMESPACE}title"
    assert root[0].text == picture.title
    # A style sheet would affect the rest of the page.
    assert "<style" not in text
    assert "<metadata" not in text


@pytest.mark.slow
@every_theme
def test_svg_is_reproducible_across_processes(theme):
    code = f"""
import sys
from counterspin.reports.blocks import *
from counterspin.reports.charts import render_svg
for picture in {PICTURES!r}:
    sys.stdout.buffer.write(render_svg(picture, theme={theme!r}).encode())
"""
    first = [render_svg(picture, theme=theme) for picture in PICTURES]
    run = subprocess.run(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONHASHSEED": "7"},
        check=True,
    )
    assert [render_svg(picture, theme=theme) for picture in PICTURES] == first
    assert run.stdout.decode() == "".join(first)


def test_ids_are_unique_across_plots_and_references_resolve():
    taken = []
    for picture in [*PICTURES, Bars("Another", BARS.labels, BARS.values, BARS.texts)]:
        text = render_svg(picture)
        ids = re.findall(r' id="([^"]+)"', text)
        assert set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', text)) <= {
            pair for name in ids for pair in ((name, ""), ("", name))
        }
        taken += ids
    assert taken
    assert len(taken) == len(set(taken))


@every_picture
def test_page_theme_sets_all_colours_and_font(picture):
    text = render_svg(picture, theme="page")
    assert "font-family" not in text
    bare = re.sub(r"var\(--([a-z0-9-]+), (currentColor|#[0-9a-f]{6})\)", r"<\1>", text.lower())
    bare = re.sub(r"var\(--ink, currentcolor\)", "<ink>", bare)
    assert re.findall(r"(?<![(\"])#[0-9a-f]{3,6}\b", bare) == []
    assert re.findall(r"(?:fill|stroke): (?!<|none)\S+", bare) == []
    named = set(re.findall(r"var\(--([a-z0-9-]+)", text))
    assert named <= set(PAPER_COLOURS)
    assert "ink" in named


def test_paper_theme_has_fixed_colours():
    text = render_svg(LINE)
    assert "var(" not in text
    assert set(re.findall(r"#[0-9a-f]{6}\b", text)) <= set(PAPER_COLOURS.values()) | set(
        re.findall(r"#(?=p)\w+", text)
    )


def test_text_is_not_changed():
    odd = {"time / $s^2$", "a_b < c & d", 'x$y$ #0100fe id="m" "z"\u3000d="M 1  2"'}
    x_label, y_label, label = sorted(odd)
    plot = Plot("", x_label, y_label, (PlotSeries(label, (0.0, 1.0), (0.0, 1.0)),))
    assert odd <= set(svg_texts(render_svg(plot)))


def test_symbols_have_subscripts():
    plot = Plot("", "K_II of a_run, ug", "K_I.csv and E_n", (PlotSeries("", (0.0,), (0.0,)),))
    x_label, y_label = (
        node
        for node in ET.fromstring(render_svg(plot)).iter(f"{NAMESPACE}text")
        if "of" in "".join(node.itertext()) or "and" in "".join(node.itertext())
    )
    assert "".join(x_label.itertext()) == "KII of a_run, ug"
    assert "".join(y_label.itertext()) == "K_I.csv and En"
    index, subscript = x_label.iter(f"{NAMESPACE}tspan")
    assert (index.text, subscript.text) == ("II", " of a_run, ug")
    assert float(index.get("dy")) == -float(subscript.get("dy")) > 0.0
    assert float(index.get("font-size")) < 9.0


def test_missing_glyphs_and_control_characters_in_text():
    name = "加速度計\x01\u202e\n"
    text = render_svg(Bars(name, (name,), (1.0,), ("1 %",)))
    assert not re.search("[\x01\u202e]", text)
    assert r"加速度計\x01\u202e\n" in svg_texts(text)
    assert ET.fromstring(text)[0].text == r"加速度計\x01\u202e\n"


# Curves


def test_line_keeps_proportions():
    (line,) = paths(render_svg(LINE), "series-1")
    (x0, y0), (x1, y1), (x2, y2) = line
    assert x1 - x0 == pytest.approx(x2 - x1, abs=1e-4)
    # Heights 1, 3, 2; the y axis of SVG points down.
    assert (y2 - y1) / (y0 - y1) == pytest.approx(0.5, abs=1e-4)


def test_gap_breaks_line_and_isolated_value_is_visible():
    values = (1.0, 2.0, None, 3.0, None, 1.0, 2.0)
    plot = Plot("", "x", "y", (PlotSeries("", tuple(map(float, range(7))), values),))
    text = render_svg(plot)
    strokes = [
        p for p in ET.fromstring(text).iter(f"{NAMESPACE}path") if "0072b2" in str(p.attrib).lower()
    ]
    line, dot = sorted(strokes, key=lambda path: -len(path.get("d")))
    assert line.get("d").count("L") == 2
    assert "stroke-linecap: round" in dot.get("style")
    (start, end) = number_pairs(dot.get("d"))
    assert start == end


def test_error_bars_and_level_are_at_their_values():
    plot = Plot(
        "",
        "run",
        "K_II",
        (PlotSeries("", (0.0, 1.0), (5.0, 6.0), (4.0, 3.0), (6.0, 9.0), kind="points"),),
        levels=(4.0,),
        x_names=("run1", "run2"),
    )
    text = render_svg(plot)
    bars = [bar for bar in paths(text, "series-1") if len(bar) == 2]
    (low1, high1), (low2, high2) = [[y for _, y in bar] for bar in bars]
    assert (low2 - high2) / (low1 - high1) == pytest.approx(3.0, abs=1e-4)
    (level,) = [path for path in paths(text, "muted") if len(path) == 2]
    assert level[0][1] == pytest.approx(low1, abs=1e-4)
    assert {"run1", "run2"} <= set(svg_texts(text))


def test_points_at_same_integer_are_offset():
    def point_series(height, **kind):
        return PlotSeries("", (1.0, 3.0), (height, height), (0.0, 0.0), (9.0, 9.0), **kind)

    plot = Plot(
        "", "harmonic", "ppm", (point_series(5.0, kind="points"), point_series(6.0, kind="points"))
    )
    text = render_svg(plot)
    ticks = [word for word in svg_texts(text) if word in "0123456"]
    assert ticks[:3] == ["1", "2", "3"]
    first, second = (
        [bar[0][0] for bar in paths(text, colour) if len(bar) == 2]
        for colour in ("series-1", "series-2")
    )
    # Two axis steps between 1 and 3; 0.12 of a step between the series.
    step = 0.5 * (first[1] - first[0])
    assert second[0] - first[0] == pytest.approx(0.12 * step, rel=1e-4)
    assert second[1] - second[0] == pytest.approx(2.0 * step, rel=1e-4)


def test_logarithmic_axes():
    plot = Plot(
        "",
        "f",
        "p",
        (
            PlotSeries("", (1e-6, 1e-3, 1.0), (1.0, 1e4, -1.0)),
            PlotSeries("", (1.0, 2.0), (1.0, 1e8)),
        ),
        log_x=True,
        log_y=True,
    )
    text = render_svg(plot)
    assert {"10⁻⁶", "1", "10⁸"} <= set(svg_texts(text))
    # A value that is not positive has no logarithm and becomes a gap.
    (line,) = paths(text, "series-1")
    assert len(line) == 2


def test_empty_data_draws_empty_plot():
    for y in ((None, None), (math.nan, math.inf)):
        assert render_svg(Plot("", "x", "y", (PlotSeries("a", (0.0, 1.0), y),), log_y=True))
    assert render_svg(Plot("", "x", "y", ()))
    assert render_svg(Bars("", (), (), ()))
    assert render_svg(HeatMap("", (), ()))
    assert render_svg(Sphere("", ("X", "Y", "Z"), (), (), (), ""))


def test_many_names_are_vertical():
    names = tuple(f"2024-03-{day:02d} fast" for day in range(1, 25))
    text = render_svg(
        Plot(
            "", "", "y", (PlotSeries("", tuple(map(float, range(24))), (1.0,) * 24),), x_names=names
        )
    )
    upright = re.findall(r'rotate\(-90\)"[^>]*>([^<]*)<', text)
    assert set(names) <= set(upright)


def test_columns_are_adjacent_with_height_of_values():
    plot = Plot("", "z", "n", (PlotSeries("", (0.5, 1.5, 2.5), (1.0, 3.0, 2.0), kind="columns"),))
    columns = paths(render_svg(plot), "series-1", kind="fill")
    heights = [max(y for _, y in column) - min(y for _, y in column) for column in columns]
    assert heights[1] / heights[0] == pytest.approx(3.0, rel=1e-3)
    assert heights[2] / heights[0] == pytest.approx(2.0, rel=1e-3)
    ends = [(min(x for x, _ in column), max(x for x, _ in column)) for column in columns]
    assert ends[0][1] == pytest.approx(ends[1][0], abs=1e-3)
    assert ends[1][1] == pytest.approx(ends[2][0], abs=1e-3)


def test_series_share_assigned_colour():
    both = (
        PlotSeries("", (0.0, 1.0), (0.0, 1.0), colour=2),
        PlotSeries("", (0.0, 1.0), (1.0, 1.0)),
        PlotSeries("", (0.0, 1.0), (1.0, 0.0), colour=2),
    )
    text = render_svg(Plot("", "x", "y", both))
    assert len(paths(text, "series-3")) == 2
    assert len(paths(text, "series-1")) == 1


def test_axis_limits_are_applied():
    line = PlotSeries("", (0.0, 1.0), (0.0, 1.0))
    wide, narrow = (
        render_svg(Plot("", "x", "y", (line,), x_range=(0.0, end), y_range=(0.0, 1.0)))
        for end in (2.0, 1.0)
    )
    ((a0, _), (a1, _)), ((b0, _), (b1, _)) = (paths(text, "series-1")[0] for text in (wide, narrow))
    assert b1 - b0 == pytest.approx(2.0 * (a1 - a0), rel=1e-4)


def day_numbers(*dates):
    return tuple(np.array(dates, dtype="datetime64[D]").astype(float))


def month_names(first, count):
    return [str(month) for month in np.datetime64(first, "M") + np.arange(count)]


@pytest.mark.parametrize(
    ("low", "high", "names"),
    [
        ("2018-02-03", "2026-07-01", [str(year) for year in range(2019, 2027)]),
        ("2004-12-31", "2026-07-01", [str(year) for year in range(2006, 2027, 2)]),
        ("2025-08-30", "2026-03-02", month_names("2025-09", 7)),
        ("2024-03-04", "2024-03-07", [f"2024-03-0{day}" for day in (4, 5, 6, 7)]),
    ],
)
def test_date_ticks_are_at_start_of_date(low, high, names):
    places, shown = date_ticks(*day_numbers(low, high))
    assert shown == names
    assert places == np.array(shown, dtype="datetime64[D]").astype(float).tolist()


@pytest.mark.parametrize("years", [0.01, 0.1, 0.5, 1.0, 2.0, 5.0, 14.0, 40.0, 300.0])
def test_date_ticks_fit_axis_of_any_length(years):
    low = day_numbers("2019-05-06")[0]
    places, _ = date_ticks(low, low + 365.25 * years)
    assert 2 <= len(places) <= 15
    assert low <= min(places) < max(places) <= low + 365.25 * years


def test_last_date_label_is_not_clipped():
    first, last = day_numbers("2025-10-01", "2026-03-01")
    # The axis ends 1 % of its length after the last point.
    line = PlotSeries("", (first, last), (1.0, 2.0), kind="points")
    with drawing_parameters(PAPER_COLOURS):
        figure = draw_pictures(
            [Plot("", "date", "", (line,), is_date_axis=True)], PAPER_COLOURS, show_titles=True
        )
        figure.canvas.draw()
    texts = [text for text in figure.findobj(Text) if text.get_text() == "2026-03"]
    end = max(text.get_window_extent().x1 for text in texts)
    # The label is centred near the end of the axis.
    assert figure.axes[0].get_window_extent().x1 < end <= figure.bbox.x1


# Files


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["svg", "png", "pdf"])
def test_figure_file_is_reproducible(ending, tmp_path):
    files = [tmp_path / f"{name}.{ending}" for name in "ab"]
    for file in files:
        save_figure(PICTURES, file)
    assert files[0].read_bytes() == files[1].read_bytes()
    assert sorted(tmp_path.iterdir()) == files


def test_figure_file_has_titles_and_shared_axis(tmp_path):
    line = PlotSeries("", (0.0, 1.0), (0.0, 1.0))
    plots = [Plot(f"part {n}, ug/g", "time, s", "y", (line,), x_range=(0.0, 1.0)) for n in "ab"]
    save_figure(plots, tmp_path / "file.svg")
    text = (tmp_path / "file.svg").read_text("utf-8")
    actual_svg_texts = svg_texts(text)
    assert [word for word in actual_svg_texts if word.startswith("part")] == [
        "part a, µg/g",
        "part b, µg/g",
    ]
    assert actual_svg_texts.count("time, s") == 1
    assert actual_svg_texts.count("0.2") == 3  # twice along y, once along x
    assert "<dc:date>" not in text
    assert "var(" not in text


def test_rejects_unknown_file_ending(tmp_path):
    with raises("wrong-file-ending", "figure.gif:", ".svg, .png"):
        save_figure(PICTURES, tmp_path / "figure.gif")
    assert list(tmp_path.iterdir()) == []


def test_only_earlier_figure_is_overwritten_on_request(tmp_path):
    file, foreign = tmp_path / "figure.svg", tmp_path / "own.svg"
    save_figure(PICTURES, file)
    with pytest.raises(CounterspinError, match=r"figure\.svg already exists; .*overwrite=True"):
        save_figure(PICTURES[:1], file)
    before = file.read_bytes()
    save_figure(PICTURES[:1], file, overwrite=True)
    assert file.read_bytes() != before
    foreign.write_text("<svg>drawn by hand</svg>")
    for overwrite in (False, True):
        with raises("file-exists", "own.svg", "figure"):
            save_figure(PICTURES, foreign, overwrite=overwrite)
    assert foreign.read_text() == "<svg>drawn by hand</svg>"


def test_failed_write_leaves_no_file(tmp_path, monkeypatch):
    def raise_no_space(_, part, **__):
        part.write_text("half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", raise_no_space)
    with pytest.raises(CounterspinError, match="No space left on device"):
        save_figure(PICTURES, tmp_path / "figure.svg")
    assert list(tmp_path.iterdir()) == []


def test_user_rcparams_are_unchanged(tmp_path):
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    save_figure(PICTURES, tmp_path / "figure.png")
    assert dict(mpl.rcParams) == before


def test_matplotlib_is_imported_only_for_drawing():
    code = "import sys, counterspin.reports.charts; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# Many points


@pytest.mark.parametrize("kind", ["points", "line"])
def test_thinning_keeps_outliers(kind):
    rng = np.random.default_rng(11)
    y = rng.normal(size=200_000)
    y[[5, 123_456, 199_990]] = [9.0, -8.0, 7.5]
    x = np.linspace(0.0, 1e4, y.size)
    seen_x, seen_y, _, _ = thin_series(
        PlotSeries("", tuple(x), tuple(y), kind=kind), log_x=False, log_y=False
    )
    assert seen_x.size < 3000
    assert {9.0, -8.0, 7.5} <= set(seen_y)
    assert (np.diff(seen_x) > 0.0).all()
    # Each hundredth of the axis keeps its extremes.
    for part in np.array_split(np.arange(y.size), 100):
        there = (seen_x >= x[part[0]]) & (seen_x <= x[part[-1]])
        assert seen_y[there].max() >= np.sort(y[part])[-2]
    if kind == "points":
        # Not only the extremes: half of a normal distribution lies within 0.674 of its mean.
        assert np.mean(np.abs(seen_y) < 0.674) > 0.2


def test_thinning_keeps_gaps():
    y = [math.sin(0.01 * i) for i in range(5000)]
    y[2000:3000] = [None] * 1000
    seen_x, seen_y, _, _ = thin_series(
        PlotSeries("", tuple(map(float, range(5000))), tuple(y)), log_x=False, log_y=False
    )
    before, after = seen_x[seen_x < 2000.0][-1], seen_x[seen_x >= 3000.0][0]
    between = (seen_x > before) & (seen_x < after)
    assert between.any()
    assert np.isnan(seen_y[between]).all()


def test_svg_of_long_record_is_small():
    n = 100_000
    y = tuple(np.random.default_rng(5).normal(size=n))
    text = render_svg(
        Plot("", "t", "y", (PlotSeries("", tuple(map(float, range(n))), y, kind="points"),))
    )
    assert len(text) < 150_000


# Bars and heat map


def test_bar_lengths_match_values_and_labels_fit():
    text = render_svg(Bars("", ("first", "second"), (40.0, 10.0), ("0.04 ug/g^2, 80 %", "20 %")))
    first, second = [
        [x for x, _ in bar] for bar in paths(text, "series-1", kind="fill") if len(bar) >= 4
    ]
    assert (max(first) - min(first)) / (max(second) - min(second)) == pytest.approx(4.0, rel=1e-3)
    ends = {
        node.text: float(node.get("x")) for node in ET.fromstring(text).iter(f"{NAMESPACE}text")
    }
    assert max(first) < ends["0.04 ug/g^2, 80 %"]
    assert ends["0.04 ug/g^2, 80 %"] + text_width("0.04 ug/g^2, 80 %") <= 504.0


def test_stacked_bars_are_contiguous():
    bars = Bars("", ("first", "second"), (40.0, 10.0), ("a", "b"), stacked=True, colours=(0, 2))
    with drawing_parameters(PAPER_COLOURS):
        figure = draw_pictures([bars], PAPER_COLOURS, show_titles=False)
    first, second = figure.axes[0].patches
    assert (first.get_x(), first.get_width()) == (0.0, 40.0)
    assert (second.get_x(), second.get_width()) == (40.0, 10.0)
    assert first.get_facecolor() != second.get_facecolor()


def test_long_names_are_shortened():
    name = "considered: platform.g_sensitivity.zx of the second spindle"
    for room in (40.0, 100.0, 200.0):
        short = shorten_text(name, room)
        assert short.endswith("…")
        assert room - 15.0 < text_width(short) <= room
    assert shorten_text(name, 1e3) == name


def test_long_bar_labels_are_wrapped():
    name = "encoder error, four times a revolution, encoder.harmonic.4.cos (stated)"
    for room in (130.0, 226.0):
        lines = wrap_text(name, room).split("\n")
        assert " ".join(lines) == name
        assert max(map(text_width, lines)) <= room
        # A line ends only where the next word would not fit.
        for line, below in itertools.pairwise(lines):
            assert text_width(f"{line} {below.split()[0]}") > room
    assert wrap_text(name, 1e3) == name


def test_title_that_fits_is_not_shortened():
    title = "What the square of u of K_II of the first accelerometer consists of, in all"
    bars = Bars(title, ("w" * 30,), (1.0,), ("1",))
    with drawing_parameters(PAPER_COLOURS):
        figure = draw_pictures(
            [bars, replace(bars, title="short")], PAPER_COLOURS, show_titles=True
        )
        figure.set_dpi(160)  # as PNG is written
        figure.canvas.draw()
    below = figure.axes[1].get_window_extent()
    ends = {text.get_text(): text.get_window_extent() for text in figure.findobj(Text)}
    assert ends[title].x0 < below.x0 - 10.0
    assert ends[title].x1 <= figure.bbox.x1
    assert ends["short"].x0 == pytest.approx(below.x0, abs=2.0)


def luminance(rgb):
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


def rgb(colour):
    return np.array([int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])


@pytest.mark.parametrize(("value", "colour"), [(-0.9999, "negative"), (0.9999, "positive")])
def test_heat_map_numbers_have_sufficient_contrast(value, colour):
    text = render_svg(HeatMap("", ("a", "b"), ((1.0, value), (value, 1.0))))
    assert f"{value:.2f}".replace("-", "−") in svg_texts(text)
    cells = re.findall(rf"fill: {PAPER_COLOURS[colour]}; fill-opacity: ([\d.]+)", text)
    assert len(cells) == 2
    opacity = float(cells[0])
    ground = opacity * rgb(PAPER_COLOURS[colour]) + (1.0 - opacity) * np.ones(3)
    lighter, darker = luminance(ground) + 0.05, luminance(rgb(PAPER_COLOURS["ink"])) + 0.05
    assert lighter / darker >= 4.5


def test_zero_after_rounding_has_no_sign():
    text = render_svg(HeatMap("", ("a", "b"), ((1.0, -0.004), (-0.006, 1.0))))
    assert {"0.00", "−0.01"} <= set(svg_texts(text))


def test_heat_map_opacity_is_proportional_to_value():
    text = render_svg(HeatMap("", ("a", "b"), ((1.0, 0.25), (0.5, 1.0))))
    opacity = [float(o) for o in re.findall(r"fill-opacity: ([\d.]+)", text)]
    assert max(opacity) == pytest.approx(2.0 * min(opacity))
