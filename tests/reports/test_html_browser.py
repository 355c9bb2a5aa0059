"""The HTML report in a browser: Chromium, driven by Playwright, without a network.

Nothing is downloaded; without a browser, these tests are skipped.
"""

import re
from contextlib import contextmanager
from functools import partial
from io import BytesIO

import pytest
from chromium import launch_chromium, needs_chromium, open_context, wait_until
from pages import render_page
from pypdf import PdfReader

from counterspin.reports.blocks import Card, Check, Column, Heading, Paragraph, Share, Table

pytestmark = needs_chromium

PHONE = {"width": 360, "height": 740}
DESK = {"width": 1280, "height": 900}


@pytest.fixture(scope="module")
def browser():
    with launch_chromium() as started:
        yield started


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(render_page(), encoding="utf-8")
    return path


@contextmanager
def open_page(browser, path, **settings):
    """Open a file; yield its tab, its external requests and its errors."""
    context = open_context(browser, **{"viewport": DESK} | settings)
    requests, wrong = [], []

    def handle_route(route):
        if route.request.url == path.as_uri():
            route.continue_()
        else:
            requests.append(route.request.url)
            route.abort()

    context.route("**/*", handle_route)
    tab = context.new_page()
    tab.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.goto(path.as_uri())
    yield tab, requests, wrong
    context.close()


@pytest.fixture
def report_tab(browser, report):
    with open_page(browser, report) as (tab, _, wrong):
        yield tab
        assert wrong == []


def first_plot(tab):
    """Return the first plot that can be zoomed, scrolled into view."""
    figure = tab.locator("figure.zoomed").first
    figure.scroll_into_view_if_needed()
    return figure


def axis_limits(figure):
    """Return the visible axis limits of a plot: x low, x high, y low, y high."""
    return figure.evaluate(
        "f => ['x', 'y'].flatMap(k => [f.chart.scales[k].min, f.chart.scales[k].max])"
    )


def colour_at(figure, x, from_top):
    """Return red, green and blue of a plot at x, a number of pixels below its top."""
    return figure.evaluate(
        """(f, [x, down]) => {
            const { ctx, bbox } = f.chart;
            const at = [f.chart.valToPos(x, "x", true), bbox.top + down];
            return [...ctx.getImageData(...at.map(Math.round), 1, 1).data].slice(0, 3);
        }""",
        [x, from_top],
    )


# External requests


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("viewport", [DESK, PHONE], ids=["desk", "phone"])
def test_page_makes_no_request_and_has_no_error(browser, report, viewport, scheme):
    with open_page(browser, report, viewport=viewport, color_scheme=scheme) as (
        tab,
        requests,
        wrong,
    ):
        tab.get_by_role("button", name="Zoom in").first.click()
        tab.locator("#theme").click()
        tab.emulate_media(media="print")
        assert requests == []
        assert wrong == []


def test_external_request_is_blocked_by_policy(browser, tmp_path):
    image = '<img src="http://example.invalid/a.png">'
    path = tmp_path / "page.html"
    path.write_text(image, encoding="utf-8")
    with open_page(browser, path) as (_, requests, wrong):
        assert requests == ["http://example.invalid/a.png"]
    path.write_text(render_page().replace("<header>", image + "<header>"), encoding="utf-8")
    with open_page(browser, path) as (_, requests, wrong):
        assert requests == []
        assert "Content Security Policy" in wrong[0]


# Colours


def background_colour(tab):
    return tab.evaluate("getComputedStyle(document.documentElement).backgroundColor")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_colour_scheme_follows_system_and_switch(browser, report, scheme):
    with open_page(browser, report, color_scheme=scheme) as (tab, _, _):
        drawing = "document.querySelector('figure.zoomed canvas').toDataURL()"
        before, drawn = background_colour(tab), tab.evaluate(drawing)
        assert (before == "rgb(255, 255, 255)") == (scheme == "light")
        tab.locator("#theme").click()
        assert (background_colour(tab) == "rgb(255, 255, 255)") == (scheme == "dark")
        tab.wait_for_function(f"before => {drawing} !== before", arg=drawn)
        tab.locator("#theme").click()
        assert background_colour(tab) == before
        tab.wait_for_function(f"before => {drawing} === before", arg=drawn)


def test_colour_scheme_follows_system_change(report_tab):
    light = background_colour(report_tab)
    report_tab.emulate_media(color_scheme="dark")
    assert background_colour(report_tab) != light


def test_colour_scheme_persists_after_reload(report_tab):
    light = background_colour(report_tab)
    report_tab.locator("#theme").click()
    dark = background_colour(report_tab)
    report_tab.reload()
    assert light != background_colour(report_tab) == dark
    assert report_tab.locator("#theme").inner_text() == "Light"
    # Without local storage, as in a frame without an origin, the rest works.
    report_tab.add_init_script(
        "Object.defineProperty(window, 'localStorage', {get() { throw Error(); }})"
    )
    report_tab.reload()
    assert background_colour(report_tab) == light
    report_tab.locator("#theme").click()
    assert background_colour(report_tab) == dark
    assert report_tab.locator("figure.zoomed").count()


# A small screen


def test_phone_shows_answer_without_overflow(browser, report):
    settings = {"viewport": PHONE, "has_touch": True, "is_mobile": True}
    with open_page(browser, report, **settings) as (tab, _, _):
        assert tab.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
        box = tab.locator(".answers").bounding_box()
        assert box["y"] + box["height"] < PHONE["height"]
        # Elements wider than the screen are inside scrollable boxes.
        assert (
            tab.evaluate(
                """width => [...document.body.querySelectorAll("*")].filter((element) =>
                element.getBoundingClientRect().right > width
                && !element.closest(".scroll, .still, .u-wrap, .skip")).map((e) => e.outerHTML)""",
                PHONE["width"],
            )
            == []
        )
        assert tab.locator(".uplot").first.bounding_box()["width"] <= PHONE["width"]


def test_plots_follow_window_width(report_tab):
    figure = first_plot(report_tab)
    wide = figure.evaluate("f => f.chart.width")
    report_tab.set_viewport_size(PHONE)
    report_tab.wait_for_function("document.querySelector('figure.zoomed').chart.width < 360")
    report_tab.set_viewport_size(DESK)
    report_tab.wait_for_function(
        "wide => document.querySelector('figure.zoomed').chart.width === wide", arg=wide
    )


# Paper


def test_print_view_is_light_static_and_without_controls(browser, report):
    with open_page(browser, report, color_scheme="dark") as (tab, _, _):
        tab.locator("#theme").click()
        tab.locator("#theme").click()
        assert background_colour(tab) != "rgb(255, 255, 255)"
        tab.emulate_media(media="print")
        assert background_colour(tab) == "rgb(255, 255, 255)"
        assert tab.locator("button:visible").count() == 0
        assert tab.locator("canvas:visible").count() == 0
        figures = tab.locator("figure").count()
        assert tab.locator("figure .still svg:visible").count() == figures


def test_printed_pages_have_identifier_and_number(report_tab):
    printed = PdfReader(BytesIO(report_tab.pdf(prefer_css_page_size=True)))
    count = len(printed.pages)
    assert count > 1
    for number, sheet in enumerate(printed.pages, 1):
        text = " ".join(sheet.extract_text().split())
        assert "LAB 7/26 Qx" in text
        assert f"{number} / {count}" in text


# Zoom


def test_dragging_zooms_and_double_click_resets(report_tab):
    figure = first_plot(report_tab)
    whole = axis_limits(figure)
    assert whole[:2] == [0.0, 749.5]
    box = figure.locator(".u-over").bounding_box()
    left, right = box["x"] + 0.25 * box["width"], box["x"] + 0.5 * box["width"]
    middle = box["y"] + 0.5 * box["height"]
    report_tab.mouse.move(left, middle)
    report_tab.mouse.down()
    report_tab.mouse.move(right, middle, steps=4)
    report_tab.mouse.up()
    report_tab.wait_for_function("document.querySelector('figure.zoomed').chart.scales.x.min > 0")
    low, high, *_ = axis_limits(figure)
    pixel = 749.5 / box["width"]
    assert low == pytest.approx(0.25 * 749.5, abs=2.0 * pixel)
    assert high == pytest.approx(0.5 * 749.5, abs=2.0 * pixel)
    report_tab.mouse.dblclick(left, middle)
    report_tab.wait_for_function("document.querySelector('figure.zoomed').chart.scales.x.min === 0")
    assert axis_limits(figure) == pytest.approx(whole)


def test_keys_and_touch_zoom_and_pan(report_tab):
    figure = first_plot(report_tab)

    def press_key(name, expected=None):
        button = figure.get_by_role("button", name=name)
        button.focus()
        report_tab.keyboard.press("Enter")
        if expected is not None:
            wait_until(report_tab, lambda: axis_limits(figure)[:2] == pytest.approx(expected))

    press_key("Zoom in", [187.375, 562.125])
    press_key("Zoom in", [281.0625, 468.4375])
    press_key("Move right", [327.90625, 515.28125])
    press_key("Move left", [281.0625, 468.4375])
    press_key("Zoom out", [187.375, 562.125])
    # Panning stops at the ends.
    for _ in range(3):
        press_key("Move right")
    press_key("Move right", [374.75, 749.5])
    press_key("Zoom out", [0.0, 749.5])
    press_key("Zoom in")
    press_key("Show all", [0.0, 749.5])


def test_outliers_are_visible_and_do_not_set_axis_range(report_tab):
    figure = first_plot(report_tab)
    warning = [0xB3, 0x26, 0x1E]
    _, _, low, high = axis_limits(figure)
    # The band is from -6 to 6; 12 and -13 widen the axis, 4000 does not.
    assert low == pytest.approx(-13.0 - 0.06 * 25.0, abs=0.1)
    assert high == pytest.approx(12.0 + 0.06 * 25.0, abs=0.1)
    assert colour_at(figure, 600.0, 4) == warning
    figure.evaluate("f => f.chart.setScale('x', { min: 590, max: 610 })")
    report_tab.wait_for_function(
        "document.querySelector('figure.zoomed').chart.scales.x.min === 590"
    )
    assert axis_limits(figure)[3] < 7.0
    assert colour_at(figure, 600.0, 4) == warning
    assert colour_at(figure, 605.0, 4) != warning


def test_cursor_shows_values(report_tab):
    figure = first_plot(report_tab)
    texts = figure.locator(".readout li")
    assert [text.strip() for text in texts.all_inner_texts()] == [
        "time, s: –",
        "Qx: –",
        "mean: –",
        "left out: –",
    ]
    box = figure.locator(".u-over").bounding_box()
    report_tab.mouse.move(box["x"] + 600.0 / 749.5 * box["width"], box["y"] + 20.0)
    report_tab.wait_for_function(
        "!document.querySelector('.readout li:last-child').innerText.endsWith('–')"
    )
    place, band, mean, out = (text.split(": ")[1] for text in texts.all_inner_texts())
    assert float(place) == pytest.approx(600.0, abs=2.0)
    assert re.fullmatch(r"−5\.\d+ to 5\.\d+", band)
    assert abs(float(mean.replace("−", "-"))) <= 1.0
    assert float(out) == 4000.0


# No script


def test_page_is_complete_without_script(browser, report):
    with open_page(browser, report, java_script_enabled=False) as (tab, _, _):
        assert tab.locator(".answer").inner_text().startswith("K_II of Qx = 27.04 ± 0.11 ug/g^2")
        assert tab.locator("td:visible").count() == 6
        assert (
            tab.locator("figure .still svg:visible").count() == tab.locator("figure").count() == 6
        )
        assert tab.locator("button:visible").count() == 0


# Phone


def check_scroll_hints(boxes, expected):
    """Check that exactly these tables show the hint on further columns."""
    marked = "all => all.map(b => getComputedStyle(b, '::after').content.includes('columns'))"
    return boxes.evaluate_all(marked) == expected


def test_wide_table_on_phone_has_hint_and_fixed_row_names(browser, tmp_path):
    path = tmp_path / "report.html"
    columns = (Column("Run"), *(Column(f"Quantity {n}", "right") for n in range(9)))
    wide = Table(columns, (("run1", *(f"{n}.12345" for n in range(9))),))
    narrow = Table((Column("Run"), Column("n")), (("run1", "1"),))
    path.write_text(render_page(page_blocks=[wide, narrow]), encoding="utf-8")
    for viewport, more in ((PHONE, [True, False]), (DESK, [False, False])):
        with open_page(browser, path, viewport=viewport) as (tab, _, wrong):
            boxes = tab.locator(".scroll")
            wait_until(tab, partial(check_scroll_hints, boxes, more))
            if more[0]:
                boxes.first.evaluate("box => { box.scrollLeft = 1e4; }")
                name = boxes.first.locator("tbody th").bounding_box()
                assert 0.0 <= name["x"] < 40.0
            assert wrong == []


def test_symbol_has_subscript_and_is_copied_as_text(report_tab):
    answer = report_tab.locator(".answer").first
    assert answer.inner_text().startswith("K_II of Qx")
    letter, index = answer.evaluate(
        """a => ["strong", "sub"].map(
            name => parseFloat(getComputedStyle(a.querySelector(name)).fontSize))"""
    )
    assert index < letter
    assert answer.locator("sub i").first.evaluate("i => i.getBoundingClientRect().width") == 0


CARD = Card(
    title="Qx",
    detail="",
    state="good",
    state_text="Good",
    symbol="K_II",
    value="27.0 ± 0.5",
    unit="µg/g²",
    remarks=(),
    shares=(Share("noise 90 %", 0.9), Share("others 10 %", 0.1)),
    note="",
    checks=(Check("Fit", "passed", "the residuals are consistent with noise"),),
    paragraphs=(Paragraph("K_II of Qx = 27.0 ± 0.5 µg/g²", "answer"),),
)


def test_chapters_are_tabs_on_screen_and_sequential_in_print(browser, tmp_path):
    blocks = [
        CARD,
        Heading("First"),
        Paragraph("in the first"),
        Heading("Second"),
        Paragraph("in it"),
    ]
    path = tmp_path / "tabs.html"
    path.write_text(render_page(page_blocks=blocks), encoding="utf-8")
    with open_page(browser, path) as (tab, _, wrong):
        second = tab.get_by_text("in it")
        assert tab.get_by_text("in the first").is_visible()
        assert second.is_hidden()
        tab.get_by_role("tab", name="First").press("ArrowRight")
        assert second.is_visible()
        assert tab.get_by_text("in the first").is_hidden()
        # A link to a heading opens its tab.
        tab.evaluate("location.hash = 'at-first'")
        tab.get_by_text("in the first").wait_for()
        tab.emulate_media(media="print")
        assert tab.get_by_text("in the first").is_visible()
        assert second.is_visible()
        assert wrong == []
    with open_page(browser, path, java_script_enabled=False) as (tab, _, _):
        assert tab.get_by_text("in it").is_visible()


def test_table_can_be_copied_and_saved(browser, tmp_path):
    table = Table((Column("Name"), Column("Value, ug")), (("a, b", "−1.5"), ('c"d', "2")))
    path = tmp_path / "table.html"
    path.write_text(render_page(page_blocks=[Heading("Table"), table]), encoding="utf-8")
    with open_page(browser, path, accept_downloads=True) as (tab, _, wrong):
        with tab.expect_download() as saved:
            tab.get_by_role("button", name="CSV").click()
        text = saved.value.path().read_bytes().decode("utf-8-sig")
        assert text == 'Name,"Value, ug"\r\n"a, b",-1.5\r\n"c""d",2\r\n'
        assert wrong == []
