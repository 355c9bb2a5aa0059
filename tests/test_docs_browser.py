"""A built site: no broken link, words for pictures, nothing fetched.

COUNTERSPIN_SITE names its folder, as `make docs-tests` does; else these are skipped.
"""

import os
from pathlib import Path
from urllib.parse import unquote, urlsplit

import lxml.html
import pytest
from chromium import launch_chromium, needs_chromium, open_context

SITE = Path(os.environ.get("COUNTERSPIN_SITE", "no-site")).resolve()
PAGES = sorted(path for path in SITE.rglob("*.html") if "_" not in path.relative_to(SITE).parts[0])

pytestmark = pytest.mark.skipif(
    "COUNTERSPIN_SITE" not in os.environ, reason="no site is built: make docs-tests"
)

PHONE = {"width": 360, "height": 740}


@pytest.fixture(scope="module")
def trees():
    return {page: lxml.html.parse(page).getroot() for page in PAGES}


def test_site_exists():
    assert SITE / "index.html" in PAGES


def test_internal_links_have_existing_targets(trees):
    names = {page.resolve(): set(tree.xpath("//@id | //@name")) for page, tree in trees.items()}
    broken = []
    for page, tree in trees.items():
        for link in tree.xpath("//@href | //@src"):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            place = (page.parent / unquote(parts.path)).resolve() if parts.path else page.resolve()
            known = names.get(place)
            anchor = unquote(parts.fragment)
            if not place.exists() or (anchor and known is not None and anchor not in known):
                broken.append((page.name, link))
    assert broken == []


def test_pictures_have_alternative_text(trees):
    for page, tree in trees.items():
        for picture in tree.xpath("//article//img"):
            words = picture.get("alt", "")
            assert len(words) > 20, (page.name, picture.get("src"), words)


@needs_chromium
def test_site_sends_no_external_request_and_fits_phone():
    requests, wrong, wide = [], [], []
    with launch_chromium() as browser:
        context = open_context(browser, viewport=PHONE, color_scheme="dark")

        def decide(route):
            inside = route.request.url.startswith((SITE.as_uri(), "data:"))
            if not inside:
                requests.append(route.request.url)
            (route.continue_ if inside else route.abort)()

        context.route("**/*", decide)
        tab = context.new_page()
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        for page in PAGES:
            tab.goto(page.as_uri())
            if tab.evaluate("document.documentElement.scrollWidth") > PHONE["width"]:
                wide.append(page.name)
        tab.goto((SITE / "search.html").as_uri() + "?q=two-stage")
        tab.locator("#search-results li a").first.wait_for()
        context.close()
    assert requests == []
    assert wrong == []
    assert wide == []
