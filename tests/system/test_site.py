"""The built site in a real browser, without a network: links, search, gallery, a phone's width."""

from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from urllib.parse import unquote, urldefrag

import pytest
from browsers import wait_for

pytestmark = pytest.mark.system
SITE = Path(__file__).parents[2] / "build" / "site"
PAGES = sorted(
    path.relative_to(SITE)
    for path in SITE.rglob("*.html")
    if path.relative_to(SITE).parts[0] != "_static"  # the templates of the theme
)
PHONE = 400

if not PAGES:
    pytest.skip("the site is not built: sphinx-build docs build/site", allow_module_level=True)


class Reader(HTMLParser):
    """Collects the places that a page refers to, and the anchors that it has."""

    def __init__(self, page):
        super().__init__()
        self.targets, self.anchors = [], set()
        self.feed((SITE / page).read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        """Take the addresses of links and pictures, and the names of elements."""
        given = dict(attrs)
        self.targets += [given[name] for name in ("href", "src") if given.get(name)]
        if "id" in given:
            self.anchors.add(given["id"])


@pytest.fixture(scope="module")
def readers():
    return {page: Reader(page) for page in PAGES}


def test_all_links_inside_the_site_resolve(readers):
    broken = []
    for page, reader in readers.items():
        for target in reader.targets:
            address, anchor = urldefrag(target)
            if "://" in address or address.startswith(("data:", "mailto:")):
                continue
            path = (SITE / page.parent / unquote(address.partition("?")[0])).resolve()
            path = SITE / page if not address else path
            if not path.exists():
                broken.append((str(page), target))
            # The way back from a source knows one name of a module: it leads to the page at least.
            elif anchor and path.suffix == ".html" and page.parts[0] != "_modules":
                there = readers.get(path.relative_to(SITE))
                if there and unquote(anchor) not in there.anchors and "highlight" not in anchor:
                    broken.append((str(page), target))
    assert broken == []


def test_functions_link_their_source(readers):
    targets = readers[Path("reference/made/lnocl.deconvolve.html")].targets
    assert any("_modules/lnocl/deconvolution.html" in target for target in targets)


class Quiet(SimpleHTTPRequestHandler):
    """Serves files without a word."""

    def log_message(self, *_):
        """Say nothing."""


@pytest.fixture(scope="module")
def look(browser):
    """Return what opens a page in a window of some width."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=SITE)) as server:
        Thread(target=server.serve_forever, daemon=True).start()

        def look(page, width=1300):
            browser.set_window_size(width, 900)
            browser.get(f"http://127.0.0.1:{server.server_port}/{page}")

        yield look
        server.shutdown()


# The theme scrolls an article that is too wide, beside the page. Pages that list code run to the
# width that they need in frames of their own.
@pytest.mark.parametrize("width", [PHONE, 1300])
@pytest.mark.parametrize("page", [page for page in PAGES if page.parts[0] != "_modules"], ids=str)
def test_no_page_is_wider_than_the_window(page, width, look, browser):
    look(page, width)
    assert too_wide(browser, "html, .bd-article-container, .prev-next-area a") == []


@pytest.mark.parametrize("page", [page for page in PAGES if page.parts[0] == "start"], ids=str)
def test_no_block_of_getting_started_scrolls(page, look, browser):
    look(page)
    assert too_wide(browser, "pre") == []


def test_a_table_is_as_wide_as_its_rows(look, browser):
    look("comparison.html")
    table, rows = (
        browser.find_element("css selector", f"article {each}") for each in ("table", "tbody")
    )
    assert table.size["width"] <= rows.size["width"] + 2  # its border
    assert table.location["x"] == browser.find_element("tag name", "h1").location["x"]


def test_pictures_of_many_panels_can_be_read_on_a_phone(look, browser):
    look("start/picture.html", PHONE)
    widths = [each.size["width"] for each in browser.find_elements("css selector", "figure img")]
    assert len(widths) == 4
    assert min(widths) > 800
    look("index.html", PHONE)
    assert browser.find_element("css selector", "figure img").size["width"] < PHONE


def too_wide(browser, selector):
    """Return the first words of elements that have to be scrolled sideways."""
    script = (
        "return [...document.querySelectorAll(arguments[0])]"
        ".filter((each) => each.scrollWidth > each.clientWidth + 1)"
        ".map((each) => each.innerText.slice(0, 50))"
    )
    return browser.execute_script(script, selector)


def test_commands_are_copied_without_prompts_and_outputs(look, browser):
    from selenium.webdriver import ActionChains

    look("start/install.html")
    browser.execute_cdp_cmd("Browser.grantPermissions", {"permissions": ["clipboardReadWrite"]})
    wait_for(browser, lambda: browser.find_elements("css selector", "button.copybtn"))
    button = browser.find_element("css selector", ".highlight-console button.copybtn")
    ActionChains(browser).move_to_element(button).click().perform()
    copied = browser.execute_script("return navigator.clipboard.readText()")
    shown = browser.find_element("css selector", ".highlight-console pre").text.splitlines()
    commands = [line[2:] for line in shown if line.startswith("$ ")]
    assert len(shown) > len(commands) > 1
    assert copied.splitlines() == commands
    assert not browser.find_elements("css selector", ".highlight-output button.copybtn")


def test_the_font_of_equations_is_there(look, browser):
    look("theory/model.html")
    loaded = "return document.fonts.load('16px \"STIX Two Math\"').then((found) => found.length)"
    assert browser.execute_script(loaded) == 1


def test_the_search_finds_a_page(look, browser):
    look("search.html?q=checkpoint")
    found = "#search-results li a"
    wait_for(browser, lambda: browser.find_elements("css selector", found))
    links = [each.get_attribute("href") for each in browser.find_elements("css selector", found)]
    assert any("guide/long_runs.html" in each for each in links)


def test_the_gallery_shows_a_picture_for_each_script(look, browser):
    look("gallery/index.html")
    pictures = browser.find_elements("css selector", ".sphx-glr-thumbcontainer img")
    assert len(pictures) >= 10
    loaded = "return arguments[0].complete && arguments[0].naturalWidth > 100"
    assert all(browser.execute_script(loaded, each) for each in pictures)


def test_equations_are_set_without_a_network(look, browser):
    look("theory/model.html")
    wait_for(browser, lambda: browser.find_elements("css selector", "math, .katex, mjx-container"))
