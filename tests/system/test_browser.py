"""The page of a result in a real browser, without a network: pictures, blink, stretch, keys."""

import re
from pathlib import Path

import numpy as np
import pytest
from browsers import wait_for
from result_views import make_view

from lnocl.plotting.report import make_report

PAGES = sorted((Path(__file__).parents[2] / "docs" / "start" / "look").glob("*.html"))

pytestmark = pytest.mark.system
pytest.importorskip("matplotlib")


@pytest.fixture
def page(browser, tmp_path):
    """Open the page of a view with two images and a star; return the browser."""
    view = make_view(p=2)
    y, x = np.indices(view.extended.shape)
    bright = 4000.0 * np.exp(-((x - 10) ** 2 + (y - 20) ** 2) / 8.0)
    view.models[:] += bright
    view.images[:] = view.models + np.sqrt(view.models) * view.residuals
    path = tmp_path / "report.html"
    path.write_text(make_report(view, "a jet", ["the model fits"]))
    browser.get(path.as_uri())
    wait_for(browser, lambda: layer(browser) == "image")
    return browser


def layer(browser):
    return browser.execute_script("return document.getElementById('canvas').dataset.layer")


def picture(browser):
    return browser.execute_script("return document.getElementById('canvas').toDataURL()")


def colour(browser, x, y):
    """Return the colour at a pixel of the frame of 70 by 60, shown 640 wide."""
    script = (
        "return Array.from(document.getElementById('canvas').getContext('2d')"
        ".getImageData(arguments[0], arguments[1], 1, 1).data.slice(0, 3))"
    )
    scale = 640 / 70
    return browser.execute_script(script, int((x + 0.5) * scale), int((60 - y - 0.5) * scale))


def choose(browser, name, text):
    from selenium.webdriver.support.ui import Select

    Select(browser.find_element("id", name)).select_by_visible_text(text)


def test_it_loads_without_a_fault_and_asks_for_no_file(page):
    assert page.title == "a jet"
    assert page.get_log("browser") == []
    entries = "return performance.getEntriesByType('resource').map((each) => each.name)"
    assert all(name.startswith("data:") for name in page.execute_script(entries))
    assert "the model fits" in page.find_element("tag name", "body").text


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_the_pages_in_docs_are_shown(path, browser):
    assert path.stat().st_size < 3e6
    browser.get_log("browser")
    browser.get(path.as_uri())
    wait_for(browser, lambda: layer(browser) == "image")
    browser.find_element("tag name", "body").send_keys("4")
    wait_for(browser, lambda: layer(browser) == "extended source")
    assert browser.get_log("browser") == []


def test_each_button_shows_its_picture(page):
    shown = {}
    for button in page.find_elements("css selector", "#layers button"):
        button.click()
        wait_for(page, lambda name=button.text: layer(page) == name)
        shown[button.text] = picture(page)
        assert button.get_attribute("aria-pressed") == "true"
    assert list(shown) == ["image", "model", "residuals", "extended source"]
    assert len(set(shown.values())) == 4


def test_the_star_is_where_it_should_be(page):
    page.find_element("id", "marks").click()
    choose(page, "stretch", "linear")
    wait_for(page, lambda: colour(page, 10, 20)[0] > 150)  # the yellow end of the palette
    assert colour(page, 60, 50)[0] < 100


def test_the_stretch_changes_the_picture_as_it_should(page):
    brightness = []
    script = "return document.getElementById('canvas').dataset.stretch"
    for name in ("linear", "square root", "asinh", "logarithm"):
        choose(page, "stretch", name)
        wait_for(page, lambda name=name: page.execute_script(script) == name)
        brightness.append(colour(page, 14, 20)[1])  # green grows along the palette
    assert brightness == sorted(brightness)
    assert len(set(brightness)) == 4


def test_it_blinks_by_button_and_by_key(page):
    from selenium.webdriver.common.keys import Keys

    seen = []

    def look():
        if layer(page) not in seen:
            seen.append(layer(page))
        return len(seen) == 4

    page.find_element("id", "blink").click()
    wait_for(page, look)
    assert seen == ["image", "model", "residuals", "extended source"]
    body = page.find_element("tag name", "body")
    page.execute_script("document.activeElement.blur()")
    body.send_keys(Keys.SPACE)
    assert page.find_element("id", "blink").get_attribute("aria-pressed") == "false"
    body.send_keys("3")
    wait_for(page, lambda: layer(page) == "residuals")


def test_regions_and_images_are_chosen(page):
    before = picture(page)
    other = {"1 of 2": "2 of 2", "2 of 2": "1 of 2"}
    first = page.execute_script("return document.getElementById('image').selectedOptions[0].text")
    choose(page, "image", other[first])
    wait_for(page, lambda: picture(page) != before)
    before = picture(page)
    choose(page, "region", "star 1")
    wait_for(page, lambda: picture(page) != before)


def test_the_value_under_the_pointer_is_said(page):
    from selenium.webdriver import ActionChains

    page.find_element("id", "marks").click()
    canvas = page.find_element("id", "canvas")
    scale = canvas.size["width"] / 70
    right, down = (10 - 34.5) * scale, (29.5 - 20) * scale  # from the middle
    ActionChains(page).move_to_element_with_offset(canvas, int(right), int(down)).perform()
    wait_for(page, lambda: page.find_element("id", "value").text != "")
    said = re.fullmatch(r"\((\d+), (\d+)\): (\S+) electron", page.find_element("id", "value").text)
    assert (said[1], said[2]) == ("10", "20")
    assert float(said[3]) == pytest.approx(4050, rel=0.1)
