import json
import re
from datetime import datetime, timedelta, timezone
from itertools import pairwise

import lxml.html
import pytest
from pages import NASTY, make_blocks, make_residual_plot, render_page

from counterspin.reports.blocks import (
    Column,
    Heading,
    HeatMap,
    Paragraph,
    Picture,
    Plot,
    PlotSeries,
    Table,
)
from counterspin.reports.charts import is_zoomable, plot_json, render_svg
from counterspin.reports.html import (
    _read_asset,
    _set_equation,
    render_fragment,
    render_notebook_cell,
)


def parse_html(text):
    return lxml.html.document_fromstring(text)


def element_text(element):
    return " ".join(element.text_content().split())


@pytest.fixture(scope="module", params=["Qx", NASTY], ids=["plain", "nasty"])
def name(request):
    return request.param


@pytest.fixture(scope="module")
def text(name):
    return render_page(name)


@pytest.fixture(scope="module")
def tree(text):
    return parse_html(text)


# Content


def test_blocks_appear_once_and_in_order(tree, name):
    body = element_text(tree.body)
    places = [0]
    for block in make_blocks(name):
        match block:
            case Heading(text, _):
                hs = [
                    h
                    for h in tree.xpath("//h1|//h2|//h3")
                    if element_text(h) == " ".join(text.split())
                ]
                assert len(hs) == 1
            case Paragraph(text, "equation"):
                [equation] = tree.xpath("//p[@class='equation']")
                assert element_text(equation).replace("_", "") == text.replace("_", "")
            case Paragraph(text, _):
                at = body.index(" ".join(text.split()))
                assert at > places[-1]
                places.append(at)
            case _:
                continue


def test_headings_are_nested_below_title(tree):
    levels = [int(h.tag[1]) for h in tree.xpath("//h1|//h2|//h3")]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))


def test_answer_precedes_warnings_and_contents(tree):
    kinds = tree.xpath(
        "//main//*[self::h1 or self::p or self::nav]/@class|//main//nav/@aria-labelledby"
    )
    assert kinds[:4] == ["answer", "warning", "quiet", "contents"]
    [answer] = tree.xpath("//p[@class='answer']")
    assert element_text(answer.find("strong")).endswith("= 27.04 ± 0.11 ug/g^2")
    assert element_text(answer.find("span")) == "= 2.7e-5 g/g^2 (95 %: a to b)"


def test_contents_link_to_chapters(tree, name):
    links = {element_text(a): a.get("href") for a in tree.xpath("//nav//a")}
    chapters = [
        block.text for block in make_blocks(name) if isinstance(block, Heading) and block.level == 2
    ]
    assert list(links) == [" ".join(chapter.split()) for chapter in chapters]
    for chapter, href in links.items():
        [target] = tree.xpath(f"//*[@id='{href.removeprefix('#')}']")
        assert element_text(target) == chapter


def test_table_headers_have_scope(tree, name):
    [table] = tree.xpath("//table")
    blocks = next(block for block in make_blocks(name) if isinstance(block, Table))
    assert [element_text(th) for th in table.xpath("thead//th[@scope='col']")] == [
        "Symbol",
        "Words",
        "Value",
    ]
    rows = table.xpath("tbody/tr")
    assert [tuple(cell.text_content() for cell in row) for row in rows] == list(blocks.rows)
    assert [row.get("class") for row in rows] == [None, "quiet", None]
    assert all(row[0].tag == "th" and row[0].get("scope") == "row" for row in rows)
    assert table.xpath("tbody/tr/td[2]/@class") == ["right"] * 3
    [box] = table.xpath("..")
    assert box.get("class") == "scroll"
    assert box.get("tabindex") == "0"
    assert element_text(table.xpath("preceding::h2[1]")[0]) in " ".join(
        box.get("aria-label").split()
    )


def test_answer_with_reservations_has_separate_class():
    paragraphs = [Paragraph("a", "answer"), Paragraph("b", "reserved"), Paragraph("c", "reserved")]
    for text in (
        render_page(page_blocks=paragraphs),
        render_fragment(paragraphs, title="T"),
        render_notebook_cell(paragraphs),
    ):
        boxes = parse_html(text).xpath("//div[starts-with(@class, 'answers')]")
        assert [(box.get("class"), len(box)) for box in boxes] == [
            ("answers", 1),
            ("answers reserved", 2),
        ]
    for style in ("report.css", "cell.css"):
        assert ".answers.reserved {" in _read_asset(style)


def test_plots_have_caption_and_static_image(tree, name):
    pictures = [block for block in make_blocks(name) if isinstance(block, Picture)]
    figures = tree.xpath("//figure")
    captions = [figure.find("figcaption").text_content() for figure in figures]
    assert captions == [picture.title for picture in pictures]
    for figure, picture in zip(figures, pictures, strict=True):
        [still] = figure.xpath("div[@class='still']/svg")
        assert still.get("role") == "img"
        assert len(figure.xpath("script")) == (isinstance(picture, Plot) and picture.zoom)


def test_page_has_identifier_date_and_end(tree, name):
    assert element_text(tree.xpath("//header")[0]).startswith(" ".join(f"LAB 7/26 {name}".split()))
    assert tree.xpath("//header/time/@datetime") == ["2026-03-01T00:00:00+00:00"]
    assert element_text(tree.xpath("//footer")[0]).startswith("End of LAB 7/26")
    assert tree.find("head/title").text == f"Calibration of {name}"


def test_title_is_heading_of_report_without_heading():
    tree = parse_html(render_page(page_blocks=[Paragraph("a")], title="T"))
    assert [element_text(h) for h in tree.xpath("//h1")] == ["T"]
    assert not tree.xpath("//nav")


def test_date_is_in_utc():
    there = datetime(2026, 3, 1, 1, 30, tzinfo=timezone(timedelta(hours=2)))
    assert "2026-02-28 23:30 UTC" in render_page(date=there)


def test_equations_have_subscripts_and_code_has_none(tree):
    [equation] = tree.xpath("//p[@class='equation']")
    assert equation.xpath("sub/text()") == ["ind", "F", "II", "I"]
    turned = _set_equation("K_I a_I + delta_O a_P")
    assert "δ<sub><i>_</i>O</sub> a<sub><i>_</i>P</sub>" in turned


# Injection


def test_hostile_text_is_escaped(tree, text):
    assert all(
        script.get("type") in (None, "application/json") for script in tree.xpath("//script")
    )
    # Two scripts, and one for each plot that can be zoomed.
    assert len(tree.xpath("//script[not(@type)]")) == 2
    assert len(tree.xpath("//script[@type]")) == 2
    assert len(tree.xpath("//style")) == 1
    assert not tree.xpath("//@*[starts-with(name(), 'on')]")
    assert "alert(" not in "".join(tree.xpath("//script[not(@type)]/text()|//style/text()"))


def test_control_characters_in_names_are_escaped():
    hostile, shown = "Qx\x1b\u202e\nK_II = 1", r"Qx\x1b\u202e\nK_II = 1"
    series = (PlotSeries(hostile, (0.0, 1.0), (0.0, 1.0)),)
    report_blocks = [
        *(Heading(hostile, 2), Paragraph(hostile), Paragraph(hostile, "answer")),
        Table((Column(hostile),), ((hostile,),)),
        Plot(hostile, hostile, hostile, series, zoom=True),
        HeatMap(hostile, (hostile,), ((1.0,),)),
    ]
    for text in (
        render_page(page_blocks=report_blocks, title=hostile, identifier=hostile),
        render_fragment(report_blocks, title=hostile),
    ):
        assert not re.search("[\x1b\u202e]|^K_II", text, re.M)
        seen = parse_html(text).text_content()
        assert seen.count(shown) >= 7
        assert not re.search("[\x1b\u202e]|^K_II", seen, re.M)


def test_page_makes_no_external_request(tree, text):
    for attribute in ("href", "src", "srcset", "action", "data", "poster", "xlink:href"):
        for element in tree.xpath(f"//@*[name() = '{attribute}']"):
            assert re.match(r"#|data:,$", element), (attribute, element)
    assert not tree.xpath(
        "//iframe|//object|//embed|//base|//img|//form|//*[@http-equiv='refresh']"
    )
    assert "@import" not in text
    assert all(match.startswith("#") for match in re.findall(r"url\(\s*[\"']?([^)]*)", text))
    # Namespace names and the address in the uPlot licence are not requests.
    addresses = set(re.findall(r"(?:https?:|wss?:)?//[\w.-]+\.[a-z]{2,}[^\s\"')]*", text))
    assert addresses <= {
        "http://www.w3.org/2000/svg",
        "http://www.w3.org/1999/xlink",
        "https://github.com/leeoniya/uPlot",
    }


def test_content_security_policy_allows_only_inline_content(tree):
    [policy] = tree.xpath("//meta[@http-equiv='Content-Security-Policy']/@content")
    allowed = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert allowed == {
        "default-src": "'none'",
        "style-src": "'unsafe-inline'",
        "script-src": "'unsafe-inline'",
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    # The policy applies only to later elements.
    assert tree.xpath("//head/*")[1].get("http-equiv") == "Content-Security-Policy"


def test_ids_are_unique_and_references_resolve(tree, text):
    ids = tree.xpath("//@id")
    assert len(ids) == len(set(ids))
    named = set(re.findall(r"(?:href=\"#|url\(#|aria-labelledby=\")([^\")]+)", text))
    assert named <= set(ids)


def test_option_names_are_not_broken():
    command = "counterspin calibrate a-b --json x --overwrite"
    text = render_fragment([Paragraph(command, "command")], title="")
    whole = re.findall(r'<span class="whole">(.*?)</span>', text)
    assert whole == ["--json", "--overwrite"]
    (code,) = re.findall(r"<code>(.*?)</code>", text)
    assert re.sub("<.*?>", "", code) == command


def test_equal_headings_have_different_ids():
    tree = parse_html(
        render_page(page_blocks=[Heading("A b"), Heading("A: b"), Heading("µ", 3), Heading("²", 3)])
    )
    assert tree.xpath("//h2[position() > 0]/@id|//h3/@id")[1:] == [
        "at-a-b",
        "at-a-b-2",
        "at-part",
        "at-part-2",
    ]


def test_page_is_reproducible(text, name):
    assert render_page(name) == text
    assert render_page(name, identifier="another") != text


# Plots that can be zoomed


def zoom_data(text):
    return [json.loads(element) for element in parse_html(text).xpath("//figure/script/text()")]


def unpack(packed):
    return [None if value is None else value * packed["step"] for value in packed["values"]]


def test_zoom_data_have_screen_resolution(text, name):
    plot = make_residual_plot(label=name)
    first, _ = zoom_data(text)
    assert (first["x_label"], first["y_label"], first["levels"]) == (
        "time, s",
        "residual, mm",
        [0.0],
    )
    assert [series["label"] for series in first["series"]] == [name, "mean", "left out"]
    for record, series in zip(first["series"], plot.series, strict=True):
        for key in ("x", "y", "low", "high"):
            wanted = getattr(series, key)
            if record[key] is None:
                assert wanted is None or (series.kind == "band" and key == "y")
                continue
            known = [value for value in wanted if value is not None]
            spread = max(known) - min(known)
            for unpacked, value in zip(unpack(record[key]), wanted, strict=True):
                assert (unpacked is None) == (value is None)
                assert unpacked is None or abs(unpacked - value) <= 0.5 * spread / 2e4


def test_logarithmic_zoom_data_keep_relative_precision():
    series = PlotSeries("a", (1e-3, 1.2345678e5), (9.87654e-9, 3.0))
    data = json.loads(plot_json(Plot("t", "x", "y", (series,), log_x=True, log_y=True)))
    assert unpack(data["series"][0]["x"]) == [1e-3, 1.235e5]
    assert unpack(data["series"][0]["y"]) == [9.877e-9, 3.0]


def test_non_finite_value_is_a_gap():
    series = PlotSeries("a", (0.0, 1.0, 2.0), (float("nan"), 5.0, float("inf")))
    data = json.loads(plot_json(Plot("t", "x", "y", (series,))))
    assert unpack(data["series"][0]["y"]) == [None, pytest.approx(5.0, rel=1e-4), None]


def test_plot_with_names_or_single_x_has_no_zoom():
    series = (PlotSeries("a", (0.0, 0.0), (1.0, 2.0)),)
    assert not is_zoomable(Plot("t", "x", "y", series, zoom=True))
    two = (PlotSeries("a", (0.0, 1.0), (1.0, 2.0)),)
    assert is_zoomable(Plot("t", "x", "y", two, zoom=True))
    assert not is_zoomable(Plot("t", "x", "y", two, zoom=True, x_names=("p", "q")))
    assert not is_zoomable(Plot("t", "x", "y", two))


def test_zoom_script_is_included_only_if_needed():
    assert "uPlot=function" not in render_page(page_blocks=[Paragraph("a")])
    assert "uPlot=function" in render_page(page_blocks=[make_residual_plot()])
    assert "Copyright (c) 2022 Leon Sorokin" in render_page(page_blocks=[make_residual_plot()])


@pytest.mark.parametrize("kind", ["line", "points", "band"])
def test_zoomed_and_static_plots_have_same_colours(kind):
    x = (0.0, 1.0, 2.0)
    plot = Plot(
        "t",
        "x",
        "y",
        (
            PlotSeries("", x, x, (0.0, 0.5, 1.0), (2.0, 3.0, 4.0), kind="band"),
            *(PlotSeries(f"s{index}", x, x, x, x, kind=kind) for index in range(8)),
            PlotSeries("o", x, x, kind="points", is_highlighted=True),
        ),
    )
    used = {series["colour"] for series in json.loads(plot_json(plot))["series"]}
    drawn = set(re.findall(r"var\((--(?:series-\d|warning))", render_svg(plot, theme="page")))
    assert drawn == used - {"--muted"}


def test_page_of_long_campaign_is_below_3_mb():
    # Traces have at most 1500 chunks, for records of any length.
    plots = [make_residual_plot(f"Residuals of Q{index}, run") for index in range(20)]
    assert len(render_page(page_blocks=plots).encode()) < 3e6


# Colours


def read_palettes():
    style = _read_asset("report.css")
    light = style[style.index(":root {") : style.index("}")]
    return {"light": light, "dark": _read_asset("dark.css")}


def luminance(colour):
    """Return the relative luminance of WCAG 2.1."""
    parts = (int(colour[at : at + 2], 16) / 255.0 for at in (1, 3, 5))
    linear = [
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
    ]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast_ratio(first, second):
    high, low = sorted((luminance(first), luminance(second)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_and_lines_meet_wcag_contrast(theme):
    colours = dict(re.findall(r"(--[\w-]+): (#[0-9a-f]{6});", read_palettes()[theme]))
    grounds = [
        colours[name]
        for name in (
            *("--ground", "--raised"),
            *("--good-ground", "--reserved-ground", "--warning-ground"),
            "--undetermined-ground",
        )
    ]
    # WCAG 2.1: 4.5 for text (1.4.3), 3 for graphics (1.4.11).
    for ground in grounds:
        assert contrast_ratio(colours["--ink"], ground) >= 4.5
        assert contrast_ratio(colours["--muted"], ground) >= 4.5
    assert contrast_ratio(colours["--link"], colours["--ground"]) >= 4.5
    for name in (
        "--warning",
        "--undetermined",
        "--good",
        "--reserved",
        *(f"--series-{index}" for index in range(1, 7)),
    ):
        assert contrast_ratio(colours[name], colours["--ground"]) >= 3.0


def test_palettes_define_same_colours():
    names = {
        theme: set(re.findall(r"(--[\w-]+):", text)) for theme, text in read_palettes().items()
    }
    assert names["light"] == names["dark"]
    used = set(re.findall(r"var\((--[\w-]+)", render_page() + _read_asset("report.js"))) - {
        "--${entry.colour}"
    }
    assert used <= names["light"]
